"""Measure elbows from the outline of the torso, as in the released tracker of sign language."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose.errors import InputError
from torchpose.measure._face_detector import check_faces
from torchpose.measure._skin import SkinModel, SkinState

# Lengths in sizes of the face, heights from its centre.
_ROWS = (1.5, 4.2)  # where elbows are searched for
_GAP = 0.3  # holes of this width do not end the torso: badges, prints, shadows
_INSET = 0.2  # from the outline to the joint
_SUPPORT = 0.15  # height over which the outline has to reach so far
_SOFT = 0.06  # rows that reach less far by this count a third
_PLAUSIBLE = (0.9, 2.4)  # how far the outline is from the face's axis at an elbow
_LARGEST_SPREAD = 0.7  # of the rows: a straight outline does not determine the height
_STD = (0.25, 0.4)  # least deviation of an elbow, across and down
_REACH = 2.6
_FLOOR, _SLOPE, _BIAS = 2e-4, 1.5, 0.5


class Elbows(NamedTuple):
    """Holds the elbows of N persons: left, right (the person's own), pixels.

    Attributes:
        points: (x, y), NaN where unknown [N, 2, 2].
        covariance: pixels squared [N, 2, 2, 2].
        seen: whether they are measured [N, 2].
    """

    points: Float[Tensor, "N 2 2"]
    covariance: Float[Tensor, "N 2 2 2"]
    seen: Bool[Tensor, "N 2"]


def clothes_likelihood(
    model: SkinModel, state: SkinState, bins: Int[Tensor, "N H W"], skin: bool = True
) -> Float[Tensor, "N H W"]:
    """Return the probability that a pixel shows the person's clothes, or skin, rather than the background.

    p = sigmoid(slope (log (p(c | clothes) + f) / (p(c | far) + f) - bias))

    Args:
        model: that the state belongs to. state: colours of the persons.
        bins: of the pixels, see `SkinModel.bins`. skin: count bare arms as well.
    """
    worn = torch.maximum(state.clothes, state.face) if skin else state.clothes
    ratio = ((worn + _FLOOR) / (state.far + _FLOOR)).log()
    table = torch.sigmoid(_SLOPE * (ratio - _BIAS)).flatten(1)
    return table.gather(1, bins.flatten(1).long()).view(bins.shape)


def elbows_from_torso(
    likelihood: Float[Tensor, "N H W"], faces: Float[Tensor, "N 3"], threshold: float = 0.4
) -> Elbows:
    """Return the elbows where the torso with the sleeves is widest.

    In every row below the shoulders the outline is followed from the face's axis to both sides. On
    each side the elbow is at the height at which it reaches farthest,

        y = sum_r w_r y_r,   w_r ~ exp(x_r / s),   x = max_r x_r - inset,

    with the variance of y_r under w as covariance, which is large for an arm that hangs straight down.
    An elbow is missing where the outline is nearer or farther than arms are, where it meets the
    border of the image, and where the widest row is not distinct.

    Args:
        likelihood: of clothes, such as `clothes_likelihood`. faces: centre (x, y) and size, pixels
            of the map. threshold: above it a pixel belongs to the torso.

    Returns:
        Elbows with covariances.

    Raises:
        ShapeError: wrong shapes. InputError: a face without a size, a threshold outside (0, 1).

    Reference:
        The released tracker of Burke & Lasenby for sign language, which takes the widest row of the
        body for both elbows; here the sides have rows of their own.

    Example:
        >>> import torch
        >>> from torchpose.measure._torso_elbows import elbows_from_torso
        >>> body = torch.zeros(1, 120, 160)
        >>> for v in range(35, 80):  # sleeves go out to a point at row 60
        ...     half = 36 - abs(v - 60) // 2
        ...     body[0, v, 80 - half : 81 + half] = 1.0
        >>> elbows = elbows_from_torso(body, torch.tensor([[80.0, 20.0, 20.0]]))
        >>> elbows.seen.tolist(), [round(x) for x in elbows.points[0, 0].tolist()]
        ([[True, True]], [111, 60])
    """
    check_shape("likelihood", likelihood, ["N", "H", "W"])
    check_faces(faces, len(likelihood))
    if not 0 < threshold < 1:
        raise InputError(f"threshold must be in (0, 1), got {threshold}")
    faces = faces.to(likelihood)
    body = likelihood > threshold
    sides = [_outline(body, faces, 1), _outline(body, faces, -1)]
    far = torch.stack([x for x, _ in sides], 1)  # [N, side, row], in sizes of the face
    at_border = torch.stack([b for _, b in sides], 1)
    down = (torch.arange(likelihood.shape[1]).to(faces) - faces[:, 1:2]) / faces[:, 2:]
    searched = ((down > _ROWS[0]) & (down < _ROWS[1]))[:, None]
    far = _supported(far, faces[:, 2]).masked_fill(~searched, -torch.inf)
    widest = far.amax(2)
    weight = (far / _SOFT).softmax(2).nan_to_num(0.0)
    row = (weight * down[:, None]).sum(2)
    spread = (weight * (down[:, None] - row[..., None]).square()).sum(2)
    ends = searched.any(2) & ~(weight * at_border).sum(2).gt(0.1)
    seen = (widest > _PLAUSIBLE[0]) & (widest < _PLAUSIBLE[1]) & ends
    seen = seen & (spread < _LARGEST_SPREAD**2) & ~_at_the_end(far, searched)
    return _elbows(faces, widest, row, spread, seen)


def _outline(body: Tensor, faces: Tensor, side: int) -> tuple[Tensor, Tensor]:
    """Return the torso's half width per row in face sizes, and whether it meets the image's border, [N, H].

    Outwards from the axis, until a gap.
    """
    width = body.shape[2]
    column = torch.arange(width).to(faces)
    if side < 0:
        body, column = body.flip(2), column.flip(0)
    away = side * (column - faces[:, :1]) / faces[:, 2:]  # [N, W], ascending
    away = away[:, None].expand(body.shape)
    last = torch.where(body & (away > 0), away, 0.0).cummax(2).values
    ended = ((away - last > _GAP) | (away > _REACH)).long().cummax(2).values > 0
    reached = torch.where(body & ~ended, away, 0.0).amax(2)
    return reached, reached >= away[..., -1] - 0.5 * _GAP


def _supported(far: Float[Tensor, "N S H"], size: Float[Tensor, " N"]) -> Float[Tensor, "N S H"]:
    """Return the least reach over some rows about each one, as many as the person's own face has."""
    rows = (_SUPPORT * size.double() / 2).round().long().clamp_min(1)
    most = int(rows.amax()) if len(rows) else 1
    offsets = torch.arange(-most, most + 1, device=far.device)
    beyond = offsets.abs() > rows[:, None]
    padded = torch.nn.functional.pad(far, (most, most), value=torch.inf)
    windows = padded.unfold(2, 2 * most + 1, 1)
    return windows.masked_fill(beyond[:, None, None], torch.inf).amin(-1)


def _at_the_end(far: Tensor, searched: Tensor) -> Tensor:
    """Return whether the torso is widest in the last searched row, so that the elbow is below it."""
    place = torch.arange(far.shape[2], device=far.device)
    last = torch.where(searched, place, -1).amax(2)
    return far.argmax(2) >= last - 1


def _elbows(faces: Tensor, widest: Tensor, row: Tensor, spread: Tensor, seen: Tensor) -> Elbows:
    x, y, size = faces[:, None].unbind(-1)
    sign = widest.new_tensor([1.0, -1.0])  # the person's left is at larger x
    points = torch.stack([x + sign * (widest - _INSET) * size, y + row * size], -1)
    points = torch.where(seen[..., None], points, torch.nan)
    variance = torch.stack([torch.full_like(spread, _STD[0] ** 2), spread + _STD[1] ** 2], -1)
    return Elbows(points, torch.diag_embed(variance * size[..., None].square()), seen)
