"""Priors over arms that leave out a set or some persons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.bones.arm_prior_fit import fit_arm_prior
from benchmarks.bones.views import recordings
from torchpose.priors._arms import ArmPrior

SETS = {
    "kinect_utd_mhad": 0.4,
    "burke_kinect/kinect_joints.npz": 0.12,
    "kinect_laban": 0.08,
    "mocap_berkeley_mhad": 0.25,
    "mocap_cmu_actions": 0.12,
    "mocap_cmu_walk": 0.03,
}
"""Share of each set in the fit of a prior over arms."""


def fit_without(data: Path, left_out: str | None, persons: Sequence[str] = ()) -> ArmPrior:
    """Return the prior over arms that is fitted to all sets but one, and without some persons.

    Args:
        data: folder with the sets. left_out: name of a set, None for none. persons: left out of all
            sets.
    """
    kept = {name: share for name, share in SETS.items() if name != left_out}
    found = [[r for r in recordings(data / name) if r.person not in persons] for name in kept]
    return fit_arm_prior(found, shares=list(kept.values()))


def fit_shipped(data: Path, path: Path) -> None:
    """Fit the prior over arms to all sets, and write it."""
    fitted = fit_without(data, None)
    info = replace(
        fitted.info,
        name="upper-body-arms",
        sources=tuple(name.split("/")[0] for name in SETS),
        licence="MIT; see the card for the recordings",
        command=f"python -m benchmarks.bones --data DIR --fit {path.name}",
    )
    fitted = ArmPrior(
        fitted.directions.rounded(), fitted.lengths, fitted.spread, fitted.broad, info,
        fitted.together.float(),
    )  # fmt: skip
    fitted.save(path)
