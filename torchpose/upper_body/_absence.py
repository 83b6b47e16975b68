"""Take hands that are probably outside of the image as evidence about the arms."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.camera._pinhole import PinholeCamera
from torchpose.camera._tilt import Turn
from torchpose.errors import InputError
from torchpose.math._half_planes import log_outside
from torchpose.skeleton._joint_sets import UPPER_BODY

HANDS = (UPPER_BODY.index("hand_left"), UPPER_BODY.index("hand_right"))
"""Rows of the hands among the eight joints."""

# Probability that a hand in the image is not visible; chosen on persons P08 and P12 of video_people.
_HIDDEN = 0.4
_SOFT = 0.02  # deviation of the image's border, as a share of its longer side
_SUREST = 1e-3
_NEAREST = 0.1  # metres


class Absence(NamedTuple):
    """Evidence that hands which are not measured are outside of the image.

    Attributes:
        log_inside: the log of how likely the evidence is if the left, or the right, hand is in the image,
            relative to outside, at most 0, [B, T, 2]. It is 0 where nothing is known.
        planes: (a, b) of the borders: a (u, v) + b is how far beyond, in deviations, [P, 3].
    """

    log_inside: Tensor
    planes: Tensor


def absence_of(
    absent: Float[Tensor, "B T 2"],
    camera: PinholeCamera,
    matrix: Float[Tensor, "3 3"],
    turn: Turn | None = None,
) -> Absence | None:
    """Return the evidence of probabilities that hands cannot be seen; None if nothing is known of any.

    A hand is hidden with probability h where it is in the image, and always elsewhere. The probability
    g that it cannot be seen, at even odds before, is then

        rho = h + (1 - h) (1 - g) / g

    times as likely for a place in the image as for one outside.

    Args:
        absent: g of both hands; NaN where nothing is known. camera: of the image.
        matrix: K of the prior's camera, in whose pixels the borders are.
        turn: the turn of these pixels that makes the camera level; None if it is.

    Raises:
        InputError: a camera without the size of its image, or probabilities outside [0, 1].
    """
    if camera.image_size is None:
        raise InputError(
            "absent needs the borders of the image: expected a camera with width and height, got one "
            "without; leave absent out, or give the camera its size"
        )
    known = ~absent.isnan()
    if bool((known & ((absent < 0) | (absent > 1))).any()):
        raise InputError(
            "absent must hold probabilities from 0 to 1, or NaN where nothing is known"
        )
    if not bool(known.any()):
        return None
    gone = torch.where(known, absent, 0.5).clamp_min(_SUREST)
    ratio = (_HIDDEN + (1 - _HIDDEN) * (1 - gone) / gone).clamp_max(1.0)
    width, height = camera.image_size
    lines = absent.new_tensor(
        [[0.0, 1.0, 0.5 - height], [-1.0, 0.0, -0.5], [1.0, 0.0, 0.5 - width], [0.0, -1.0, -0.5]]
    )
    own, wanted = camera.matrix.to(absent), matrix.to(absent)
    lines = torch.linalg.solve_triangular(wanted.mT, (lines @ own).mT, upper=False).mT
    lines = lines if turn is None else turn.lines(lines)
    return Absence(ratio.log(), lines / (_SOFT * max(width, height)))


def log_beyond(
    points: Float[Tensor, "*batch N 3"],
    borders: Float[Tensor, "*#batch P 3"],
    axis: Float[Tensor, "*#batch 3"],
    log_inside: Float[Tensor, "*#batch"],
) -> Float[Tensor, "*batch N"]:
    """Return the log-likelihood of the evidence for hands in space.

    Args:
        points: metres from the camera, in any axes. borders: the planes through camera and borders of the
            image, K^T (a, b), in the same axes. axis: the optical axis there.
        log_inside: see `Absence`.
    """
    depth = (points @ axis[..., None]).clamp_min(_NEAREST)
    return log_outside(points @ borders.mT / depth, log_inside[..., None])
