"""`torchpose track-body`: keypoints or videos of calibrated cameras to the 3D poses of a whole body."""

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

from torchpose._core.terminal import show_progress
from torchpose._core.wording import counted
from torchpose.cli._body_overlays import draw
from torchpose.cli._body_recordings import Recordings, SilhouetteSettings
from torchpose.cli._command import Command, Given
from torchpose.cli._common import pictures_possible, share_cores
from torchpose.cli._options import options_of
from torchpose.cli._track_body_options import (
    by_particles,
    check_numbers,
    check_values,
    filter_options,
    parse_delays,
    parse_facing,
    parse_names,
    parse_persons,
    refuse_unsuited,
)
from torchpose.cli._track_body_output import (
    KALMAN,
    BodyJob,
    action_text,
    body_results,
    gate_is_in_a_note,
    report_nobody,
    summary,
    write_page,
    write_people,
)
from torchpose.cli._uncalibrated import camera_without_file, is_tilt_told, needs_no_file, told_tilt
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
torchpose track-body uncalibrated clip.mp4 --detector pose_landmarker_full.task --out result
torchpose track-body cameras.toml cam*.npz --videos cam*.mp4 --silhouettes true --method apf --out result
torchpose track-body cameras.toml cam*.npz --formats trc c3d bvh --up z --out result
torchpose track-body cameras.toml cam1.mp4 cam2.mp4 cam3.mp4 --out result
torchpose track-body cameras.toml cam*.mp4 --background empty*.png --height 1.82 --out result
torchpose track-body cameras.toml cam*.mp4 --manifold walk --out result
torchpose track-body cameras.toml cam*.mp4 --method root --conditionals walk --out result
torchpose track-body cameras.toml cam1.mp4 --method constrained --action bend.safetensors --out result
torchpose track-body cameras.toml cam*.mp4 --body result/body.npz --facing [1,0,0] --out again"""


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
            "method_options": filter_options(),
        },
        spaced=("inputs", "background", "videos", "formats"),
        parse={
            "persons": parse_persons,
            "camera_names": parse_names,
            "delays": parse_delays,
            "facing": parse_facing,
        },
        metavars={
            "cameras": "FILE|fx,fy,cx,cy|uncalibrated",
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
    tilt: float | None = None,
    roll: float | None = None,
    overlay: bool = True,
    pictures: bool = True,
    given: Given,
) -> int:
    """Track whole bodies in calibrated cameras that stand still.

    With keypoints, of files or found in videos by --detector, one camera is enough, and several persons can
    be tracked. Videos without --detector are tracked by the silhouettes of one person. Writes body.npz,
    joints.csv, an overlay of every camera, report.html and pictures into a folder.

    Args:
        cameras: TOML file with a table per camera: size, matrix, distortions, and its pose; for keypoints
            of one camera also fx,fy,cx,cy in pixels, or the word uncalibrated.
        inputs: an input per camera, in the order of the file, synchronised: keypoints (.npz, .csv or a folder
            of OpenPose JSON files), or a video or a folder of images.
        out: folder of the results.
        camera_names: which cameras of the file the inputs are of, if not all in order.
        detector: find keypoints in the videos: a model in ONNX (.onnx), a pose landmarker of MediaPipe
            (.task), or package:factory, a Python callable that returns a detector.
        min_confidence: with --detector: treat keypoints as missing below this confidence (default 0.3).
        smoothing: kalman: "full" uses later frames too.
        refine: kalman: estimate the cameras' delays against the first, their poses (extrinsics), or both
            from the person who moves, and write refined_cameras.toml.
        persons: kalman: track several persons, all or at most N at a time; without it one is followed.
        videos: keypoints: a video per camera, into which the body is drawn; by default the inputs, if they
            are videos.
        silhouettes: keypoints and --method: use the silhouettes of the videos in addition to the keypoints.
        background: a picture, folder of pictures or video of the empty scene per camera; without it,
            what never changes in a video is its background, so the person has to move about.
        ignore_still: with --background: leave out what never changes in a video, such as an object that was
            moved since the scene was empty. Do not use it if the person stands still.
        method: kalman, the default for keypoints, or a particle filter for silhouettes or keypoints: mrpf,
            regularised by a manifold (needs --manifold); apf, annealed; sir, plain; root, hypotheses of the
            root with Gaussian limbs (needs --conditionals); or constrained, to an action (needs --action).
            For silhouettes the default is the one that uses the given model, without a model apf.
        tracker: the arguments of `BodyTracker`.
        initial_pose: a body.npz whose first pose the person begins with; without it, that pose is found.
        facing: the direction in which the person looks at first, in world axes; without it, the direction
            of the first steps and the bend of the knees decide. Give it if the person walks backwards or
            stands straight at first.
        rows: the height of the silhouettes, pixels.
        sharpness: the exponent of the likelihood of silhouettes (default 100, for constrained 30; the papers
            have 1). It is not for root, nor for apf without keypoints, which compute theirs.
        method_options: the options of the filter.
        fps: the frame rate of the keypoints, and at which all videos are read, unless those of --videos have
            a frame for each of the keypoints.
        delays: the number of frames to skip at the beginning of each input, at the rate of fps if it is given
            (default none).
        seed: the seed of the filter; kalman has none.
        formats: also write the poses as body.trc, body.c3d or body.bvh.
        up: the axis of the cameras' world that points up: kalman expects people upright along it, and the
            files of --formats have y up. By default they have the axes of the world.
        tilt: degrees by which a camera without a file looks up, negative if down. Without it, the tilt is
            found by how people stand.
        roll: degrees by which a camera without a file is rolled clockwise, as seen from behind it.
        overlay: write a video per camera with the body drawn into it.
        pictures: write overlay.png, and for keypoints skeleton.png.
        given: the command.

    Returns:
        The exit code: 1 if nobody was seen or the filter lost the person.
    """
    from torchpose.cli._body_keypoint_inputs import are_keypoints

    by_keypoints = are_keypoints(inputs, detector)
    check_values(given.values)
    refuse_unsuited(given, by_keypoints)
    share_cores()
    found, notes = _cameras(cameras, camera_names, inputs, videos, tilt, roll)
    finds_tilt = False
    if needs_no_file(cameras):
        finds_tilt = not (by_particles(method) or is_tilt_told(given.values) or up)
        notes += () if finds_tilt else (told_tilt(given.values),)
    if camera_names is None:
        check_numbers(inputs, [camera.name for camera in found])
    job = BodyJob(
        out, given.files(), tuple(dict.fromkeys(formats or ())), up, overlay,
        pictures_possible(pictures), notes,
    )  # fmt: skip
    options = {"sharpness": sharpness, **method_options}
    options = {name: value for name, value in options.items() if value is not None}
    if not by_keypoints or by_particles(method):
        tracker |= _models(method, tracker, options, initial_pose)
    if by_keypoints:
        options = {**tracker, **options}
        return _run_on_keypoints(job, inputs, found, given.values, options, finds_tilt)
    return _run_on_silhouettes(job, inputs, found, given, tracker, options)


def _run_on_silhouettes(
    job: BodyJob,
    inputs: list[str],
    cameras: "list[PinholeCamera]",
    given: Given,
    tracker: dict[str, Any],
    options: dict[str, Any],
) -> int:
    """Track by silhouettes, and return the exit code."""
    values, drawn = given.values, ["overlay.png"] if job.pictures else []
    with body_results(job, cameras, job.overlay, drawn) as results:
        of_videos = ("fps", "delays", "background", "ignore_still")
        with Recordings(
            inputs, cameras, values["rows"], **{name: values[name] for name in of_videos}
        ) as recordings:
            start = time.perf_counter()
            body_tracker = _tracker(recordings, values["method"], tracker, options)
            try:
                poses = _track(
                    recordings,
                    body_tracker,
                    values["initial_pose"],
                    values["facing"],
                    values["seed"],
                )
            except NobodySeenError as error:
                return report_nobody(str(error), results.folder)
            seconds = time.perf_counter() - start
            written = results.commit(write_people(job, results.stage, [poses]))
            shown: list[Path] = []
            if job.overlay or job.pictures:
                shown, _ = draw(recordings, [poses], results.stage, job.overlay, job.pictures)
        facts = _facts(given, body_tracker, recordings, poses, seconds)
        shown += write_page(recordings.views[0].source, [poses], facts, results.stage)
        written += results.commit(shown)
    return summary([poses], facts, written, [*job.notes, *results.notes])


def _run_on_keypoints(
    job: BodyJob,
    inputs: list[str],
    cameras: "list[PinholeCamera]",
    values: dict[str, Any],
    tracker: dict[str, Any],
    finds_tilt: bool,
) -> int:
    """Track by keypoints, and return the exit code."""
    from torchpose.cli._body_keypoint_inputs import DetectorSettings
    from torchpose.cli._track_body_keypoints import KeypointSettings, track_keypoints

    detector = None
    if values["detector"] is not None:
        detector = DetectorSettings(values["detector"], values["min_confidence"])
    arguments = tracker
    if not by_particles(values["method"]):
        names = ("body", "height", "keypoint_std", "pixel_std", "motion", "camera_height")
        up = "y" if is_tilt_told(values) else values["up"]
        arguments = {**{name: tracker[name] for name in names}, "up": up}
    outlines = None
    if values["silhouettes"]:
        outlines = SilhouetteSettings(values["rows"], values["background"], values["ignore_still"])
    as_given = ("smoothing", "videos", "fps", "delays", "refine", "persons", "initial_pose", "seed")
    settings = KeypointSettings(
        detector=detector,
        tracker=arguments,
        method=values["method"] or KALMAN,
        silhouettes=outlines,
        without_file=needs_no_file(values["cameras"]),
        finds_tilt=finds_tilt,
        **{name: values[name] for name in as_given},
    )
    return track_keypoints(job, inputs, cameras, settings)


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
        "videos": f"{counted(len(recordings.videos), 'camera')}, {recordings.fps:g} fps",
        "silhouettes": f"{width} x {height} pixels, "
        + ("against the empty scene" if recordings.background else "against what never changes"),
        "method": f"{tracker.method}, {tracker.n_particles} particles{sharpness}",
        "learnt": ", ".join(filter(None, map(values.get, ("manifold", "conditionals", "action")))),
        "body": values["body"] or f"average proportions, {tracker.upright.height:.3g} m",
        "actions": action_text(poses),
        "speed": f"{len(poses) / max(seconds, 1e-9):.1f} frames a second, without drawing",
    }
    return {name: fact for name, fact in facts.items() if fact}


def _cameras(
    file: str,
    names: list[str] | None,
    inputs: list[str],
    videos: list[str] | None,
    tilt: float | None,
    roll: float | None,
) -> "tuple[list[PinholeCamera], tuple[str, ...]]":
    """Return the cameras of the inputs, and notes on the file, or on what is assumed without one."""
    from torchpose.camera._pinhole import camera_of_name, list_names, read_cameras

    n_inputs = len(inputs)
    if needs_no_file(file):
        camera, assumed = camera_without_file(file, inputs, videos, tilt, roll)
        return [camera], assumed
    cameras, notes = read_cameras(file)
    names = list(cameras) if names is None else names
    found = [camera_of_name(cameras, name) for name in names]
    if None in found or len(names) != n_inputs:
        raise CameraError(
            f"{file}: expected a camera for each of the {n_inputs} inputs, got {', '.join(names)}; "
            f"it holds {list_names(cameras)} (choose by --camera-names)"
        )
    return [camera for camera in found if camera is not None], notes


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
) -> "BodyTrack":
    """Find the person, then track; raise `NobodySeenError` if there is nobody."""
    import torch

    from torchpose.cli._track_body_keypoints import first_state

    start = first_state(tracker, initial_pose)
    frames = recordings.silhouettes()
    direction = None if facing is None else torch.tensor(facing, dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    with gate_is_in_a_note():
        poses = tracker(
            frames, start, generator=generator, facing=direction, n_frames=recordings.n_frames,
            progress=show_progress(),
        )  # fmt: skip
    return replace(poses, notes=(*recordings.all_notes, *poses.notes))
