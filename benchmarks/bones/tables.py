"""Groups of views that are scored together, with their tables and pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

import torchpose
from benchmarks.bones.fits import fit_without
from benchmarks.bones.scoring import (
    Chains,
    errors,
    lifts,
    poses_of,
    tracked,
    trackers,
    true_lengths,
)
from benchmarks.bones.views import (
    ENDS,
    EVERY,
    UTD,
    UTD_EVERY,
    UTD_PERSONS,
    View,
    begun,
    kinect_views,
    mhad_views,
    openpose_views,
    recordings,
    webcam_views,
)
from torchpose.evaluation import Report
from torchpose.learning import fit_kinect_prior
from torchpose.priors import UpperBodyPrior
from torchpose.priors._arms import ArmPrior, shipped_arm_prior

_DIGITS = (1, 1, 0, 1, 0, 0)
COLUMNS = (
    "wrist (cm)",
    "elbow (cm)",
    "elbow before or behind (%)",
    "spread of the forearm (%)",
    "inside 50 %",
    "inside 90 %",
)
FEW = (0, 3, 6)  # neck and wrists
FOUR = (0, 3, 6, 7)  # neck, hands and head
FIT = {"n_components": 10, "window_components": 48, "calibration_folds": 0}


class Group(NamedTuple):
    """Views that are scored together.

    Attributes:
        seen: what they are, for the title. views: of them.
        left_out, persons: of the fit of arms (`fit_without`); of the persons' own set the prior of the
            other trackers is fitted to everybody else.
        each: whether each view has rows of its own.
        few: keypoints that are measured in one more table. few_seen: what these are.
    """

    seen: str
    views: Sequence[View]
    left_out: str | None = None
    persons: Sequence[str] = ()
    each: bool = False
    few: Sequence[int] = ()
    few_seen: str = ""


def groups(data: Path, quick: bool) -> Iterator[Group]:
    """Yield the groups of views to score, set by set; few views of each in a quick run."""
    for group in _groups(data, quick):
        views = [begun(view) for view in group.views] if quick else group.views
        yield group._replace(views=views)


def _groups(data: Path, quick: bool) -> Iterator[Group]:
    every = 150 if quick else EVERY
    yield Group("MHAD, seven joints", mhad_views(data, every), "mocap_berkeley_mhad",
                few=FEW, few_seen="MHAD, neck and wrists")  # fmt: skip
    yield Group("OpenPose, upper body and face, one of four views",
                openpose_views(data)[: 1 if quick else None], each=True)  # fmt: skip
    yield Group("Webcams, MediaPipe's 2D against its own 3D landmarks",
                webcam_views(data)[: 1 if quick else None])  # fmt: skip
    every = 200 if quick else UTD_EVERY
    yield Group("UTD-MHAD, eight joints", kinect_views(data, every), persons=UTD_PERSONS,
                few=FOUR, few_seen="UTD-MHAD, head, neck and hands")  # fmt: skip


def priors_of(group: Group, data: Path, quick: bool) -> tuple[UpperBodyPrior, ArmPrior]:
    """Return the priors of a group, which know nobody in it; of a quick run those at hand."""
    if quick:
        return torchpose.load_prior("kinect-upper-body-small"), shipped_arm_prior()
    known = group.left_out is not None or group.persons
    arms = fit_without(data, group.left_out, group.persons) if known else shipped_arm_prior()
    if not group.persons:
        return torchpose.load_prior("kinect-upper-body"), arms
    others = [r for r in recordings(data / UTD) if r.person not in group.persons]
    return fit_kinect_prior(others, seed=0, **FIT), arms


def add_group(report: Report, group: Group, prior: UpperBodyPrior, arms: ArmPrior) -> None:
    """Add the tables of a group: all keypoints measured, and few."""

    def rows(method: Callable[[View], Chains]) -> Float[Tensor, "V 6"]:
        return torch.tensor([errors(method(view), view.truth) for view in group.views])

    def of_trackers(chosen: Sequence[int] | None) -> dict[str, Tensor]:
        return {
            name: rows(partial(tracked, prior=prior, chosen=chosen, **options))
            for name, options in trackers(arms).items()
        }

    def measured_first(view: View) -> Chains:
        upper, lower = true_lengths(view).nanmean(0).tolist()
        own = {"upper_arm": upper, "forearm": lower}
        return tracked(view, prior, None, **trackers(arms)["articulated"], bone_lengths=own)

    table = report.table(group.seen, group.seen, COLUMNS, digits=_DIGITS)
    smoothed = {
        f"{name}, smoothed": rows(
            partial(tracked, prior=prior, chosen=None, smoothing="full", **own)
        )
        for name, own in trackers(arms).items()
    }
    own_lengths = {"articulated, own lengths of arms": rows(measured_first)}
    found = of_trackers(None) | own_lengths | smoothed
    others = {name: rows(lift) for name, lift in lifts(arms.lengths[:2].expand(2, 2)).items()}
    for name, scored in (found | others).items():
        table.add(name, scored.nanmean(0))
    for i in range(len(group.views) if group.each else 0):
        for name, scored in found.items():
            table.add(f"view {i + 1}, {name}", scored[i])
    if group.few:
        table = report.table(group.few_seen, group.few_seen, COLUMNS, digits=_DIGITS)
        for name, scored in of_trackers(group.few).items():
            table.add(name, scored.nanmean(0))


def draw(
    group: Group, prior: UpperBodyPrior, arms: ArmPrior, folder: Path, name: str, n_frames: int = 8
) -> None:
    """Write strips of the last view of a group: windows and bones, with the truth in grey.

    The truth is moved so that the middles of the shoulders meet.
    """
    from torchpose import viz

    view = group.views[-1]
    for method in ("window-mixture", "articulated"):
        poses = poses_of(view, prior, None, **trackers(arms)[method])
        joints = poses.joints3d[0]
        truth = torch.full_like(joints, torch.nan)
        truth[:, ENDS] = view.truth
        middles = (x[:, ENDS][:, :, 0].mean(1, keepdim=True) for x in (joints, truth))
        found, true = middles
        figure = viz.plot_pose_strip(
            joints, truth=truth + found - true, fps=view.fps, observed=poses.observed[0],
            n_frames=n_frames, title=f"{group.seen}: {method}",
        )  # fmt: skip
        viz.save_figure(figure, folder / f"{name}-{method}.png", dpi=110)
