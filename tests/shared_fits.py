"""Priors that several files of tests use: one process of the run fits each, the others read its file."""

import os
from collections.abc import Callable
from pathlib import Path

from tests.priors.poses import recording
from torchpose._core.files import hold
from torchpose.demo import performer
from torchpose.learning._recipes import fit_kinect_prior
from torchpose.priors import UpperBodyPrior


def fitted_once(factory, name: str, fit: Callable[[], UpperBodyPrior]) -> Path:
    """Return the file of a prior that is fitted once in a run of pytest, however many processes it has.

    Args:
        factory: `tmp_path_factory`. name: of the file. fit: makes the prior.
    """
    folder = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent  # of all processes
    path = folder / f"{name}.safetensors"
    with (folder / f"{name}.lock").open("w") as lock:
        hold(lock.fileno(), wait=True)
        if not path.exists():
            fit().save(path)
    return path


def fit_small_windows() -> UpperBodyPrior:
    """A prior with windows as small as it may be, of one person: only the arithmetic is of interest."""
    people = [recording(performer(120, seed=1).body, person="p", fps=30.0)]
    return fit_kinect_prior(
        people, 3, window_components=4, window_samples=1000, n_samples=2000, pose_steps=5
    )
