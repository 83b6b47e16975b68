"""Hands beyond the borders of the image: where poses have them, with the evidence of absence and without.

The clips of `video_people` in which MediaPipe's hand (`*_mediapipe_pose1.npz`, 0.7 of the way from wrist to
index finger) is below the image, or beside it, in more than 20 frames. Poses are made from the same
measurements twice: a hand that is not measured is missing, or it is missing and probably absent
(`UpperBodyTracker`, `absent`). The first table measures as `torchpose track` does; in the second, MediaPipe's
landmarks are the detector too, so it shows what a detector's hands beyond the image are good for. The
baseline leaves a hand where it was measured last. Hands that are measured although they are outside are
counted apart: both ways draw them where they were measured. The third table takes visible hands away for 20
frames in every 60, and tells the tracker that they are probably absent: what it costs if that is wrong.

    python -m benchmarks.video_borders --data DIR
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks._command import run_command
from benchmarks._table_file import TableFile, print_tables
from benchmarks.hand_network.clips import BELOW, BURN_IN, PEOPLE, Clip, Labels, read_clips
from torchpose import PinholeCamera, PoseTrack, UpperBodyTracker, VideoTracker, load_prior
from torchpose._core.images import Image
from torchpose.evaluation import Report
from torchpose.priors import UpperBodyPrior
from torchpose.skeleton import UPPER_BODY
from torchpose.video import open_video
from torchpose.video._recording import TrackedPerson

CHOOSING = ("P08", "P12")
"""Persons on whom the two constants of `torchpose.upper_body._absence` were chosen."""

_LEAST = 20  # hands outside of the image that a clip needs
_BESIDE = 0.05  # of the width of the image, from where on a hand is beside it
_HANDS = [UPPER_BODY.index(f"hand_{side}") for side in ("left", "right")]
_COLUMNS = (
    "hands outside", "measured (%)", "last place in view (%)", "missing: in view (%)",
    "absent: in view (%)", "missing: off (widths)", "absent: off (widths)",
    "visible but missed", "missing: out of view (%)", "absent: out of view (%)",
)  # fmt: skip


class Landmarks:
    """Gives MediaPipe's landmarks of a clip, frame by frame, as a detector of one person does.

    Args:
        path: of the landmarks.
    """

    def __init__(self, path: Path) -> None:
        with np.load(path) as file:
            self.names = [str(name) for name in file["names"]]
            self._points = file["joints2d"].astype(np.float64)
            self._sure = file["visibility"].astype(np.float64).clip(0, 1)
        self._at = 0

    def reset(self) -> None:
        """Begin with the first frame."""
        self._at = 0

    def __call__(self, image: Image) -> tuple[np.ndarray, np.ndarray]:
        """Return the landmarks of the next frame, of nobody where MediaPipe found nobody."""
        row = min(self._at, len(self._points) - 1)
        self._at += 1
        count = int(np.isfinite(self._points[row]).all())
        return self._points[row : row + 1][:count], self._sure[row : row + 1][:count]


_FALSE = 0.95  # probability that a hand which is taken away cannot be seen
_PERIOD, _AWAY = 60, 20  # frames; the right hand is taken away half a period after the left one
_FALSE_COLUMNS = (
    "hands", "missing: off (widths)", "absent: off (widths)", "missing: out of view (%)",
    "absent: out of view (%)",
)  # fmt: skip


class Drawn(NamedTuple):
    """Holds hands of both kinds of poses, pixels [T, 2, 2], what was measured [T, 2], and the image size."""

    missing: Tensor
    absent: Tensor
    measured: Tensor
    size: tuple[int, int]


class Person(NamedTuple):
    """Holds the person of a clip who is seen longest, a tracker of poses, and the names of the keypoints."""

    found: TrackedPerson
    tracker: UpperBodyTracker
    names: Sequence[str]
    size: tuple[int, int]

    def poses(self, keypoints: Tensor, absent: Tensor | None) -> PoseTrack:
        """Return the poses from these keypoints [T, J, 2] and probabilities of absence [T, J]."""
        cov, sure, absent = (
            None if x is None else x[None]
            for x in (self.found.covariance, self.found.confidence, absent)
        )
        return self.tracker(keypoints[None], sure, self.names, covariance=cov, absent=absent)


def tracked(clip: Clip, prior: UpperBodyPrior, detector: Landmarks | None) -> Person:
    """Return the person of a clip.

    Args:
        clip: the clip. prior: the prior over poses. detector: of keypoints; None measures by faces and hands.
    """
    with open_video(clip.path) as video:
        camera = PinholeCamera.from_image_size(*video.size)
        tracker = VideoTracker(prior, camera, fps=video.fps, detector=detector)
        person, *_ = tracker(video)
        options = {"fps": video.fps, "max_gap": None, "neck": tracker.tracker.neck}
        poses = UpperBodyTracker(prior, camera, **options)
        return Person(person, poses, tracker.measurer.names, video.size)


def placed(values: Tensor, first: int, n_frames: int, nothing: float | bool) -> Tensor:
    """Return the values of a person who is there from a frame on, in frames of the clip."""
    whole = torch.full((n_frames, *values.shape[1:]), nothing, dtype=values.dtype)
    values = values[: n_frames - first]
    whole[first:][: len(values)] = values
    return whole


def drawn(clip: Clip, person: Person) -> Drawn:
    """Return the hands of the person of a clip, with the evidence of their absence and without."""
    plain = person.poses(person.found.keypoints, None)
    where = person.found.first_frame, len(clip.labels.nose)
    hands = (track.joints2d[0][:, _HANDS] for track in (plain, person.found.track))
    missing, absent = (placed(x, *where, torch.nan) for x in hands)
    return Drawn(missing, absent, placed(plain.observed[0][:, _HANDS], *where, False), person.size)


def false_absence(clip: Clip, person: Person) -> list[float] | None:
    """Return a row of the third table; None of a clip without visible hands to take away."""
    found, labels = person.found, clip.labels
    where, rows = (found.first_frame, len(labels.nose)), []
    away = torch.zeros(len(found), 2, dtype=torch.bool)
    keypoints = found.keypoints.clone()
    absent = torch.full_like(keypoints[..., 0], torch.nan)
    frames = torch.arange(len(found)) + found.first_frame - _AWAY
    for hand, side in enumerate(("left", "right")):
        joint = person.names.index(f"hand_{side}")
        apart = (frames - hand * _PERIOD // 2) % _PERIOD
        away[:, hand] = (apart < _AWAY) & keypoints[:, joint].isfinite().all(-1)
        keypoints[away[:, hand], joint] = torch.nan
        absent[away[:, hand], joint] = _FALSE
    scored = placed(away, *where, False) & (labels.seen[:, :2] == 1)
    if not bool(scored.any()):
        return None
    size = torch.tensor(person.size, dtype=torch.float64)
    for given in (None, absent):
        hands = placed(person.poses(keypoints, given).joints2d[0][:, _HANDS], *where, torch.nan)
        off = (hands - labels.centres[:, :2]).norm(dim=-1)[scored] / labels.width
        inside = ((hands >= 0) & (hands < size)).all(-1)[scored]
        rows.append((float(off.nanmedian()), 100 * float((~inside).double().mean())))
    (plain, plain_out), (told, told_out) = rows
    return [int(scored.sum()), plain, told, plain_out, told_out]


def last_places(points: Tensor, measured: Tensor) -> Tensor:
    """Return each point where it was measured last, NaN before [T, 2, 2]."""
    frames = torch.arange(len(points))[:, None]
    last = torch.where(measured, frames, -1).cummax(0).values
    held = points.gather(0, last.clamp_min(0)[..., None].expand_as(points))
    return torch.where((last >= 0)[..., None], held, torch.nan)


def score(labels: Labels, found: Drawn) -> list[float] | None:
    """Return a row of the table; None of a clip with fewer hands outside than it needs."""
    size = torch.tensor(found.size, dtype=torch.float64)
    late = slice(BURN_IN + 1, None)
    truth, seen = labels.centres[late, :2], labels.seen[late, :2]
    x, y = (truth / size).unbind(-1)
    outside = (seen == 0) & ((y > BELOW) | (x < -_BESIDE) | (x > 1 + _BESIDE))
    if int(outside.sum()) <= _LEAST:
        return None
    last = last_places(found.missing, found.measured)[late]
    missing, absent, measured = (values[late] for values in found[:3])
    hidden, missed = outside & ~measured, (seen == 1) & ~measured

    def share(which: Tensor, rows: Tensor) -> float:
        return 100 * float(which[rows].double().mean()) if bool(rows.any()) else torch.nan

    def in_view(points: Tensor) -> Tensor:
        return ((points >= 0) & (points < size)).all(-1)

    def off(points: Tensor) -> float:
        return float(((points - truth).norm(dim=-1)[hidden] / labels.width).nanmedian())

    return [
        int(outside.sum()), share(measured, outside), share(in_view(last), hidden),
        share(in_view(missing), hidden), share(in_view(absent), hidden), off(missing), off(absent),
        int(missed.sum()), share(~in_view(missing), missed), share(~in_view(absent), missed),
    ]  # fmt: skip


def add_table(
    report: Report,
    key: str,
    title: str,
    rows: dict[str, tuple[str, list[float]]],
    columns: Sequence[str] = _COLUMNS,
    digits: tuple[int, ...] = (0, 0, 0, 0, 0, 2, 2, 0, 0, 0),
) -> None:
    """Add the rows of all clips, and their means over both groups of persons.

    Args:
        report: of the benchmark. key, title: of the table. rows: by clip, with the person.
        columns, digits: of the table.
    """
    table = report.table(key, title, list(columns), digits=digits)
    for name, (person, row) in rows.items():
        table.add(f"{name} ({person})", row)
    for title, chosen in (("mean of persons chosen on", True), ("mean of the others", False)):
        values = [row for person, row in rows.values() if (person in CHOOSING) == chosen]
        if values:
            table.add(title, torch.tensor(values, dtype=torch.float64).nanmean(0).tolist())


def main(
    *,
    data: Path,
    prior: str = "kinect-upper-body",
    threads: int = 2,
    out: TableFile | None = None,
    quick: bool = False,
) -> None:
    """Print the tables.

    Args:
        data: folder with video_people/ and video_asl/.
        prior: name or file.
        threads: cores.
        out: file for the same as Markdown, or a folder.
        quick: one clip, to see that it works.
    """
    torch.set_num_threads(threads)
    clips = read_clips(data, ("akstheme_gesture",) if quick else ())
    fitted = load_prior(prior)
    report = Report("Hands beyond the borders of the image")
    titles = {
        "measured": "Measured by faces and hands",
        "detected": "MediaPipe's landmarks as the detector",
    }
    taken: dict[str, tuple[str, list[float]]] = {}
    for key, title in titles.items():
        rows = {}
        for clip in clips:
            path = clip.path.parent / f"{clip.name}_mediapipe_pose1.npz"
            person = tracked(clip, fitted, Landmarks(path) if key == "detected" else None)
            row = score(clip.labels, drawn(clip, person)) if clip.name in PEOPLE else None
            if row is not None:
                rows[clip.name] = clip.person, row
            row = false_absence(clip, person) if key == "measured" else None
            if row is not None:
                taken[clip.name] = clip.person, row
        add_table(report, key, title, rows)
        clips = [clip for clip in clips if clip.name in rows]
    title = "Visible hands that are taken away, and said to be absent"
    add_table(report, "false", title, taken, _FALSE_COLUMNS, (0, 2, 2, 0, 0))
    print_tables(report, out)


if __name__ == "__main__":
    run_command(main)
