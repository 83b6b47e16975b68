"""Arms by trackers and by elementary geometry, and their errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

import torchpose
from benchmarks.bones.views import ENDS, View, arm_rows
from torchpose.metrics import coverage
from torchpose.priors import UpperBodyPrior
from torchpose.priors._arm_lifter import ArmLifter
from torchpose.priors._arms import ArmPrior

_SETTLED = 90  # frames, from where on the spread of a bone's length counts


class Chains(NamedTuple):
    """Vectors from the shoulder to the elbow and on to the wrist, [T, 2, 3] each.

    Attributes:
        inside: shares of true elbows and wrists in the 50 % and the 90 % ellipsoids, NaN without any.
    """

    upper: Tensor
    lower: Tensor
    inside: Sequence[float] = (float("nan"), float("nan"))


def tracked(
    view: View, prior: UpperBodyPrior, chosen: Sequence[int] | None, **options: object
) -> Chains:
    """Return the chains of a tracker.

    Args:
        view: what is seen. prior: of the tracker. chosen: keypoints that are measured, None for all.
        options: of the tracker.
    """
    poses = poses_of(view, prior, chosen, **options)
    bones = poses.joints3d[0][:, ENDS].diff(dim=2)
    inside = coverage(*limbs(view, poses)).overall.tolist()
    return Chains(bones[:, :, 0], bones[:, :, 1], inside)


def limbs(
    view: View, poses: torchpose.PoseTrack
) -> tuple[Float[Tensor, "T 4 3"], Float[Tensor, "T 4 3 3"], Float[Tensor, "T 4 3"]]:
    """Return elbows and wrists from the middle of the shoulders, their covariances, and the true ones.

    Args:
        view: what is seen. poses: of a tracker.
    """
    ends = poses.joints3d[0][:, ENDS]
    covariance = poses.covariance3d[0][:, ENDS]
    found, true = (x - x[:, :, :1].mean(1, keepdim=True) for x in (ends, view.truth))
    found, covariance, true = (x[:, :, 1:].flatten(1, 2) for x in (found, covariance, true))
    return found, covariance, true


def poses_of(
    view: View, prior: UpperBodyPrior, chosen: Sequence[int] | None, **options: object
) -> torchpose.PoseTrack:
    """Return the poses of a tracker; see `tracked`."""
    rows = list(range(len(view.names))) if chosen is None else list(chosen)
    tracker = torchpose.UpperBodyTracker(
        prior, view.camera, neck=view.neck, fps=view.fps, max_gap=None, **options
    )  # type: ignore[arg-type]
    with torch.inference_mode():
        return tracker(
            view.keypoints[None, :, rows],
            view.confidence[None, :, rows].double(),
            names=[view.names[i] for i in rows],
        )


def lifted(
    view: View, lengths: Float[Tensor, "2 2"], depth: float, true_signs: bool = False
) -> Chains:
    """Return arms in front of the image plane through the shoulders, at one depth.

    Args:
        view: what is seen. lengths: of upper arm and forearm, left and right. depth: of the body.
        true_signs: whether bones point away from the camera where the truth does, which nothing that is
            seen tells.
    """
    matrix = view.camera.matrix
    focal = torch.stack([matrix[0, 0], matrix[1, 1]])
    flat = view.keypoints[:, arm_rows(view.names)] / focal * depth
    bones = flat.diff(dim=2)
    away = (lengths.square() - bones.square().sum(-1)).clamp_min(0).sqrt()
    behind = view.truth.diff(dim=2)[..., 2] > 0
    away = torch.where(behind & true_signs, away, -away)
    whole = torch.cat([bones, away[..., None]], -1)
    return Chains(whole[:, :, 0], whole[:, :, 1])


def errors(chains: Chains, truth: Float[Tensor, "T 2 3 3"]) -> list[float]:
    """Return a row of a method: two errors, share of right signs, a bone's spread, and coverages."""
    upper, lower = truth[:, :, 1] - truth[:, :, 0], truth[:, :, 2] - truth[:, :, 1]
    wrist = (chains.upper + chains.lower - upper - lower).norm(dim=-1).nanmean()
    elbow = (chains.upper - upper).norm(dim=-1).nanmean()
    known = upper[..., 2].isfinite()
    sign = (chains.upper[..., 2] * upper[..., 2] > 0)[known].double().mean()
    length = chains.lower.norm(dim=-1)[_SETTLED:] if len(upper) > _SETTLED + 10 else None
    spread = torch.nan
    if length is not None:
        spread = float((length.std(0) / length.mean(0)).mean())
    inside = [100 * share for share in chains.inside]
    return [100 * float(wrist), 100 * float(elbow), 100 * float(sign), 100 * spread, *inside]


def true_lengths(view: View) -> Float[Tensor, "2 2"]:
    """Return the mean lengths of upper arm and forearm of left and right."""
    return view.truth.diff(dim=2).norm(dim=-1).nanmean(0)


METHODS = ("window-mixture", "articulated", "multiple-model", "mkf-fixed")
"""Methods that are compared."""


def trackers(arms: ArmPrior, lifter: ArmLifter | None = None) -> dict[str, dict[str, object]]:
    """Return the options of the trackers that are compared, by the method's name.

    Args:
        arms: prior over arms. lifter: network that lifts arms; None is that of the package.
    """
    options: dict[str, dict[str, object]] = {
        "articulated": {"arms": arms, "lifter": lifter},
        "multiple-model": {"arms": arms, "lifter": lifter},
    }
    return {name: {"method": name, **options.get(name, {})} for name in METHODS}


def lifts(mean: Float[Tensor, "2 2"]) -> dict[str, Callable[[View], Chains]]:
    """Return the methods that need no tracker, by name.

    Args:
        mean: lengths of other persons.
    """

    def mean_arm(view: View) -> Chains:
        hanging = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        upper, lower = (mean[:, i, None] * hanging for i in (0, 1))
        return Chains(*(bone.expand(len(view.truth), 2, 3) for bone in (upper, lower)))

    return {
        "lift, own lengths and depth": lambda v: lifted(v, true_lengths(v), v.far),
        "lift, own lengths, depth and signs": lambda v: lifted(v, true_lengths(v), v.far, True),
        "lift, others' lengths, own depth": lambda v: lifted(v, mean, v.far),
        "hanging arms": mean_arm,
    }
