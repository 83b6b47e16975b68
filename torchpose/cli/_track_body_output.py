"""What `torchpose track-body` writes and prints: poses, the page, words."""

import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from torchpose._core.wording import counted
from torchpose.cli._body_overlays import overlay_name, span_of
from torchpose.cli._track_output import notes_of_all, person_suffix
from torchpose.errors import DegenerateFilterWarning

if TYPE_CHECKING:
    from torchpose.camera._pinhole import PinholeCamera
    from torchpose.io._results import ResultsFolder
    from torchpose.whole_body._body_track import BodyTrack

KALMAN = "kalman"
"""The method that takes nothing but keypoints, and is their default."""
_POSES = ("body.npz", "joints.csv")
_OWN = (
    r"(body(_p\d\d+)?\.(npz|trc|c3d|bvh)|joints(_p\d\d+)?\.csv|skeleton(_p\d\d+)?\.png)"
    r"|overlay(_.+\.mp4|\.png)|report\.html"
    r"|refined_cameras\.toml"
)
CAMERA_FILE = "camera.toml"
"""Name of the file of a camera that was given without one."""
_MOST_RUNS = 8  # of actions that are listed by their frames


class BodyJob(NamedTuple):
    """Holds what a run of the command writes, and where.

    Attributes:
        out: folder of the results. files: that the command reads.
        formats: suffixes of further files of the poses. up: the axis that points up, None if it is not told.
        overlay, pictures: whether a video per camera, and pictures, are wanted. notes: on the cameras.
    """

    out: str
    files: list[Path]
    formats: tuple[str, ...]
    up: str | None
    overlay: bool
    pictures: bool
    notes: tuple[str, ...] = ()


def report_nobody(why: str, folder: Path) -> int:
    """Print why there are no poses, and whether the folder has those of an earlier run; return 1."""
    earlier = folder / _POSES[0]
    said = f"; {earlier} is of an earlier run" if earlier.exists() else ""
    print(f"torchpose: there are no poses: {why}{said}", file=sys.stderr)
    return 1


def body_results(
    job: BodyJob, cameras: "Sequence[PinholeCamera]", overlay: bool, pictures: Sequence[str]
) -> "ResultsFolder":
    """Return the folder of the results, for poses of a body and what shows them.

    Args:
        job: of the command. cameras: of the videos. overlay: whether a video per camera is going to be
            written. pictures: the names of those that are.
    """
    from torchpose.io._results import ResultsFolder, holds_arrays

    videos = [overlay_name(camera.name) for camera in cameras] if overlay else []
    camera = (Path(job.out) / CAMERA_FILE).resolve()
    read = any(file.resolve() == camera for file in job.files)  # an earlier run's, which stays
    return ResultsFolder(
        job.out,
        "track",
        _OWN if read else f"{_OWN}|{re.escape(CAMERA_FILE)}",
        [*_POSES, *_exports(job), *videos, *pictures, "report.html"],
        job.files,
        lambda folder: holds_arrays(folder / _POSES[0], ("state", "joints3d", "body_skeleton")),
    )


def _exports(job: BodyJob) -> list[str]:
    return [f"body.{suffix}" for suffix in job.formats]


def write_people(job: BodyJob, out: Path, people: "Sequence[BodyTrack]") -> list[Path]:
    """Write the poses of everybody: body.npz and so on of the first, body_p02.npz of the second."""
    written = []
    for place, poses in enumerate(people, 1):
        written += _write_poses(job, out, poses, person_suffix(place))
    return written


def _write_poses(job: BodyJob, out: Path, poses: "BodyTrack", suffix: str) -> list[Path]:
    """Write the poses as an .npz, as a table, and in the formats of other programs."""
    files = [out / name for name in (*_POSES, *_exports(job))]
    written = [file.with_stem(file.stem + suffix) for file in files]
    poses.save(written[0])
    _write_csv(written[1], poses)
    for file in written[2:]:
        poses.export(file, up=job.up)
    return written


def _write_csv(path: Path, poses: "BodyTrack") -> None:
    """Write one row per frame: x, y, z of every joint in metres, and its standard deviation.

    Feet, if there are any, follow: heels and toes as joints are, then angles of both ankles in degrees.
    """
    import torch

    from torchpose._core.files import atomic_path
    from torchpose.math._gaussian import mean_std
    from torchpose.whole_body._body_feet import ANKLE_ANGLES
    from torchpose.whole_body._body_track import points_of

    names, points, covariance = points_of(poses)
    rows = torch.cat([points, mean_std(covariance)[..., None]], -1)
    angles, feet = rows.new_zeros(len(rows), 0), poses.feet
    more: list[str] = []
    if feet is not None:
        angles = feet.angles.rad2deg().flatten(1)
        more = [f"{side}_ankle_{angle}" for side in ("left", "right") for angle in ANKLE_ANGLES]
    columns = [*(f"{n}_{axis}" for n in names for axis in ("x", "y", "z", "std")), *more]
    rows = torch.cat([rows.flatten(1), angles], 1)
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as stream:
        stream.write(",".join(["frame", *columns, "coasting"]) + "\n")
        for t, (row, coasting) in enumerate(zip(rows.tolist(), poses.coasting.tolist(),
                                                strict=True)):  # fmt: skip
            cells = [str(t + poses.first_frame), *(f"{v:.4f}" for v in row), str(int(coasting))]
            stream.write(",".join(cells) + "\n")


@contextmanager
def gate_is_in_a_note() -> Iterator[None]:
    """Keep quiet about frames in which the gate of an action lets nobody pass; a note numbers them."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the gate rejected", DegenerateFilterWarning)
        yield


def action_text(poses: "BodyTrack") -> str:
    """Return the likeliest action frame by frame, as runs of frames, or as shares if there are many runs."""
    import torch

    if "actions" not in poses.details or not poses.action_names:
        return ""
    likeliest = poses.details["actions"].argmax(-1)
    action, length = torch.unique_consecutive(likeliest, return_counts=True)
    if len(action) > _MOST_RUNS:
        shares = torch.bincount(likeliest, minlength=len(poses.action_names)) / len(likeliest)
        pairs = zip(poses.action_names, shares.tolist(), strict=True)
        return ", ".join(f"{name} {100 * share:.0f} % of the frames" for name, share in pairs)
    last = length.cumsum(0) + poses.first_frame - 1
    first = last - length + 1
    return ", ".join(
        f"{poses.action_names[k]} {a}-{b}"
        for k, a, b in zip(action.tolist(), first.tolist(), last.tolist(), strict=True)
    )


def write_page(
    camera: "PinholeCamera", people: "Sequence[BodyTrack]", facts: dict[str, str], out: Path
) -> list[Path]:
    """Write the page with the first camera's overlay, if there is one, the skeletons and curves."""
    from torchpose.viz._report.page import write_report

    overlay = out / overlay_name(camera.name)
    first, end = span_of(people)
    late = [f"frame 0 of this page is frame {first} of the recording"] if first else []
    page = write_report(
        out / "report.html", [poses.seen_by(camera) for poses in people],
        overlay=overlay if overlay.exists() else None,
        title="Tracked body" if len(people) == 1 else "Tracked bodies", facts=facts,
        notes=[*late, *_notes_of(people)], first_frames=[poses.first_frame - first for poses in people],
        n_frames=end - first,
    )  # fmt: skip
    return [page]


def _notes_of(people: "Sequence[BodyTrack]") -> tuple[str, ...]:
    names = [f"person {place}" for place, _ in enumerate(people, 1)]
    return notes_of_all([poses.notes for poses in people], names)


def summary(
    people: "Sequence[BodyTrack]",
    facts: dict[str, str],
    written: Sequence[Path],
    notes: Sequence[str] = (),
) -> int:
    """Print what was found; return 1 if persons were lost in more than half of their frames, else 0."""
    for name, fact in facts.items():
        print(f"{name:<12} {fact}")
    if len(people) == 1:
        print(f"{'frames':<12} {len(people[0])} from frame {people[0].first_frame}")
    for place, poses in enumerate(people if len(people) > 1 else (), 1):
        last = poses.first_frame + len(poses) - 1
        print(f"{f'person {place}':<12} frames {poses.first_frame} to {last}")
    coasting = sum(int(poses.coasting.sum()) for poses in people)
    respread = sum(int(poses.respread.sum()) for poses in people)
    if coasting:
        print(f"{'unseen':<12} {counted(coasting, 'frame')}, whose poses are predictions")
    if respread:
        print(f"{'lost':<12} {counted(respread, 'frame')} in which the search began anew")
    for note in (*_notes_of(people), *notes):
        print(f"{'note':<12} {note}")
    print(f"{'written':<12} " + ", ".join(map(str, written)))
    if 2 * (coasting + respread) <= sum(map(len, people)):
        return 0
    print("torchpose: the person was lost in more than half of the frames", file=sys.stderr)
    return 1
