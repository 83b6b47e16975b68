"""Decode models that give the keypoints of one person: classified coordinates, heatmaps, MoveNet."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.measure._detectors.protocol import Detections

_NUDGE = 0.25  # cells, from the highest cell of a heatmap towards its higher neighbour


def decode_simcc(
    x: Float[Tensor, "N J Wx"], y: Float[Tensor, "N J Hy"], size: tuple[int, int]
) -> Detections:
    """Return the keypoints of coordinates that are classified into bins.

        u = argmax x  w / W_x,   v = argmax y  h / H_y,   confidence = min(max x, max y)

    Args:
        x, y: scores of the bins of each coordinate. size: (w, h) of the model's input.

    Reference:
        Li et al., SimCC, ECCV 2022; Jiang et al., RTMPose, 2023.
    """
    score_x, u = x.max(-1)
    score_y, v = y.max(-1)
    bins = torch.tensor([size[0] / x.shape[-1], size[1] / y.shape[-1]], dtype=torch.float64)
    points = torch.stack([u, v], -1) * bins
    return Detections(points, _confidence(torch.minimum(score_x, score_y)))


def decode_heatmaps(maps: Float[Tensor, "N J h w"], size: tuple[int, int]) -> Detections:
    """Return the highest cells of heatmaps, moved by a quarter of a cell towards the higher neighbour.

    Args:
        maps: of each keypoint. size: (w, h) of the model's input.

    Reference:
        Newell et al., Stacked hourglass networks, ECCV 2016.
    """
    height, width = maps.shape[-2:]
    best, place = maps.flatten(-2).max(-1)
    row, column = place // width, place % width
    u = column + _NUDGE * _slope(_line(maps, row, -2), column)
    v = row + _NUDGE * _slope(_line(maps, column, -1), row)
    cells = torch.tensor([size[0] / width, size[1] / height], dtype=torch.float64)
    return Detections(torch.stack([u, v], -1) * cells, _confidence(best))


def _line(maps: Tensor, index: Int[Tensor, "N J"], axis: int) -> Float[Tensor, "N J n"]:
    """Return the row (axis -2) or the column (axis -1) of each map."""
    shape = list(maps.shape)
    shape[axis] = 1
    return torch.gather(maps, axis, index[..., None, None].expand(shape)).squeeze(axis)


def _slope(line: Float[Tensor, "N J n"], place: Int[Tensor, "N J"]) -> Float[Tensor, "N J"]:
    """Return the sign of the difference of the two neighbours of a place, 0 at the ends."""
    last = line.shape[-1] - 1
    after, before = (place + 1).clamp_max(last), (place - 1).clamp_min(0)
    steps = line.gather(-1, after[..., None]) - line.gather(-1, before[..., None])
    inside = (place > 0) & (place < last)
    return torch.sign(steps[..., 0]).double() * inside


def decode_movenet_single(out: Float[Tensor, "1 1 J 3"], size: tuple[int, int]) -> Detections:
    """Return the keypoints of MoveNet's single pose: (v, u, confidence), shares of the input.

    Args:
        size: (w, h) of the model's input.
    """
    rows = out[:, 0].double()
    return Detections(rows[..., [1, 0]] * rows.new_tensor(size), _confidence(rows[..., 2]))


def _confidence(score: Tensor) -> Float[Tensor, "*batch"]:
    return score.double().nan_to_num(0.0).clamp(0.0, 1.0)
