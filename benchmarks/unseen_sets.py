"""Arms of persons of a data set that is left out of every fit, beside learned lifters.

Each of four sets in turn is left out of the prior over arms (`bones.SETS`), of the network that lifts arms
(`arm_lifter`), of the tracker's prior (the other Kinect sets; for Berkeley MHAD the one that comes with
torchpose) and of the lifters (`_lifters`). Its
recordings are seen by one camera with 3 px of noise; the error is that of `bones`: the vector from the
shoulder to the wrist (or hand) and to the elbow, camera axes, nothing aligned.

    python -m benchmarks.unseen_sets --data DIR [--out FILE]

Two tables for each set: all joints measured, and neck, hands and head (Berkeley MHAD has no head).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch

import torchpose
from benchmarks import arm_lifter, bones
from benchmarks._command import run_command
from benchmarks._lifters import FEW, LIFTERS, Lifter, fit_lifter
from benchmarks._table_file import TableFile, print_tables
from torchpose.evaluation import Report
from torchpose.learning import fit_kinect_prior
from torchpose.priors import UpperBodyPrior
from torchpose.priors._arm_lifter import ArmLifter, shipped_arm_lifter
from torchpose.priors._arms import ArmPrior, shipped_arm_prior
from torchpose.skeleton._joint_sets import canonical_names

_MHAD = "mocap_berkeley_mhad"
_KINECT = {"kinect_utd_mhad": 24, "burke_kinect/kinect_joints.npz": 1, "kinect_laban": 1}
"""Kinect sets, and one recording of so many that is scored."""
NAMES = (*_KINECT, _MHAD)
"""Sets that are left out in turn."""
_ONE = "burke_kinect/kinect_joints.npz"  # that lifters of a quick run know
_LONGEST, _SHORTEST = 600, 30  # frames of a recording
_LIFT, _HANGING = "lift, others' lengths, own depth", "hanging arms"
_DIGITS = (1, 1, 0, 0)
_COLUMNS = ("wrist (cm)", "elbow (cm)", "inside 50 %", "inside 90 %")
_ROWS = [0, 1, 4, 5]  # of `bones.errors`


class Unseen(NamedTuple):
    """A set that is left out.

    Attributes:
        views: of its recordings. few: keypoints that are measured in the second table.
        prior, arms, network: fitted without it; the network lifts arms. lifters: by name.
    """

    views: Sequence[bones.View]
    few: Sequence[int]
    prior: UpperBodyPrior
    arms: ArmPrior
    network: ArmLifter
    lifters: dict[str, Lifter]


def leave_out(data: Path, name: str, quick: bool, kinds: Sequence[str] = LIFTERS) -> Unseen:
    """Return a set with the priors and the lifters that do not know it.

    Args:
        data: folder with the sets. name: one of `bones.SETS`. quick: few recordings and
            steps, and the priors that come with torchpose. kinds: of lifters.
    """
    arms = shipped_arm_prior() if quick else bones.fit_without(data, name)
    if name == _MHAD:
        views, few = bones.mhad_views(data, 150 if quick else 4), bones.FEW
        views = [bones.begun(view) for view in views] if quick else views
        own = "kinect-upper-body-small" if quick else "kinect-upper-body"
        prior, hand = torchpose.load_prior(own), "wrist"
    else:
        views, few = _kinect_views(data / name, 300 if quick else _KINECT[name]), bones.FOUR
        others = [r for other in _KINECT if other != name for r in bones.recordings(data / other)]
        prior, hand = fit_kinect_prior(others[:: 20 if quick else 1], seed=0, **bones.FIT), "hand"
    known = {other: share for other, share in bones.SETS.items() if other != name}
    known = {_ONE: known[_ONE]} if quick else known
    known = known if kinds or not quick else {}
    sets = [(share, bones.with_arms(bones.recordings(data / o))) for o, share in known.items()]
    network = shipped_arm_lifter() if quick else arm_lifter.fit_network(sets, arms)
    lifters = {kind: fit_lifter(kind, sets, arms, hand, quick) for kind in kinds}
    return Unseen(views, few, prior, arms, network, lifters)


def _kinect_views(path: Path, every: int) -> list[bones.View]:
    """Return recordings of a Kinect set in the test camera of UB-people."""
    joints = [bones.at_rate(r)[:_LONGEST] for r in bones.recordings(path)[::every]]
    return bones.seen_by_camera([x for x in joints if len(x) > _SHORTEST])


def lifted(view: bones.View, lifter: Lifter, few: bool) -> bones.Chains:
    """Return the arms of a lifter.

    Args:
        view: what is seen. lifter: a learned one. few: whether it is told neck and hands alone.
    """
    matrix = view.camera.matrix
    rays = (view.keypoints - matrix[:2, 2]) / matrix.diagonal()[:2]
    neck = rays[:, canonical_names(view.names).index("neck")]
    given = torch.tensor(FEW if few else (True, True, True))
    found = lifter(rays[:, bones.arm_rows(view.names)], neck, given)
    return bones.Chains(found[:, :, 0], found[:, :, 1])


def add_set(report: Report, name: str, unseen: Unseen) -> None:
    """Add both tables of a set."""
    simple = bones.lifts(unseen.arms.lengths[:2].expand(2, 2))
    for few in (False, True):
        chosen = unseen.few if few else None
        rows = {
            method: partial(bones.tracked, prior=unseen.prior, chosen=chosen, **options)
            for method, options in bones.trackers(unseen.arms, unseen.network).items()
        }
        rows |= {k: partial(lifted, lifter=x, few=few) for k, x in unseen.lifters.items()}
        rows |= {name: simple[name] for name in ((_HANGING,) if few else (_LIFT, _HANGING))}
        title = f"{name.split('/')[0]}, {'neck, hands and head' if few else 'all joints'}"
        table = report.table(title, title, _COLUMNS, digits=_DIGITS)
        for row, method in rows.items():
            scored = torch.tensor([bones.errors(method(v), v.truth) for v in unseen.views])
            table.add(row, scored.nanmean(0)[_ROWS])


def main(
    *, data: Path, threads: int = 2, out: TableFile | None = None, quick: bool = False
) -> None:
    """Print the tables.

    Args:
        data: folder with the sets.
        threads: cores.
        out: file for the same as Markdown, or a folder.
        quick: one set, few recordings.
    """
    torch.set_num_threads(threads)
    report = Report("Sets that nobody knows")
    for name in NAMES[-1:] if quick else NAMES:
        add_set(report, name, leave_out(data, name, quick))
    print_tables(report, out)


if __name__ == "__main__":
    run_command(main)
