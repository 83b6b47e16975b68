"""What `torchpose track` does alike with keypoints and video: its settings, its files, what it prints."""

import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jsonargparse import Namespace

from torchpose.cli.common import input_files, save_pictures
from torchpose.errors import InputError

if TYPE_CHECKING:
    from torchpose.io._results import ResultsFolder
    from torchpose.upper_body._keypoint_files import TrackSettings
    from torchpose.upper_body._pose_track import PoseTrack

_POSES = ("poses.npz", "poses.csv", "poses.bvh")
_PICTURES = ("pose_strip.png", "joint_curves.png")
_VIDEO = ("overlay.mp4", "report.html")
_OWN = r"poses(_p\d\d+)?\.(npz|csv|bvh)|overlay\.mp4|report\.html|(pose_strip|joint_curves)\.png"

__all__ = [
    "camera_text",
    "percent",
    "report_failure",
    "smoothing_text",
    "summary",
    "track_pictures",
    "track_results",
    "track_settings",
    "write_pictures",
    "write_track",
]


def track_settings(args: Namespace) -> "TrackSettings":
    """Return the settings of a tracker that are among the options of the command."""
    from torchpose.upper_body._keypoint_files import TrackSettings

    if args.prior is None:  # as a configuration may say it
        raise InputError("--prior must be a name or a file, got null")
    return TrackSettings(**{f.name: getattr(args, f.name) for f in fields(TrackSettings)})


def track_results(
    args: Namespace, pictures: bool, video: bool, more: Sequence[str] = (), own: str = ""
) -> "ResultsFolder":
    """The folder of `--out`, for poses of persons and what shows them.

    Args:
        args: of the command. pictures, video: whether they are going to be written.
        more: further names that are. own: pattern of further names that a run may write.
    """
    from torchpose.io._results import ResultsFolder, holds_arrays

    return ResultsFolder(
        args.out,
        "track",
        f"{_OWN}|{own}" if own else _OWN,
        [*_POSES, *(_PICTURES if pictures else ()), *(_VIDEO if video else ()), *more],
        input_files(args),
        lambda out: holds_arrays(out / _POSES[0], ("joints3d", "covariance3d", "observed")),
    )


def write_track(track: "PoseTrack", out: Path, suffix: str = "") -> list[Path]:
    """Write poses.npz, .csv and, if there is a pose in them, .bvh of one sequence.

    Args:
        suffix: of the names, such as "_p02".
    """
    from torchpose.upper_body._pose_files import write_bvh, write_pose_csv

    written = [out / f"poses{suffix}.{kind}" for kind in ("npz", "csv", "bvh")]
    track.save(written[0])
    write_pose_csv(track, written[1])
    if not _has_poses(track):
        return written[:2]
    write_bvh(track, written[2])
    return written


def write_pictures(track: "PoseTrack", out: Path) -> list[Path]:
    """Draw one sequence, if there is a pose in it."""
    return save_pictures(out, track_pictures(track)) if _has_poses(track) else []


def _has_poses(track: "PoseTrack") -> bool:
    return bool(track.joints3d.isfinite().all(-1).any())


def track_pictures(track: "PoseTrack", truth: Any = None, labels: Any = None) -> dict[str, Any]:
    """Pictures of one sequence by file name, each as a function that draws it."""
    from torchpose import viz

    joints, observed, fps = track.joints3d[0], track.observed[0], track.fps or 30.0
    return {
        "pose_strip.png": lambda: viz.plot_pose_strip(
            joints, fps=fps, observed=observed, truth=truth, labels=labels, title="Tracked poses"
        ),
        "joint_curves.png": lambda: viz.plot_joint_curves(
            joints, track.covariance3d[0], observed, truth, fps=fps,
            title="Hands and elbows with 90 % bands",
        ),
    }  # fmt: skip


def summary(
    track: "PoseTrack", written: list[Path], settings: dict[str, str], notes: Sequence[str] = ()
) -> str:
    """A few lines for people: frames, what was measured, what was assumed, which files."""
    n, fps = track.joints3d.shape[1], track.fps
    length = f" ({n / fps:.1f} s at {fps:g} fps)" if fps else ""
    shares = track.observed[0].double().mean(0).tolist()
    seen = {name: share for name, share in zip(track.names, shares, strict=True) if share > 0}
    hidden = [name for name in track.names if name not in seen]
    measured = ", ".join(f"{name} {percent(share)}" for name, share in seen.items())
    return "\n".join(
        [
            f"frames   {n}{length}",
            *(f"{name:<9}{value}" for name, value in settings.items()),
            f"measured {measured}",
            *([f"inferred {', '.join(hidden)}"] if hidden else []),
            *_sample_size(track),
            *(f"note     {note}" for note in (*track.notes, *notes)),
            *(f"wrote    {path}" for path in written),
        ]
    )


def _sample_size(track: "PoseTrack") -> list[str]:
    """A line on how many particles or tracks carry the weight, where it is known."""
    size = track.effective_sample_size[0]
    size = size[size.isfinite().all(-1)]
    if not len(size):
        return []
    kinds = {"pf": "particles", "window": "components"}
    kind = kinds.get(track.method.partition("-")[0], "tracks")
    left, right = size.quantile(0.5, 0).tolist()
    return [f"weight   on {left:.3g} (left arm) and {right:.3g} (right arm) {kind}, median"]


def report_failure(track: "PoseTrack") -> int:
    """Exit code: 1 and a line on stderr if the filter degenerated, else 0."""
    at = int(track.failed_at[0])
    if at < 0:
        return 0
    print(
        f"torchpose: the filter degenerated at frame {at}; poses from there on are NaN. Measurements "
        "far from what the prior knows do that: check the camera and left and right, or raise "
        "--measurement-std",
        file=sys.stderr,
    )
    return 1


def camera_text(camera: Any) -> str:
    """Focal lengths and centre of a camera in a few words."""
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
    return f"f = ({fx:g}, {fy:g}), centre ({cx:g}, {cy:g}) pixels"


def smoothing_text(smoothing: int | str | None) -> str:
    """How later frames were used, to follow the name of a method."""
    if smoothing is None:
        return ", filtered"
    return ", smoothed" if smoothing == "full" else f", smoothed with {smoothing} later frames"


def percent(share: float) -> str:
    """Rounded, but 100 % only for all."""
    return f"{min(100 * share, 99.9 if share < 1 else 100.0):.3g} %"
