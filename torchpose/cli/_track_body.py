"""`torchpose track-body`: keypoints or videos of calibrated cameras to the 3D poses of a whole body."""

import sys
import time
from argparse import ArgumentError
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

from torchpose._core.checks import check_choice, check_height, check_positive
from torchpose._core.terminal import show_progress
from torchpose.cli._body_recordings import Recordings, SilhouetteSettings
from torchpose.cli._command import Command, Given
from torchpose.cli._common import pictures_possible, share_cores
from torchpose.cli._options import Option, options_of, options_of_methods
from torchpose.cli._track import is_video
from torchpose.cli._track_body_output import (
    KALMAN,
    BodyJob,
    action_text,
    body_results,
    draw,
    gate_is_in_a_note,
    summary,
    write_page,
    write_people,
)
from torchpose.errors import CameraError, InputError, NobodySeenError

if TYPE_CHECKING:
    from pathlib import Path

    from torchpose.camera._pinhole import PinholeCamera
    from torchpose.whole_body._body_track import BodyTrack
    from torchpose.whole_body._body_tracker import BodyTracker

_EXAMPLES = """
torchpose track-body cameras.toml cam1_json/ cam2_json/ --fps 60 --smoothing full --out result
torchpose track-body cameras.toml cam1.npz cam2.csv --videos cam1.mp4 cam2.mp4 --out result
torchpose track-body cameras.toml cam1_json/ cam2_json/ --refine both --out result
torchpose track-body cameras.toml cam1_json/ cam2_json/ --persons all --out result
torchpose track-body cameras.toml cam1_json/ cam2_json/ --method mrpf --manifold walk --out result
torchpose track-body cameras.toml cam1.mp4 cam2.mp4 --detector rtmpose-m.onnx --out result
torchpose track-body cameras.toml cam*.npz --videos cam*.mp4 --silhouettes true --method apf --out result
torchpose track-body cameras.toml cam*.npz --formats trc c3d bvh --up z --out result
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
_HOW_SILHOUETTES = ("background", "ignore_still", "rows", "sharpness")
_OF_PARTICLES = ("initial_pose", "manifold", "conditionals", "action", "n_particles")
_OF_KALMAN = ("smoothing", "refine", "persons", "motion", "camera_height")
_OF_KEYPOINTS = (
    *_OF_KALMAN, "videos", "silhouettes", "keypoint_std", "pixel_std", "min_confidence"
)  # fmt: skip


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
            "tracker": options_of(BodyTracker, ("cameras", "method", "fps", "up")),
            "method_options": _method_options(),
        },
        spaced=("inputs", "background", "videos", "formats"),
        parse={"persons": parse_persons, "camera_names": parse_names},
        metavars={
            "cameras": "CAMERAS",
            "inputs": "INPUT",
            "method": "|".join((KALMAN, *METHODS)),
            "background": "FILE",
            "detector": "FILE|package:factory",
            "formats": "trc|c3d|bvh",
            "smoothing": "none|full",
            "refine": "none|delays|extrinsics|both",
            "persons": "all|N",
        },
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
    inputs: list[str],
    *,
    out: str,
    camera_names: list[str] | None = None,
    detector: str | None = None,
    min_confidence: float | None = None,
    smoothing: Literal["none", "full"] = "none",
    refine: Literal["none", "delays", "extrinsics", "both"] = "none",
    persons: str | int | None = None,
    videos: list[str] | None = None,
    silhouettes: bool = False,
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
    formats: list[str] | None = None,
    up: Literal["y", "z"] | None = None,
    overlay: bool = True,
    pictures: bool = True,
    given: Given,
) -> int:
    """Track whole bodies in calibrated cameras: of persons by 2D keypoints, of one in videos by silhouettes.

    The cameras stand still. Keypoints are those of files, or with --detector those that a model finds in
    videos; one camera is enough for them. Writes body.npz, joints.csv, an overlay of every camera,
    report.html and pictures into a folder.

    Args:
        cameras: TOML file with a table per camera: size, matrix, distortions, and its pose.
        inputs: an input per camera, in the order of the file, in step: keypoints (.npz, .csv or a folder of
            OpenPose JSON files), or a video or a folder of images.
        out: folder of the results.
        camera_names: which cameras of the file the inputs are of, if not all in order.
        detector: find keypoints in the videos: a model in ONNX (.onnx), a pose landmarker of MediaPipe
            (.task), or package:factory, a Python callable that returns a detector.
        min_confidence: with --detector: treat keypoints as missing below this confidence (default 0.3).
        smoothing: kalman: "full" lets later frames count too.
        refine: kalman: estimate the cameras' delays against the first, their poses (extrinsics), or both
            from the person who moves, and write refined_cameras.toml.
        persons: kalman: track several persons, all or at most N at a time; without it one is followed.
        videos: keypoints: a video per camera, into which the body is drawn; by default the inputs, if they
            are videos.
        silhouettes: keypoints and --method: let silhouettes of these videos count beside the keypoints.
        background: a picture, folder of pictures or video of the empty scene per camera; without it,
            what stays in a video is its background, so the person has to move about.
        ignore_still: with --background: take what always looks the same in a video for an object that was
            moved since the scene was empty, and not for the person; not if the person stands still.
        method: of keypoints kalman, by default. The others are particle filters on silhouettes or keypoints:
            mrpf, regularised by a manifold (needs --manifold); apf, annealed; sir, plain; root, hypotheses of
            the root with Gaussian limbs (needs --conditionals); or constrained, to an action (needs
            --action). Of silhouettes the default is the one that suits the file given, else apf.
        tracker: the arguments of `BodyTracker`.
        initial_pose: a body.npz whose first pose the person begins with; without it, that pose is found.
        facing: the direction in which the person looks at first, in world axes; without it, the first
            steps and the bend of the knees tell, which is wrong for a person who walks backwards or
            stands straight.
        rows: the height of the silhouettes, pixels.
        sharpness: the exponent of the likelihood of silhouettes; not for root, nor for apf without keypoints,
            which solve for theirs (default 100, for the overlap that constrained uses 30; the papers have 1).
        method_options: the options of the filter.
        fps: the frame rate at which all videos are read, and which keypoints have.
        delays: the number of frames by which each input began too early (default none).
        seed: the seed of the filter; kalman has none.
        formats: also write the poses as body.trc, body.c3d or body.bvh.
        up: the axis of the cameras' world that points up: kalman expects people upright along it, and the
            files of --formats have y up. By default they have the axes of the world.
        overlay: write a video per camera with the body drawn into it.
        pictures: write overlay.png, and of keypoints skeleton.png.
        given: the command.

    Returns:
        The exit code: 1 if nobody was seen or the filter lost the person.
    """
    from torchpose.cli._body_keypoint_inputs import are_keypoints

    by_keypoints = are_keypoints(inputs, detector)
    _check(given.values)
    _refuse_others(given, by_keypoints)
    share_cores()
    found = _cameras(cameras, camera_names, len(inputs))
    job = BodyJob(
        out, given.files(), tuple(dict.fromkeys(formats or ())), up, overlay,
        pictures_possible(pictures),
    )  # fmt: skip
    options = {"sharpness": sharpness, **method_options}
    options = {name: value for name, value in options.items() if value is not None}
    if not by_keypoints or _of_particles(method):
        tracker |= _models(method, tracker, options, initial_pose)
    if by_keypoints:
        return _run_on_keypoints(job, inputs, found, given.values, {**tracker, **options})
    with ExitStack() as stack:
        drawn = ["overlay.png"] if job.pictures else []
        results = stack.enter_context(body_results(job, found, overlay, drawn))
        recordings = Recordings(
            inputs, found, rows, fps=fps, delays=delays, background=background,
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
            written = results.commit(write_people(job, results.stage, [poses]))
            shown: list[Path] = []
            if overlay or job.pictures:
                shown, _ = draw(recordings, [poses], results.stage, overlay, job.pictures)
        facts = _facts(given, body_tracker, recordings, poses, seconds)
        shown += write_page(recordings.views[0].source, [poses], facts, results.stage)
        written += results.commit(shown)
    return summary([poses], facts, written, results.notes)


def parse_persons(value: Any) -> int | str:
    """Return "all", or a number of persons.

    Raises:
        ArgumentError: anything else.
    """
    text = str(value)
    if text == "all":
        return text
    if not text.isdecimal() or int(text) < 1:
        raise ArgumentError(
            None, f"--persons must be 'all' or a number of persons from 1 on, got {text!r}"
        )
    return int(text)


def parse_names(value: Any) -> list[str]:
    """Return names from a list, or from text with commas and perhaps brackets."""
    words = value if isinstance(value, list) else str(value).strip("[] ").split(",")
    return [str(word).strip().strip("'\"") for word in words]


def _run_on_keypoints(
    job: BodyJob,
    inputs: list[str],
    cameras: "list[PinholeCamera]",
    values: dict[str, Any],
    tracker: dict[str, Any],
) -> int:
    """Track by keypoints, and return the exit code."""
    from torchpose.cli._body_keypoint_inputs import DetectorSettings
    from torchpose.cli._track_body_keypoints import KeypointSettings, track_keypoints

    detector = None
    if values["detector"] is not None:
        detector = DetectorSettings(values["detector"], values["min_confidence"])
    arguments = tracker
    if not _of_particles(values["method"]):
        names = ("body", "height", "keypoint_std", "pixel_std", "motion", "camera_height")
        arguments = {**{name: tracker[name] for name in names}, "up": values["up"]}
    outlines = None
    if values["silhouettes"]:
        outlines = SilhouetteSettings(values["rows"], values["background"], values["ignore_still"])
    settings = KeypointSettings(
        detector, values["smoothing"], values["videos"], values["fps"], values["delays"], arguments,
        values["refine"], values["persons"], values["method"] or KALMAN,
        values["initial_pose"], values["seed"], outlines,
    )  # fmt: skip
    return track_keypoints(job, inputs, cameras, settings)


def _of_particles(method: str | None) -> bool:
    """Return whether keypoints are tracked by a particle filter."""
    return method not in (None, KALMAN)


def _facts(
    given: Given,
    tracker: "BodyTracker",
    recordings: Recordings,
    poses: "BodyTrack",
    seconds: float,
) -> dict[str, str]:
    """Return what was tracked, and how, by the name of each fact."""
    height, width = recordings.rig.sizes[0]  # type: ignore[misc]  # views have sizes
    values = given.values
    exponent = tracker.filter.sharpness
    sharpness = "" if tracker.filter.sharpness_cancels else f", sharpness {exponent:g}"
    facts = {
        "videos": f"{len(recordings.videos)} cameras, {recordings.fps:g} fps",
        "silhouettes": f"{width} x {height} pixels, "
        + ("against the empty scene" if recordings.background else "against what stays"),
        "method": f"{tracker.method}, {tracker.n_particles} particles{sharpness}",
        "learnt": ", ".join(filter(None, map(values.get, ("manifold", "conditionals", "action")))),
        "body": values["body"] or f"average proportions, {tracker.upright.height:.3g} m",
        "actions": action_text(poses),
        "speed": f"{len(poses) / max(seconds, 1e-9):.1f} frames a second, without drawing",
    }
    return {name: fact for name, fact in facts.items() if fact}


def _refuse_others(given: Given, by_keypoints: bool) -> None:
    """Raise `InputError` for a method and options that do not go with the inputs."""
    method = given.values["method"]
    if not by_keypoints and method == KALMAN:
        raise InputError(
            f"--method {method} takes keypoints: .npz, .csv or folders of OpenPose JSON files in place of "
            "videos, or --detector, which finds them"
        )
    if not by_keypoints:
        given.refuse(_OF_KEYPOINTS, "keypoints, and the inputs are videos without --detector")
    else:
        _refuse_beside_keypoints(given, method)
    kalman = by_keypoints and not _of_particles(method)
    if not kalman and given.values["up"] is not None and not given.values["formats"]:
        raise InputError(
            f"--up is for {KALMAN} on keypoints and for the files of --formats; the other results "
            "are in world axes"
        )
    if given.values["persons"] is not None and given.values["refine"] != "none":
        raise InputError(
            "--refine is for recordings of one person, and --persons is given; refine the cameras on a "
            "recording of one, and track with its refined_cameras.toml"
        )


def _refuse_beside_keypoints(given: Given, method: str | None) -> None:
    """Raise `InputError` for options of silhouettes, or of another method than keypoints are tracked by."""
    given.refuse(
        ("facing",),
        "silhouettes of videos, and where keypoints are given the first pose is found in these",
    )  # fmt: skip
    if given.values["silhouettes"]:
        _check_silhouettes(given.values, method)
    else:
        given.refuse(
            _HOW_SILHOUETTES,
            "silhouettes of videos, which are not computed beside keypoints without --silhouettes true",
        )  # fmt: skip
    if _of_particles(method):
        given.refuse(_OF_KALMAN, f"{KALMAN}, and --method {method} is given")
    else:
        options = (*_OF_PARTICLES, *(option.key for option in _method_options()))
        taken = f"particle filters, and keypoints are tracked by {KALMAN} without another --method"
        given.refuse(options, taken)
    if given.values["detector"] is None and given.values["min_confidence"] is not None:
        raise InputError(
            "--min-confidence is for --detector; confidences of files count as they are"
        )


def _check_silhouettes(values: dict[str, Any], method: str | None) -> None:
    """Raise `InputError` if silhouettes cannot count beside keypoints."""
    if not _of_particles(method):
        raise InputError(
            f"--silhouettes true needs a particle filter by --method; {KALMAN} takes keypoints alone"
        )
    if values["videos"] is None and not all(map(is_video, values["inputs"])):
        raise InputError(
            "--silhouettes true needs the videos of all cameras, by --videos, or as inputs of --detector"
        )


def _check(values: dict[str, Any]) -> None:
    """Raise `InputError` for values out of range, and for lists that do not go with the inputs."""
    from torchpose.whole_body._body_files import BODY_FORMATS

    for key in ("sharpness", "rows", "n_particles", "fps", "keypoint_std", "pixel_std"):
        if values[key] is not None:
            check_positive(f"--{key.replace('_', '-')}", values[key])
    if values["height"] is not None:
        check_height(values["height"], "--height")
    facing, n_inputs = values["facing"], len(values["inputs"])
    if facing is not None and values["initial_pose"]:
        raise InputError("--facing does nothing with --initial-pose; leave one of them out")
    if facing is not None and len(facing) != 3:
        raise InputError(f"--facing must be three numbers, got {facing}")
    if values["ignore_still"] and not values["background"]:
        raise InputError("--ignore-still true needs --background")
    for key in ("background", "delays", "videos"):
        given = values[key]
        if given and len(given) != n_inputs:
            raise InputError(
                f"--{key} needs one entry for each of the {n_inputs} cameras, got {len(given)}"
            )
    for kind in values["formats"] or ():
        check_choice("--formats", kind, BODY_FORMATS)


def _cameras(file: str, names: list[str] | None, n_inputs: int) -> "list[PinholeCamera]":
    from torchpose.camera._pinhole import camera_of_name, list_names, load_cameras

    cameras = load_cameras(file)
    names = list(cameras) if names is None else names
    found = [camera_of_name(cameras, name) for name in names]
    if None in found or len(names) != n_inputs:
        raise CameraError(
            f"{file}: expected a camera for each of the {n_inputs} inputs, got {', '.join(names)}; "
            f"it holds {list_names(cameras)} (choose by --camera-names)"
        )
    return [camera for camera in found if camera is not None]


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

    tracker = BodyTracker(recordings.rig, method, fps=recordings.fps, **arguments, **options)
    if "sharpness" in options and tracker.filter.sharpness_cancels:
        raise InputError(
            f"--sharpness does nothing for --method {tracker.method} on silhouettes alone, whose exponents "
            "are solved so that a share of the particles survives; leave it out, or take --method sir"
        )
    return tracker


def _track(
    recordings: Recordings,
    tracker: "BodyTracker",
    initial_pose: str | None,
    facing: list[float] | None,
    seed: int,
) -> "BodyTrack | None":
    """Find the person, then track; return None if there is nobody."""
    import torch

    from torchpose.cli._track_body_keypoints import first_state

    start = first_state(tracker, initial_pose)
    frames = recordings.silhouettes()
    direction = None if facing is None else torch.tensor(facing, dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    with gate_is_in_a_note():
        try:
            poses = tracker(
                frames, start, generator=generator, facing=direction, n_frames=recordings.n_frames,
                progress=show_progress(),
            )  # fmt: skip
        except NobodySeenError:
            return None
    return replace(poses, notes=(*recordings.all_notes, *poses.notes))
