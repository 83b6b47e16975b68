"""How well are hands found in ordinary webcam video?

    python -m benchmarks.video_asl_hands --data FOLDER [--trackers grid,mean-shift] [--ablation]
        [--changed] [--pictures DIR] [--out FILE]

On the seven clips of `video_asl` (three signers). The truth is MediaPipe's centre of the hand, wrist +
0.7 (index - wrist), where its visibility is at least 0.5 and the point lies in the image, after 15
frames. A hand is right within a quarter of the clip's shoulder width (33 to 40 px), swapped if it is
not and lies that near to the other hand, missing if the tracker says that it is lost. Faces come from
`FaceTracker`: the longest-lived track.

`--ablation` switches parts of the tracker off, one at a time. `--changed` runs clips that were mirrored
(left and right change places in the truth too), entered late, shrunk, halved in frame rate, darkened
with noise, or reversed in time; settings were compared on those too, so nothing is held out. `--pictures`
draws frames of every kind of failure: rings are the truth, crosses what was found, green the person's
left hand and red the right.
"""

import math
import os
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor

from benchmarks._asl import CLIPS
from benchmarks._asl_failures import draw_failures
from benchmarks._asl_materials import CHANGES, Material, read_material
from benchmarks._command import OneOf, run_command
from benchmarks._data import data_folder
from benchmarks._table_file import TableFile
from benchmarks.speed._timing import Report, limit_threads
from torchpose.errors import InputError
from torchpose.measure import HandTracker
from torchpose.measure._hand_likelihood import HandSettings
from torchpose.measure._hand_prior import HandPrior
from torchpose.priors import load_prior

EASY = CLIPS[:3]  # dark long sleeves
HEADER = ("", *CLIPS, "all", "first 3", "px", "px, first 3", "swapped", "missing", "ms")
ABLATION: dict[str, dict[str, Any]] = {
    "all parts": {},
    "no optical flow": {"flow": 0.0},
    "no motion in the likelihood": {"motion": 0.0, "unusual": 0.0},
    "no running median": {"unusual": 0.0},
    "no point beyond the fingers": {"beyond": 0.0},
    "no shape (beyond, towards, beside)": {"beyond": 0.0, "towards": 0.0, "beside": 0.0},
    "no exclusion of the hands": {"exclusion": 0.0},
    "no cost of crossing": {"crossing": 0.0},
    "no clothes in the skin model": {"clothes_share": 0.0},
    "no background in the skin model": {"clothes_share": 1.0},
    "neither: the face's histogram": {"clothes_share": 0.0, "skin_floor": 0.05},
    "no prior in the likelihood": {"prior": 0.0},
    "no memory of the face": {"face_memory": False},
    "no alignment of the face": {"face_alignment": False},
    "still frames count fully": {"still": 1.0},
    "no rebirth": {"jump": 2e-4},
    "rebirth before the face too": {"face_rebirth": 0.0},
    "no velocity": {"velocity": 0.0},
    "beyond the image is no skin": {"unknown_skin": 0.0},
    "no filter (wide diffusion)": {
        "jump": 0.5, "flow": 0.0, "far": 0.8, "near_share": 0.1, "still": 1.0
    },
}  # fmt: skip


class Found(NamedTuple):
    """What a tracker said: points [T, 2, 2], NaN where a hand is lost; CPU seconds per frame."""

    points: Tensor
    covariance: Tensor
    seconds: list[float]


class Score(NamedTuple):
    """Hand-frames of a clip: how many, and how many of them right, swapped, missing; errors."""

    count: int
    right: int
    swapped: int
    missing: int
    errors: Tensor


def main(
    *,
    data: Path,
    prior: str = "kinect-upper-body",
    trackers: str = "grid",
    ablation: bool = False,
    changed: bool = False,
    pictures: Path | None = None,
    clips: Annotated[Sequence[str], OneOf(CLIPS)] = CLIPS,
    threads: int = 1,
    quick: bool = False,
    out: TableFile | None = None,
) -> None:
    """Print the tables.

    Args:
        data: folder with video_asl/.
        prior: name or file.
        trackers: grid, mean-shift, or both.
        ablation: switch parts off, one at a time.
        changed: changed clips too.
        pictures: folder for sheets of failures.
        clips: which clips.
        threads: cores.
        quick: one clip only.
        out: file for the same as Markdown, or a folder.
    """
    import cv2

    limit_threads(threads)
    cv2.setNumThreads(threads)  # faces differ a little with the number of threads
    clips = list(clips[:1] if quick else clips)
    folder = data_folder(data, "video_asl")
    hand_prior = HandPrior.from_prior(load_prior(prior))
    report = Report("Hands in the clips of video_asl", out, threads)
    materials = {name: read_material(folder, name) for name in clips}
    makers = make_trackers(trackers.split(","), hand_prior, report)
    found = {}
    rows = []
    for name, make in makers.items():
        found[name] = {clip: track(make(m.fps), m) for clip, m in materials.items()}
        rows.append(row(name, found[name], materials))
    report.add("Hands found, percent within a quarter of the shoulder width:")
    report.table(HEADER, rows)
    for name in makers:
        report.add(f"{name}: {calibration(found[name], materials)}")
    if ablation:
        report.add("Parts switched off, one at a time:")
        report.table(HEADER, ablation_rows(hand_prior, materials, quick))
    if changed:
        report.add("Changed clips:")
        report.table(HEADER, changed_rows(makers, folder, clips))
    if pictures:
        points = {clip: f.points for clip, f in found[next(iter(makers))].items()}
        for kind, count, file in draw_failures(pictures, materials, points):
            near = os.path.relpath(file, out.parent if out else ".")
            report.add(f"{kind.capitalize()}, {count} hand-frames:")
            report.add(f"![Hands found {kind}]({near})")
    report.add(
        "First 3: again, brother, help. px: median distance of what is not missing. Swapped and missing in "
        "percent. ms: median CPU time of a frame, without face detection, beside other work."
    )
    report.close(["opencv-python-headless"])


def make_trackers(
    names: list[str], prior: HandPrior, report: Report
) -> dict[str, Callable[[float], Any]]:
    """Return functions that make a tracker for a frame rate, by name."""
    made: dict[str, Callable[[float], Any]] = {}
    for name in names:
        if name == "grid":
            made[name] = lambda fps: HandTracker(prior, fps=fps)
        elif name == "mean-shift":
            try:
                from torchpose.measure import MeanShiftHandTracker
            except ImportError as error:
                report.add(f"The paper's recipe is left out: {error}.")
                continue
            made["mean-shift"] = lambda fps: MeanShiftHandTracker()
            made["mean-shift, skin ratio"] = lambda fps: MeanShiftHandTracker("ratio", prior=prior)
        else:
            raise InputError(f"trackers are grid and mean-shift, got {name!r}")
    return made


def track(tracker: Any, material: Material) -> Found:
    """Return the hands of the one person in a clip."""
    state, points, covariance, seconds = tracker.init(), [], [], []
    nobody = torch.full((2, 2), torch.nan, dtype=torch.float64)
    for frame, face in zip(material.frames, material.faces, strict=True):
        known = torch.isfinite(face).all()[None]
        start = time.process_time()
        state, hands = tracker.step(state, frame, face[None][known], torch.zeros(1).long()[known])
        seconds.append(time.process_time() - start)
        if not bool(known):
            points.append(nobody)
            covariance.append(torch.eye(2, dtype=torch.float64).expand(2, 2, 2))
            continue
        points.append(torch.where(hands.seen[0, :, None], hands.points[0].double(), torch.nan))
        covariance.append(hands.covariance[0].double())
    return Found(torch.stack(points), torch.stack(covariance), seconds)


def score(points: Tensor, material: Material) -> Score:
    """Return counts and errors of a clip."""
    truth = material.truth
    known, given = ~truth.isnan().any(-1), ~points.isnan().any(-1)
    error = (points - truth).norm(dim=-1)
    right = known & given & (error <= material.tolerance)
    other = (points - truth.flip(1)).norm(dim=-1) <= material.tolerance
    swapped = known & given & ~right & other
    counts = (int(x.sum()) for x in (known, right, swapped, known & ~given))
    return Score(*counts, error[known & given])


def row(name: str, found: dict[str, Found], materials: dict[str, Material]) -> list[str]:
    """Return a row of the table."""
    scores = {clip: score(f.points, materials[clip]) for clip, f in found.items()}
    easy = [s for clip, s in scores.items() if clip in EASY]
    cells = [_percent([scores[clip]], "right") if clip in scores else "" for clip in CLIPS]
    cells += [_percent(scores.values(), "right"), _percent(easy, "right")]
    cells += [_median(scores.values()), _median(easy)]
    cells += [_percent(scores.values(), "swapped"), _percent(scores.values(), "missing")]
    seconds = [s for f in found.values() for s in f.seconds]
    return [name, *cells, f"{1e3 * statistics.median(seconds):.1f}"]


def calibration(found: dict[str, Found], materials: dict[str, Material]) -> str:
    """Return a sentence on how many of the found hands lie within their ellipses."""
    inside, right = [], []
    for clip, material in materials.items():
        error = found[clip].points - material.truth
        known = ~error.isnan().any(-1)
        error, cov = error[known], found[clip].covariance[known]
        inside.append((error * torch.linalg.solve(cov, error[..., None])[..., 0]).sum(-1))
        right.append(error.norm(dim=-1) <= material.tolerance)
    squared, good = torch.cat(inside), torch.cat(right)
    shares = []
    for level in (0.5, 0.9):
        within = squared <= -2 * math.log(1 - level)
        kinds = [100 * float(within[kind].double().mean()) for kind in (good, good | True)]
        shares.append("{:.0f} % (of all: {:.0f} %) within {:.0f} %".format(*kinds, 100 * level))
    return f"of the right hands {' and '.join(shares)} of what their covariance says."


def _percent(scores: Iterable[Score], what: str) -> str:
    scores = list(scores)
    count = sum(s.count for s in scores)
    return f"{100 * sum(getattr(s, what) for s in scores) / count:.1f}" if count else ""


def _median(scores: Iterable[Score]) -> str:
    errors = torch.cat([torch.zeros(0).double(), *(s.errors for s in scores)])
    return f"{float(errors.median()):.1f}" if len(errors) else ""


def ablation_rows(
    prior: HandPrior, materials: dict[str, Material], quick: bool
) -> Iterable[list[str]]:
    """Return rows with parts switched off."""
    rows = []
    for name, off in list(ABLATION.items())[: 3 if quick else None]:
        settings = HandSettings(**off)
        found = {
            clip: track(HandTracker(prior, settings, m.fps), m) for clip, m in materials.items()
        }
        rows.append(row(name, found, materials))
    return rows


def changed_rows(
    makers: dict[str, Callable[[float], Any]], folder: Path, clips: list[str]
) -> Iterable[list[str]]:
    """Return rows on changed clips, and one with all of them."""
    rows, kept = [], {name: {} for name in makers}  # type: ignore[var-annotated]
    everything: dict[str, Material] = {}
    for change in CHANGES:
        materials = {clip: read_material(folder, clip, change) for clip in clips}
        for name, make in makers.items():
            found = {clip: track(make(m.fps), m) for clip, m in materials.items()}
            rows.append(row(f"{change}, {name}" if len(makers) > 1 else change, found, materials))
            kept[name] |= {f"{change} {clip}": f for clip, f in found.items()}
        small = {clip: m._replace(frames=m.frames[:0]) for clip, m in materials.items()}
        everything |= {f"{change} {clip}": m for clip, m in small.items()}
    for name, found in kept.items():
        label = f"all changed, {name}" if len(makers) > 1 else "all changed"
        rows.append(row(label, found, everything))
    return rows


if __name__ == "__main__":
    run_command(main)
