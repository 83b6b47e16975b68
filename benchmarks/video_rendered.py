"""3D error from video with known truth, with and without background model, edges and hand tracker.

    python -m benchmarks.video_rendered --out DIR

Figures 10 and 11 of Burke & Lasenby in kind. They compared with a Kinect's skeleton; here performers are
rendered (`torchpose.demo._rendering`), 1,000 frames each, H.264, so the truth is exact and everything
else made up: movements, clothes, room. The shipped prior has seen none of it. Errors are distances
in centimetres
after fixed-scale Procrustes on head, neck and shoulders, frame by frame, in all frames with a pose.

`true 2D` is the same tracker fed with the true pixels of head, neck and hands: what is left is the price of
going from four points to eight joints. `mean pose` does not look at the video at all.

DIR keeps videos, truth and finished rows: started again, the script goes on where it stopped.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._command import OneOf, run_command
from benchmarks._performances import performance
from benchmarks._table_file import save_text
from benchmarks._upper_body import MADE_WITH, Tracker
from benchmarks.engine import Experiment, Grid, source_hash
from benchmarks.speed._timing import markdown_table, processor_model
from torchpose import VideoTracker, load_prior, viz
from torchpose._core.files import check_output_folder
from torchpose.demo import KEYPOINT_NAMES, demo_camera
from torchpose.demo._rendering import LOOKS, render_video
from torchpose.metrics import joint_errors_3d
from torchpose.priors import UpperBodyPrior
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import PoseTrack, UpperBodyTracker
from torchpose.video import open_video
from torchpose.viz import save_figure
from torchpose.viz._style import readable

DISTANCE = 1.6  # metres; a face of about 55 pixels
FPS = 30.0
KINDS = ("performer", "signing", "clapping", "merging hands")  # of movements
HANDS = [UPPER_BODY.index("hand_left"), UPPER_BODY.index("hand_right")]
SHOULDERS = [UPPER_BODY.index("shoulder_left"), UPPER_BODY.index("shoulder_right")]
TRACKERS: dict[str, dict[str, Any]] = {
    "with the network": {},
    "histogram filter": {"hands": "grid"},
    "histogram filter, background": {"hands": "grid", "background": True},
    "histogram filter, edges": {"hands": "grid", "edges": True},
    "histogram filter, candidates": {"hands": "grid", "candidates": True},
    "mean shift": {"hands": "mean-shift"},
    "mean shift, background": {"hands": "mean-shift", "background": True},
    "mean shift, edges": {"hands": "mean-shift", "edges": True},
    "mean shift, background, edges": {"hands": "mean-shift", "background": True, "edges": True},
}
TRUE_2D, MEAN_POSE = "true 2D", "mean pose"


class Clip(NamedTuple):
    """A rendered sequence, the name of its picture, and its truth: joints [T, 8, 3] and [T, 8, 2]."""

    name: str
    picture: str
    path: Path
    joints3d: Tensor
    joints2d: Tensor


class Outcome(NamedTuple):
    """3D errors [T, 8] in metres, NaN without a pose.

    In the share `near` of all true hands the measured one was within a quarter of the shoulders' width;
    in the share `swapped` of all frames both were nearer to the other hand. `others`: further persons.
    """

    errors: Tensor
    near: Tensor = torch.tensor(torch.nan)
    swapped: Tensor = torch.tensor(torch.nan)
    others: Tensor = torch.tensor(0)


def main(
    *,
    out: Path,
    frames: int = 1000,
    seeds: int = 2,
    look: Annotated[str, OneOf(LOOKS)] = "dark sleeves",
    only: Annotated[Sequence[str], OneOf(TRACKERS)] | None = None,
    threads: int = 2,
    quick: bool = False,
) -> None:
    """Run and print.

    Args:
        out: folder for videos and results.
        frames: of each sequence.
        seeds: sequences of each kind.
        look: of the performers.
        only: these rows.
        threads: cores.
        quick: small, to see that all of it works.
    """
    torch.set_num_threads(threads)
    check_output_folder(out)
    n_frames, seeds = (40, 1) if quick else (frames, seeds)
    names = KINDS[:1] if quick else KINDS
    jobs = [(name, seed) for name in names for seed in range(seeds)]
    clips = [
        make_clip(out, name, seed, n_frames, look) for name, seed in tqdm(jobs, desc="rendering")
    ]
    prior = load_prior("kinect-upper-body")
    rows = {n: options for n, options in TRACKERS.items() if only is None or n in only}
    grid = Grid(
        {clip.name: clip for clip in clips}, {n: Tracker(prior, o) for n, o in rows.items()}
    )
    found = TRACKING.run({"": grid}, (0,), out, progress=True, title="tracking")
    outcomes = {name: own.runs for (name,), own in found.by("method").items()}
    outcomes[TRUE_2D] = [from_truth(prior, clip) for clip in clips]
    outcomes[MEAN_POSE] = [
        Outcome(joint_errors_3d(prior.mean_pose().expand_as(clip.joints3d), clip.joints3d))
        for clip in clips
    ]
    text = report(outcomes, clips, look)
    print(text, end="")
    save_text(out / "video_rendered.md", text)
    draw(outcomes, clips, out)


# --- sequences ------------------------------------------------------------------------------------


def make_clip(out: Path, name: str, seed: int, n_frames: int, look: str) -> Clip:
    """Render a sequence, unless it is there already."""
    stem = f"{name}-{seed}-{look}-{n_frames}".replace(" ", "_")
    source = source_hash("torchpose/demo", "benchmarks/_performances.py")
    path, truth = out / f"{stem}-{source}.mp4", out / f"{stem}-{source}.npz"
    if not (path.is_file() and truth.is_file()):
        clip = performance(name, n_frames, FPS, seed, DISTANCE)
        render_video(path, clip, demo_camera(), seed=seed, look=look, truth=truth)
    with np.load(truth) as arrays:
        joints3d, joints2d = (torch.from_numpy(arrays[k]) for k in ("joints3d", "joints2d"))
    return Clip(f"{name} {seed + 1}", stem, path, joints3d, joints2d)


# --- trackers -------------------------------------------------------------------------------------


def from_video(prior: UpperBodyPrior, clip: Clip, options: dict[str, Any]) -> Outcome:
    """Track the video; the person seen longest is compared with the truth."""
    tracker = VideoTracker(prior, demo_camera(), fps=FPS, **options)
    with open_video(clip.path) as video:
        people = tracker(video)
    errors = torch.full(clip.joints3d.shape[:2], torch.nan, dtype=torch.float64)
    if not people:
        return Outcome(errors, torch.tensor(0.0), torch.tensor(0.0))
    person = people[0]
    there = slice(person.first_frame, person.first_frame + len(person))
    errors[there] = compare(person.track, clip.joints3d[there])
    hands = person.keypoints[
        :, [KEYPOINT_NAMES.index("hand_left"), KEYPOINT_NAMES.index("hand_right")]
    ]
    true = clip.joints2d[there][:, HANDS]
    width = (clip.joints2d[:, SHOULDERS[0]] - clip.joints2d[:, SHOULDERS[1]]).norm(dim=-1).mean()
    right = (hands - true).norm(dim=-1)
    wrong = (hands - true.flip(1)).norm(dim=-1)
    near = (right < width / 4).double().sum() / (2 * len(clip.joints2d))
    swapped = (wrong < right).all(-1) & (right > width / 4).all(-1)
    share = swapped.double().sum() / len(clip.joints2d)
    return Outcome(errors, near, share, torch.tensor(len(people) - 1))


def track_clip(clip: Clip, tracker: Tracker, seeds: Sequence[int]) -> list[Outcome]:
    """Track a video once for each seed, on which nothing depends."""
    return [from_video(tracker.prior, clip, dict(tracker.options)) for _ in seeds]


def clip_facts(clip: Clip, tracker: Tracker) -> list[Any]:
    """Return the inputs of an outcome: prior, options, video and truth."""
    prior, options = tracker
    video = hashlib.sha256(clip.path.read_bytes()).hexdigest()
    return [dict(options), prior.info.transition, *prior.state_dict().values(),
            video, clip.joints3d, clip.joints2d]  # fmt: skip


TRACKING = Experiment(
    Outcome,
    track_clip,
    clip_facts,
    (*MADE_WITH, "torchpose/measure", "torchpose/metrics", "torchpose/video",
     "torchpose/weights/arms/upper-body-arms.safetensors",
     "torchpose/weights/hands/hands.safetensors", "benchmarks/video_rendered.py"),
)  # fmt: skip


def from_truth(prior: UpperBodyPrior, clip: Clip) -> Outcome:
    """Track the true pixels of head, neck and hands."""
    points = clip.joints2d[:, [UPPER_BODY.index(name) for name in KEYPOINT_NAMES]]
    tracker = UpperBodyTracker(prior, demo_camera(), fps=FPS)
    return Outcome(compare(tracker(points[None], names=KEYPOINT_NAMES), clip.joints3d))


def compare(track: PoseTrack, truth: Tensor) -> Tensor:
    """Return the 3D errors [T, 8], metres."""
    return joint_errors_3d(track.joints3d[0].double(), truth)


# --- report ---------------------------------------------------------------------------------------


def centimetres(errors: Tensor) -> str:
    """Return the mean of the errors that are there, cm."""
    return f"{100 * float(errors.nanmean()):.1f}"


def percent(values: list[float]) -> str:
    """Return the mean share, or a dash."""
    mean = float(np.mean(values))
    return "-" if np.isnan(mean) else f"{100 * mean:.0f} %"


def report(outcomes: dict[str, list[Outcome]], clips: list[Clip], look: str) -> str:
    """Return the errors by joint and by sequence, and the shares of found hands."""
    by_joint, by_clip = [], []
    for name, done in outcomes.items():
        errors = torch.cat([one.errors for one in done])
        hands = [[float(getattr(one, k)) for one in done] for k in ("near", "swapped")]
        posed = float(errors.isfinite().all(-1).double().mean())
        by_joint.append(
            [name, *(centimetres(errors[:, j]) for j in range(8)), centimetres(errors),
             percent(hands[0]), percent(hands[1]), f"{100 * posed:.1f} %"]
        )  # fmt: skip
        by_clip.append([name, *(centimetres(one.errors) for one in done)])
    head = [
        "3D error (cm)",
        *map(readable, UPPER_BODY),
        "all",
        "hands within 1/4",
        "swapped",
        "posed",
    ]
    others = {n: sum(int(o.others) for o in done) for n, done in outcomes.items()}
    n_frames = sum(len(clip.joints3d) for clip in clips)
    lines = [
        markdown_table(head, by_joint),
        markdown_table(["3D error (cm), all joints", *(clip.name for clip in clips)], by_clip),
        f"{n_frames:,} frames at 640 x 480, {look}, {DISTANCE} m from the camera; hands: within a quarter "
        "of the shoulders' width of the truth, and both nearer to the other hand, of all frames.",
    ]
    if any(others.values()):
        found = ", ".join(f"{name}: {n}" for name, n in others.items() if n)
        lines.append(f"Persons beyond the one who is there: {found}.")
    return "\n\n".join([*lines, processor_model()]) + "\n"


def draw(outcomes: dict[str, list[Outcome]], clips: list[Clip], out: Path) -> None:
    """Draw Figures 10 and 11: mean error of each joint, and errors over time."""
    shown = [n for n in (*list(TRACKERS)[:1], "mean shift", TRUE_2D, MEAN_POSE) if n in outcomes]
    means = {name: torch.cat([one.errors for one in outcomes[name]]) for name in shown}
    save_figure(
        viz.plot_error_bars(means, title="3D error on rendered performers"), out / "by_joint.png"
    )
    for i, clip in enumerate(clips):
        figure = viz.plot_errors_over_time(
            {name: outcomes[name][i].errors for name in shown[:3]},
            fps=FPS,
            bound=20,
            title=f"3D error, {clip.name}",
        )
        save_figure(figure, out / f"{clip.picture}.png")


if __name__ == "__main__":
    run_command(main)
