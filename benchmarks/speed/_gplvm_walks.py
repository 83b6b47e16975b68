"""Errors of held-out trials of CMU walks, reconstructed by manifolds and by principal components."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks._data import data_files
from benchmarks.speed._timing import Report
from torchpose.body import body_joints, fit_body, fit_state
from torchpose.errors import InputError
from torchpose.learning import fit_gplvm, fit_gplvm_noise
from torchpose.learning._manifolds import thin

TRAINED, NOISE = 350, 0.03  # poses of a person; of a column, as particles have it


class Walks(NamedTuple):
    """Poses of one person at 60 Hz, trial by trial: to fit to, to end the fit, and to test on."""

    train: list[Tensor]
    validation: list[Tensor]
    test: Tensor


def held_out_tables(data: Path, persons: Sequence[str], report: Report) -> None:
    """Add the errors of held-out trials, and the standard deviations for the filter."""
    people = {person: read_walks(data, person) for person in persons}
    report.table(("1000 x root mean square", *people, "mean"), held_out_rows(people))
    report.add(
        "Of a column of x - f(g(x)), quaternion vectors, in two trials of each person; two more end the "
        f"fit, and {TRAINED} poses are fitted to. Noisy: g is given the pose plus noise of {NOISE}, as "
        "particles have it."
    )
    rows = []
    for person, walks in people.items():
        manifold = fit_gplvm(thin(walks.train, TRAINED), validation=walks.validation)
        fit_gplvm_noise(manifold, walks.validation, 60.0)
        pose, step = (x.square().mean().sqrt() for x in (manifold.std_pose, manifold.std_step))
        latent = " ".join(f"{value:.3f}" for value in manifold.std_latent.tolist())
        rows.append([person, f"{pose:.4f}", f"{step:.4f}", f"{pose / step:.2f}", latent])
    report.table(("person", "sigma z->x", "sigma x->x", "ratio", "sigma x->z"), rows)
    report.add("Root mean squares over the columns, at 60 Hz, on the trials that end the fit.")


def read_walks(folder: Path, person: str) -> Walks:
    """Return two trials to test on, two to end the fit, and the others to fit to."""
    trials = []
    for file in data_files(folder, f"s{person}_*.npz"):
        with np.load(file) as arrays:
            joints, names = torch.from_numpy(arrays["joints"]).double(), arrays["names"].tolist()
            trials.append(body_joints(joints[:: round(float(arrays["fps"]) / 60)], names))
    if len(trials) < 5:
        raise InputError(
            f"{folder}: expected five trials or more of s{person}, found {len(trials)}"
        )
    body = fit_body(torch.cat(trials[2:]))
    poses = [body.relative(fit_state(body, joints)) for joints in trials]
    return Walks(poses[4:], poses[2:4], torch.cat(poses[:2]))


def held_out_rows(people: dict[str, Walks]) -> list[list[str]]:
    watched, shown = {"validation": True}, {}
    variants: dict[str, dict[str, Any]] = {
        "manifold, in a row, 30 iterations": {"row": True},
        "manifold, in a row, 300 iterations": {"row": True, "steps": 30, "tolerance": 0.0},
        "manifold, in a row, validation": {"row": True} | watched,
        "manifold, spread, validation": watched,
        "the same, one start": {"n_init": 1} | watched,
        "the same, standardised": {"standardise": True} | watched,
        "the same, smoothness 30": {"smoothness": 30.0} | watched,
        "the same, three dimensions": {"latent_dim": 3} | watched,
    }
    for dims in (2, 4):
        errors = [pca_error(torch.cat(walks.train), walks.test, dims) for walks in people.values()]
        shown[f"{dims} principal components"] = errors
    for name, options in variants.items():
        errors, noisy = zip(
            *(errors_of_walks(walks, **options) for walks in people.values()), strict=True
        )
        shown[name] = list(errors)
        if name in ("manifold, spread, validation", "the same, smoothness 30"):
            shown[f"{name}, noisy"] = list(noisy)
    return [
        [name, *(f"{1000 * e:.1f}" for e in (*errors, sum(errors) / len(errors)))]
        for name, errors in shown.items()
    ]


def errors_of_walks(
    walks: Walks, row: bool = False, validation: bool = False, **options: Any
) -> tuple[float, float]:
    """Return the error of the test poses, and that where g is given noisy ones."""
    train = [torch.cat(walks.train)[:TRAINED]] if row else thin(walks.train, TRAINED)
    watched = walks.validation if validation else None
    manifold = fit_gplvm(train, validation=watched, **options)
    noise = torch.randn(walks.test.shape, generator=torch.Generator().manual_seed(0))
    noisy = walks.test - manifold.reconstruct(walks.test + NOISE * noise.double())
    return manifold.reconstruction_error(walks.test), float(noisy.square().mean().sqrt())


def pca_error(train: Tensor, test: Tensor, dims: int) -> float:
    mean = train.mean(0)
    _, _, axes = torch.linalg.svd(train - mean, full_matrices=False)
    back = (test - mean) @ axes[:dims].T @ axes[:dims]
    return float((test - mean - back).square().mean().sqrt())
