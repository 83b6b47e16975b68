"""Draw tracked persons on their video frame.

The colours are those of `torchpose.viz`: the person's left arm is blue, the right one orange. A filled
joint was measured; a ring was inferred and has an ellipse of its covariance. Head, neck, collar bones,
bounding box of the face and label have the tint of the person.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from torchpose._core.checks import check_rgb, check_shape
from torchpose._core.images import Image
from torchpose.body._feet import FEET, FOOT_BONES
from torchpose.body._skeleton import BODY_15, BodySkeleton
from torchpose.errors import InputError
from torchpose.metrics._calibration import chi2_quantile
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.skeleton._upper_body import LIMBS
from torchpose.viz._style import LEFT, RIGHT, side_of

Color = tuple[int, int, int]

PERSON_TINTS = ("#F2F2F2", "#009E73", "#CC79A7", "#F0E442", "#56B4E9")
"""Colours of the persons in turn, from the palette of Okabe & Ito."""

_HAND_SIDES = (LEFT, RIGHT)
_HEAD = UPPER_BODY.index("head")
_MIDDLE, _MEASURED, _MODEL = (242, 242, 242), (240, 228, 66), (0, 158, 115)
_TINT = 0.35  # opacity of the model's silhouette
_LIGHT, _DARK = (255, 255, 255), (20, 20, 20)
_SHIFT = 3  # cv2 takes coordinates in eighths of a pixel
_REACH = 8  # image sizes; points further out are not drawn


class Pen:
    """Draws outlined shapes by OpenCV, in widths that fit the image; skips what cannot be drawn."""

    def __init__(self, canvas: Image) -> None:
        height, width = canvas.shape[:2]
        self.canvas = canvas
        self.scale = math.sqrt(height * width / (640 * 480))
        self.limit = _REACH * max(height, width)
        self.bone_width = max(1, round(3 * self.scale))
        self.edge = max(1, round(self.scale))
        self.thin = max(1, round(0.6 * self.scale))
        self.radius = max(1.5, 4.5 * self.scale)

    def drawable(self, *numbers: float) -> bool:
        return all(math.isfinite(n) and abs(n) <= self.limit for n in numbers)

    def bone(self, a: list[float], b: list[float], color: Color) -> None:
        if self.drawable(*a, *b):
            self.line(a, b, _outline(color), self.bone_width + 2 * self.edge)
            self.line(a, b, color, self.bone_width)

    def line(self, a: list[float], b: list[float], color: Color, width: int) -> None:
        import cv2

        cv2.line(self.canvas, _fixed(a), _fixed(b), color, width, cv2.LINE_AA, _SHIFT)

    def joint(self, point: list[float], color: Color, filled: bool) -> None:
        import cv2

        if not self.drawable(*point):
            return
        around, inner = _outline(color), self.radius - 1.5 * self.edge
        rings = [(self.radius + self.edge, around), (self.radius, color)]
        for radius, paint in rings if filled else [*rings, (max(inner, 0.0), around)]:
            size = max(1, round(radius * (1 << _SHIFT)))
            cv2.circle(self.canvas, _fixed(point), size, paint, -1, cv2.LINE_AA, _SHIFT)

    def ellipse(
        self, point: list[float], shape: list[float], color: Color, outlined: bool = False
    ) -> None:
        import cv2

        if not (self.drawable(*point, *shape[:2]) and math.isfinite(shape[2])):
            return
        strokes = [(_outline(color), 2 * self.edge + self.thin)] if outlined else []
        for paint, width in [*strokes, (color, self.thin)]:
            cv2.ellipse(
                self.canvas, _fixed(point), _fixed(shape[:2]), shape[2], 0, 360, paint, width,
                cv2.LINE_AA, _SHIFT,
            )  # fmt: skip

    def box(self, face: list[float], color: Color) -> None:
        import cv2

        if self.drawable(*face):
            x, y, half = face[0], face[1], face[2] / 2
            corners = _fixed([x - half, y - half]), _fixed([x + half, y + half])
            for paint, width in ((_outline(color), self.edge + 2), (color, self.edge)):
                cv2.rectangle(self.canvas, *corners, paint, width, cv2.LINE_AA, _SHIFT)

    def cross(self, point: list[float], color: Color) -> None:
        if self.drawable(*point):
            arm = 1.6 * self.radius
            for paint, width in ((_outline(color), 3 * self.edge), (color, self.edge)):
                for dx, dy in ((arm, arm), (arm, -arm)):
                    ends = [point[0] - dx, point[1] - dy], [point[0] + dx, point[1] + dy]
                    self.line(*ends, paint, width)

    def label(self, text: str, joints: list[list[float]], head: int, color: Color) -> None:
        """Draw a label over the head, else over the highest known joint, inside the image."""
        import cv2

        there = [joint for joint in joints if self.drawable(*joint)]
        if not text or not there:
            return
        text = text.encode("ascii", "replace").decode()  # cv2 has no other letters
        size = max(0.35, 0.5 * self.scale)
        (width, height), base = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, self.edge)
        over = joints[head]
        x, y = over if over in there else min(there, key=lambda joint: joint[1])
        rows, columns = self.canvas.shape[:2]
        left = round(min(max(x - width / 2, 2), max(2, columns - width - 2)))
        top = y - 10 * self.radius - base
        bottom = round(min(max(top, height + 2), max(height + 2, rows - base - 2)))
        for paint, stroke in ((_outline(color), 3 * self.edge), (color, self.edge)):
            cv2.putText(
                self.canvas, text, (left, bottom), cv2.FONT_HERSHEY_SIMPLEX, size, paint, stroke,
                cv2.LINE_AA,
            )  # fmt: skip


def _fixed(point: list[float]) -> tuple[int, int]:
    return round(point[0] * (1 << _SHIFT)), round(point[1] * (1 << _SHIFT))


@lru_cache(maxsize=32)
def rgb(text: str) -> Color:
    return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)


@lru_cache(maxsize=32)
def _outline(color: Color) -> Color:
    """Return black for light colours and white for dark ones, for contrast on any picture."""
    return _DARK if 0.3 * color[0] + 0.59 * color[1] + 0.11 * color[2] > 140 else _LIGHT


def draw_overlay(
    image: Image,
    poses2d: Float[Tensor, "P 8 2"],
    covariance2d: Float[Tensor, "P 8 2 2"] | None,
    observed: Bool[Tensor, "P 8"],
    *,
    faces: Float[Tensor, "F 3"] | None = None,
    hands: Float[Tensor, "N 2 2"] | None = None,
    hand_covariance: Float[Tensor, "N 2 2 2"] | None = None,
    labels: Sequence[str] | None = None,
    tints: Sequence[int] | None = None,
    face_tints: Sequence[int] | None = None,
    level: float = 0.9,
) -> Image:
    """Return a copy of a frame with P persons and their measurements drawn on it.

    Bones join the joints; a joint that was measured is a disc, one that was inferred a ring with the
    ellipse of probability `level`. Joints that are NaN or far outside of the image are left out with
    their bones. Widths scale with the image.

    Args:
        image: [H, W, 3], RGB, uint8; not changed.
        poses2d: joints in the order of `UPPER_BODY`, pixels [P, 8, 2].
        covariance2d: theirs, pixels squared [P, 8, 2, 2]; None draws no ellipses.
        observed: True where the joint was measured [P, 8].
        faces: centre and size of the measured faces, pixels [F, 3].
        hands: measured hands, left and right [N, 2, 2], pixels, drawn as crosses below the joints.
        hand_covariance: theirs [N, 2, 2, 2], drawn as ellipses of probability `level`.
        labels: a word or two for each person, over the head; ASCII.
        tints: index into `PERSON_TINTS` of each person, such as its number; by default in order.
        face_tints: the same for each face; by default face i has the tint of person i.
        level: probability of the ellipses.

    Returns:
        A new image of the same size.

    Raises:
        InputError: not an RGB image of uint8, labels or tints of another number than persons, or a
            level outside (0, 1).
        ShapeError: tensors of other shapes, or another number of faces than of their tints.

    >>> frame = np.zeros((48, 64, 3), dtype=np.uint8)
    >>> nobody = torch.zeros(0, 8, 2), None, torch.zeros(0, 8, dtype=torch.bool)
    >>> draw_overlay(frame, *nobody).sum().item()
    0
    """
    _check(image, poses2d, covariance2d, observed, labels, tints, level)
    canvas = np.array(image, order="C")
    pen = Pen(canvas)
    numbers = range(len(poses2d)) if tints is None else tints
    own = _tints_of(numbers)
    if faces is not None:
        check_shape("faces", faces, [None if face_tints is None else len(face_tints), 3])
        others = [rgb(PERSON_TINTS[0])] * len(faces)
        colors = (own + others)[: len(faces)] if face_tints is None else _tints_of(face_tints)
        for face, color in zip(faces.tolist(), colors, strict=True):
            pen.box(face, color)
    if hands is not None:
        _draw_hands(pen, hands, hand_covariance, level)
    points = poses2d.tolist()
    ellipses = None if covariance2d is None else _ellipses(covariance2d, level)
    for person, seen in enumerate(observed.tolist()):
        colors = _joint_colors(UPPER_BODY, own[person])
        for joint in range(len(UPPER_BODY)):
            if ellipses is not None and not seen[joint]:
                pen.ellipse(points[person][joint], ellipses[person][joint], colors[joint])
        for a, b in LIMBS:
            color = colors[a] if colors[a] == colors[b] else own[person]
            pen.bone(points[person][a], points[person][b], color)
        for joint, filled in enumerate(seen):
            pen.joint(points[person][joint], colors[joint], filled)
        if labels is not None:
            pen.label(labels[person], points[person], _HEAD, own[person])
    return canvas


def _tints_of(numbers: Sequence[int]) -> list[Color]:
    return [rgb(PERSON_TINTS[n % len(PERSON_TINTS)]) for n in numbers]


def _draw_hands(pen: Pen, hands: Tensor, covariance: Tensor | None, level: float) -> None:
    check_shape("hands", hands, [None, 2, 2])
    points = hands.tolist()
    ellipses = None
    if covariance is not None:
        check_shape("hand_covariance", covariance, [len(points), 2, 2, 2])
        ellipses = _ellipses(covariance, level)
    for person, pair in enumerate(points):
        for side, point in enumerate(pair):
            color = rgb(_HAND_SIDES[side])
            if ellipses is not None:
                pen.ellipse(point, ellipses[person][side], color, outlined=True)
            pen.cross(point, color)


def _ellipses(covariance: Tensor, level: float) -> list:
    """Return half axes in pixels and angle in degrees of ellipses [..., 2, 2]; NaN where undefined.

    Half axes: sqrt(l chi2) of the eigenvalues l = (a + c)/2 +- sqrt(((a - c)/2)^2 + b^2) of
    [[a, b], [b, c]]; the angle of the longer one is atan2(2 b, a - c) / 2.
    """
    C = covariance.detach().cpu().double()
    a, b, c = C[..., 0, 0], (C[..., 0, 1] + C[..., 1, 0]) / 2, C[..., 1, 1]
    middle, radius = (a + c) / 2, torch.hypot((a - c) / 2, b)
    squared = torch.stack([middle + radius, middle - radius], -1).clamp_min(0)
    half = (squared * _chi2(level)).sqrt()
    angle = torch.rad2deg(torch.atan2(2 * b, a - c)) / 2
    return torch.cat([half, angle[..., None]], -1).tolist()


@lru_cache(maxsize=8)
def _chi2(level: float) -> float:
    return float(chi2_quantile(torch.tensor(level, dtype=torch.float64), 2))


@lru_cache(maxsize=32)
def _joint_colors(names: tuple[str, ...], own: Color) -> list[Color]:
    sides = {"left": rgb(LEFT), "right": rgb(RIGHT), "middle": own}
    return [sides[side_of(name)] for name in names]


def _check(
    image: Image,
    poses2d: Tensor,
    covariance2d: Tensor | None,
    observed: Tensor,
    labels: Sequence[str] | None,
    tints: Sequence[int] | None,
    level: float,
) -> None:
    check_rgb("image", image, empty=False)
    check_shape("poses2d", poses2d, [None, len(UPPER_BODY), 2])
    n = len(poses2d)
    check_shape("observed", observed, [n, len(UPPER_BODY)])
    if covariance2d is not None:
        check_shape("covariance2d", covariance2d, [n, len(UPPER_BODY), 2, 2])
    for name, given in (("labels", labels), ("tints", tints)):
        if given is not None and len(given) != n:
            raise InputError(f"expected {name} for {n} persons, got {len(given)}")
    if not 0 < level < 1:
        raise InputError(f"level must be a probability inside (0, 1), got {level}")


def draw_body(
    image: Image,
    joints2d: Float[Tensor, "J 2"],
    skeleton: BodySkeleton = BODY_15,
    *,
    model: Bool[Tensor, "h w"] | None = None,
    silhouette: Bool[Tensor, "h w"] | None = None,
    keypoints: Float[Tensor, "K 2"] | None = None,
    label: str = "",
    tint: int | None = None,
    feet: Float[Tensor, "6 2"] | None = None,
) -> Image:
    """Return a copy of a frame with a body, its silhouette and what was measured drawn on it.

    The person's left is blue, the right orange. The body's silhouette is a green tint, the outline
    of what was measured yellow, as are the crosses of measured keypoints. Joints that are NaN or far
    outside are left out with their bones.

    Args:
        image: [H, W, 3], RGB, uint8; not changed.
        joints2d: pixels of that image [J, 2]. skeleton: whose joints they are.
        model, silhouette: of the image at any scale [h, w]. keypoints: pixels of that image, NaN where
            there is none.
        label: a word or two over the head; ASCII.
        tint: index into `PERSON_TINTS`, of the trunk, the head and the label; by default they are white.
        feet: pixels of heels and toes of a body of fifteen joints, if they were tracked.

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
    own = _MIDDLE if tint is None else rgb(PERSON_TINTS[tint % len(PERSON_TINTS)])
    points, colors = joints2d.tolist(), _joint_colors(tuple(skeleton.names), own)
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            pen.bone(points[parent], points[joint], colors[joint])
    if feet is not None:
        points, colors = points + feet.tolist(), colors + _joint_colors(FEET, own)
        for start, end in FOOT_BONES:
            pen.bone(points[start], points[end], colors[end])
    for point, color in zip(points, colors, strict=True):
        pen.joint(point, color, True)
    for point in [] if keypoints is None else keypoints.tolist():
        pen.cross(point, _MEASURED)
    pen.label(label, points, skeleton.names.index("head") if "head" in skeleton.names else 0,
              own)  # fmt: skip
    return canvas


def named(image: Image, name: str) -> Image:
    """Return a copy of an image with a name in its upper left corner, of which cv2 has the ASCII letters."""
    canvas = np.array(image, order="C")
    Pen(canvas).label(name, [[0.0, 0.0]], 0, _MIDDLE)
    return canvas


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
