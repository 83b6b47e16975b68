"""Tell from the shapes of a model's outputs what they mean, and how its input is to be made."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchpose._core.images import Image
from torchpose.errors import InputError
from torchpose.measure._detectors.bottom_up import (
    decode_movenet_multi,
    decode_rtmo,
    decode_yolo,
    decode_yolo_suppressed,
)
from torchpose.measure._detectors.joint_sets import KNOWN, JointSet, joint_set
from torchpose.measure._detectors.protocol import Detections
from torchpose.measure._detectors.top_down import (
    decode_heatmaps,
    decode_movenet_single,
    decode_simcc,
)

Shape = tuple[int, ...]
Size = tuple[int, int]

_MEAN = np.array([123.675, 116.28, 103.53], np.float32)  # of ImageNet, RGB
_STD = np.array([58.395, 57.12, 57.375], np.float32)
_GREY = 114  # outside of the image, of RTMO and YOLO


class Layout(NamedTuple):
    """Holds how a model is fed and read.

    Attributes:
        title: of the kind of model. joints: of its keypoints.
        crops: whether it wants one person, cropped out of the image.
        normalise: from RGB, uint8 [h, w, 3], to the values that it wants, in the same order.
        decode: from its outputs and (w, h) of its input to keypoints in pixels of that.
        fill: value of pixels outside of the image. centred: whether the image is in the middle.
    """

    title: str
    joints: JointSet
    crops: bool
    normalise: Callable[[Image], np.ndarray]
    decode: Callable[[Sequence[Tensor], Size], Detections]
    fill: int = 0
    centred: bool = True


class _Outputs(NamedTuple):
    """Holds what tells the layout: shapes of the outputs, (w, h) of the input, channels last or first."""

    shapes: tuple[Shape, ...]
    size: Size
    channels_last: bool
    model: str


def find_layout(
    shapes: Sequence[Shape], size: Size, channels_last: bool, model: str, names: Sequence[str] = ()
) -> Layout:
    """Return the layout that fits the outputs of a model.

    Args:
        shapes: of the outputs. size: (w, h) of the input. channels_last: its order.
        model: its name in messages. names: of the outputs.

    Raises:
        InputError: none fits, or the joint set is not known.
    """
    outputs = _Outputs(tuple(tuple(shape) for shape in shapes), size, channels_last, model)
    for fitting in (_movenet,) if channels_last else (_simcc, _rtmo, _heatmaps, _yolo):
        layout = fitting(outputs, tuple(names))
        if layout is not None:
            return layout
    came = "; ".join(str(list(shape)) for shape in outputs.shapes)
    order = "[1, h, w, 3]" if channels_last else "[1, 3, h, w]"
    raise InputError(
        f"{model}: its outputs {came} (input {order}, {size[0]} x {size[1]}) are of no known layout; "
        "expected simcc_x [1, J, W] and simcc_y [1, J, H] (RTMPose), heatmaps [1, J, h, w], dets [1, N, 5] "
        "and keypoints [1, N, J, 3] (RTMO), [1, 5 + 3 J, N], [1, N, 5 + 3 J] or [1, N, 6 + 3 J] (YOLO-pose) "
        "of an input [1, 3, h, w], or [1, 1, 17, 3] or [1, 6, 56] (MoveNet) of an input [1, h, w, 3]; wrap "
        "other models in Python (package:factory)"
    )


def _movenet(outputs: _Outputs, names: tuple[str, ...]) -> Layout | None:
    if len(outputs.shapes) != 1:
        return None
    shape = outputs.shapes[0]
    if len(shape) == 4 and shape[:2] == (1, 1) and shape[3] == 3:
        joints = joint_set(shape[2], outputs.model)
        return Layout(
            "MoveNet single pose", joints, True, np.asarray,
            lambda out, size: decode_movenet_single(out[0], size),
        )  # fmt: skip
    if len(shape) == 3 and (shape[2] - 5) % 3 == 0 and shape[2] > 5:
        joints = joint_set((shape[2] - 5) // 3, outputs.model)
        return Layout(
            "MoveNet multi pose", joints, False, np.asarray,
            lambda out, size: decode_movenet_multi(out[0], size),
        )  # fmt: skip
    return None


def _simcc(outputs: _Outputs, names: tuple[str, ...]) -> Layout | None:
    """Fit two outputs [1, J, k w] and [1, J, k h]."""
    shapes, (width, height) = outputs.shapes, outputs.size
    if [len(shape) for shape in shapes] != [3, 3] or shapes[0][1] != shapes[1][1]:
        return None
    bins = shapes[0][2], shapes[1][2]
    swapped = bins[0] * height != bins[1] * width or names[:1] == ("simcc_y",)
    if swapped and bins[1] * height != bins[0] * width:
        return None
    joints = joint_set(shapes[0][1], outputs.model)
    x, y = (1, 0) if swapped else (0, 1)
    return Layout(
        "RTMPose (SimCC)", joints, True, _imagenet,
        lambda out, size: decode_simcc(out[x], out[y], size),
    )  # fmt: skip


def _rtmo(outputs: _Outputs, names: tuple[str, ...]) -> Layout | None:
    """Fit boxes [1, N, 5] and keypoints [1, N, J, 3], in this order or the other."""
    if sorted(len(shape) for shape in outputs.shapes) != [3, 4]:
        return None
    swapped = len(outputs.shapes[0]) == 4
    dets, keypoints = outputs.shapes[::-1] if swapped else outputs.shapes
    if dets[2] != 5 or keypoints[3] != 3:
        return None
    joints = joint_set(keypoints[2], outputs.model)
    order = -1 if swapped else 1
    return Layout(
        "RTMO", joints, False,
        lambda image: image[..., ::-1].astype(np.float32),  # BGR
        lambda out, _: decode_rtmo(*out[::order]),
        _GREY, centred=False,
    )  # fmt: skip


def _heatmaps(outputs: _Outputs, names: tuple[str, ...]) -> Layout | None:
    """Fit one output [1, J, h, w] whose sides are those of the input over one number."""
    shapes, (width, height) = outputs.shapes, outputs.size
    if [len(shape) for shape in shapes] != [4]:
        return None
    shape = shapes[0]
    if shape[3] * height != shape[2] * width:
        return None
    joints = joint_set(shape[1], outputs.model)
    return Layout(
        "heatmaps", joints, True, _imagenet, lambda out, size: decode_heatmaps(out[0], size)
    )


def _yolo(outputs: _Outputs, names: tuple[str, ...]) -> Layout | None:
    """Fit one output [1, C, N] or [1, N, C], C = 5 + 3 J, or [1, N, 6 + 3 J] of a model that suppresses."""
    if [len(shape) for shape in outputs.shapes] != [3]:
        return None
    first, last = outputs.shapes[0][1:]
    fitting = [
        (side - before, decode)
        for side, before, decode in (
            (first, 5, lambda out, _: decode_yolo(out[0][0].T)),
            (last, 5, lambda out, _: decode_yolo(out[0][0])),
            (last, 6, lambda out, _: decode_yolo_suppressed(out[0][0])),
        )
        if side > before and (side - before) % 3 == 0
    ]  # fmt: skip
    if not fitting:
        return None
    known = [(values, decode) for values, decode in fitting if values // 3 in KNOWN]
    values, decode = known[0] if known else min(fitting, key=lambda one: one[0])
    joints = joint_set(values // 3, outputs.model)
    share = np.float32(255)
    return Layout(
        "YOLO-pose", joints, False, lambda image: image.astype(np.float32) / share, decode, _GREY
    )


def _imagenet(image: Image) -> np.ndarray:
    """Return RGB by the mean and deviation of ImageNet."""
    return (image.astype(np.float32) - _MEAN) / _STD


def as_tensors(arrays: Sequence[np.ndarray]) -> list[Tensor]:
    """Return arrays as tensors."""
    return [torch.from_numpy(np.ascontiguousarray(array)) for array in arrays]
