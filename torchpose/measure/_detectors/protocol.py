"""State what a detector of keypoints is, and check what one returns."""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import CONFIDENCE_ADVICE, MOST_CONFIDENCE
from torchpose._core.images import Image
from torchpose.errors import InputError

_SEVERAL = 3  # keypoints that tell whether all are shares of the image
_SPREAD = 0.01  # points that are nearer are no body


class Detections(NamedTuple):
    """Holds the keypoints of the N persons in a frame.

    Attributes:
        keypoints: pixels [N, J, 2], NaN where missing. confidence: 0 to 1 [N, J], 0 where missing.
    """

    keypoints: Float[Tensor, "N J 2"]
    confidence: Float[Tensor, "N J"]


@runtime_checkable
class KeypointDetector(Protocol):
    """Detects the keypoints of all persons in an image.

    Attributes:
        names: of the J keypoints, in spellings of `torchpose.skeleton`.

    Two more members are used where they exist: `neck`, the kind of neck where the names do not tell it, and
    `reset()`, which is called before a video begins.
    """

    @property
    def names(self) -> Sequence[str]:
        """Return the names of the keypoints."""
        ...

    def __call__(self, image: Image) -> tuple[Any, Any]:
        """Return keypoints [N, J, 2] and confidence [N, J] of N persons, arrays or tensors.

        Args:
            image: RGB, uint8 [H, W, 3].

        Returns:
            Pixels of the image, u to the right and v down, NaN where missing; and numbers in 0 to 1.
        """
        ...


@runtime_checkable
class CroppingDetector(KeypointDetector, Protocol):
    """Detects the keypoints of one person in each of some boxes, or in the whole image."""

    def detect_in(self, image: Image, boxes: Float[Tensor, "N 4"] | None) -> Detections:
        """Return the keypoints of one person for each box.

        Args:
            image: RGB, uint8 [H, W, 3].
            boxes: left, top, right, bottom, pixels; they may reach out of the image. None is the image.
        """
        ...


def checked_detections(found: Any, n_keypoints: int, detector: str) -> Detections:
    """Return the result of a detector as tensors.

    Args:
        found: keypoints and confidence. n_keypoints: J, as many as it has names.
        detector: its name in messages.

    Raises:
        InputError: not a pair, other shapes, no numbers, no pixels, or a confidence below 0 or above 2.
    """
    wanted = f"keypoints [N, {n_keypoints}, 2] and confidence [N, {n_keypoints}] of N persons"
    try:
        keypoints, confidence = (_double(values) for values in found)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{detector} must return {wanted}, arrays or tensors of numbers; got {_kind(found)}"
        ) from error
    shapes = list(keypoints.shape), list(confidence.shape)
    if shapes != ([len(keypoints), n_keypoints, 2], [len(keypoints), n_keypoints]):
        raise InputError(f"{detector} must return {wanted}, got {shapes[0]} and {shapes[1]}")
    there = keypoints.isfinite().all(-1) & confidence.isfinite()
    wrong = there & ((confidence < 0) | (confidence > MOST_CONFIDENCE))
    if bool(wrong.any()):
        raise InputError(
            f"{detector} must return a confidence in 0 to 1, got {float(confidence[wrong][0]):g}; "
            + CONFIDENCE_ADVICE
        )
    _check_pixels(keypoints[there & (confidence > 0)], detector)
    keypoints = torch.where(there[..., None], keypoints, torch.nan)
    return Detections(keypoints, torch.where(there, confidence.clamp(max=1.0), 0.0))


def _check_pixels(points: Float[Tensor, "K 2"], detector: str) -> None:
    """Refuse keypoints that are spread over less than a pixel: shares of the image's sides."""
    if len(points) < _SEVERAL or bool((points < 0).any() | (points > 1).any()):
        return
    if bool((points.amax(0) - points.amin(0) > _SPREAD).all()):
        raise InputError(
            f"{detector} must return keypoints in pixels, got all of them between "
            f"{float(points.min()):.3g} and {float(points.max()):.3g}; multiply shares by the width and "
            "height of the image"
        )


def _double(values: Any) -> Tensor:
    if isinstance(values, Tensor):
        return values.detach().to("cpu", torch.float64)
    return torch.from_numpy(np.array(values, dtype=np.float64))


def _kind(found: Any) -> str:
    if isinstance(found, tuple | list):
        kinds = ", ".join(type(part).__name__ for part in found[:4])
        return f"{len(found)} values ({kinds})"
    return type(found).__name__
