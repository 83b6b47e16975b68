"""Tracked persons drawn over their video frame.

The look is that of `torchpose.viz`: the person's left arm is blue, the right one orange; a filled
joint was measured, a ring was inferred and comes with the ellipse that holds it. What belongs to
neither arm (head, neck, collar bones, face box, label) has the tint of the person.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from torchpose.errors import InputError, check_rgb, check_shape
from torchpose.metrics.calibration import chi2_quantile
from torchpose.skeleton.joint_sets import UPPER_BODY
from torchpose.skeleton.upper_body import LIMBS
from torchpose.video.pen import Color, Pen, rgb
from torchpose.viz.style import LEFT, RIGHT

__all__ = ["PERSON_TINTS", "draw_overlay"]

Image = NDArray[np.uint8]

PERSON_TINTS = ("#F2F2F2", "#009E73", "#CC79A7", "#F0E442", "#56B4E9")
"""Of one person after the other, from the colours of Okabe & Ito; they come round again."""

_HAND_SIDES = (LEFT, RIGHT)
_HEAD = UPPER_BODY.index("head")


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
    level: float = 0.9,
) -> Image:
    """Draw P persons, and what was measured of them, on a copy of a frame.

    Bones join the joints; a joint that was measured is a disc, one that was inferred a ring with the
    ellipse of probability `level`. Joints that are NaN, or absurdly far outside, are left out with
    their bones. Widths grow with the image.

    Args:
        image: [H, W, 3], RGB, uint8; not changed.
        poses2d: joints in the order of `UPPER_BODY`, pixels [P, 8, 2].
        covariance2d: theirs, pixels squared [P, 8, 2, 2]; None draws no ellipses.
        observed: True where the joint was measured [P, 8].
        faces: centre and size of the measured faces, pixels [F, 3]; face i has the tint of person i.
        hands: measured hands, left and right [N, 2, 2], pixels, drawn as crosses below the joints.
        hand_covariance: theirs [N, 2, 2, 2], drawn as ellipses of probability `level`.
        labels: a word or two for each person, over the head; ASCII.
        tints: which of `PERSON_TINTS` each person has, such as its number; by default in order.
        level: probability of the ellipses.

    Returns:
        A new image of the same size.

    Raises:
        InputError: not an RGB image of uint8, labels or tints of another number than persons, or a
            level outside (0, 1).
        ShapeError: tensors of other shapes.

    >>> frame = np.zeros((48, 64, 3), dtype=np.uint8)
    >>> nobody = torch.zeros(0, 8, 2), None, torch.zeros(0, 8, dtype=torch.bool)
    >>> draw_overlay(frame, *nobody).sum().item()
    0
    """
    _check(image, poses2d, covariance2d, observed, labels, tints, level)
    canvas = np.array(image, order="C")
    pen = Pen(canvas)
    numbers = range(len(poses2d)) if tints is None else tints
    own = [rgb(PERSON_TINTS[n % len(PERSON_TINTS)]) for n in numbers]
    if faces is not None:
        check_shape("faces", faces, [None, 3])
        for i, face in enumerate(faces.tolist()):
            pen.box(face, own[i] if i < len(own) else rgb(PERSON_TINTS[0]))
    if hands is not None:
        _draw_hands(pen, hands, hand_covariance, level)
    points = poses2d.tolist()
    ellipses = None if covariance2d is None else _ellipses(covariance2d, level, 2)
    for person, seen in enumerate(observed.tolist()):
        colors = _joint_colors(own[person])
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


def _draw_hands(pen: Pen, hands: Tensor, covariance: Tensor | None, level: float) -> None:
    check_shape("hands", hands, [None, 2, 2])
    points = hands.tolist()
    ellipses = None
    if covariance is not None:
        check_shape("hand_covariance", covariance, [len(points), 2, 2, 2])
        ellipses = _ellipses(covariance, level, 2)
    for person, pair in enumerate(points):
        for side, point in enumerate(pair):
            color = rgb(_HAND_SIDES[side])
            if ellipses is not None:
                pen.ellipse(point, ellipses[person][side], color, outlined=True)
            pen.cross(point, color)


def _ellipses(covariance: Tensor, level: float, dof: int) -> list:
    """Half axes in pixels and angle in degrees of ellipses [..., 2, 2]; NaN where undefined.

    Half axes: sqrt(l chi2) of the eigenvalues l = (a + c)/2 +- sqrt(((a - c)/2)^2 + b^2) of
    [[a, b], [b, c]]; the angle of the longer one is atan2(2 b, a - c) / 2.
    """
    C = covariance.detach().cpu().double()
    a, b, c = C[..., 0, 0], (C[..., 0, 1] + C[..., 1, 0]) / 2, C[..., 1, 1]
    middle, radius = (a + c) / 2, torch.hypot((a - c) / 2, b)
    squared = torch.stack([middle + radius, middle - radius], -1).clamp_min(0)
    half = (squared * _chi2(level, dof)).sqrt()
    angle = torch.rad2deg(torch.atan2(2 * b, a - c)) / 2
    return torch.cat([half, angle[..., None]], -1).tolist()


@lru_cache(maxsize=8)
def _chi2(level: float, dof: int) -> float:
    return float(chi2_quantile(torch.tensor(level, dtype=torch.float64), dof))


@lru_cache(maxsize=32)
def _joint_colors(own: Color) -> list[Color]:
    sides = {"left": rgb(LEFT), "right": rgb(RIGHT)}
    return [sides.get(name.rsplit("_", 1)[-1], own) for name in UPPER_BODY]


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
