"""A detector's keypoints in video of strangers: found and invented hands, elbows and shoulders.

The clips of `video_people`: webcams, phones, studios. The reference is MediaPipe's landmarks beside each clip
(`*_mediapipe_pose1.npz`), so for MediaPipe itself the table says what association, filter and prior leave
of a detector, and not how good that is. A hand is 0.7 of the way from the wrist to the index finger. It is
visible with a visibility of both above 0.6 inside the image, and found within a quarter of the shoulders'
width; it is not there with one below 0.15 or below the image, and invented if it counts as measured then.

    python -m benchmarks.video_detector --data DIR --detector pose_landmarker_full.task
"""

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from benchmarks._command import run_command
from benchmarks._data import data_files, data_folder
from benchmarks._table_file import TableFile, save_text
from benchmarks.hand_network.clips import BELOW, BURN_IN, LOWEST, SEEN, UNSEEN
from torchpose import VideoTracker
from torchpose.camera import PinholeCamera
from torchpose.errors import InputError
from torchpose.evaluation import Report
from torchpose.io import read_keypoints
from torchpose.priors import UpperBodyPrior, load_prior
from torchpose.skeleton import UPPER_BODY
from torchpose.skeleton._joint_sets import canonical_names
from torchpose.video import open_video

NEAR = 0.25  # widths of the shoulders
COLUMNS = ["hands found", "invented", "elbows", "shoulders", "frames with a pose"]


class Scores(NamedTuple):
    """Of one clip: visible hands and those found, absent hands and those invented, shares, medians."""

    visible: int
    found: int
    absent: int
    invented: int
    elbows: float
    shoulders: float
    posed: float

    def cells(self) -> list[float]:
        """Return a row of the table."""
        share = self.found / self.visible if self.visible else torch.nan
        invented = self.invented / self.absent if self.absent else torch.nan
        return [share, invented, self.elbows, self.shoulders, self.posed]


def tracked(
    path: Path, prior: UpperBodyPrior, detector: str | None
) -> tuple[Tensor, Tensor, tuple[int, int]]:
    """Return joints [T, 8, 2] of the person seen longest, what was measured [T, 8], and the image's size."""
    with open_video(path) as video:
        camera = PinholeCamera.from_image_size(*video.size)
        people = VideoTracker(prior, camera, fps=video.fps, detector=detector)(video)
        size = video.size
    if not people:
        return torch.zeros(0, 8, 2), torch.zeros(0, 8, dtype=torch.bool), size
    first = people[0]
    absent = torch.full((first.first_frame, 8, 2), torch.nan, dtype=torch.float64)
    joints = torch.cat([absent, first.track.joints2d[0]])
    measured = torch.cat([absent[..., 0] > 0, first.track.observed[0]])
    return joints, measured, size


def score(path: Path, reference: Path, prior: UpperBodyPrior, detector: str | None) -> Scores:
    """Return the scores of one clip."""
    landmarks = read_keypoints(reference)
    names = canonical_names(landmarks.names)
    points, sure = landmarks.keypoints, landmarks.confidence
    if sure is None:
        raise InputError(f"{reference}: expected a visibility of the landmarks")
    joints, measured, (_, height) = tracked(path, prior, detector)
    n = min(len(points), len(joints))
    points, sure, joints, measured = points[:n], sure[:n], joints[:n], measured[:n]
    late = torch.arange(n)[:, None] > BURN_IN

    def of(part: str) -> tuple[Tensor, Tensor, Tensor]:
        rows = [names.index(f"{part}_{side}") for side in ("left", "right")]
        own = [UPPER_BODY.index(f"{part}_{side}") for side in ("left", "right")]
        gap = (joints[:, own] - points[:, rows]).norm(dim=-1)
        return points[:, rows], sure[:, rows], gap

    shoulders, _, _ = of("shoulder")
    width = float((shoulders[:, 0] - shoulders[:, 1]).norm(dim=-1).nanmedian())
    hands, hand_sure, hand_gap = of("hand")
    v = hands[..., 1]
    visible = late & (hand_sure > SEEN) & (v > 0) & (v < LOWEST * height)
    absent = late & ((hand_sure < UNSEEN) | (v > BELOW * height))
    own = [UPPER_BODY.index(f"hand_{side}") for side in ("left", "right")]

    def median(part: str) -> float:
        place, confidence, gap = of(part)
        return float(gap[late & (confidence > SEEN) & (place[..., 1] < height)].nanmedian()) / width

    return Scores(
        int(visible.sum()), int((visible & (hand_gap < NEAR * width)).sum()),
        int(absent.sum()), int((absent & measured[:, own]).sum()),
        median("elbow"), median("shoulder"),
        float(joints[BURN_IN + 1 :, UPPER_BODY.index("head"), 0].isfinite().double().mean()),
    )  # fmt: skip


def main(
    *,
    data: Path,
    detector: str | None = None,
    prior: str = "kinect-upper-body",
    threads: int = 2,
    out: TableFile | None = None,
    quick: bool = False,
) -> None:
    """Print the table.

    Args:
        data: folder with video_people/.
        detector: as of torchpose track; without it torchpose measures.
        prior: name or file.
        threads: cores.
        out: file for the same as Markdown, or a folder.
        quick: one clip, to see that it works.
    """
    torch.set_num_threads(threads)
    folder = data_folder(data, "video_people")
    references = data_files(folder, "*_mediapipe_pose1.npz")[: 1 if quick else None]
    fitted = load_prior(prior)
    report = Report("Keypoints of a detector in video of strangers")
    table = report.table("clips", "By clip: shares, and medians in widths of the shoulders", COLUMNS,
                         digits=(2, 2, 2, 2, 2))  # fmt: skip
    scores = []
    for reference in references:
        name = reference.name.removesuffix("_mediapipe_pose1.npz")
        scores.append(score(folder / f"{name}.mp4", reference, fitted, detector))
        table.add(name, scores[-1].cells())
    rows = torch.tensor([one.cells() for one in scores], dtype=torch.float64)
    invented = sum(one.invented for one in scores) / max(1, sum(one.absent for one in scores))
    mean, middle = rows.nanmean(0).tolist(), rows.nanmedian(0).values.tolist()
    table.add("all (means of shares, medians of medians; invented pooled)",
              [mean[0], invented, *middle[2:4], mean[4]])  # fmt: skip
    report.settings = {"detector": detector or "none", "prior": fitted.info.name}
    print(report.summary())
    save_text(out, report.to_markdown())


if __name__ == "__main__":
    run_command(main)
