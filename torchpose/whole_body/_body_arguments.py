"""Check what `BodyTracker` is given: arguments that its method does not use are refused."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from jaxtyping import Integer
from torch import Tensor

from torchpose._core.checks import check_shape, check_tensors
from torchpose.body._kinematics import Body
from torchpose.errors import InputError
from torchpose.whole_body._filter_table import choose_method
from torchpose.whole_body._keypoints.track_builder import KEYPOINT_METHOD


def given_of(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments that are not None."""
    return {name: value for name, value in arguments.items() if value is not None}


def check_kind(name: str, value: object, *kinds: type) -> None:
    """Raise `InputError` unless an argument is None, of a kind, or the name of a file."""
    if value is not None and not isinstance(value, (*kinds, str, Path)):
        wanted = " or ".join(kind.__name__ for kind in kinds)
        article = "an" if wanted.startswith(tuple("AEIOU")) else "a"
        raise InputError(
            f"{name} must be {article} {wanted} or the name of its file, got {type(value).__name__}"
        )


def check_person(body: object, height: object) -> None:
    """Raise `InputError` unless a body is one, or the name of its file, and no height is given beside it."""
    if body is not None and height is not None:
        raise InputError(
            "height does nothing beside body, whose bones tell it; leave one of them out"
        )
    check_kind("body", body, Body)


def method_for(
    method: str | None,
    models: Collection[str],
    of_kalman: Collection[str],
    of_particles: Collection[str],
) -> str:
    """Return the method that tracks with what is given; raise `InputError` for what it does not use."""
    if method == KEYPOINT_METHOD:
        refuse([*models, *of_particles], f"for method {method}")
        return method
    refuse(of_kalman, f"without method={KEYPOINT_METHOD!r}")
    return choose_method(method, models)


def refuse(unused: Collection[str], where: str) -> None:
    """Raise `InputError` for arguments that the method does not use."""
    if unused:
        raise InputError(f"{', '.join(unused)} does nothing {where}; leave it out")


def keypoints_alone(method: str, silhouettes: Any, keypoints: Any) -> Any:
    """Return keypoints; raise `InputError` for silhouettes, and without keypoints."""
    if silhouettes is not None:
        given = "silhouettes" if keypoints is None else "both"
        raise InputError(
            f"method {method} takes keypoints and no silhouettes, got {given}; keypoints are "
            "given by name, and other methods take either or both"
        )
    if keypoints is None:
        raise InputError(f"method {method} takes keypoints, got none")
    return keypoints


def check_not_refined(refine: str) -> None:
    """Raise `InputError` for cameras that are to be refined by several persons."""
    if refine != "none":
        raise InputError(
            f"refine={refine!r} is for recordings of one person, and persons is given; refine "
            "cameras on a recording of one, and take its details"
        )


def check_filters_one(method: str, smoothing: str, refine: str, persons: str | int | None) -> None:
    """Raise `InputError` for what the Kalman filter alone does: smooth, refine, and track several persons."""
    if smoothing != "none":
        raise InputError(
            f"smoothing={smoothing!r} needs method={KEYPOINT_METHOD!r}; method {method} filters"
        )
    if refine != "none" or persons is not None:
        given = "persons" if persons is not None else f"refine={refine!r}"
        raise InputError(
            f"{given} needs method={KEYPOINT_METHOD!r}; method {method} tracks one person in "
            "cameras as they are given"
        )


def check_facing(facing: Any, initial_state: Any, keypoints: Any) -> None:
    """Raise `InputError` for a direction where the first pose is given, or found in keypoints."""
    if initial_state is not None:
        refuse(["facing"] * (facing is not None), "beside an initial_state")
    if keypoints is not None:
        refuse(["facing"] * (facing is not None), "where keypoints are given, which show it")


def whole_length(lengths: Integer[Tensor, "1"]) -> int:
    """Return how many frames of a sequence are tracked; `check_lengths` follows when all are counted."""
    check_tensors(lengths=lengths)
    check_shape("lengths", lengths, [1])
    if int(lengths) < 1:
        raise InputError(f"lengths must be integers of 1 or more, got {lengths.tolist()}")
    return int(lengths)
