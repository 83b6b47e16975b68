"""How good the tracks of the animated performer are, beside the mean pose of the prior."""

import sys
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from torch import Tensor

    from torchpose.priors._upper_body import UpperBodyPrior
    from torchpose.upper_body._pose_track import PoseTrack

__all__ = [
    "MEAN_POSE",
    "Hidden",
    "Scores",
    "beaten",
    "report",
    "score",
    "score_mean_pose",
]

_LEVELS = (0.5, 0.9)
MEAN_POSE = "mean pose"


class Scores(NamedTuple):
    """How good an estimate of the performance is.

    Attributes:
        errors3d: [T, 8] metres, after Procrustes. errors2d: [T, 8] pixels, None for the mean pose.
        inside: share of true joints inside the 50 % and the 90 % ellipsoid, or None.
    """

    errors3d: "Tensor"
    errors2d: "Tensor | None" = None
    inside: tuple[float, ...] | None = None


class Hidden(NamedTuple):
    """Frames in which a joint was hidden."""

    joint: str
    frames: slice


def score(track: "PoseTrack", truth: "Tensor") -> Scores:
    """Errors and coverage of a track of true joints [T, 8, 3] before `demo_camera`."""
    from torchpose.demo._performer import demo_camera
    from torchpose.metrics._calibration import coverage
    from torchpose.metrics._poses import align, joint_errors_2d, joint_errors_3d

    points = demo_camera()(truth)[..., :2]
    points3d, covariance, _ = align(track.joints3d[0], truth, covariance=track.covariance3d[0])
    inside = None if covariance is None else coverage(points3d, covariance, truth, _LEVELS).overall
    return Scores(
        joint_errors_3d(track.joints3d[0], truth),
        joint_errors_2d(track.joints2d[0], points),
        None if inside is None else tuple(inside.tolist()),
    )


def score_mean_pose(prior: "UpperBodyPrior", truth: "Tensor") -> Scores:
    """Errors of the mean pose of the prior, which does not move."""
    from torchpose.metrics._poses import joint_errors_3d

    return Scores(joint_errors_3d(prior.mean_pose().expand_as(truth), truth))


def report(scores: dict[str, Scores], measured: str, hidden: Hidden | None = None) -> str:
    """Table of errors per joint, pixel errors and coverage, one column for each estimate."""
    from torchpose.skeleton._joint_sets import UPPER_BODY
    from torchpose.viz._style import readable

    n_frames = next(iter(scores.values())).errors3d.shape[0]
    rows = {
        readable(name): [f"{100 * float(s.errors3d[:, j].mean()):.1f}" for s in scores.values()]
        for j, name in enumerate(UPPER_BODY)
    }
    rows["all joints"] = [f"{100 * float(s.errors3d.mean()):.1f}" for s in scores.values()]
    if hidden is not None:
        joint, gap = UPPER_BODY.index(hidden.joint), hidden.frames
        count = gap.stop - gap.start
        rows[f"{readable(hidden.joint)} while hidden ({count} frames)"] = [
            f"{100 * float(s.errors3d[gap, joint].mean()):.1f}" for s in scores.values()
        ]
    others = {
        "2D error, all joints (pixels)": [
            "-" if s.errors2d is None else f"{float(s.errors2d.mean()):.1f}"
            for s in scores.values()
        ]
    }
    for i, level in enumerate(_LEVELS):
        others[f"true joints inside the {100 * level:.0f} % ellipsoid"] = [
            "-" if s.inside is None else f"{100 * s.inside[i]:.0f} %" for s in scores.values()
        ]
    title = (
        f"3D error in cm over {n_frames} frames, poses aligned on head, neck and shoulders\n"
        f"({measured})"
    )
    head = _row("", list(scores))
    lines = [_row(name, cells) for name, cells in rows.items()]
    more = [_row(name, cells) for name, cells in others.items()]
    return "\n".join([title, "", head, *lines, "", *more])


def _row(name: str, cells: list[str]) -> str:
    return f"{name:<42}" + "".join(f"{cell:>11}" for cell in cells)


def beaten(scores: dict[str, Scores]) -> bool:
    """Whether all tracks are better than the mean pose; says so on stderr if they are not."""
    best = float(scores[MEAN_POSE].errors3d.mean())
    worse = [
        name
        for name, found in scores.items()
        if name != MEAN_POSE and not float(found.errors3d.mean()) < best
    ]
    if worse:
        print(
            f"torchpose: the demo failed: {' and '.join(worse)} poses are no better than the mean "
            f"pose of the prior ({100 * best:.1f} cm)",
            file=sys.stderr,
        )
    return not worse
