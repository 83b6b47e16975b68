"""A tracked whole body drawn over the frame of a camera."""

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from torchpose.body.skeleton import BODY_15, BodySkeleton
from torchpose.errors import check_rgb, check_shape
from torchpose.video.pen import Color, Pen, rgb
from torchpose.viz.style import LEFT, RIGHT

__all__ = ["draw_body"]

Image = NDArray[np.uint8]
_MIDDLE = rgb("#F2F2F2")
_MEASURED = rgb("#F0E442")
_MODEL = rgb("#009E73")
_TINT = 0.35  # of the model's silhouette over the picture


def draw_body(
    image: Image,
    joints2d: Float[Tensor, "J 2"],
    skeleton: BodySkeleton = BODY_15,
    *,
    model: Bool[Tensor, "h w"] | None = None,
    silhouette: Bool[Tensor, "h w"] | None = None,
    label: str = "",
) -> Image:
    """Draw a body, its silhouette, and the measured silhouette's outline on a copy of a frame.

    The person's left is blue, the right orange. The body's silhouette is a green tint, the outline
    of what was measured yellow. Joints that are NaN or far outside are left out with their bones.

    Args:
        image: [H, W, 3], RGB, uint8; not changed.
        joints2d: pixels of that image [J, 2]. skeleton: whose joints they are.
        model, silhouette: of the image at any scale [h, w].
        label: a word or two over the head; ASCII.

    Returns:
        A new image of the same size.

    Raises:
        InputError: not an RGB image of uint8. ShapeError: another number of joints.
    """
    check_rgb("image", image, empty=False)
    check_shape("joints2d", joints2d, [len(skeleton.names), 2])
    canvas = np.array(image, order="C")
    pen = Pen(canvas)
    if model is not None:
        _tint(canvas, model, _MODEL)
    if silhouette is not None:
        _contour(canvas, silhouette, _MEASURED, pen.edge + 1)
    points, colors = joints2d.tolist(), [_color(name) for name in skeleton.names]
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            pen.bone(points[parent], points[joint], colors[joint])
    for point, color in zip(points, colors, strict=True):
        pen.joint(point, color, True)
    pen.label(label, points, skeleton.names.index("head") if "head" in skeleton.names else 0,
              _MIDDLE)  # fmt: skip
    return canvas


def _color(name: str) -> Color:
    side = name.split("_")[0]
    return {"left": rgb(LEFT), "right": rgb(RIGHT)}.get(side, _MIDDLE)


def _enlarged(canvas: Image, mask: Tensor) -> NDArray[np.uint8]:
    import cv2

    size = (canvas.shape[1], canvas.shape[0])
    small = mask.detach().cpu().numpy().astype(np.uint8)
    return np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_NEAREST), np.uint8)


def _tint(canvas: Image, mask: Tensor, color: Color) -> None:
    inside = _enlarged(canvas, mask) > 0
    mixed = (1 - _TINT) * canvas[inside] + _TINT * np.array(color)
    canvas[inside] = mixed.round().astype(np.uint8)


def _contour(canvas: Image, mask: Tensor, color: Color, width: int) -> None:
    import cv2

    outlines, _ = cv2.findContours(_enlarged(canvas, mask), cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
    cv2.drawContours(canvas, outlines, -1, color, width, cv2.LINE_AA)
