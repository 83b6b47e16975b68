"""Decode models that give the keypoints of several persons: RTMO, YOLO-pose, MoveNet multi pose."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.measure._detectors.protocol import Detections

LEAST_SCORE = 0.3
"""Of a person, from which on a detection counts."""
_OVERLAP = 0.65  # of two boxes, intersection over union, from which on they are one person
_MOST_BOXES = 100  # of a frame, by score, that are compared


class ScoredPersons(NamedTuple):
    """Holds persons with boxes (left, top, right, bottom) [N, 4], scores [N], and keypoints [N, J, 3]."""

    boxes: Tensor
    scores: Tensor
    keypoints: Tensor


def decode_rtmo(dets: Float[Tensor, "1 N 5"], keypoints: Float[Tensor, "1 N J 3"]) -> Detections:
    """Return the persons of RTMO.

    Args:
        dets: boxes (left, top, right, bottom) and score. keypoints: u, v and confidence. Both in pixels of
            the model's input.

    Reference:
        Lu et al., RTMO, CVPR 2024.
    """
    return _persons(ScoredPersons(dets[0, :, :4], dets[0, :, 4], keypoints[0]))


def decode_yolo(rows: Float[Tensor, "N C"]) -> Detections:
    """Return the persons of YOLO-pose.

    Args:
        rows: box (middle, width, height), score, and u, v and confidence of each keypoint, C = 5 + 3 J,
            pixels of the model's input.
    """
    middle, half = rows[:, :2], rows[:, 2:4] / 2
    boxes = torch.cat([middle - half, middle + half], 1)
    return _persons(ScoredPersons(boxes, rows[:, 4], rows[:, 5:].unflatten(1, (-1, 3))))


def decode_yolo_suppressed(rows: Float[Tensor, "N C"]) -> Detections:
    """Return the persons of YOLO-pose with its own suppression of overlaps.

    Args:
        rows: box (left, top, right, bottom), score, class, and u, v and confidence of each keypoint,
            C = 6 + 3 J, pixels of the model's input.
    """
    return _persons(ScoredPersons(rows[:, :4], rows[:, 4], rows[:, 6:].unflatten(1, (-1, 3))))


def decode_movenet_multi(out: Float[Tensor, "1 N C"], size: tuple[int, int]) -> Detections:
    """Return the persons of MoveNet's multi pose.

    Args:
        out: v, u and confidence of each keypoint, box (top, left, bottom, right) and score, C = 3 J + 5,
            shares of the model's input. size: (w, h) of that.
    """
    rows = out[0].double()
    sides = rows.new_tensor([*size, 1.0])
    keypoints = rows[:, :-5].unflatten(1, (-1, 3))[..., [1, 0, 2]] * sides
    boxes = rows[:, [-4, -5, -2, -3]] * rows.new_tensor([*size, *size])
    return _persons(ScoredPersons(boxes, rows[:, -1], keypoints))


def _persons(found: ScoredPersons) -> Detections:
    """Return the keypoints of the persons who score enough, each once, the surest first."""
    chosen = torch.nonzero(found.scores >= LEAST_SCORE).flatten()
    order = found.scores[chosen].argsort(descending=True)[:_MOST_BOXES]
    boxes, keypoints = (x[chosen[order]].double() for x in (found.boxes, found.keypoints))
    keypoints = keypoints[suppress_overlaps(boxes)]
    return Detections(keypoints[..., :2], keypoints[..., 2].nan_to_num(0.0).clamp(0.0, 1.0))


def suppress_overlaps(boxes: Float[Tensor, "N 4"], most: float = _OVERLAP) -> Int[Tensor, " n"]:
    """Return the rows of boxes that overlap no better one which is kept (non-maximum suppression).

    Args:
        boxes: left, top, right, bottom, the best first. most: intersection over union that may be.

    >>> boxes = torch.tensor([[0.0, 0, 10, 10], [1, 0, 10, 10], [20, 0, 30, 10]])
    >>> suppress_overlaps(boxes).tolist()
    [0, 2]
    """
    area = (boxes[:, 2:] - boxes[:, :2]).clamp_min(0).prod(1)
    first = torch.maximum(boxes[:, None, :2], boxes[:, :2])
    last = torch.minimum(boxes[:, None, 2:], boxes[:, 2:])
    shared = (last - first).clamp_min(0).prod(-1)
    overlap = shared / (area[:, None] + area - shared).clamp_min(1e-9) > most
    kept = torch.ones(len(boxes), dtype=torch.bool)
    for row in range(len(boxes)):
        if kept[row]:
            kept[row + 1 :] &= ~overlap[row, row + 1 :]
    return torch.nonzero(kept).flatten()
