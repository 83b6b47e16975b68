"""Estimate both elbows from a network's map of them and the hands, in each frame alone."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.measure._body_window import CELL, CELLS, cell_axes, cells_to_pixels, pixels_to_cells
from torchpose.measure._grid_filter import read_out
from torchpose.measure._hand_likelihood import HandMeasurements, HandSettings
from torchpose.measure._hand_network import HandPlaces
from torchpose.measure._torso_elbows import Elbows

_FREEDOM = 4.0  # of the Student distribution of an elbow given the hand


def expected_elbows(
    hands: HandMeasurements, elbow: Float[Tensor, "N 2 2 r c"], anchors: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 2 2"]:
    """Return where elbows are expected given the hands, in B from the anchors, NaN without one.

    Args:
        hands: as measured. elbow: (x, y) for a hand in each cell, in B from the anchor.
        anchors: (x, y, B) of the windows, pixels.
    """
    cells = pixels_to_cells(hands.points.nan_to_num(0.0), anchors).round().long()
    column, row = (cells[..., i].clamp(0, CELLS[1 - i] - 1) for i in (0, 1))
    index = (row * CELLS[1] + column)[:, :, None, None].expand(-1, -1, 2, 1)
    place = elbow.flatten(3).gather(3, index)[..., 0]
    return torch.where(hands.seen[..., None], place, torch.nan)


def find_elbows(
    found: HandPlaces,
    expected: Float[Tensor, "N 2 2"],
    anchors: Float[Tensor, "N 3"],
    shape: tuple[int, ...],
    settings: HandSettings,
) -> Elbows:
    """Return the elbows in one frame, by the network and by the density of an elbow given its hand.

    Args:
        found: by the network. expected: see `expected_elbows`.
        anchors: (x, y, B) of the windows, pixels. shape: of the frame. settings: constants.
    """
    s = settings
    x, y = (places - expected[:, :, i, None] for i, places in enumerate(cell_axes()))
    away = x.square()[:, :, None] + y.square()[..., None]
    away = away.div_(s.elbow_reach**2).nan_to_num_(0.0).div_(_FREEDOM)
    likely = away.log1p_().mul_(-0.5 * (_FREEDOM + 2))
    belief = torch.softmax((found.elbows + likely.to(found.elbows)).flatten(2), 2)
    peak = read_out(belief.view_as(found.elbows), smooth=1.5, within=5.0)
    points = cells_to_pixels(peak.place, anchors)
    unit = (anchors[:, 2] * CELL).square()[:, None, None, None]
    floor = (s.elbow_floor / CELL) ** 2 * torch.eye(2, dtype=unit.dtype)
    seen = in_frame(points, shape) & (peak.mass >= s.least_mass)
    seen = seen & (found.elbows_gone + s.elbow_bias < 0)
    return Elbows(points, (s.elbow_scale * peak.covariance + floor) * unit, seen)


def in_frame(points: Float[Tensor, "N 2 2"], shape: tuple[int, ...]) -> Bool[Tensor, "N 2"]:
    """Return whether points are in a frame of this shape."""
    high = points.new_tensor([shape[1] - 0.5, shape[0] - 0.5])
    return ((points >= -0.5) & (points <= high)).all(-1)
