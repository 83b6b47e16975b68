"""Joints in the image, measured in video: the paper's Figures 12 and 13 on seven webcam clips.

The pipeline (face, skin, hands, filter) and, beside it, the same filter fed with MediaPipe's head, neck
and hands, or with its head and neck alone (what the prior alone says of hands), against MediaPipe's 2D
joints (`*_pose1.npz`, the full model) where their visibility is 0.5 or more, in the image, after 15
frames. Elbows and shoulders are inferred, never measured. The paper compares itself with Eichner et al.
(2012), whose code is not to be had; MediaPipe's joints are the reference here as Kinect's are there, and
its Figure 12 has the pipeline with and without background subtraction, as here.

    python -m benchmarks.video_asl_joints --data DIR --out video-joints.md --pictures DIR
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks._asl import BURN_IN, CLIPS, FPS, GROUPS, SIZE, VISIBLE, Clip, begun, read_clip
from benchmarks._command import run_command
from benchmarks._data import data_folder
from benchmarks._table_file import TableFile, save_text
from torchpose._core.files import check_output_folder
from torchpose.camera import PinholeCamera
from torchpose.evaluation import Report
from torchpose.metrics import pcp
from torchpose.metrics._pose_errors import ARM_LIMBS, PCP
from torchpose.priors import UpperBodyPrior, load_prior
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import UpperBodyTracker
from torchpose.video import VideoFrame, open_video
from torchpose.video._video_tracker import VideoTracker

HEAD = UPPER_BODY.index("head")
TRUNK = (HEAD, UPPER_BODY.index("neck"))
HANDS = (UPPER_BODY.index("hand_left"), UPPER_BODY.index("hand_right"))
THRESHOLDS = (0.2, 0.3, 0.5, 0.7, 1.0)
SHOWN = "again"
_QUICK_FRAMES = 20  # of the clip of a quick run
Method = Callable[[Clip], Tensor]


def from_video(
    folder: Path, prior: UpperBodyPrior, background: bool, most: int | None = None
) -> Method:
    """Return a method: joints [T, 8, 2] of the person seen longest, by the pipeline, in `most` frames."""

    def run(clip: Clip) -> Tensor:
        video = open_video(folder / f"{clip.name}.mkv")
        camera = PinholeCamera.from_image_size(*video.size)
        tracker = VideoTracker(prior, camera, fps=video.fps or FPS, background=background)
        own: list[int] = []
        people = tracker(watched(video, own, most))
        joints = torch.full((own[-1] + 1, 8, 2), torch.nan, dtype=clip.points.dtype)
        if people:
            found = people[0].track.joints2d[0]
            rows = people[0].first_frame + torch.arange(len(found))
            joints[rows[rows <= own[-1]]] = found[rows <= own[-1]]
        if len(own) != len(clip.points):
            raise ValueError(
                f"{clip.name}: {len(own)} frames, but landmarks of {len(clip.points)} frames"
            )
        return joints[own]

    return run


def watched(
    frames: Iterable[VideoFrame], own: list[int], most: int | None = None
) -> Iterator[VideoFrame]:
    """Yield the frames, and add the indices of those that differ from the one before to `own`.

    It stops after `most` that differ. A video that lacks a frame is read with the one before twice;
    MediaPipe saw what there is.
    """
    last = None
    for frame in frames:
        if last is None or not np.array_equal(frame.image, last):
            if len(own) == most:
                return
            own.append(int(frame.index))
        last = frame.image.copy()
        yield frame


def from_landmarks(
    prior: UpperBodyPrior, joints: Sequence[int], smoothing: str | None = None
) -> Method:
    """Return a method: joints [T, 8, 2] by the filter or smoother alone, from some of MediaPipe's."""
    camera = PinholeCamera.from_image_size(*SIZE)
    tracker = UpperBodyTracker(prior, camera, fps=FPS, neck="neck", smoothing=smoothing)

    def run(clip: Clip) -> Tensor:
        chosen = list(joints)
        names = [UPPER_BODY[j] for j in chosen]
        mask = clip.visibility[None, :, chosen] >= VISIBLE
        with torch.no_grad():
            return tracker(clip.points[None, :, chosen], names=names, mask=mask).joints2d[0]

    return run


def with_ears(clip: Clip) -> Tensor:
    """Return the reference: MediaPipe's joints, with the middle of its ears for the head."""
    points = clip.points.clone()
    points[:, HEAD] = clip.ears
    return points


def error_tables(clips: list[Clip], found: dict[str, list[Tensor]], report: Report) -> None:
    """Add mean and median distances per joint."""
    mean, median = (
        report.table(
            key,
            f"{word} 2D distance from MediaPipe's joints, all clips: pixels (shoulder widths)",
            list(GROUPS),
        )
        for key, word in (("mean", "Mean"), ("median", "Median"))
    )
    mean.note = (
        "The head is compared with the middle of MediaPipe's ears, which is not quite where the prior "
        "has it. Frames without an estimate are left out here, and count as wrong in the PCP."
    )
    for method, tracks in found.items():
        pixels, widths, missing = [], [], []
        for clip, joints in zip(clips, tracks, strict=True):
            gap = (joints - with_ears(clip)).norm(dim=-1)
            pixels.append(torch.where(clip.known, gap, torch.nan))
            widths.append(pixels[-1] / clip.width)
            missing.append(joints[BURN_IN:].isnan().any(-1).any(-1))
        parts = [(torch.cat(pixels)[:, list(js)], torch.cat(widths)[:, list(js)])
                 for js in GROUPS.values()]  # fmt: skip
        mean.add(method, [f"{p.nanmean():.1f} ({w.nanmean():.3f})" for p, w in parts])
        median.add(method, [f"{p.nanmedian():.1f} ({w.nanmedian():.3f})" for p, w in parts])
        share = 100 * float(torch.cat(missing).double().mean())
        if share > 0:
            report.findings.append(f"{method}: no estimate in {share:.1f} % of the frames")


def clip_table(clips: list[Clip], found: dict[str, list[Tensor]], report: Report) -> None:
    """Add the errors of elbows and hands, clip by clip."""
    table = report.table(
        "by_clip",
        "Clip by clip, mean in shoulder widths: shoulders / elbows / hands",
        list(found),
        note="again, brother, help: dark long sleeves; bird, milk: bare forearms; book, learn: a "
        "skin-coloured jumper.",
    )
    for i, clip in enumerate(clips):
        cells = []
        for tracks in found.values():
            gap = (tracks[i] - clip.points).norm(dim=-1) / clip.width
            gap = torch.where(clip.known, gap, torch.nan)
            parts = [float(gap[:, list(GROUPS[g])].nanmean()) for g in list(GROUPS)[1:]]
            cells.append(" / ".join(f"{value:.2f}" for value in parts))
        table.add(clip.name, cells)


def pcp_tables(clips: list[Clip], found: dict[str, list[Tensor]], report: Report) -> dict[str, PCP]:
    """Add the shares of correct limbs, all clips pooled and clip by clip; return the curves."""
    table = report.table(
        "pcp",
        "PCP of upper arms and forearms: both ends within so many limb lengths of MediaPipe's (%)",
        [f"{part} {t:g}" for part in ("upper", "fore") for t in THRESHOLDS],
        note="Lengths are those in the image: a forearm that points at the camera is hard to get right.",
    )
    each = report.table(
        "pcp_clips", "PCP at 0.5, clip by clip: upper arms / forearms (%)", list(found)
    )
    truth, known = torch.cat([c.points for c in clips]), torch.cat([c.known for c in clips])
    curves = {}
    for method, tracks in found.items():
        joints = torch.cat(tracks)
        at = pcp(joints, truth, list(THRESHOLDS), mask=known)
        upper, fore = _arms(at)
        table.add(method, [*(100 * upper).tolist(), *(100 * fore).tolist()])
        curves[method] = pcp(joints, truth, mask=known)
    for i, clip in enumerate(clips):
        cells = []
        for tracks in found.values():
            upper, fore = _arms(pcp(tracks[i], clip.points, [0.5], mask=clip.known))
            cells.append(f"{100 * float(upper):.0f} / {100 * float(fore):.0f}")
        each.add(clip.name, cells)
    return curves


def _arms(values: PCP) -> tuple[Tensor, Tensor]:
    """Return the PCP of upper arms and of forearms, both sides pooled; limbs in the order of `ARM_LIMBS`."""
    if len(values.per_limb) != len(ARM_LIMBS):
        raise ValueError(f"expected {len(ARM_LIMBS)} limbs, got {len(values.per_limb)}")
    weights = values.counts[:, None].to(values.per_limb)
    hits = values.per_limb.nan_to_num() * weights
    return tuple(hits[r].sum(0) / weights[r].sum(0) for r in ([0, 2], [1, 3]))  # type: ignore[return-value]


def draw_pictures(
    clips: list[Clip], found: dict[str, list[Tensor]], curves: dict[str, PCP], out: Path
) -> list[str]:
    """Draw the PCP curve (Figure 13) and the errors over time of one clip (Figure 12)."""
    from torchpose import viz
    from torchpose.viz import save_figure

    save_figure(
        viz.plot_pcp(curves, by_limb=True, title="Correct limbs, seven clips"), out / "pcp.png"
    )
    index = next((i for i, c in enumerate(clips) if c.name == SHOWN), 0)
    clip = clips[index]
    errors = {
        method: torch.where(clip.known, (tracks[index] - clip.points).norm(dim=-1), torch.nan)
        for method, tracks in found.items()
    }
    show = ("elbow_left", "elbow_right", "hand_left", "hand_right")
    figure = viz.plot_errors_over_time(
        errors, FPS, show, unit="px", scale=1.0, title=f"2D errors over time, clip {clip.name}"
    )
    save_figure(figure, out / "errors-over-time.png")
    return ["pcp.png", "errors-over-time.png"]


def main(
    *,
    data: Path,
    prior: str = "kinect-upper-body",
    threads: int = 2,
    out: TableFile | None = None,
    pictures: Path | None = None,
    quick: bool = False,
) -> None:
    """Print the tables, draw the pictures.

    Args:
        data: folder with video_asl/.
        prior: name or file.
        threads: cores.
        out: file for the same as Markdown, or a folder.
        pictures: folder for pcp.png and errors-over-time.png.
        quick: the beginning of one clip, to see that it works.
    """
    torch.set_num_threads(threads)
    folder = data_folder(data, "video_asl")
    clips = [read_clip(folder, name) for name in (CLIPS[:1] if quick else CLIPS)]
    most = _QUICK_FRAMES if quick else None
    clips = [begun(clip, most) for clip in clips]
    fitted = load_prior(prior)
    methods = {
        "video": from_video(folder, fitted, False, most),
        "video, background model": from_video(folder, fitted, True, most),
        "MediaPipe's head, neck, hands": from_landmarks(fitted, (*TRUNK, *HANDS)),
        "the same, smoothed": from_landmarks(fitted, (*TRUNK, *HANDS), "full"),
        "MediaPipe's head and neck": from_landmarks(fitted, TRUNK),
    }
    if quick:
        del methods["video, background model"]
    found = {name: [method(clip) for clip in clips] for name, method in methods.items()}
    report = Report("Joints in the image, on the webcam clips")
    error_tables(clips, found, report)
    curves = pcp_tables(clips, found, report)
    clip_table(clips, found, report)
    report.findings.append(
        "The code of Eichner et al. (2012), which the paper compares itself with, is not to be had."
    )
    if pictures:
        report.pictures = draw_pictures(clips, found, curves, check_output_folder(pictures))
        if out and pictures.resolve().parent == out.resolve().parent:
            report.pictures = [f"{pictures.name}/{name}" for name in report.pictures]
    report.settings = {
        "prior": fitted.info.name,
        "reference": "MediaPipe 0.10.21 pose, full; visibility 0.5 or more, in the image, after 15 "
        "frames",
        "camera": "f = 525 px (assumed)",
        "clips": {c.name: f"{len(c.points)} frames, shoulders {c.width:.0f} px" for c in clips},
    }
    print(report.summary())
    save_text(out, report.to_markdown())


if __name__ == "__main__":
    run_command(main)
