"""`torchpose track-body`: videos of calibrated cameras to the 3D poses of a whole body."""

import sys
import time
import warnings
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from torchpose._core.checks import check_positive
from torchpose._core.terminal import show_progress
from torchpose.cli._command import Command, Given
from torchpose.cli._common import pictures_possible, share_cores
from torchpose.cli._options import Option, options_of, options_of_methods
from torchpose.cli._track_body_output import (
    Recordings,
    body_results,
    draw,
    facts_of,
    summary,
    write_page,
    write_poses,
)
from torchpose.errors import CameraError, DegenerateFilterWarning, InputError, NobodySeenError

if TYPE_CHECKING:
    from torchpose.camera._pinhole import PinholeCamera
    from torchpose.whole_body._body_track import BodyTrack
    from torchpose.whole_body._body_tracker import BodyTracker

_EXAMPLES = """
torchpose track-body cameras.toml cam1.mp4 cam2.mp4 cam3.mp4 --out result
torchpose track-body cameras.toml cam*.mp4 --background empty*.png --height 1.82 --out result
torchpose track-body cameras.toml cam*.mp4 --manifold walk --out result
torchpose track-body cameras.toml cam*.mp4 --method root --conditionals walk --out result
torchpose track-body cameras.toml cam1.mp4 --method constrained --action bend.safetensors --out result
torchpose track-body cameras.toml cam*.mp4 --body result/body.npz --facing [1,0,0] --out again"""
PYTHON_ONLY = frozenset({
    "weights", "proposal", "process_cov", "likelihood", "limit_mode", "resampling",
    "resample_threshold", "estimate", "leg_swap", "limb_shape", "respread_scale", "n_layers",
    "survival_rate", "schedule", "noise_decay", "survival_per_second", "normalisation",
    "camera_rule", "observation_sharpness", "least_std", "first_std", "weighting",
    "velocity_rate", "max_redraws", "gate_width",
})  # fmt: skip
"""Options of the shipped filters that only Python has: what the papers' experiments vary."""


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    return command().main(arguments)


def command() -> Command:
    """Return the command, with the filters that are registered now."""
    from torchpose.whole_body._body_tracker import BodyTracker
    from torchpose.whole_body._filter_table import METHODS

    return Command(
        "track-body",
        run,
        _EXAMPLES,
        {
            "tracker": options_of(BodyTracker, ("cameras", "method", "fps")),
            "method_options": _method_options(),
        },
        spaced=("videos", "background"),
        metavars={"cameras": "CAMERAS", "method": "|".join(METHODS), "background": "FILE"},
    )


def _method_options() -> tuple[Option, ...]:
    """Return the options of single filters; the sharpness is the command's own, with its usual values."""
    from torchpose.whole_body._filter_table import METHODS, method_options

    having = {
        name: [one for one in options_of(method.filter) if one.name in method_options(name)]
        for name, method in METHODS.items()
    }
    return options_of_methods(having, PYTHON_ONLY | {"sharpness"})


def run(
    cameras: str,
    videos: list[str],
    *,
    out: str,
    camera_names: list[str] | None = None,
    background: list[str] | None = None,
    ignore_still: bool = False,
    method: str | None = None,
    tracker: dict[str, Any],
    initial_pose: str | None = None,
    facing: list[float] | None = None,
    rows: int = 160,
    sharpness: float | None = None,
    method_options: dict[str, Any],
    fps: float | None = None,
    delays: list[int] | None = None,
    seed: int = 0,
    overlay: bool = True,
    pictures: bool = True,
    given: Given,
) -> int:
    """Track one person's whole body through videos of calibrated cameras, by silhouettes.

    The cameras stand still. Writes body.npz, joints.csv, an overlay of every camera, report.html and a
    picture into a folder.

    Args:
        cameras: TOML file with a table per camera: size, matrix, distortions, and its pose.
        videos: a video or a folder of images per camera, in the order of the file, in step.
        out: folder of the results.
        camera_names: which cameras of the file the videos are of, if not all in order.
        background: a picture, folder of pictures or video of the empty scene per camera; without it,
            what stays in a video is its background, so the person has to move about.
        ignore_still: with --background: take what always looks the same in a video for an object that was
            moved since the scene was empty, and not for the person; not if the person stands still.
        method: the particle filter: mrpf, regularised by a manifold (needs --manifold); apf, annealed;
            sir, plain; root, hypotheses of the root with Gaussian limbs (needs --conditionals); or
            constrained, to an action (needs --action). By default the one that suits the file given, else
            apf.
        tracker: the arguments of `BodyTracker`.
        initial_pose: a body.npz whose first pose the person begins with; without it, that pose is found.
        facing: the direction in which the person looks at first, in world axes; without it, the first
            steps and the bend of the knees tell, which is wrong for a person who walks backwards or
            stands straight.
        rows: the height of the silhouettes, pixels.
        sharpness: the exponent of the likelihood; not for root (default 100, for the overlap that
            constrained uses 30; the papers have 1).
        method_options: the options of the filter.
        fps: the frame rate at which all videos are read.
        delays: the number of frames by which each video began too early (default none).
        seed: the seed of the filter.
        overlay: write a video per camera with the body drawn into it.
        pictures: write overlay.png.
        given: the command.

    Returns:
        The exit code: 1 if nobody was seen or the filter lost the person.
    """
    _check(given.values)
    share_cores()
    found = _cameras(cameras, camera_names, len(videos))
    options = {"sharpness": sharpness, **method_options}
    options = {name: value for name, value in options.items() if value is not None}
    tracker |= _models(method, tracker, options, initial_pose)
    pictures = pictures_possible(pictures)
    with ExitStack() as stack:
        files = given.files()
        results = stack.enter_context(body_results(out, files, found, overlay, pictures))
        recordings = Recordings(
            videos, found, rows, fps=fps, delays=delays, background=background,
            ignore_still=ignore_still,
        )  # fmt: skip
        with recordings:
            start = time.perf_counter()
            body_tracker = _tracker(recordings, method, tracker, options)
            poses = _track(recordings, body_tracker, initial_pose, facing, seed)
            seconds = time.perf_counter() - start
            if poses is None:
                print(
                    "torchpose: nobody was seen by all cameras, so there are no poses",
                    file=sys.stderr,
                )
                return 1
            written = results.commit(write_poses(results.stage, poses))
            shown = []
            if overlay or pictures:
                shown = draw(recordings, poses, results.stage, overlay, pictures)
        facts = facts_of(given, body_tracker, recordings, poses, seconds)
        shown += write_page(recordings, poses, facts, results.stage)
        written += results.commit(shown)
    return summary(poses, facts, written, results.notes)


def _check(values: dict[str, Any]) -> None:
    """Raise `InputError` for values out of range, and for lists that do not go with the videos."""
    for key in ("height", "sharpness", "rows", "n_particles", "fps"):
        if values[key] is not None:
            check_positive(f"--{key.replace('_', '-')}", values[key])
    facing, n_videos = values["facing"], len(values["videos"])
    if facing is not None and len(facing) != 3:
        raise InputError(f"--facing must be three numbers, got {facing}")
    if values["ignore_still"] and not values["background"]:
        raise InputError("--ignore-still true needs --background")
    for key in ("background", "delays"):
        given = values[key]
        if given and len(given) != n_videos:
            raise InputError(
                f"--{key} needs one entry for each of the {n_videos} videos, got {len(given)}"
            )


def _cameras(file: str, names: list[str] | None, n_videos: int) -> "list[PinholeCamera]":
    from torchpose.camera._pinhole import load_cameras

    found = load_cameras(file)
    names = list(found) if names is None else names
    missing = [name for name in names if name not in found]
    if missing or len(names) != n_videos:
        raise CameraError(
            f"{file}: expected a camera for each of the {n_videos} videos, got "
            f"{', '.join(names)}; it holds {', '.join(found)} (choose by --camera-names)"
        )
    return [found[name] for name in names]


def _models(
    method: str | None,
    tracker: dict[str, Any],
    options: dict[str, Any],
    initial_pose: str | None,
) -> dict[str, Any]:
    """Return the models that the options name; refuse options that do not go together."""
    from torchpose.whole_body._filter_table import LEARNT, METHODS, check_options, choose_method

    given = {kind: tracker[kind] for kind in LEARNT if tracker[kind]}
    chosen = choose_method(method, given)
    check_options(chosen, options)
    if initial_pose and "manifold" in given and METHODS[chosen].needs != "manifold":
        raise InputError(f"--manifold does nothing for --method {chosen} with an initial pose")
    return {kind: LEARNT[kind].load(name) for kind, name in given.items()}


def _tracker(
    recordings: Recordings, method: str | None, arguments: dict[str, Any], options: dict[str, Any]
) -> "BodyTracker":
    from torchpose.whole_body._body_tracker import BodyTracker

    return BodyTracker(recordings.rig, method, fps=recordings.fps, **arguments, **options)


def _track(
    recordings: Recordings,
    tracker: "BodyTracker",
    initial_pose: str | None,
    facing: list[float] | None,
    seed: int,
) -> "BodyTrack | None":
    """Find the person, then track; return None if there is nobody."""
    import torch

    from torchpose.body._fitting import fit_state
    from torchpose.whole_body._body_track import BodyTrack

    start = None
    frames = recordings.silhouettes()
    if initial_pose:
        recorded = BodyTrack.load(initial_pose)
        start = fit_state(tracker.body, recorded.joints3d[:1])[0]
    else:
        print("finding the pose of the first frame ...", flush=True)
    direction = None if facing is None else torch.tensor(facing, dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    with warnings.catch_warnings():
        # said in a note, with the numbers of the frames
        warnings.filterwarnings("ignore", "the gate rejected", DegenerateFilterWarning)
        try:
            poses = tracker(
                frames, start, generator=generator, facing=direction, n_frames=recordings.n_frames,
                progress=show_progress(),
            )  # fmt: skip
        except NobodySeenError:
            return None
    notes = (*recordings.notes, *(n for s in recordings.sources for n in s.notes))
    return replace(poses, notes=(*notes, *poses.notes))
