"""Are persons found whose faces are small, large, tilted, in the dark, and nobody where nobody is?

The clips of `video_people` and `video_asl`, changed: scaled such that the face has so many pixels and put
into a rendered room of 960 x 540, cut such that the face fills a part of the frame, turned, darkened, tinted.
A face is as large as 1.42 distances of MediaPipe's ears (median of a clip), which is what OpenCV's cascade
draws. A person is found in a frame if a face that the tracker uses is within half a size of MediaPipe's nose;
every other face in use is a false person. All frames count, the first ones without a face too.

    python -m benchmarks.video_faces --data DIR
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import cv2
import numpy as np
import torch

from benchmarks._command import OneOf, run_command
from benchmarks._data import data_files
from benchmarks._table_file import TableFile, save_text
from benchmarks.hand_network.clips import PEOPLE, SIGNERS
from torchpose._core.images import Image
from torchpose.demo._rendering.scene import Scene, room
from torchpose.evaluation import Report
from torchpose.io import read_keypoints
from torchpose.measure._face import FaceTracker
from torchpose.video import open_video

LONGER = 960  # pixels of the longer side of a frame in which faces are looked for
FACE = 1.42  # size of a face in distances of the ears
NEAR = 0.5  # sizes between face and nose
UNSEEN = 1.0  # seconds over which a face counts that is not detected
MOST = 45  # frames of a clip


class Frame(NamedTuple):
    """Holds a frame, RGB, the nose in it, and the size of the face, pixels."""

    image: Image
    nose: np.ndarray
    size: float


Change = Callable[[Frame], Frame]


def mapped(frame: Frame, matrix: np.ndarray, shape: tuple[int, int], canvas: Image | None) -> Frame:
    """Return a frame under an affine map [2, 3], on a canvas of that width and height (black without one)."""
    scale = float(np.sqrt(abs(np.linalg.det(matrix[:, :2]))))
    image, inner = frame.image, matrix.copy()
    if scale < 1:  # averaged first, as a camera does
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        inner[:, :2] /= scale
    moved = cv2.warpAffine(image, inner, shape, borderMode=cv2.BORDER_REPLICATE)
    if canvas is not None:
        inside = cv2.warpAffine(np.full(image.shape[:2], 255, np.uint8), inner, shape) > 127
        moved = np.where(inside[..., None], moved, canvas)
    nose = matrix[:, :2] @ frame.nose + matrix[:, 2]
    return Frame(np.asarray(moved, np.uint8), nose, scale * frame.size)


def small(pixels: float) -> Change:
    """Return what makes the face so small and puts the frame into the middle of a room."""
    width, height = 960, 540
    canvas = np.rint(room(width, height, Scene())).astype(np.uint8)

    def change(frame: Frame) -> Frame:
        scale = pixels / frame.size
        rows, columns = (scale * n for n in frame.image.shape[:2])
        place = [[scale, 0.0, (width - columns) / 2], [0.0, scale, (height - rows) / 2]]
        return mapped(frame, np.array(place), (width, height), canvas)

    return change


def large(share: float, width: int, height: int) -> Change:
    """Return what enlarges the frame until the face has this share of the frame's height (or width)."""

    def change(frame: Frame) -> Frame:
        scale = share * min(width, height) / frame.size
        x, y = scale * frame.nose
        away = [[scale, 0.0, width / 2 - x], [0.0, scale, 0.5 * height - y]]
        return mapped(frame, np.array(away), (width, height), None)

    return change


def turned(degrees: float) -> Change:
    """Return what turns the frame about the nose."""

    def change(frame: Frame) -> Frame:
        height, width = frame.image.shape[:2]
        matrix = cv2.getRotationMatrix2D(tuple(frame.nose), degrees, 1.0)
        return mapped(frame, matrix, (width, height), None)

    return change


def lit(exposure: float, gamma: float = 1.0, tint: tuple[float, ...] = (1.0, 1.0, 1.0)) -> Change:
    """Return what changes the light: v = 255 (exposure tint v / 255)^gamma."""
    level = exposure * np.arange(256)[:, None] / 255 * np.array(tint)
    table = np.rint(255 * level.clip(0, 1) ** gamma).astype(np.uint8)

    def change(frame: Frame) -> Frame:
        image = np.stack([table[frame.image[..., c], c] for c in range(3)], -1)
        return frame._replace(image=image)

    return change


CHANGES: dict[str, Change | None] = {
    "none": None,
    "face of 30 px": small(30), "face of 20 px": small(20), "face of 16 px": small(16),
    "face 0.4 of 640 x 480": large(0.4, 640, 480), "face 0.6 of 640 x 480": large(0.6, 640, 480),
    "face 0.6 of 720 x 1280": large(0.6, 720, 1280),
    "turned by 20 degrees": turned(20), "turned by 35 degrees": turned(35),
    "light x 0.3": lit(0.3), "gamma 2": lit(1.0, 2.0), "warm light x 0.5": lit(0.5, 1.0, (1.0, 0.7, 0.4)),
}  # fmt: skip


class Found(NamedTuple):
    """Holds the share of frames in which the person is found, and false persons in a frame."""

    share: float
    false: float


def frames(path: Path, most: int) -> Iterator[Frame]:
    """Yield the first frames of a clip, with MediaPipe's nose."""
    landmarks = read_keypoints(path.with_name(f"{path.stem}_mediapipe_pose1.npz"))
    names = list(landmarks.names)
    points = landmarks.keypoints.double().numpy()
    nose, left, right = (points[:, names.index(n)] for n in ("nose", "left_ear", "right_ear"))
    size = FACE * float(np.nanmedian(np.linalg.norm(left - right, axis=-1)))
    with open_video(path) as video:
        for place, frame in zip(nose[:most], video, strict=False):
            yield Frame(frame.image, place, size)


def smaller(frame: Frame) -> Frame:
    """Return a frame whose longer side has at most 960 pixels, as the measurer makes it."""
    height, width = frame.image.shape[:2]
    scale = LONGER / max(height, width)
    if scale >= 1:
        return frame
    image = cv2.resize(frame.image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return Frame(np.asarray(image, np.uint8), scale * frame.nose, scale * frame.size)


def follow(shown: list[Frame], fps: float) -> Found:
    """Return how the person of these frames is found."""
    tracker = FaceTracker()
    tracks, found, false = tracker.init(), 0, 0
    for frame in map(smaller, shown):
        tracks = tracker.step(tracks, cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY))
        used = tracker.usable(tracks) & (tracks.unseen <= UNSEEN * fps)
        away = np.linalg.norm(tracks.mean[used, :2].numpy() - frame.nose, axis=1)
        near = int((away < NEAR * frame.size).any())
        found, false = found + near, false + len(away) - near
    return Found(found / len(shown), false / len(shown))


def main(
    *,
    data: Path,
    out: TableFile | None = None,
    threads: int = 1,
    only: Annotated[Sequence[str], OneOf(CHANGES)] | None = None,
    quick: bool = False,
) -> None:
    """Print shares of frames and false persons, by change and by clip.

    Args:
        data: folder of the data sets.
        out: file for the same as Markdown, or a folder.
        threads: cores.
        only: these changes.
        quick: one short clip, three changes.
    """
    torch.set_num_threads(threads)
    folders = ((data / "video_people", PEOPLE), (data / "video_asl", SIGNERS))
    clips = [data_files(folder, f"{name}.m*")[0] for folder, names in folders for name in names]
    changes = {name: CHANGES[name] for name in only or CHANGES}
    most = MOST
    if quick:
        clips, most, changes = clips[-3:-2], 20, dict(list(changes.items())[:3])
    report = make_report(clips, changes, most)
    print(report.summary())
    save_text(out, report.to_markdown())


def make_report(clips: list[Path], changes: dict[str, Change | None], most: int) -> Report:
    """Return the report of these clips, frames decoded once."""
    rows: dict[str, list[Found]] = {name: [] for name in changes}
    for clip in clips:
        with open_video(clip) as video:
            fps = video.fps
        shown = list(frames(clip, most))
        for name, change in changes.items():
            seen = shown if change is None else [change(frame) for frame in shown]
            rows[name].append(follow(seen, fps))
    report = Report("Faces in changed clips")
    table = report.table(
        "changes", "Person found (mean share of frames), least of a clip, false persons in a frame",
        ["found", "least", "false persons"], digits=(3, 2, 3),
    )  # fmt: skip
    for name, found in rows.items():
        shares, false = np.array(found).T
        table.add(name, [shares.mean(), shares.min(), false.mean()])
    each = report.table("clips", "Clip by clip: found / false persons", list(changes))
    for i, clip in enumerate(clips):
        each.add(clip.stem, [f"{r[i].share:.2f} / {r[i].false:.2f}" for r in rows.values()])
    report.settings = {"frames of a clip": f"the first {most} at most"}
    return report


if __name__ == "__main__":
    run_command(main)
