"""`torchpose track`: video or 2D keypoints to 2D and 3D poses with covariances."""

from argparse import ArgumentError
from pathlib import Path
from typing import Any

from torchpose._core.checks import check_positive
from torchpose._core.terminal import show_progress
from torchpose.cli._command import Command, Given
from torchpose.cli._common import pictures_possible
from torchpose.cli._options import Option, options_of, options_of_methods
from torchpose.cli._track_output import (
    TrackingJob,
    camera_text,
    report_failure,
    smoothing_text,
    summary,
    track_results,
    write_pictures,
    write_track,
)
from torchpose.errors import InputError

_EXAMPLES = """
torchpose track clip.mp4 --out result
torchpose track 0 --out result
torchpose track clip.mp4 --out result --detector pose_landmarker_full.task
torchpose track clip.mp4 --out result --detector rtmo.onnx --max-persons 2
torchpose track frames/ --out result --fps 25 --background true
torchpose track keypoints.npz --out result
torchpose track openpose_json/ --out result --camera 525,525,319.5,239.5 --nose-as-head true
torchpose track keypoints.csv --out result --prior prior.safetensors --smoothing full
torchpose track keypoints.npz --out result --method pf-mixture --n-particles 10000 --seed 1
torchpose track keypoints.npz --out result --print_config > track.yaml
torchpose track --config track.yaml"""
_JOINT_STDS = 5
_KEYPOINT_FILES = (".npz", ".csv")
OTHER_TABLES = (
    ".json", ".txt", ".tsv", ".h5", ".hdf5", ".npy", ".pkl", ".pickle", ".mat", ".xlsx", ".parquet", ".trc",
    ".c3d",
)  # fmt: skip
"""Ends of the names of tables that other programs write: neither videos, nor keypoints that are read."""
PYTHON_ONLY = frozenset({
    "likelihood_power", "uniform_weight", "transition", "gamma", "subspace", "burn_in",
    "burn_in_scale", "weighting", "reset_below", "resample_threshold", "resampling", "start",
})  # fmt: skip
"""Options of the shipped methods that only Python has: what the papers' experiments vary."""


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    return command().main(arguments)


def command() -> Command:
    """Return the command, with the methods that are registered now."""
    from torchpose.upper_body._estimator_table import METHODS
    from torchpose.upper_body._keypoint_files import TrackSettings
    from torchpose.video._video_tracker import VideoTracker

    settings = [
        option._replace(text=f"{option.text}. There are {', '.join(METHODS)}")
        if option.name == "method"
        else option
        for option in options_of(TrackSettings)
    ]
    names = {option.name for option in settings}
    video = options_of(VideoTracker, leave_out=names)
    return Command(
        "track",
        run,
        _EXAMPLES,
        {
            "settings": settings,
            "video": [option._replace(text=f"video: {option.text}") for option in video],
            "method_options": _method_options(names),
        },
        parse={"measurement_std": parse_stds, "smoothing": parse_smoothing},
        metavars={
            "smoothing": "N|full|none",
            "frame": "camera|body",
            "hands": "learnt|grid|mean-shift",
        },
    )


def _method_options(leave_out: set[str]) -> tuple[Option, ...]:
    """Return the options of single methods that are no settings of all."""
    from torchpose.upper_body._estimator_table import METHODS, method_options
    from torchpose.upper_body._single_poses import PoseFilter

    having = {}
    for name, method in METHODS.items():
        options = options_of(method.filter if isinstance(method, PoseFilter) else method)
        having[name] = [option for option in options if option.name in method_options(name)]
    return options_of_methods(having, leave_out | PYTHON_ONLY)


def run(
    input: str,
    *,
    out: str,
    settings: dict[str, Any],
    video: dict[str, Any],
    face_model: str | None = None,
    method_options: dict[str, Any],
    workers: int = 1,
    overlay: bool = True,
    pictures: bool = True,
    given: Given,
) -> int:
    """Track everybody in a video, or a person from 2D keypoints; write poses and what shows them.

    A video is a file, a folder of images or a camera. Keypoints are those of head, neck and hands, or any
    others of the upper body, and may have gaps. Writes poses.npz, poses.csv, poses.bvh and pictures into
    a folder, for a video also overlay.mp4 and report.html. With --detector the keypoints in a video are
    found by a model in ONNX, by MediaPipe, or by a Python object.

    Args:
        input: a video file, a folder of images, or the number of a camera; or keypoints: .npz, .csv or a
            folder of OpenPose JSON files. Digits are a camera only if no such path exists.
        out: folder of the results.
        settings: the options of `TrackSettings`. video: the options of `VideoTracker`.
        method_options: the options of the method.
        face_model: video: find faces with a detector of MediaPipe (.tflite) in place of OpenCV's
            cascade; needs mediapipe.
        workers: video: 1 for other processes, which look ahead in a long recording and draw the
            pictures; 0 for none.
        overlay: video: write overlay.mp4 and report.html.
        pictures: draw pose_strip.png and joint_curves.png.
        given: the command.

    Returns:
        The exit code: 1 if the filter degenerated, or if there is nobody in the video.
    """
    from torchpose.upper_body._keypoint_files import TrackSettings

    if settings["prior"] is None:  # as a configuration may say it
        raise InputError("--prior must be a name or a file, got null")
    for option in ("fps", "max_gap"):
        if settings[option] is not None:
            check_positive(f"--{option.replace('_', '-')}", settings[option])
    options = {name: value for name, value in method_options.items() if value is not None}
    job = TrackingJob(input, out, given.files(), TrackSettings(**settings), options, pictures)
    if is_video(input):
        from torchpose.cli._track_video import track_video

        return track_video(job, video, face_model, overlay, workers)
    given.refuse(
        (*video, "face_model", "overlay", "workers"), f"videos, and {input} holds keypoints"
    )
    return track_keypoints(job)


def track_keypoints(job: TrackingJob) -> int:
    """Track keypoints, write and report, and return the exit code; every check comes before any work."""
    from torchpose.io._keypoints import read_keypoints
    from torchpose.upper_body._keypoint_files import KeypointFileTracker

    keypoints = read_keypoints(job.input)
    tracker = KeypointFileTracker(job.settings, options=job.options)
    prepared = tracker.prepare(keypoints)
    pictures = pictures_possible(job.pictures)
    with track_results(job.out, job.files, pictures, video=False) as results:
        track = tracker.track(keypoints, prepared, show_progress())
        written = results.commit(list(write_track(track, results.stage)))
        if pictures:
            written += results.commit(write_pictures(track, results.stage))
    facts = {
        "prior": tracker.prior.info.name or job.settings.prior,
        "camera": camera_text(prepared.camera),
        "method": track.method + smoothing_text(job.settings.smoothing),
    }
    print(summary(track, written, facts, results.notes))
    return report_failure(track)


def is_video(where: str) -> bool:
    """Return whether it is a video, a folder of images or a camera, and not keypoints.

    Tables that other programs write count as keypoints: FFmpeg takes some for video, as DeepLabCut's .h5.
    A folder of images may hold other JSON files than those of keypoints, such as labels.
    """
    path = Path(where)
    if path.is_dir():
        return _holds_images(path) or not any(path.glob("*.json"))
    return path.suffix.lower() not in (*_KEYPOINT_FILES, *OTHER_TABLES)


def _holds_images(folder: Path) -> bool:
    """Return whether a folder holds images, and no files of keypoints, beside which they may be drawn."""
    from torchpose.io._formats.openpose import openpose_files
    from torchpose.video._images import is_image

    return not openpose_files(folder) and any(map(is_image, folder.glob("*")))


def parse_stds(value: Any) -> float | list[float] | None:
    """Return one number or five, from text with commas, a number or a list.

    Raises:
        ArgumentError: anything else.
    """
    parts = value.strip("[]").split(",") if isinstance(value, str) else value
    try:
        numbers = [float(p) for p in (parts if isinstance(parts, list) else [parts])]
    except (TypeError, ValueError) as error:
        raise ArgumentError(
            None, f"--measurement-std must be a number or five with commas, got {value!r}"
        ) from error
    if len(numbers) not in (1, _JOINT_STDS):
        raise ArgumentError(
            None, f"--measurement-std must be one number or five (hand, elbow, shoulder, head, neck), "
            f"got {len(numbers)}"
        )  # fmt: skip
    return numbers[0] if len(numbers) == 1 else numbers


def parse_smoothing(value: Any) -> int | str | None:
    """Return a number of frames, "full", or None for "none", as `track-body` has it, and for 0.

    Raises:
        ArgumentError: anything else.
    """
    if value == "full":
        return "full"
    if value in (None, "none"):
        return None
    try:
        lag = int(str(value))
    except ValueError:
        lag = -1
    if lag < 0:
        raise ArgumentError(
            None, f"--smoothing must be a number of frames, 'full' or 'none', got {str(value)!r}"
        )
    return lag or None
