"""`torchpose demo --input keypoints`: keypoints with a gap, tracked; scores of an animated performer."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from torchpose._core.terminal import show_progress
from torchpose.cli._common import save_pictures
from torchpose.cli._track_output import track_pictures, write_track

if TYPE_CHECKING:
    from torch import Tensor

    from torchpose.demo._performer import Performance
    from torchpose.io._keypoints import Keypoints
    from torchpose.io._results import ResultsFolder
    from torchpose.priors._upper_body_prior import UpperBodyPrior
    from torchpose.upper_body._pose_track import PoseTrack

_FPS = 30.0
_STD_PX = 3.0
_GAP_JOINT, _GAP_START, _GAP_LENGTH = "hand_right", 2.6, 1.0
_LEVELS = (0.5, 0.9)
MEAN_POSE = "mean pose"


class Scores(NamedTuple):
    """Holds the errors of an estimate of the performance.

    Attributes:
        errors3d: [T, 8] metres, after Procrustes. errors2d: [T, 8] pixels, None for the mean pose.
        inside: share of true joints inside the 50 % and the 90 % ellipsoid, or None.
    """

    errors3d: "Tensor"
    errors2d: "Tensor | None" = None
    inside: tuple[float, ...] | None = None


class Hidden(NamedTuple):
    """Holds the frames in which a joint is hidden."""

    joint: str
    frames: slice


def score(track: "PoseTrack", truth: "Tensor") -> Scores:
    """Return the errors and the coverage of a track of true joints [T, 8, 3] before `demo_camera`."""
    from torchpose.demo._performer import demo_camera
    from torchpose.metrics._calibration import coverage
    from torchpose.metrics._pose_errors import align, joint_errors_2d, joint_errors_3d

    points = demo_camera()(truth)[..., :2]
    points3d, covariance, _ = align(track.joints3d[0], truth, covariance=track.covariance3d[0])
    inside = None if covariance is None else coverage(points3d, covariance, truth, _LEVELS).overall
    return Scores(
        joint_errors_3d(track.joints3d[0], truth),
        joint_errors_2d(track.joints2d[0], points),
        None if inside is None else tuple(inside.tolist()),
    )


def score_mean_pose(prior: "UpperBodyPrior", truth: "Tensor") -> Scores:
    """Return the errors of the mean pose of the prior, which does not move."""
    from torchpose.metrics._pose_errors import joint_errors_3d

    return Scores(joint_errors_3d(prior.mean_pose().expand_as(truth), truth))


def report(scores: dict[str, Scores], measured: str, hidden: Hidden | None = None) -> str:
    """Return the table of errors per joint, pixel errors and coverage, one column for each estimate."""
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
    """Return whether all tracks are better than the mean pose; say on stderr which are not."""
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


def demo_keypoints(
    prior: "UpperBodyPrior", results: "ResultsFolder", seconds: float, seed: int, pictures: bool
) -> int:
    """Perform, track, score and draw; return exit code 1 if the mean pose is not beaten."""
    from torchpose.io._keypoints import write_keypoints

    performance, clip, gap = perform(seconds, seed)
    tracks = {
        "filtered": track_clip(prior, clip, None),
        "smoothed": track_clip(prior, clip, "full"),
    }
    scores = {name: score(t, performance.joints) for name, t in tracks.items()}
    scores[MEAN_POSE] = score_mean_pose(prior, performance.joints)
    measured = "head and neck are measured, with hands; elbows and shoulders never are"
    print(report(scores, measured, Hidden(_GAP_JOINT, gap)))
    stage = results.stage
    file = stage / "keypoints.npz"
    write_keypoints(file, clip)
    poses = list(write_track(tracks["filtered"], stage))
    drawn = _draw(stage, tracks["filtered"], scores, performance, gap) if pictures else []
    at, *places = results.commit([file, *poses, *drawn])
    print(f"\nThe keypoints: {at}; the poses: {places[0]}, poses.csv")
    good = beaten(scores)
    if drawn:
        print("Pictures:\n" + "\n".join(f"  {path}" for path in places[len(poses) :]))
    for note in results.notes:
        print(f"note: {note}")
    return 0 if good else 1


def perform(seconds: float, seed: int) -> tuple["Performance", "Keypoints", slice]:
    """Return the performance, its noisy keypoints, and the frames in which a hand is hidden.

    The gap takes one second out of the wave; in short performances it is earlier and shorter.
    """
    from torchpose.demo._performer import KEYPOINT_NAMES, demo_camera, noisy_keypoints, performer
    from torchpose.io._keypoints import Keypoints
    from torchpose.skeleton._upper_body import measure_neck_kind

    n_frames = round(seconds * _FPS)
    performance = performer(n_frames, _FPS, seed)
    start, length = min(_GAP_START, 0.4 * seconds), min(_GAP_LENGTH, 0.3 * seconds)
    camera = demo_camera()
    points = noisy_keypoints(
        performance.joints, camera, _STD_PX, seed, (_GAP_JOINT, start, length), _FPS
    )
    first = round(start * _FPS)
    clip = Keypoints(
        points,
        KEYPOINT_NAMES,
        fps=_FPS,
        K=camera.matrix,
        image_size=camera.image_size,
        neck=measure_neck_kind(performance.joints),
    )
    return performance, clip, slice(first, first + round(length * _FPS))


def track_clip(prior: "UpperBodyPrior", clip: "Keypoints", smoothing: str | None) -> "PoseTrack":
    """Return the poses from the keypoints, by the tracker's default method."""
    from torchpose.camera._pinhole import PinholeCamera
    from torchpose.upper_body._upper_body_tracker import UpperBodyTracker

    camera = PinholeCamera.from_matrix(clip.K)
    tracker = UpperBodyTracker(prior, camera, fps=clip.fps, smoothing=smoothing, neck=clip.neck)
    return tracker(clip.keypoints[None], names=clip.names, progress=show_progress())


def _draw(
    out: Path,
    track: "PoseTrack",
    scores: dict[str, Scores],
    performance: "Performance",
    gap: slice,
) -> list[Path]:
    """Draw the poses, one of them in 3D, and the errors, and return the paths of the pictures."""
    from torchpose import viz

    middle = (gap.start + gap.stop) // 2
    title = f"{middle / _FPS:.1f} s: the right hand is hidden, elbows and shoulders are inferred"
    drawn = track_pictures(track, performance.joints, performance.labels) | {
        "pose_3d.png": lambda: viz.plot_pose_3d(
            track.joints3d[0, middle], track.covariance3d[0, middle], track.observed[0, middle],
            performance.joints[middle], title=title,
        ),
        "errors.png": lambda: viz.plot_error_bars(
            {name: s.errors3d for name, s in scores.items()},
            title="3D error on the animated performer (a smoke test)",
        ),
    }  # fmt: skip
    return save_pictures(out, drawn)
