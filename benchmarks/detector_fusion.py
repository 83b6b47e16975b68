"""A detector's hands and torchpose's own, alone and together, beside a second model of hands.

The detector is MediaPipe's pose landmarker (`*_mediapipe_pose1.npz`): a hand is 0.7 of the way from wrist to
index finger, and is lost with a confidence below 0.3 or outside of the image. Own hands are those that
`torchpose track` measures. The truth are the centres of MediaPipe's hand landmarks (`*_mediapipe_hands.npz`),
another network, so its errors are less like the detector's. A hand is right within a quarter of the
shoulder width. Three ways to use both: own hands where the detector has none; the mean with the inverse
variances as weights, which takes their errors for independent; and the one with the smaller variance,
which is the covariance intersection (Julier & Uhlmann, 1997) of two circles and holds for any correlation.

    python -m benchmarks.detector_fusion --data DIR
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from benchmarks._command import run_command
from benchmarks._table_file import TableFile, save_text
from benchmarks.hand_network.clips import BURN_IN, Clip, found_hands, read_clips
from torchpose._core.reading import read_npz
from torchpose.evaluation import Report
from torchpose.io import read_keypoints
from torchpose.skeleton._joint_sets import canonical_names

_SURE = 0.3  # confidence from which on the detector has a hand
_STD = 0.03  # of a detected hand with full confidence, shoulder widths
_NEAR = 0.25  # shoulder widths
_WAYS = ("own", "detector", "detector, else own", "mean", "smaller variance")
_COLUMNS = (
    "hands", *(f"{way} (%)" for way in _WAYS), "lost by the detector", "own right there",
    "own where neither has one",
)  # fmt: skip


class Hands(NamedTuple):
    """Holds hands [T, 2, 2], pixels, NaN where there is none, and their variances [T, 2]."""

    points: Tensor
    variance: Tensor

    @property
    def there(self) -> Tensor:
        """Return where there is a hand [T, 2]."""
        return self.points.isfinite().all(-1)

    def filled(self, other: Hands) -> Hands:
        """Return these hands, and those of another where there is none."""
        return self.chosen(other, self.there)

    def chosen(self, other: Hands, which: Tensor) -> Hands:
        """Return these hands where `which` is True, else the others."""
        points = torch.where(which[..., None], self.points, other.points)
        return Hands(points, torch.where(which, self.variance, other.variance))


def detected(clip: Clip, size: tuple[int, int]) -> Hands:
    """Return the detector's hands."""
    landmarks = read_keypoints(clip.path.parent / f"{clip.name}_mediapipe_pose1.npz")
    names = canonical_names(landmarks.names)
    rows = [names.index(f"hand_{side}") for side in ("left", "right")]
    points, confidence = landmarks.keypoints[:, rows].double(), landmarks.confidence
    if confidence is None:
        raise ValueError(f"{clip.name}: expected a visibility of the landmarks")
    sure = confidence[:, rows].double()
    inside = ((points >= 0) & (points < torch.tensor(size))).all(-1)
    there = (inside & (sure >= _SURE))[..., None]
    variance = (_STD * clip.labels.width) ** 2 / sure.clamp_min(1e-3)
    return Hands(torch.where(there, points, torch.nan), variance)


def together(own: Hands, found: Hands) -> dict[str, Hands]:
    """Return the hands of every way to use both."""
    weight = own.variance / (own.variance + found.variance)
    mean = own.points.lerp(found.points, weight[..., None])
    both = own.there & found.there
    either = found.filled(own)
    averaged = Hands(mean, found.variance * weight).chosen(either, both)
    smaller = own.chosen(either, both & (own.variance < found.variance))
    return dict(zip(_WAYS, (own, found, either, averaged, smaller), strict=True))


def score(ways: dict[str, Hands], truth: Tensor, width: float) -> list[float] | None:
    """Return a row of the table; None without any true hands.

    Args:
        ways: from `together`. truth: pixels, NaN where unknown [T, 2, 2]. width: of the shoulders, pixels.
    """
    late = slice(BURN_IN + 1, None)
    known = truth[late].isfinite().all(-1)
    if not bool(known.any()):
        return None
    right = {
        way: (hands.points[late] - truth[late]).norm(dim=-1) < _NEAR * width
        for way, hands in ways.items()
    }
    shares = [100 * float(near[known].double().mean()) for near in right.values()]
    own, found = (ways[way].there[late] for way in _WAYS[:2])
    lost = known & ~found
    return [
        int(known.sum()), *shares, int(lost.sum()), int((lost & right["own"]).sum()),
        int((own & ~found & ~known).sum()),
    ]  # fmt: skip


def true_hands(clip: Clip) -> Tensor:
    """Return the centres of both hands by MediaPipe's model of hands, NaN where it has none [T, 2, 2]."""
    arrays = read_npz(clip.path.parent / f"{clip.name}_mediapipe_hands.npz")
    return torch.from_numpy(arrays["centre2d"]).double()


def main(
    *,
    data: Path,
    threads: int = 2,
    out: TableFile | None = None,
    quick: bool = False,
) -> None:
    """Print the table.

    Args:
        data: folder with video_people/ and video_asl/.
        threads: cores.
        out: file for the same as Markdown, or a folder.
        quick: one clip, to see that it works.
    """
    torch.set_num_threads(threads)
    clips = read_clips(data, ("akstheme_gesture",) if quick else ())
    report = Report("Hands of a detector and own hands")
    digits = (0,) * len(_COLUMNS)
    table = report.table("hands", "Hands that are right, by clip", list(_COLUMNS), digits=digits)
    rows = []
    for clip in clips:
        points, variance, size = found_hands(clip)
        truth, found = true_hands(clip), detected(clip, size)
        count = min(len(points), len(truth), len(found.points))
        own = Hands(points[:count], variance[:count])
        ways = together(own, Hands(found.points[:count], found.variance[:count]))
        row = score(ways, truth[:count], clip.labels.width)
        if row is not None:
            rows.append(row)
            table.add(f"{clip.name} ({clip.person})", row)
    values = torch.tensor(rows, dtype=torch.float64)
    shares, counts = values[:, 1 : 1 + len(_WAYS)].mean(0), values[:, 1 + len(_WAYS) :].sum(0)
    total = [float(values[:, 0].sum()), *shares.tolist(), *counts.tolist()]
    table.add("mean of clips; sums of hands", total)
    print(table.to_markdown())
    save_text(out, table.to_markdown() + "\n")


if __name__ == "__main__":
    run_command(main)
