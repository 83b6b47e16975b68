"""`torchpose demo`: the animated performer, tracked from noisy keypoints with a gap, and scored."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from jsonargparse import ArgumentParser, Namespace

from torchpose.cli.common import (
    add_seed,
    new_parser,
    pictures_possible,
    save_pictures,
    show_progress,
)
from torchpose.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from torchpose.demo import Performance
    from torchpose.io import Keypoints
    from torchpose.pose_track import PoseTrack
    from torchpose.priors import UpperBodyPrior

_EXAMPLES = """
torchpose demo --out demo-output
torchpose demo --out demo-output --seed 3 --seconds 10
torchpose demo --out demo-output --prior prior.safetensors"""
_FPS = 30.0
_STD_PX = 3.0
_GAP_JOINT, _GAP_START, _GAP_LENGTH = "hand_right", 2.6, 1.0
_LEVELS = (0.5, 0.9)
_MEAN_POSE = "mean pose"


class Scores(NamedTuple):
    """How good an estimate of the performance is.

    Attributes:
        errors3d: [T, 8] metres, after Procrustes. errors2d: [T, 8] pixels, None for the mean pose.
        inside: share of true joints inside the 50 % and the 90 % ellipsoid, or None.
    """

    errors3d: "Tensor"
    errors2d: "Tensor | None" = None
    inside: tuple[float, ...] | None = None


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    return run(build().parse_args(arguments))


def build() -> ArgumentParser:
    """Parser of the command."""
    parser = new_parser(
        "demo",
        "Animate a performer, make noisy keypoints of head, neck and hands with one hand hidden for "
        "a second, track them, and score and draw the result. Needs no data. Exit code 1 if the "
        "tracker does not beat the mean pose of its prior.",
        _EXAMPLES,
    )
    add = parser.add_argument
    add("--out", type=str, required=True, metavar="DIR", help="folder of the results")
    add(
        "--prior",
        type=str,
        default="kinect-upper-body",
        metavar="NAME|FILE",
        help="a prior that comes with torchpose, or a .safetensors file (default kinect-upper-body)",
    )
    add_seed(parser, "the performance and its noise")
    add(
        "--seconds",
        type=float,
        default=20.0,
        metavar="S",
        help="length; the performance takes 20 s and starts over (default 20)",
    )
    add("--pictures", type=bool, default=True, metavar="true|false",
        help="draw pictures (default true)")  # fmt: skip
    return parser


def run(args: Namespace) -> int:
    """Perform, track, score, draw; exit code 1 if the mean pose is not beaten."""
    from torchpose.io import check_output_folder, write_keypoints
    from torchpose.priors import load_prior

    if not 1 <= args.seconds <= 3600:
        raise InputError(f"--seconds must be from 1 to 3600, got {args.seconds:g}")
    prior = load_prior(args.prior)
    pictures = pictures_possible(args.pictures)
    out = check_output_folder(args.out)
    performance, clip, gap = perform(args.seconds, args.seed)
    print(
        "This is a smoke test on an animated performer, with made-up movements and noise. It shows "
        "that\nthe tracker works, not how well it does on people: see `torchpose evaluate`.\n"
    )
    tracks = {
        "filtered": track_clip(prior, clip, None),
        "smoothed": track_clip(prior, clip, "full"),
    }
    scores = {name: score(t, performance) for name, t in tracks.items()}
    scores[_MEAN_POSE] = score_mean_pose(prior, performance)
    print(report(scores, gap))
    write_keypoints(out / "keypoints.npz", clip)
    written = write_results(out, tracks, scores, performance, gap, pictures)
    best = float(scores[_MEAN_POSE].errors3d.mean())
    worse = [n for n in tracks if not float(scores[n].errors3d.mean()) < best]
    print(f"\nThe keypoints: {out / 'keypoints.npz'}; the poses: {out / 'poses.npz'}, poses.csv")
    if worse:
        print(
            f"torchpose: the demo failed: {' and '.join(worse)} poses are no better than the mean "
            f"pose of the prior ({100 * best:.1f} cm)",
            file=sys.stderr,
        )
    if written:
        print("Pictures:\n" + "\n".join(f"  {path}" for path in written))
    return 1 if worse else 0


# --- the performance and its tracks ---------------------------------------------------------------


def perform(seconds: float, seed: int) -> tuple["Performance", "Keypoints", slice]:
    """The performance, its noisy keypoints, and the frames in which a hand is hidden.

    The gap takes one second out of the wave; in short performances it is earlier and shorter.
    """
    from torchpose.demo import KEYPOINT_NAMES, demo_camera, noisy_keypoints, performer
    from torchpose.io import Keypoints
    from torchpose.skeleton import measure_neck_kind

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
    """Poses from the keypoints by the mixture Kalman filter with fixed tracks."""
    from torchpose.camera import PinholeCamera
    from torchpose.tracking import UpperBodyTracker

    camera = PinholeCamera.from_matrix(clip.K)
    tracker = UpperBodyTracker(prior, camera, fps=clip.fps, smoothing=smoothing, neck=clip.neck)
    return tracker(clip.keypoints[None], names=clip.names, progress=show_progress())


def mean_pose(prior: "UpperBodyPrior") -> "Tensor":
    """Mean of the prior over poses, [8, 3] in the body frame, metres: the least one has to beat."""
    from torchpose.lifting import arm_in_body_frame, join_arms

    order: Any = prior.info.rotation_order
    arms = []
    for arm in (prior.left, prior.right):
        joints, _ = arm_in_body_frame(arm.means, arm.covariances, prior.info.matrix, order)
        arms.append((arm.weights[:, None, None] * joints).sum(0)[None, None])
    return join_arms(*arms)[0, 0]


# --- scores ---------------------------------------------------------------------------------------


def score(track: "PoseTrack", performance: "Performance") -> Scores:
    """Errors and coverage of a track."""
    from torchpose.demo import demo_camera
    from torchpose.metrics import align, coverage, joint_errors_2d, joint_errors_3d

    truth = performance.joints
    points = demo_camera()(truth)[..., :2]
    points3d, covariance, _ = align(track.joints3d[0], truth, covariance=track.covariance3d[0])
    inside = None if covariance is None else coverage(points3d, covariance, truth, _LEVELS).overall
    return Scores(
        joint_errors_3d(track.joints3d[0], truth),
        joint_errors_2d(track.joints2d[0], points),
        None if inside is None else tuple(inside.tolist()),
    )


def score_mean_pose(prior: "UpperBodyPrior", performance: "Performance") -> Scores:
    """Errors of the mean pose of the prior, which does not move."""
    from torchpose.metrics import joint_errors_3d

    truth = performance.joints
    return Scores(joint_errors_3d(mean_pose(prior).expand_as(truth), truth))


def report(scores: dict[str, Scores], gap: slice) -> str:
    """Table of errors per joint, pixel errors and coverage, one column for each estimate."""
    from torchpose.skeleton import UPPER_BODY
    from torchpose.viz.style import readable

    n_frames = next(iter(scores.values())).errors3d.shape[0]
    hidden = UPPER_BODY.index(_GAP_JOINT)
    rows = {
        readable(name): [f"{100 * float(s.errors3d[:, j].mean()):.1f}" for s in scores.values()]
        for j, name in enumerate(UPPER_BODY)
    }
    rows["all joints"] = [f"{100 * float(s.errors3d.mean()):.1f}" for s in scores.values()]
    count = gap.stop - gap.start
    rows[f"{readable(_GAP_JOINT)} while hidden ({count} frames)"] = [
        f"{100 * float(s.errors3d[gap, hidden].mean()):.1f}" for s in scores.values()
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
        "(head and neck are measured, with hands; elbows and shoulders never are)"
    )
    head = _row("", list(scores))
    lines = [_row(name, cells) for name, cells in rows.items()]
    more = [_row(name, cells) for name, cells in others.items()]
    return "\n".join([title, "", head, *lines, "", *more])


def _row(name: str, cells: list[str]) -> str:
    return f"{name:<42}" + "".join(f"{cell:>11}" for cell in cells)


# --- files ----------------------------------------------------------------------------------------


def write_results(
    out: Path,
    tracks: dict[str, "PoseTrack"],
    scores: dict[str, Scores],
    performance: "Performance",
    gap: slice,
    pictures: bool,
) -> list[Path]:
    """Write the filtered poses and, if asked for, the pictures; returns the paths of those."""
    from torchpose.cli.track import track_pictures, write_track

    track = tracks["filtered"]
    write_track(track, out, pictures=False)
    if not pictures:
        return []
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
