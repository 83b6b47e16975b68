"""The options of `torchpose track-body`: how they are read, and which do not go together."""

import re
from argparse import ArgumentError
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from torchpose._core.checks import check_choice, check_height, check_positive
from torchpose._core.wording import counted
from torchpose.cli._command import Given
from torchpose.cli._options import Option, options_of, options_of_methods
from torchpose.cli._track import is_video
from torchpose.cli._track_body_output import KALMAN
from torchpose.cli._uncalibrated import is_tilt_told, needs_no_file
from torchpose.errors import InputError

Number = TypeVar("Number", int, float)

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


def filter_options() -> tuple[Option, ...]:
    """Return the options of single filters; the sharpness is the command's own, with its usual values."""
    from torchpose.whole_body._filter_table import METHODS, method_options

    having = {
        name: [one for one in options_of(method.filter) if one.name in method_options(name)]
        for name, method in METHODS.items()
    }
    return options_of_methods(having, PYTHON_ONLY | {"sharpness"})


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


def parse_delays(value: Any) -> list[int] | None:
    """Return whole numbers from a list, from text with commas and perhaps brackets, or from one number.

    It is None for null, as configurations have it.

    Raises:
        ArgumentError: anything else.
    """
    return _numbers(value, "--delays", int, "whole numbers of frames, such as 0,3,12")


def parse_facing(value: Any) -> list[float] | None:
    """Return numbers, as `parse_delays`.

    Raises:
        ArgumentError: anything else.
    """
    return _numbers(value, "--facing", float, "three numbers, such as 1,0,0")


def _numbers(value: Any, flag: str, kind: type[Number], wanted: str) -> list[Number] | None:
    if value in (None, "null"):
        return None
    words = value if isinstance(value, list) else str(value).strip("[] ").split(",")
    try:
        return [kind(str(word)) for word in words]
    except ValueError as error:
        raise ArgumentError(None, f"{flag} must be {wanted}, got {value!r}") from error


def check_numbers(inputs: Sequence[str], cameras: Sequence[str]) -> None:
    """Raise `InputError` where inputs and cameras have the same numbers in their names, in another order.

    A shell sorts cam10 before cam2, and camera files do not.

    Args:
        inputs: paths. cameras: their names, in the order in which they are taken.
    """
    of_inputs, of_cameras = (
        [int(found[-1]) for name in names if (found := re.findall(r"\d+", name))]
        for names in ([Path(path).stem for path in inputs], cameras)
    )
    distinct = len(set(of_inputs)) == len(inputs)
    if distinct and of_inputs != of_cameras and sorted(of_inputs) == sorted(of_cameras):
        i = next(i for i, number in enumerate(of_inputs) if number != of_cameras[i])
        raise InputError(
            f"inputs must be in the order of the camera file, and {inputs[i]} is given for camera "
            f"{cameras[i]!r}; give them in the order {', '.join(cameras)}, or say by --camera-names whose "
            "each is (a shell sorts 10 before 2)"
        )


def by_particles(method: str | None) -> bool:
    """Return whether keypoints are tracked by a particle filter."""
    return method not in (None, KALMAN)


def check_values(values: dict[str, Any]) -> None:
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
                f"--{key} needs {counted(n_inputs, 'entry', 'entries')}, one for each camera, got "
                f"{len(given)}"
            )
    for kind in values["formats"] or ():
        check_choice("--formats", kind, BODY_FORMATS)


def refuse_unsuited(given: Given, by_keypoints: bool) -> None:
    """Raise `InputError` for a method and options that do not go with the inputs."""
    method = given.values["method"]
    if not by_keypoints and method == KALMAN:
        raise InputError(
            f"--method {method} takes keypoints: .npz, .csv or folders of OpenPose JSON files in place of "
            "videos, or --detector, which finds them"
        )
    if needs_no_file(given.values["cameras"]):
        _check_without_file(given, by_keypoints)
    else:
        given.refuse(
            ("tilt", "roll"),
            "a camera without a file; the rotation in the file and --up tell how a camera is held",
        )
    if not by_keypoints:
        given.refuse(_OF_KEYPOINTS, "keypoints, and the inputs are videos without --detector")
    else:
        _refuse_beside_keypoints(given, method)
    kalman = by_keypoints and not by_particles(method)
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


def _check_without_file(given: Given, by_keypoints: bool) -> None:
    """Raise `InputError` for what a camera without a file cannot do."""
    cameras = given.values["cameras"]
    if not by_keypoints:
        raise InputError(
            f"{cameras} stands for the camera of keypoints; silhouettes need a TOML file with the cameras. "
            "--detector finds keypoints in videos"
        )
    given.refuse(("camera_names",), f"camera files, and {cameras} stands for one camera")
    if is_tilt_told(given.values) and given.values["up"] is not None:
        raise InputError("--tilt and --roll tell which way is up; leave --up out, or them")
    if given.values["up"] == "z":
        raise InputError(
            f"the world of {cameras} has y up, got --up z; --up y says that the camera is level, and --tilt "
            "and --roll how else it is held"
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
    if by_particles(method):
        given.refuse(_OF_KALMAN, f"{KALMAN}, and --method {method} is given")
    else:
        options = (*_OF_PARTICLES, *(option.key for option in filter_options()))
        taken = f"particle filters, and keypoints are tracked by {KALMAN} without another --method"
        given.refuse(options, taken)
    if given.values["detector"] is None and given.values["min_confidence"] is not None:
        raise InputError(
            "--min-confidence is for --detector; confidences of files count as they are"
        )


def _check_silhouettes(values: dict[str, Any], method: str | None) -> None:
    """Raise `InputError` if silhouettes cannot count beside keypoints."""
    if not by_particles(method):
        raise InputError(
            f"--silhouettes true needs a particle filter by --method; {KALMAN} takes keypoints alone"
        )
    if values["videos"] is None and not all(map(is_video, values["inputs"])):
        raise InputError(
            "--silhouettes true needs the videos of all cameras, by --videos, or as inputs of --detector"
        )
