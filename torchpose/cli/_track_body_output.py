"""What `torchpose track-body` writes and prints: poses, pictures, words."""

import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

from torchpose.cli._track_output import person_suffix
from torchpose.errors import DegenerateFilterWarning

if TYPE_CHECKING:
    from torch import Tensor

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
_FOLDED = 0.01  # of a ray's length: between it and what its pixel is undistorted to
_MOST_RUNS = 8  # of actions that are listed by their frames


class BodyJob(NamedTuple):
    """Holds what a run of the command writes, and where.

    Attributes:
        out: folder of the results. files: that the command reads.
        formats: suffixes of further files of the poses. up: the axis that points up, None if it is not told.
        overlay, pictures: whether a video per camera, and pictures, are wanted.
    """

    out: str
    files: list[Path]
    formats: tuple[str, ...]
    up: str | None
    overlay: bool
    pictures: bool


@runtime_checkable
class DrawnVideos(Protocol):
    """Declares the videos of all cameras, and how bodies are drawn into them."""

    @property
    def names(self) -> Sequence[str]:
        """Return the names of the cameras."""
        ...

    @property
    def sizes(self) -> Sequence[tuple[int, int]]:
        """Return (width, height) of each video."""
        ...

    @property
    def fps(self) -> float:
        """Return the frames per second."""
        ...

    def images(self) -> Iterator[tuple[Any, ...]]:
        """Read the frames of all cameras."""
        ...

    def drawn(self, people: "Sequence[BodyTrack]", t: int, images: Sequence[Any]) -> list[Any]:
        """Return the images of frame t of all cameras with the bodies that are there."""
        ...


def body_results(
    job: BodyJob, cameras: "Sequence[PinholeCamera]", overlay: bool, pictures: Sequence[str]
) -> "ResultsFolder":
    """Return the folder of the results, for poses of a body and what shows them.

    Args:
        job: of the command. cameras: of the videos. overlay: whether a video per camera is going to be
            written. pictures: the names of those that are.
    """
    from torchpose.io._results import ResultsFolder, holds_arrays

    videos = [_overlay_name(camera.name) for camera in cameras] if overlay else []
    return ResultsFolder(
        job.out,
        "track",
        _OWN,
        [*_POSES, *_exports(job), *videos, *pictures, "report.html"],
        job.files,
        lambda folder: holds_arrays(folder / _POSES[0], ("state", "joints3d", "body_skeleton")),
    )


def _exports(job: BodyJob) -> list[str]:
    return [f"body.{suffix}" for suffix in job.formats]


def _overlay_name(camera: str) -> str:
    return f"overlay_{camera}.mp4"


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
    from torchpose.whole_body._body_feet import ANKLE_ANGLES

    names, rows = poses.names, torch.cat([poses.joints3d, poses.joints_std()[..., None]], -1)
    angles, feet = rows.new_zeros(len(rows), 0), poses.feet
    more: list[str] = []
    if feet is not None:
        names = (*names, *feet.names)
        rows = torch.cat([rows, torch.cat([feet.points3d, feet.points_std()[..., None]], -1)], 1)
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


def _span(people: "Sequence[BodyTrack]") -> tuple[int, int]:
    """Return the first frame with somebody, and the one after the last."""
    first = min(poses.first_frame for poses in people)
    return first, max(poses.first_frame + len(poses) for poses in people)


def draw(
    films: DrawnVideos, people: "Sequence[BodyTrack]", out: Path, videos: bool, picture: bool
) -> tuple[list[Path], tuple[str, ...]]:
    """Draw all bodies into the frames of every camera: videos, and some frames as one picture.

    Returns:
        The files, and a note if a video ends before the poses do.
    """
    from contextlib import ExitStack

    from torchpose.video._writer import VideoWriter

    files = [out / _overlay_name(name) for name in films.names] if videos else []
    first, end = _span(people)
    chosen = {round(i * (end - first - 1) / 5) + first for i in range(6)}
    strip: list[list[Any]] = []
    count = 0
    with ExitStack() as stack:
        writers = [
            stack.enter_context(VideoWriter(file, films.fps, size))
            for file, size in zip(files, films.sizes, strict=False)
        ]
        for t, images in enumerate(films.images()):
            if t >= end:
                break
            count = t + 1
            if t < first:
                continue
            if not videos and t not in chosen:
                continue
            drawn = films.drawn(people, t, images)
            for writer, image in zip(writers, drawn, strict=False):
                writer.write(image)
            if t in chosen:
                strip.append(drawn)
    if picture and strip:
        files.append(_write_strip(out / "overlay.png", strip))
    if count == end:
        return files, ()
    return files, (
        f"a video ends after {count} frames, so overlays do not show the poses after that",
    )


def project_joints(joints: "Tensor", camera: "PinholeCamera") -> "Tensor":
    """Return the pixels [J, 2] of world points [J, 3] in the images of a camera, its distortions applied.

    Points have none, NaN, behind the camera, and where the distortions, which were fitted to the image alone,
    fold back into it what lies far beside it.
    """
    import torch

    from torchpose.camera._rig import distort_rays, straighten_rays

    points = joints.detach().cpu().double() @ camera.rotation_matrix.mT + camera.translation
    straight, lens = points[:, :2] / points[:, 2:], (camera.distortions, camera.fisheye)
    rays = distort_rays(straight, *lens)
    size = 1 + straight.norm(dim=-1, keepdim=True)
    off = (straighten_rays(rays, *lens) - straight).norm(dim=-1, keepdim=True) / size
    pixels = rays @ camera.matrix[:2, :2].mT + camera.matrix[:2, 2]
    return torch.where((points[:, 2:] > 0) & (off < _FOLDED), pixels, torch.nan)


def _write_strip(path: Path, strip: list[list[Any]]) -> Path:
    """Write frames as columns and cameras as rows."""
    import cv2
    import numpy as np

    from torchpose._core.files import atomic_path

    height = 320

    def small(image: Any) -> Any:
        width = max(1, round(image.shape[1] * height / image.shape[0]))
        return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)

    rows = [np.hstack([small(frame[c]) for frame in strip]) for c in range(len(strip[0]))]
    widest = max(row.shape[1] for row in rows)
    rows = [np.pad(row, ((0, 4), (0, widest - row.shape[1]), (0, 0))) for row in rows]
    with atomic_path(path) as temporary:
        coded = cv2.imencode(".png", cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR))[1]
        temporary.write_bytes(coded.tobytes())
    return path


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
    from torchpose.body._feet import FOOT_BONES
    from torchpose.viz._report.page import write_report

    overlay = out / _overlay_name(camera.name)
    bones = [(p, j) for j, p in enumerate(people[0].body.skeleton.parents) if p >= 0]
    bones += FOOT_BONES if people[0].feet is not None else ()
    first, end = _span(people)
    late = [f"frame 0 of this page is frame {first} of the recording"] if first else []
    page = write_report(
        out / "report.html", [poses.seen_by(camera) for poses in people],
        overlay=overlay if overlay.exists() else None,
        title="Tracked body" if len(people) == 1 else "Tracked bodies", facts=facts,
        notes=[*late, *_notes_of(people)], first_frames=[poses.first_frame - first for poses in people],
        n_frames=end - first, limbs=bones,
    )  # fmt: skip
    return [page]


def _notes_of(people: "Sequence[BodyTrack]") -> list[str]:
    """Return the notes that all persons have, and those of single ones."""
    shared = [note for note in people[0].notes if all(note in one.notes for one in people)]
    own = [
        f"person {place}: {note}"
        for place, one in enumerate(people, 1)
        for note in one.notes
        if note not in shared
    ]
    return shared + own


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
        print(f"{'unseen':<12} {coasting} frames, in which the pose is a prediction")
    if respread:
        print(f"{'lost':<12} {respread} frames, in which the search began anew")
    for note in (*_notes_of(people), *notes):
        print(f"{'note':<12} {note}")
    print(f"{'written':<12} " + ", ".join(map(str, written)))
    if 2 * (coasting + respread) <= sum(map(len, people)):
        return 0
    print("torchpose: the person was lost in more than half of the frames", file=sys.stderr)
    return 1
