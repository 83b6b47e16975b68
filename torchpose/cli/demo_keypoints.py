"""`torchpose demo --input keypoints`: noisy keypoints of the animated performer, with a gap."""

from pathlib import Path
from typing import TYPE_CHECKING

from torchpose._core.terminal import show_progress
from torchpose.cli.common import save_pictures
from torchpose.cli.demo_scores import (
    MEAN_POSE,
    Hidden,
    Scores,
    beaten,
    report,
    score,
    score_mean_pose,
)
from torchpose.cli.track_output import track_pictures, write_track

if TYPE_CHECKING:
    from torchpose.demo._performer import Performance
    from torchpose.io._keypoints import Keypoints
    from torchpose.io._results import ResultsFolder
    from torchpose.priors._upper_body import UpperBodyPrior
    from torchpose.upper_body._pose_track import PoseTrack

__all__ = ["demo_keypoints", "perform", "track_clip"]

_FPS = 30.0
_STD_PX = 3.0
_GAP_JOINT, _GAP_START, _GAP_LENGTH = "hand_right", 2.6, 1.0


def demo_keypoints(
    prior: "UpperBodyPrior", results: "ResultsFolder", seconds: float, seed: int, pictures: bool
) -> int:
    """Perform, track, score, draw; exit code 1 if the mean pose is not beaten."""
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
    poses = write_track(tracks["filtered"], stage)
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
    """The performance, its noisy keypoints, and the frames in which a hand is hidden.

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
    """Poses from the keypoints by the mixture Kalman filter with fixed tracks."""
    from torchpose.camera._pinhole import PinholeCamera
    from torchpose.upper_body._tracker import UpperBodyTracker

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
    """Draw the poses, one of them in 3D, and the errors; returns the paths of the pictures."""
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
