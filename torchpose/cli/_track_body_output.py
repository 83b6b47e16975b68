"""What `torchpose track-body` reads, writes and prints: videos as silhouettes, poses, pictures, words."""

import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

from torchpose.cli._track_output import person_suffix
from torchpose.errors import DegenerateFilterWarning

if TYPE_CHECKING:
    from torch import Tensor

    from torchpose.camera._pinhole import PinholeCamera
    from torchpose.camera._rig import CameraRig
    from torchpose.cli._command import Given
    from torchpose.io._results import ResultsFolder
    from torchpose.video._silhouettes import SilhouetteMeasurer, SilhouetteView
    from torchpose.video._source_interface import VideoSource
    from torchpose.whole_body._body_track import BodyTrack
    from torchpose.whole_body._body_tracker import BodyTracker

__all__ = [
    "KALMAN",
    "BodyJob",
    "Recordings",
    "action_text",
    "body_results",
    "draw",
    "facts_of",
    "gate_is_in_a_note",
    "project_joints",
    "summary",
    "write_page",
    "write_people",
]

KALMAN = "kalman"
"""The method that takes nothing but keypoints, and is their default."""
_POSES = ("body.npz", "joints.csv")
_OWN = (
    r"(body(_p\d\d+)?\.(npz|trc|c3d|bvh)|joints(_p\d\d+)?\.csv|skeleton(_p\d\d+)?\.png)"
    r"|overlay(_.+\.mp4|\.png)|report\.html"
    r"|refined_cameras\.toml"
)
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


class Recordings:
    """The videos, how each becomes silhouettes, and the silhouettes that were seen so far.

    A context manager, which closes the videos.

    Args:
        videos: a file or a folder of images for each camera. cameras: in the same order.
        rows: height of the silhouettes. fps: rate at which all are read, by default their own.
        delays: frames by which each began too early. background: of the empty scene for each camera.
        ignore_still: whether what always looks the same in a video is no person.
    """

    def __init__(
        self,
        videos: Sequence[str],
        cameras: "Sequence[PinholeCamera]",
        rows: int,
        *,
        fps: float | None = None,
        delays: Sequence[int] | None = None,
        background: Sequence[str] | None = None,
        ignore_still: bool = False,
    ) -> None:
        from torchpose.video._silhouettes import fit_views

        self.videos, self._fps, self.background = videos, fps, background or ()
        self._delays, self._ignore_still = delays, ignore_still
        self.sources = self._open()
        self.views = fit_views(cameras, [s.size for s in self.sources], rows)
        self.packed: list[Any] = []
        self.notes: list[str] = []

    def __enter__(self) -> "Recordings":
        return self

    def __exit__(self, *_: object) -> None:
        for source in self.sources:
            source.close()

    @cached_property
    def rig(self) -> "CameraRig":
        """Return the cameras of the silhouettes."""
        from torchpose.camera._rig import CameraRig

        return CameraRig([view.camera for view in self.views])

    @property
    def fps(self) -> float:
        """Return the frames per second."""
        return float(self.sources[0].fps)

    @property
    def names(self) -> Sequence[str]:
        """Return the names of the cameras."""
        return self.rig.names

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Return (width, height) of each video."""
        return [view.size for view in self.views]

    @property
    def n_frames(self) -> int | None:
        """Return how many frames to expect, None if unknown."""
        counts = [s.n_frames for s in self.sources if s.n_frames is not None]
        return min(counts, default=None)

    def silhouettes(self) -> "Iterator[Tensor]":
        """Learn the background; return silhouettes [C, H, W] of one frame after the other.

        They are kept, a bit per pixel.
        """
        return self._read(self._measurers())

    def _read(self, measurers: "list[SilhouetteMeasurer]") -> "Iterator[Tensor]":
        import numpy as np

        from torchpose.video._silhouettes import read_silhouettes

        for masks in read_silhouettes(self.sources, measurers, self._delays):
            self.packed.append(np.packbits(masks.numpy(), axis=-1))
            yield masks

    def kept(self, frame: int) -> "Tensor":
        """Return the silhouettes of a frame that was read."""
        import numpy as np
        import torch

        width = self.rig.sizes[0][1]  # type: ignore[index]  # views have sizes
        bits = np.unpackbits(self.packed[frame], axis=-1)[..., :width]
        return torch.from_numpy(bits.astype(bool))

    def images(self) -> Iterator[tuple[Any, ...]]:
        """Read the frames of all cameras once more."""
        from torchpose.video._silhouettes import frames_in_step

        sources = self._open()
        try:
            for frames in frames_in_step(sources, self._delays or [0] * len(sources)):
                yield tuple(frame.image for frame in frames)
        finally:
            for source in sources:
                source.close()

    def drawn(self, people: "Sequence[BodyTrack]", t: int, images: Sequence[Any]) -> list[Any]:
        """Return the images of frame t of all cameras with the one body and the outline."""
        from torchpose.video._overlay import draw_body
        from torchpose.whole_body._silhouettes.rendering import render

        (poses,) = people
        k, rig = t - poses.first_frame, self.rig
        height, width = rig.sizes[0]  # type: ignore[misc]  # views have sizes
        model = render(poses.body, poses.state[k], rig, height, width)
        measured = self.kept(t)
        drawn = []
        for c, (view, image) in enumerate(zip(self.views, images, strict=True)):
            part = _inside(view)
            joints = project_joints(poses.joints3d[k], view.source)
            drawn.append(
                draw_body(image, joints, poses.body.skeleton,
                          model=model[c][part], silhouette=measured[c][part])
            )  # fmt: skip
        return drawn

    def _open(self) -> "list[VideoSource]":
        from torchpose.video._source import open_video

        return [open_video(path, fps=self._fps) for path in self.videos]

    def _measurers(self) -> "list[SilhouetteMeasurer]":
        from torchpose.video._silhouettes import (
            SilhouetteMeasurer,
            learning_frames,
            read_empty_scene,
        )
        from torchpose.video._source import open_video

        print("learning the background ...", flush=True)
        empty = [read_empty_scene(path) for path in self.background]
        if not empty:
            self.notes.append(
                "without --background what stays in the videos is taken for their background; a part "
                "of the person that never moves is taken for it, too"
            )
        measurers = []
        for i, (view, path) in enumerate(zip(self.views, self.videos, strict=True)):
            if empty and not self._ignore_still:
                measurers.append(SilhouetteMeasurer(view, empty[i]))
                continue
            with open_video(path, fps=self._fps) as source:
                frames = learning_frames(source)
                measurers.append(SilhouetteMeasurer(view, empty[i] if empty else None, frames))
        return measurers


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
    """Write one row per frame: x, y, z of every joint in metres, and its standard deviation."""
    from torchpose._core.files import atomic_path

    columns = [f"{n}_{axis}" for n in poses.names for axis in ("x", "y", "z", "std")]
    rows = poses.joints3d.new_zeros(len(poses), len(poses.names), 4)
    rows[..., :3], rows[..., 3] = poses.joints3d, poses.joints_std()
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as stream:
        stream.write(",".join(["frame", *columns, "coasting"]) + "\n")
        for t, (row, coasting) in enumerate(zip(rows.flatten(1).tolist(), poses.coasting.tolist(),
                                                strict=True)):  # fmt: skip
            cells = [str(t + poses.first_frame), *(f"{v:.4f}" for v in row), str(int(coasting))]
            stream.write(",".join(cells) + "\n")


def _span(people: "Sequence[BodyTrack]") -> tuple[int, int]:
    """Return the first frame with somebody, and the one after the last."""
    first = min(poses.first_frame for poses in people)
    return first, max(poses.first_frame + len(poses) for poses in people)


def draw(
    films: DrawnVideos, people: "Sequence[BodyTrack]", out: Path, videos: bool, picture: bool
) -> list[Path]:
    """Draw all bodies into the frames of every camera: videos, and some frames as one picture."""
    from contextlib import ExitStack

    from torchpose.video._writer import VideoWriter

    files = [out / _overlay_name(name) for name in films.names] if videos else []
    first, end = _span(people)
    chosen = {round(i * (end - first - 1) / 5) + first for i in range(6)}
    strip: list[list[Any]] = []
    with ExitStack() as stack:
        writers = [
            stack.enter_context(VideoWriter(file, films.fps, size))
            for file, size in zip(files, films.sizes, strict=False)
        ]
        for t, images in enumerate(films.images()):
            if not first <= t < end:
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
    return files


def _inside(view: "SilhouetteView") -> tuple[slice, slice]:
    """Return the part of a silhouette that the frame of the video shows."""
    (w, h), (right, below), (inner_w, inner_h) = view.size, view.padding, view.inner
    return slice(0, round(inner_h * h / (h + below))), slice(0, round(inner_w * w / (w + right)))


def project_joints(joints: "Tensor", camera: "PinholeCamera") -> "Tensor":
    """Return the pixels [J, 2] of world points [J, 3] in the images of a camera, its distortions applied."""
    import cv2
    import numpy as np
    import torch

    model = cv2.fisheye if camera.fisheye else cv2
    distortions = camera.distortions.numpy()
    pixels, _ = model.projectPoints(
        np.ascontiguousarray(joints.detach().cpu().double().numpy())[:, None],
        camera.rotation.numpy(), camera.translation.numpy(), camera.matrix.numpy(),
        distortions if len(distortions) else np.zeros(4),
    )  # fmt: skip
    return torch.from_numpy(np.asarray(pixels).reshape(-1, 2))


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


def facts_of(
    given: "Given",
    tracker: "BodyTracker",
    recordings: "Recordings",
    poses: "BodyTrack",
    seconds: float,
) -> dict[str, str]:
    """Return what was tracked, and how, by the name of each fact."""
    height, width = recordings.rig.sizes[0]  # type: ignore[misc]  # views have sizes
    values = given.values
    matters = "sharpness" not in tracker.filter.unused
    sharpness = f", sharpness {tracker.filter.sharpness:g}" if matters else ""
    facts = {
        "videos": f"{len(recordings.videos)} cameras, {recordings.fps:g} fps",
        "silhouettes": f"{width} x {height} pixels, "
        + ("against the empty scene" if recordings.background else "against what stays"),
        "method": f"{tracker.method}, {tracker.n_particles} particles{sharpness}",
        "learnt": ", ".join(filter(None, map(values.get, ("manifold", "conditionals", "action")))),
        "body": values["body"] or f"average proportions, {tracker.upright.height:.3g} m",
        "actions": action_text(poses),
        "speed": f"{len(poses) / max(seconds, 1e-9):.1f} frames a second, without drawing",
    }
    return {name: fact for name, fact in facts.items() if fact}


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

    overlay = out / _overlay_name(camera.name)
    bones = [(p, j) for j, p in enumerate(people[0].body.skeleton.parents) if p >= 0]
    first, end = _span(people)
    page = write_report(
        out / "report.html", [poses.seen_by(camera) for poses in people],
        overlay=overlay if overlay.exists() else None,
        title="Tracked body" if len(people) == 1 else "Tracked bodies", facts=facts,
        notes=_notes_of(people), first_frames=[poses.first_frame - first for poses in people],
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
