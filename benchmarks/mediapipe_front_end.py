"""The tracker on MediaPipe's landmarks: jitter, gaps, and joints that are not measured.

On the seven webcam clips of `video_asl` (three signers) the tracker is fed with MediaPipe's head, neck
and hands, and with all eight joints. Against MediaPipe's own 2D and 3D joints (`*_pose1.npz`, the full
model): how much they jitter, how gaps are bridged, how far elbows and shoulders that follow from
the hands are off, and how much the poses in space differ. MediaPipe is no truth, in space least of all:
beside it stands how much its own full and heavy models differ.

    python -m benchmarks.mediapipe_front_end --data DIR
"""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks._asl import BURN_IN, CLIPS, FPS, GROUPS, SIZE, VISIBLE, Clip, begun, pad, read_clip
from benchmarks._command import run_command
from benchmarks._data import data_folder
from benchmarks._table_file import TableFile, save_text
from torchpose.camera import PinholeCamera
from torchpose.evaluation import Report
from torchpose.metrics import jitter, joint_errors, joint_errors_3d
from torchpose.priors import UpperBodyPrior, load_prior
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import PoseTrack, UpperBodyTracker

HEAD, NECK, LEFT, RIGHT = (
    UPPER_BODY.index(n) for n in ("head", "neck", "shoulder_left", "shoulder_right")
)
HANDS, ARMS = (0, 7), {0: (0, 1), 7: (7, 6)}
FRONT_ENDS = {"head, neck, hands": (0, 3, 4, 7), "all eight": tuple(range(8))}
MODES: dict[str, dict[str, Any]] = {"filtered": {}, "smoothed": {"smoothing": "full"}}
GAPS = (10, 20, 30)
SIGNERS = (("again", "brother", "help"), ("bird", "milk"), ("book", "learn"))
HEADS, NECKS = (0.8, 0.9, 1.0, 1.1), (0.2, 0.27, 0.34)
_QUICK_FRAMES = 36  # of the clip of a quick run


class Bench:
    """The clips as one batch, and the tracker."""

    def __init__(self, clips: list[Clip], heavy: list[Clip], prior: UpperBodyPrior) -> None:
        self.clips = clips
        self.points, self.lengths = pad([c.points for c in clips])
        self.points3d, _ = pad([c.points3d for c in clips])
        self.heavy3d, _ = pad([c.points3d for c in heavy])
        self.heavy, _ = pad([c.points for c in heavy])
        self.visibility, _ = pad([c.visibility for c in clips])
        self.known, _ = pad([c.known for c in clips])
        self.width = torch.tensor([c.width for c in clips]).double()
        self.trackers = {
            mode: UpperBodyTracker(
                prior, PinholeCamera.from_image_size(*SIZE), fps=FPS, neck="neck", **options
            )
            for mode, options in MODES.items()
        }

    def track(
        self,
        mode: str,
        joints: tuple[int, ...],
        points: Tensor | None = None,
        rows: Tensor | None = None,
    ) -> PoseTrack:
        """Return poses from some of the eight joints; joints of visibility below 0.5 are missing."""
        rows = torch.arange(len(self.clips)) if rows is None else rows
        points = self.points[rows] if points is None else points
        chosen = list(joints)
        with torch.no_grad():
            return self.trackers[mode](
                points[:, :, chosen],
                names=[UPPER_BODY[j] for j in chosen],
                mask=self.visibility[rows][:, :, chosen] >= VISIBLE,
                lengths=self.lengths[rows],
            )

    def inferred(self, given: Sequence[Tensor]) -> Sequence[Tensor]:
        """Return joints in the image that follow from head, neck and hands, for each of several points."""
        rows = torch.arange(len(self.clips)).repeat(len(given))
        joints = FRONT_ENDS["head, neck, hands"]
        return self.track("filtered", joints, torch.cat([*given]), rows).joints2d.chunk(len(given))

    def off_by_clip(self, estimate: Tensor, group: str) -> Tensor:
        """Return the mean distance of a group from MediaPipe's joints, in shoulder widths [clips]."""
        gap = joint_errors(estimate, self.points, self.known) / self.width[:, None, None]
        return gap[..., list(GROUPS[group])].flatten(1).nanmean(1)

    def off(self, estimate: Tensor, widths: bool = False) -> dict[str, float]:
        """Return the mean distance from MediaPipe's joints by group, where those are known."""
        gap = joint_errors(estimate, self.points, self.known)
        if widths:
            gap = gap / self.width[:, None, None]
        return {name: float(gap[..., list(js)].nanmean()) for name, js in GROUPS.items()}


def jitter_tables(bench: Bench, report: Report, tracks: dict[str, PoseTrack]) -> None:
    """Add tables of the mean acceleration in the image and in space."""
    flat = report.table(
        "jitter2d",
        "Jitter in the image: mean acceleration (px/s²), and distance from MediaPipe's joints (px)",
        [*GROUPS, *(f"{g}, distance" for g in GROUPS)],
        digits=(0, 0, 0, 0, 1, 1, 1, 1),
        note="The head is the prior's, not MediaPipe's.",
    )
    space = report.table(
        "jitter3d",
        "Jitter in space, relative to the middle of the shoulders: mean acceleration (m/s²)",
        list(GROUPS),
        digits=1,
    )

    def accelerations(points: Tensor) -> list[float]:
        values = jitter(torch.where(bench.known[..., None], points, torch.nan), FPS)
        return [float(values[:, list(js)].nanmean()) for js in GROUPS.values()]

    def relative(points: Tensor) -> Tensor:
        return points - points[:, :, [LEFT, RIGHT]].mean(2, keepdim=True)

    flat.add("MediaPipe full", [*accelerations(bench.points), 0.0, 0.0, 0.0, 0.0])
    away = bench.off(bench.heavy)
    flat.add("MediaPipe heavy", [*accelerations(bench.heavy), *away.values()])
    for name, mean in (("mean of 3 frames so far", _mean(bench.points, 2, 0)),
                       ("mean of 5 frames about", _mean(bench.points, 2, 2))):  # fmt: skip
        flat.add(f"MediaPipe full, {name}", [*accelerations(mean), *bench.off(mean).values()])
    space.add("MediaPipe full", accelerations(relative(bench.points3d)))
    space.add("MediaPipe heavy", accelerations(relative(bench.heavy3d)))
    for name, track in tracks.items():
        away = bench.off(track.joints2d)
        flat.add(name, [*accelerations(track.joints2d), *away.values()])
        space.add(name, accelerations(relative(track.joints3d)))


def _mean(points: Tensor, before: int, after: int) -> Tensor:
    """Return the mean over a few frames, the simplest smoother."""
    n = points.shape[1]
    rows = torch.arange(n)[:, None] + torch.arange(-before, after + 1)
    return points[:, rows.clamp(0, n - 1)].nanmean(2)


def inferred_table(bench: Bench, report: Report) -> None:
    """Add the errors of inferred elbows and shoulders, for several definitions of head and hand."""
    table = report.table(
        "inferred",
        "Joints that are not measured, from head, neck and hands alone (filtered): mean distance from "
        "MediaPipe's",
        ["elbows (px)", "shoulders (px)", "elbows (widths)", "shoulders (widths)"],
        digits=(1, 1, 3, 3),
        note="In widths of the clip's shoulders. "
        "Where the neck is not given, the tracker puts it 37 % of the way from the middle of the "
        "shoulders to the head.",
    )
    nose, _ = pad([c.nose for c in bench.clips])
    ears, _ = pad([c.ears for c in bench.clips])
    wrists, _ = pad([c.wrists for c in bench.clips])
    middle = bench.points[:, :, [LEFT, RIGHT]].mean(2)
    up = bench.points[:, :, HEAD] - middle
    heads = {
        "nose as head": (nose, middle + 0.369 * (nose - middle)),
        "ears as head": (ears, middle + 0.369 * (ears - middle)),
        "Kinect's mean place (0.92 and 0.34 widths)": (middle + 0.92 * up, middle + 0.34 * up),
        "head and neck as read": (bench.points[:, :, HEAD], bench.points[:, :, NECK]),
    }

    given: dict[str, Tensor] = {}
    for name, (head, neck) in heads.items():
        given[name] = bench.points.clone()
        given[name][:, :, HEAD], given[name][:, :, NECK] = head, neck
    given["the same with wrists as hands"] = bench.points.clone()
    given["the same with wrists as hands"][:, :, list(HANDS)] = wrists
    for name, found in zip(given, bench.inferred([*given.values()]), strict=True):
        pixels, widths = bench.off(found), bench.off(found, widths=True)
        keys = ("elbows", "shoulders")
        table.add(name, [*(pixels[k] for k in keys), *(widths[k] for k in keys)])


def place_table(
    bench: Bench, report: Report, heads: Sequence[float], necks: Sequence[float]
) -> None:
    """Add the errors for several places of head and neck (`torchpose.skeleton._mediapipe_landmarks`)."""
    table = report.table(
        "places",
        "Where head and neck are put: inferred elbows / shoulders (shoulder widths)",
        [f"neck at {share:.0%} of the way" for share in necks],
        note="Head above the middle of the shoulders, towards the ears, in shoulder widths (the ears are "
        "0.54 to 0.66 above it); neck from there to the head. MediaPipe's shoulders lie higher than "
        "Kinect's, so that no place suits elbows and shoulders alike.",
    )
    middle = bench.points[:, :, [LEFT, RIGHT]].mean(2)
    up = bench.points[:, :, HEAD] - middle
    wide = (bench.points[:, :, LEFT] - bench.points[:, :, RIGHT]).norm(dim=-1, keepdim=True)
    up = up / up.norm(dim=-1, keepdim=True) * wide
    given = {}
    for height, share in product(heads, necks):
        points = given[height, share] = bench.points.clone()
        points[:, :, HEAD] = middle + height * up
        points[:, :, NECK] = middle + share * height * up
    tracked = dict(zip(given, bench.inferred([*given.values()]), strict=True))
    errors = {}
    for height in heads:
        cells = []
        for share in necks:
            found = tracked[height, share]
            widths = bench.off(found, widths=True)
            cells.append(f"{widths['elbows']:.3f} / {widths['shoulders']:.3f}")
            parts = [bench.off_by_clip(found, g) for g in ("elbows", "shoulders")]
            errors[height, share] = torch.stack(parts)
        table.add(f"head at {height:g}", cells)
    report.findings += unseen_signers(bench, errors)


def unseen_signers(bench: Bench, errors: dict[tuple[float, float], Tensor]) -> list[str]:
    """Return the errors on each signer's clips of the places that are best on those of the others."""
    sentences = []
    for signer in SIGNERS:
        own = torch.tensor([c.name in signer for c in bench.clips])
        if own.all() or not own.any():
            continue
        place = min(errors, key=lambda p: float(errors[p][:, ~own].mean()))
        elbows, shoulders = errors[place][:, own].mean(1).tolist()
        sentences.append(
            f"Without the clips {', '.join(signer)}, the best is a head at {place[0]:g} with a neck at "
            f"{place[1]:.0%}. On those clips it has errors of {elbows:.3f} at elbows, {shoulders:.3f} at "
            "shoulders."
        )
    return sentences


def by_clip_table(bench: Bench, report: Report, tracks: dict[str, PoseTrack]) -> None:
    """Add the errors of inferred elbows and shoulders, clip by clip."""
    names = [n for n in tracks if n.startswith("head")]
    table = report.table(
        "by_clip",
        "The same, clip by clip: elbows / shoulders (shoulder widths)",
        names,
        note="again, brother, help: dark long sleeves; bird, milk: bare forearms; book, learn: a "
        "skin-coloured jumper.",
    )
    for i, clip in enumerate(bench.clips):
        cells = []
        for name in names:
            gap = joint_errors(tracks[name].joints2d[i], bench.points[i], bench.known[i])
            gap = gap / clip.width
            pair = [float(gap[:, list(GROUPS[g])].nanmean()) for g in ("elbows", "shoulders")]
            cells.append(f"{pair[0]:.3f} / {pair[1]:.3f}")
        table.add(clip.name, cells)


def space_table(bench: Bench, report: Report, tracks: dict[str, PoseTrack]) -> None:
    """Add the distance in space from MediaPipe's own 3D joints."""
    table = report.table(
        "space",
        "Difference from MediaPipe's 3D joints after fixed-scale Procrustes on head, neck and "
        "shoulders: mean (cm)",
        list(GROUPS),
        note="MediaPipe's 3D joints (full model) come from a single image, and are no truth; the "
        "last row shows how much its own two models differ. Its shoulders are 0.34 to "
        "0.36 m apart in the full and 0.28 to 0.31 m in the heavy model.",
    )

    def differences(points: Tensor) -> list[float]:
        errors = 100 * joint_errors_3d(points, bench.points3d, None)
        errors = torch.where(bench.known, errors, torch.nan)
        return [float(errors[..., list(js)].nanmean()) for js in GROUPS.values()]

    for name, track in tracks.items():
        table.add(name, differences(track.joints3d))
    table.add("MediaPipe heavy", differences(bench.heavy3d))


def gap_cases(bench: Bench, length: int, step: int) -> list[tuple[int, int, int]]:
    """Return (clip, hand, first frame) of stretches to hide; a hand is in view at both ends."""
    cases = []
    for clip in range(len(bench.clips)):
        last = int(bench.lengths[clip]) - length - 1
        for hand in HANDS:
            for start in range(BURN_IN + 5, last + 1, step):
                if bool(bench.known[clip, start - 3 : start + length + 1, hand].all()):
                    cases.append((clip, hand, start))
    return cases


def gap_table(bench: Bench, report: Report, step: int, gaps: tuple[int, ...] = GAPS) -> None:
    """Add the errors of hidden hands, by the way in which gaps are filled."""
    table = report.table(
        "gaps",
        "A hand hidden for n frames: mean distance of what is filled in from the hidden landmark (px)",
        [f"{n} frames" for n in gaps],
        note="Smoothers and interpolation see what comes after the gap; the others do not. Constant "
        "velocity goes on with the mean of the last three differences.",
    )
    columns: dict[str, list[float]] = {}
    counts = []
    for length in gaps:
        cases = gap_cases(bench, length, step)
        counts.append(len(cases))
        for name, value in gap_errors(bench, cases, length).items():
            columns.setdefault(name, []).append(value)
    for name, values in columns.items():
        table.add(name, values)
    table.note += f" Hidden stretches: {', '.join(map(str, counts))}."


def gap_errors(bench: Bench, cases: list[tuple[int, int, int]], length: int) -> dict[str, float]:
    """Return the mean error of every way to fill these gaps."""
    clip, hand, start = torch.tensor(cases).T
    n = torch.arange(len(cases))
    frames = start[:, None] + torch.arange(length)
    truth = bench.points[clip[:, None], frames, hand[:, None]]
    known = bench.known[clip[:, None], frames, hand[:, None]]

    def at(offset: int) -> Tensor:
        return bench.points[clip, start + offset, hand][:, None]

    share = (torch.arange(1, length + 1) / (length + 1))[:, None].double()
    count = torch.arange(1, length + 1)[:, None].double()
    filled = {
        "hold the last": at(-1).expand(-1, length, 2),
        "constant velocity": at(-1) + count * (at(-1) - at(-4)) / 3,
    }
    for front_end, joints in FRONT_ENDS.items():
        for arm in (False, True) if "eight" in front_end else (False,):
            points = bench.points[clip].clone()
            points[n[:, None], frames, hand[:, None]] = torch.nan
            if arm:
                elbow = torch.where(hand == HANDS[0], ARMS[0][1], ARMS[7][1])
                points[n[:, None], frames, elbow[:, None]] = torch.nan
            for mode in MODES:
                found = bench.track(mode, joints, points, clip).joints2d
                name = f"{front_end}, {mode}" + (", elbow hidden too" if arm else "")
                filled[name] = found[n[:, None], frames, hand[:, None]]
    filled["interpolation"] = at(-1) + share * (at(length) - at(-1))
    errors = {k: (v - truth).norm(dim=-1)[known].mean() for k, v in filled.items()}
    return {name: float(value) for name, value in errors.items()}


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
        data: folder with video_asl/.
        prior: name or file.
        threads: cores.
        out: file for the same as Markdown, or a folder.
        quick: the beginning of one clip, to see that it works.
    """
    torch.set_num_threads(threads)
    folder = data_folder(data, "video_asl")
    names = CLIPS[:1] if quick else CLIPS
    clips, heavy = ([read_clip(folder, n, m) for n in names] for m in (1, 2))
    if quick:
        clips, heavy = ([begun(clip, _QUICK_FRAMES) for clip in whole] for whole in (clips, heavy))
    fitted = load_prior(prior)
    bench = Bench(clips, heavy, fitted)
    report = Report("MediaPipe as the measuring front end")
    tracks = {
        f"{front_end}, {mode}": bench.track(mode, joints)
        for front_end, joints in FRONT_ENDS.items()
        for mode in MODES
    }
    jitter_tables(bench, report, tracks)
    gap_table(bench, report, *((60, GAPS[:1]) if quick else (10,)))
    inferred_table(bench, report)
    some = slice(2 if quick else None)
    place_table(bench, report, HEADS[some], NECKS[some])
    by_clip_table(bench, report, tracks)
    space_table(bench, report, tracks)
    report.settings = {
        "prior": fitted.info.name,
        "clips": {c.name: f"{len(c.points)} frames, shoulders {c.width:.0f} px" for c in clips},
        "known": "visibility 0.5 or more, in the image, after 15 frames",
        "camera": "f = 525 px (assumed), 640x480, 30 fps",
    }
    print(report.summary())
    save_text(out, report.to_markdown())


if __name__ == "__main__":
    run_command(main)
