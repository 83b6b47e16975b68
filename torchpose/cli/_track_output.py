"""What `torchpose track` has for keypoints and for video: the job, the files, what is printed."""

import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from torchpose.cli._common import save_pictures
from torchpose.cli._picture_process import PictureProcess

if TYPE_CHECKING:
    from torch import Tensor

    from torchpose.camera._pinhole import PinholeCamera
    from torchpose.io._results import ResultsFolder
    from torchpose.upper_body._keypoint_files import TrackSettings
    from torchpose.upper_body._pose_track import PoseTrack

_POSES = ("poses.npz", "poses.csv", "poses.bvh")
_PICTURES = ("pose_strip.png", "joint_curves.png")
_VIDEO = ("overlay.mp4", "report.html")
_OWN = r"poses(_p\d\d+)?\.(npz|csv|bvh)|overlay\.mp4|report\.html|(pose_strip|joint_curves)\.png"


class TrackingJob(NamedTuple):
    """Holds the input, the settings and the output folder of one run of tracking.

    Attributes:
        input: as it was given. out: folder of the results. files: that the command reads.
        settings: of the tracker. options: the options of its method. pictures: whether they are wanted.
    """

    input: str
    out: str
    files: list[Path]
    settings: "TrackSettings"
    options: dict[str, Any]
    pictures: bool


def track_results(
    out: str,
    files: Sequence[Path],
    pictures: bool,
    video: bool,
    more: Sequence[str] = (),
    own: str = "",
) -> "ResultsFolder":
    """Return the folder of `--out`, for poses of persons and what shows them.

    Args:
        out: folder of the results. files: that the command reads.
        pictures, video: whether they are going to be written.
        more: further names that are. own: pattern of further names that a run may write.
    """
    from torchpose.io._results import ResultsFolder, holds_arrays

    return ResultsFolder(
        out,
        "track",
        f"{_OWN}|{own}" if own else _OWN,
        [*_POSES, *(_PICTURES if pictures else ()), *(_VIDEO if video else ()), *more],
        files,
        lambda folder: holds_arrays(folder / _POSES[0], ("joints3d", "covariance3d", "observed")),
    )


def write_track(track: "PoseTrack", out: Path, suffix: str = "") -> Iterator[Path]:
    """Write poses.npz, .csv and, if there is a pose in them, .bvh of one sequence; yield each path.

    Args:
        track: the track of the sequence. out: folder.
        suffix: of the names, such as "_p02".
    """
    from torchpose.upper_body._pose_files import write_bvh, write_pose_csv

    writers: dict[str, Callable[[Path], None]] = {
        "npz": track.save,
        "csv": partial(write_pose_csv, track),
    }
    if _has_poses(track):
        writers["bvh"] = partial(write_bvh, track)
    for kind, write in writers.items():
        path = out / f"poses{suffix}.{kind}"
        write(path)
        yield path


def write_pictures(
    track: "PoseTrack", out: Path, other: PictureProcess | None = None
) -> list[Path]:
    """Draw one sequence if there is a pose in it, and return the paths of the pictures.

    Args:
        track: the track of the sequence. out: folder. other: process that draws them, if there is one.
    """
    if not _has_poses(track):
        return []
    pictures = track_pictures(track)
    drawn = None if other is None else other.draw(pictures)
    return save_pictures(out, pictures) if drawn is None else _write_files(out, drawn)


def _write_files(out: Path, contents: Mapping[str, bytes]) -> list[Path]:
    """Write files by name, and return their paths."""
    from torchpose._core.files import atomic_path

    for name, content in contents.items():
        with atomic_path(out / name) as temporary:
            temporary.write_bytes(content)
    return [out / name for name in contents]


def _has_poses(track: "PoseTrack") -> bool:
    return bool(track.joints3d.isfinite().all(-1).any())


def track_pictures(
    track: "PoseTrack", truth: "Tensor | None" = None, labels: Sequence[str] | None = None
) -> dict[str, Callable[[], Any]]:
    """Return the pictures of one sequence by file name, each as a function that draws it."""
    from torchpose.viz._charts import prepare_joint_curves
    from torchpose.viz._skeletons import prepare_pose_strip

    joints, observed = track.joints3d[0], track.observed[0]
    fps, first = track.fps or 30.0, track.first_frame
    return {
        "pose_strip.png": prepare_pose_strip(
            joints, fps=fps, observed=observed, truth=truth, labels=labels, title="Tracked poses",
            first_frame=first,
        ),
        "joint_curves.png": prepare_joint_curves(
            joints, track.covariance3d[0], observed, truth, fps=fps,
            title="Hands and elbows with 90 % bands", first_frame=first,
        ),
    }  # fmt: skip


def summary(
    track: "PoseTrack", written: list[Path], settings: dict[str, str], notes: Sequence[str] = ()
) -> str:
    """Return some lines on frames, measurements, assumptions and the files."""
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
    """Return a line on the effective number of particles or tracks, where it is known."""
    size = track.effective_sample_size[0]
    size = size[size.isfinite().all(-1)]
    if not len(size):
        return []
    limbs = "limb directions"
    kinds = {"pf": "particles", "window": "components", "articulated": limbs, "multiple": limbs}
    kind = kinds.get(track.method.partition("-")[0], "tracks")
    left, right = size.quantile(0.5, 0).tolist()
    return [f"samples  {left:.3g} (left arm) and {right:.3g} (right arm) effective {kind}, median"]


def report_failure(track: "PoseTrack") -> int:
    """Return the exit code: 1, with a line on stderr, if the poses are of no use, else 0."""
    if not bool(track.observed.any()):
        print(
            "torchpose: every keypoint was rejected as an outlier, so no pose rests on a measurement. "
            "Check the camera, the units and the names of the keypoints",
            file=sys.stderr,
        )
        return 1
    at = int(track.failed_at[0])
    if at < 0:
        return 0
    print(
        f"torchpose: the filter degenerated at frame {at}; poses from there on are NaN. The cause "
        "is measurements far from all poses of the prior: check the camera and left and right, or raise "
        "--measurement-std",
        file=sys.stderr,
    )
    return 1


def camera_text(camera: "PinholeCamera") -> str:
    """Return the focal lengths and the centre of a camera in words, and where it looks if that is known."""
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
    return f"f = ({fx:g}, {fy:g}), centre ({cx:g}, {cy:g}) pixels{_tilt_text(camera)}"


def _tilt_text(camera: "PinholeCamera") -> str:
    """Return in words by how much a camera looks up or down and is rolled; nothing if that is not known."""
    from torchpose.camera._tilt import angles_of_up

    if camera.up is None:
        return ""
    pitch, roll = (round(math.degrees(angle), 1) for angle in angles_of_up(camera.up))
    way = "up" if pitch >= 0 else "down"
    rolled = "" if abs(roll) < 0.05 else f" and rolled by {roll:g} degrees"
    return f", looking {way} by {abs(pitch):g} degrees{rolled}"


def smoothing_text(smoothing: int | str | None) -> str:
    """Return the words on smoothing that follow the name of a method."""
    if smoothing is None:
        return ", filtered"
    return ", smoothed" if smoothing == "full" else f", smoothed with {smoothing} later frames"


def person_suffix(place: int) -> str:
    """Return what follows the names of the files of a person, counted from 1; nothing for the first."""
    return "" if place == 1 else f"_p{place:02d}"


def notes_of_all(notes: Sequence[Sequence[str]], names: Sequence[str]) -> tuple[str, ...]:
    """Return the notes that all persons have, each once, and those of single ones after their names.

    Args:
        notes: of each person. names: of the persons.
    """
    common = [note for note in notes[0] if all(note in own for own in notes)]
    own = [
        f"{name}: {note}"
        for name, of_one in zip(names, notes, strict=True)
        for note in of_one
        if note not in common
    ]
    return (*common, *own)


def percent(share: float) -> str:
    """Return a share as a rounded percentage, which is 100 % only of all and 0 % only of none."""
    if 0 < share < 0.001:
        return "below 0.1 %"
    return f"{min(100 * share, 99.9 if share < 1 else 100.0):.3g} %"
