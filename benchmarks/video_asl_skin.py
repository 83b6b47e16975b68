"""Does a Gaussian mixture find skin better than a histogram, and what does it cost?

    python -m benchmarks.video_asl_skin --data FOLDER

On the seven webcam clips of `video_asl` (three signers), at a quarter of their size. A pixel is skin if it
lies in a disc about a hand that MediaPipe saw (a third of the face's size, about wrist + 0.7 (index -
wrist)); everything else but face and neck is not. The area under the ROC curve is the probability that
a pixel of a hand gets a higher value than one that is none; 0.5 is chance. Forearms count as "none", so
bare ones cost all models alike.

Burke & Lasenby (section 5.2) replaced the mixture by back-projecting the face's histogram because it was
slow and gave little. `ratio` compares that histogram with those of clothes and far background.
"""

import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks._asl import BURN_IN, CLIPS, read_clip
from benchmarks._command import run_command
from benchmarks._data import data_folder
from benchmarks._table_file import TableFile, save_text
from benchmarks.speed._timing import markdown_table, processor_model
from torchpose.measure import SkinMixtureModel
from torchpose.measure._face import FaceTracker
from torchpose.measure._skin import SkinModel, parts_of_persons, rgb_to_lab
from torchpose.video import open_video

SCALE = 4
DISC = 1 / 3  # radius of a hand, in sizes of the face
FACE = (0.7, -1.0, 1.1)  # half the width, top and bottom of what is left out


class Frame(NamedTuple):
    """A frame with a face: Lab [1, 3, H, W], the face [1, 3], hands [2, 2] (NaN if not seen)."""

    lab: Tensor
    face: Tensor
    hands: Tensor
    scored: bool


class BackProjection(torch.nn.Module):
    """The paper's: the histogram of the face over its largest value."""

    def __init__(self) -> None:
        super().__init__()
        self.model = SkinModel()

    def init(self, batch_size: int) -> Any:
        return self.model.init(batch_size)

    def step(self, state: Any, lab: Tensor, faces: Tensor) -> tuple[Any, Tensor]:
        bins = self.model.bins(lab)
        state = self.model.learn(state, bins, parts_of_persons(faces, bins.shape[1:]))
        histogram = state.face.sum(1).flatten(1)
        table = histogram / histogram.amax(1, keepdim=True)
        return state, table.gather(1, (bins % table.shape[1]).flatten(1)).view(bins.shape)


MODELS = {
    "histogram, back-projected": BackProjection,
    "histogram, ratio": SkinModel,
    "mixture, 1 component": lambda: SkinMixtureModel(1),
    "mixture, 3 components": lambda: SkinMixtureModel(3),
    "mixture, 5 components": lambda: SkinMixtureModel(5),
    "mixture, 3, in every frame": lambda: SkinMixtureModel(3, every=1),
}


def main(*, data: Path, quick: bool = False, out: TableFile | None = None) -> None:
    """Print the table.

    Args:
        data: folder with video_asl/.
        quick: one clip, every tenth frame scored.
        out: file for the same as Markdown, or a folder.
    """
    torch.set_num_threads(1)
    folder = data_folder(data, "video_asl")
    clips = CLIPS[:1] if quick else CLIPS
    every = 10 if quick else 3
    areas: dict[str, list[float]] = {name: [] for name in MODELS}
    times: dict[str, list[float]] = {name: [] for name in MODELS}
    for clip in clips:
        frames = list(read_frames(folder, clip, every))
        for name, make in MODELS.items():
            area, seconds = score(make(), frames)
            areas[name].append(area)
            times[name] += seconds
    rows = [
        [name, *(f"{a:.3f}" for a in areas[name]), f"{statistics.fmean(areas[name]):.3f}",
         f"{1e3 * statistics.median(times[name]):.2f}"]
        for name in MODELS
    ]  # fmt: skip
    text = markdown_table(["area under the curve", *clips, "mean", "ms a frame"], rows)
    text += f"\n\n{processor_model()}, one thread, median of CPU times at 160 x 120, Lab given.\n"
    print(text, end="")
    save_text(out, text)


def read_frames(folder: Path, name: str, every: int) -> Iterator[Frame]:
    """Yield the frames in which a face is followed."""
    import cv2

    hands = read_clip(folder, name)
    tracker = FaceTracker()
    tracks = tracker.init()
    with open_video(folder / f"{name}.mkv") as video:
        for t, frame in zip(range(len(hands.points)), video, strict=False):
            image = frame.image
            tracks = tracker.step(tracks, cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
            usable = tracker.usable(tracks)
            if not bool(usable.any()):
                continue
            longest = int(torch.where(usable, tracks.age, -1).argmax())
            size = (image.shape[1] // SCALE, image.shape[0] // SCALE)
            small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            lab = rgb_to_lab(torch.from_numpy(small).permute(2, 0, 1)[None] / 255)
            points = torch.where(hands.known[t, [0, 7], None], hands.points[t, [0, 7]], torch.nan)
            face = tracks.mean[longest : longest + 1, :3].float() / SCALE
            scored = t >= BURN_IN and t % every == 0
            yield Frame(lab, face, points.float() / SCALE, scored)


def score(model: torch.nn.Module, frames: list[Frame]) -> tuple[float, list[float]]:
    """Return the mean area under the curve over the frames, and the CPU seconds of each."""
    state, areas, times = model.init(1), [], []  # type: ignore[operator]
    for frame in frames:
        start = time.process_time()
        state, skin = model.step(state, frame.lab, frame.face)  # type: ignore[operator]
        times.append(time.process_time() - start)
        if frame.scored and bool(torch.isfinite(frame.hands).any()):
            hand, other = pixels(frame)
            if hand.any():
                areas.append(area_under_curve(skin[0][hand].numpy(), skin[0][other].numpy()))
    return statistics.fmean(areas), times


def pixels(frame: Frame) -> tuple[Tensor, Tensor]:
    """Return the pixels of hands, and those of neither hands nor head, bool [H, W]."""
    height, width = frame.lab.shape[2:]
    u, v = torch.arange(width), torch.arange(height)[:, None]
    x, y, size = frame.face[0]
    discs = [(u - a).square() + (v - b).square() < (DISC * size) ** 2 for a, b in frame.hands]
    hand = discs[0] | discs[1]
    across, down = (u - x).abs() / size, (v - y) / size
    head = (across < FACE[0]) & (down > FACE[1]) & (down < FACE[2])
    return hand & ~head, ~hand & ~head


def area_under_curve(positive: np.ndarray, negative: np.ndarray) -> float:
    """Return the probability that a positive is above a negative; equal ones count half."""
    values = np.sort(negative)
    below = np.searchsorted(values, positive, "left") + np.searchsorted(values, positive, "right")
    return float(below.mean() / (2 * len(values)))


if __name__ == "__main__":
    run_command(main)
