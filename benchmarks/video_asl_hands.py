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
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks._asl import BURN_IN, CLIPS, FPS, Clip, read_clip
from benchmarks._command import OneOf, run_command
from benchmarks._table_file import TableFile
from benchmarks.speed._timing import Report, limit_threads, machine_line
from torchpose.errors import InputError
from torchpose.measure import HandTracker
from torchpose.measure._edges import edge_map
from torchpose.measure._face import FaceTracker
from torchpose.measure._hand_likelihood import HandSettings
from torchpose.measure._hand_prior import HandPrior
from torchpose.priors import load_prior
from torchpose.video import open_video

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
CHANGES = ("mirrored", "late", "small", "half rate", "dark", "reversed")


class Material(NamedTuple):
    """A clip to be tracked.

    Attributes:
        frames: RGB [T, 480, 640, 3]. truth: left and right hand [T, 2, 2], NaN where unknown.
        tolerance: pixels. faces: (x, y, B) [T, 3], NaN where there is none. fps: its frame rate.
    """

    frames: np.ndarray
    truth: Tensor
    tolerance: float
    faces: Tensor
    fps: float


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
    folder = data / "video_asl" if (data / "video_asl").is_dir() else data
    hand_prior = HandPrior.from_prior(load_prior(prior))
    report = Report("Hands in the clips of video_asl", out)
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
        name = next(iter(makers))
        for kind, count, file in draw_failures(pictures, materials, found[name]):
            near = os.path.relpath(file, out.parent if out else ".")
            report.add(f"{kind.capitalize()}, {count} hand-frames:")
            report.add(f"![Hands found {kind}]({near})")
    report.add(
        "First 3: again, brother, help. px: median distance of what is not missing. Swapped and missing in "
        "percent. ms: median CPU time of a frame, without face detection, beside other work. "
        f" {machine_line(threads, ['opencv-python-headless'])}"
    )
    report.close()


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


def read_material(folder: Path, name: str, change: str = "") -> Material:
    """Return a clip, as it is or changed, with its faces."""
    clip = read_clip(folder, name)
    with open_video(folder / f"{name}.mkv") as video:
        frames = np.stack([frame.image for frame in video])
    frames = frames[-len(clip.points) :]  # of "brother" MediaPipe had all frames but the first
    truth, tolerance, fps = _truth(clip), clip.width / 4, FPS
    if change:
        frames, truth, scale, fps = _changed(change, frames, truth)
        tolerance *= scale
    return Material(frames, truth, tolerance, follow_face(frames), fps)


def _truth(clip: Clip) -> Tensor:
    known = clip.known.clone()
    known[:BURN_IN] = False
    return torch.where(known[:, [0, 7], None], clip.points[:, [0, 7]], torch.nan)


def _changed(
    change: str, frames: np.ndarray, truth: Tensor
) -> tuple[np.ndarray, Tensor, float, float]:
    """Return frames and truth after a change, the scale of the image, and the frame rate."""
    import cv2

    width = frames.shape[2]
    if change == "mirrored":
        mirrored = truth.flip(1).clone()
        mirrored[..., 0] = width - 1 - mirrored[..., 0]
        return np.ascontiguousarray(frames[:, :, ::-1]), mirrored, 1.0, FPS
    if change == "late":
        return frames[10:], torch.cat([truth[10:20] * torch.nan, truth[20:]]), 1.0, FPS
    if change == "small":
        shrunk = [cv2.resize(f, (480, 360), interpolation=cv2.INTER_AREA) for f in frames]
        border = [cv2.copyMakeBorder(f, 120, 0, 100, 60, cv2.BORDER_REPLICATE) for f in shrunk]
        return np.stack(border), 0.75 * truth + torch.tensor([100.0, 120.0]), 0.75, FPS
    if change == "half rate":
        return frames[::2], truth[::2], 1.0, FPS / 2
    if change == "dark":
        rng = np.random.default_rng(0)
        noise = rng.normal(0, 4, frames.shape).astype(np.float32)
        dark = np.clip(frames * np.float32([0.66, 0.6, 0.62]) + noise, 0, 255)
        return dark.astype(np.uint8), truth, 1.0, FPS
    if change == "reversed":
        late = truth.flip(0).clone()
        late[:BURN_IN] = torch.nan
        return frames[::-1].copy(), late, 1.0, FPS
    raise InputError(f"changes are {', '.join(CHANGES)}, got {change!r}")


def follow_face(frames: np.ndarray) -> Tensor:
    """Return the longest-lived face of every frame [T, 3], NaN where none may be used."""
    import cv2

    tracker = FaceTracker()
    tracks, faces = tracker.init(), []
    for frame in frames:
        tracks = tracker.step(tracks, cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY))
        usable = tracker.usable(tracks)
        nowhere = torch.full((3,), torch.nan, dtype=torch.float64)
        longest = int(torch.where(usable, tracks.age, -1).argmax()) if bool(usable.any()) else -1
        faces.append(tracks.mean[longest, :3] if longest >= 0 else nowhere)
    return torch.stack(faces)


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


def draw_failures(
    folder: Path, materials: dict[str, Material], found: dict[str, Found]
) -> Iterator[tuple[str, int, Path]]:
    """Draw a sheet for each kind of failure, of at most eight frames that are not neighbours."""
    import cv2

    kinds: dict[str, list[tuple[str, int]]] = {}
    for clip, material in materials.items():
        for t, kind in failures(found[clip].points, material):
            kinds.setdefault(kind, []).append((clip, t))
    folder.mkdir(parents=True, exist_ok=True)
    for kind, places in kinds.items():
        some = places[:: max(1, -(-len(places) // 8))][:8]
        views = [_view(clip, t, materials[clip], found[clip].points[t]) for clip, t in some]
        views += [np.full_like(views[0], 255)] * (-len(views) % 4)
        sheet = np.vstack([np.hstack(views[i : i + 4]) for i in range(0, len(views), 4)])
        name = f"{kind.replace(' ', '-')}.jpg"
        quality = [cv2.IMWRITE_JPEG_QUALITY, 80]
        cv2.imwrite(str(folder / name), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR), quality)
        yield kind, len(places), folder / name


def failures(points: Tensor, material: Material) -> Iterator[tuple[int, str]]:
    """Yield the frames with a wrong hand, and the kind of failure."""
    truth, near = material.truth, material.tolerance
    for t, k in torch.nonzero(~truth.isnan().any(-1)).tolist():
        point, face = points[t, k], material.faces[t]
        if bool(point.isnan().any()):
            yield t, "missing"
        elif float((point - truth[t, k]).norm()) <= near:
            continue
        elif float((point - truth[t, 1 - k]).norm()) <= near:
            yield t, "at the other hand"
        elif float((point - face[:2]).norm()) <= 0.8 * float(face[2]):
            yield t, "on the face"
        elif float((point - truth[t, k]).norm()) <= 2 * near:
            yield t, "beside the hand"
        else:
            yield t, "elsewhere"


def _view(clip: str, t: int, material: Material, points: Tensor) -> np.ndarray:
    """Draw the edges of a frame with true and found hands; the recordings must not be copied."""
    import cv2

    grey = cv2.cvtColor(material.frames[t], cv2.COLOR_RGB2GRAY)
    lines = np.where(edge_map(np.asarray(grey, np.uint8)).numpy(), 60, 255).astype(np.uint8)
    image = cv2.cvtColor(lines, cv2.COLOR_GRAY2RGB)
    for k, colour in enumerate(((0, 160, 0), (220, 0, 0))):
        if not bool(material.truth[t, k].isnan().any()):
            x, y = (int(v) for v in material.truth[t, k])
            cv2.circle(image, (x, y), round(material.tolerance), colour, 2)
        if not bool(points[k].isnan().any()):
            at = tuple(int(v) for v in points[k])
            cv2.drawMarker(image, at, (255, 255, 255), cv2.MARKER_CROSS, 40, 7)
            cv2.drawMarker(image, at, colour, cv2.MARKER_CROSS, 36, 3)
    cv2.putText(image, f"{clip} {t}", (8, 40), 0, 1.2, (0, 0, 0), 5)
    cv2.putText(image, f"{clip} {t}", (8, 40), 0, 1.2, (255, 255, 255), 2)
    small = cv2.resize(image, (280, 210), interpolation=cv2.INTER_AREA)
    return np.asarray(small)


if __name__ == "__main__":
    run_command(main)
