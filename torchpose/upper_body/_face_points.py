"""Estimate from nose, eyes and ears which way a head faces, and where it is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.math._rotations import within_half_turn
from torchpose.upper_body._torso_likelihood import heavy_tail

FACE = ("nose", "eye_left", "eye_right", "ear_left", "ear_right")
"""Keypoints that tell where a head faces."""

# Of each of `FACE`: metres to the left of the middle of the ears, before it and below it, the direction in
# which it looks out of the head (degrees to the left), and the cosine to the camera from which on it is seen.
_LEFT = (0.0, 0.032, -0.032, 0.075, -0.075)
_FORWARD = (0.11, 0.085, 0.085, 0.0, 0.0)
_BELOW = (0.02, -0.015, -0.015, 0.0, 0.0)
_OUTWARD = (0.0, 20.0, -20.0, 90.0, -90.0)
_HIDDEN = (-0.1, 0.0, 0.0, -0.3, -0.3)
_SOFT = 0.15  # range of that cosine in which a keypoint becomes visible
_SEEN, _IMAGINED = 0.9, 0.1  # probabilities that a detector gives what is visible, what is hidden
_LOST = 0.1  # how often nothing of a head is given wherever it looks, as outside of the image
_SURE = 0.4  # confidence from which on a keypoint counts as given
_NOISE = 0.02  # metres: faces and detectors differ
_HEAD_ABOVE = 0.03  # metres from the middle of the ears to Kinect's head, 0.1 below the crown
_NECK_STD = math.radians(25.0)  # between head and shoulders
_ANYWHERE = 0.1  # share of the heads that are turned by any angle


class FacePoints(NamedTuple):
    """Measured `FACE`.

    Attributes:
        places: pixels, or the first two coordinates of K^-1 [u, v, 1], [..., 5, 2], 0 where missing.
        confidence: [..., 5], 1 where a detector gives none, 0 where missing.
        expected: which of the points are among the keypoints at all, [5].
    """

    places: Tensor
    confidence: Tensor
    expected: Tensor


def measure_face(
    keypoints: Float[Tensor, "B T J 2"],
    confidence: Float[Tensor, "B T J"] | None,
    mask: Bool[Tensor, "B T J"] | None,
    indices: Sequence[int],
) -> FacePoints:
    """Return nose, eyes and ears among the keypoints, in their pixels.

    Args:
        keypoints, confidence, mask: as in `UpperBodyTracker.forward`. indices: the places of `FACE` among
            the keypoints, -1 if absent.
    """
    rows = [max(i, 0) for i in indices]
    expected = torch.tensor([i >= 0 for i in indices], device=keypoints.device)
    places = keypoints[:, :, rows]
    sure = torch.ones_like(places[..., 0])
    if confidence is not None:
        sure = confidence.to(places)[:, :, rows].nan_to_num(0.0)
    if mask is not None:
        sure = sure * mask.to(places)[:, :, rows]
    sure = sure * (places.isfinite().all(-1) & expected)
    places = torch.where(sure[..., None] > 0, places, torch.zeros_like(places))
    return FacePoints(places, sure, expected)


def face_evidence(
    face: FacePoints,
    std: Float[Tensor, " B"],
    depth: Float[Tensor, " Z"],
    turn: Float[Tensor, " P"],
) -> Float[Tensor, "B Z P"]:
    """Return the log-likelihood ratio of the turn of the shoulders at each depth, of mean ratio 1 over turns.

    It is normalised at each depth, and so no evidence about the depth itself: at a small one any face is
    small, and a bad ear seems to fit.

    A head at angle h from the camera has its points at x_i = c + left_i cos h - forward_i sin h, for an
    unknown middle c; and a detector gives those that are visible at that angle more often than others.
    Heads are turned against shoulders by some 25 degrees, and now and then by any angle.

    Args:
        face: the rays of the points. std: the standard deviation of a pixel over the focal length.
        depth: the depths of the shoulders, metres. turn: their turns, at even steps round the circle.
    """
    places = _horizontal(face, std, depth.expand(len(face.places), -1), turn)
    at_angle = heavy_tail(places.squared) + _visibility(face, turn)[:, None]
    most = at_angle.amax(-1, keepdim=True)
    logs = ((at_angle - most).exp() @ _turned_necks(turn, turn).mT).log() + most
    return logs - torch.logsumexp(logs, -1, keepdim=True) + math.log(len(turn))


def head_in_face(
    face: FacePoints,
    std: Float[Tensor, " B"],
    depth: Float[Tensor, " B"],
    turn: Float[Tensor, " B"],
    angles: Float[Tensor, " P"],
) -> tuple[Float[Tensor, "B 3"], Bool[Tensor, " B"]]:
    """Return the place of Kinect's head above the middle of the ears, and whether the face is visible.

    It is the posterior mean over the angles h of the head, given all points (`face_evidence`), camera axes.

    Args:
        face: the rays of the points. std: the standard deviation of a pixel over the focal length.
        depth, turn: those of the shoulders. angles: the angles of the head, at even steps round the circle.
    """
    places = _horizontal(face, std, depth[:, None], angles)
    logs = heavy_tail(places.squared)[:, 0] + _visibility(face, angles)
    weight = torch.softmax(logs + _turned_necks(turn, angles).log(), -1)
    across = (weight * places.middle[:, 0]).sum(-1)
    sure = face.confidence
    below = face.places[..., 1] * depth[:, None] - depth.new_tensor(_BELOW)
    down = (sure * below).sum(-1) / sure.sum(-1).clamp_min(1e-12)
    return torch.stack([across, down - _HEAD_ABOVE, depth], -1), sure.sum(-1) > _SURE


class _Horizontal(NamedTuple):
    """Fit of a face along the horizontal axis of the image, at each depth and angle, [B, Z, P] each.

    Attributes:
        middle: the middle of the ears, metres. squared: the squared Mahalanobis distance of all points from
            their expected places.
    """

    middle: Tensor
    squared: Tensor


def _turned_necks(
    shoulders: Float[Tensor, " S"], heads: Float[Tensor, " P"]
) -> Float[Tensor, "S P"]:
    """Return the probability of each angle of the head given the turn of the shoulders."""
    off = within_half_turn(shoulders[:, None] - heads)
    near = torch.softmax(-0.5 * (off / _NECK_STD).square(), 1)
    return (1 - _ANYWHERE) * near + _ANYWHERE / len(heads)


def _horizontal(
    face: FacePoints, std: Tensor, depth: Float[Tensor, "B Z"], angles: Float[Tensor, " P"]
) -> _Horizontal:
    """Return the fit of the points relative to each other, for an unknown middle of the ears."""
    left, forward = (angles.new_tensor(x) for x in (_LEFT, _FORWARD))
    expected = left * angles.cos()[:, None] - forward * angles.sin()[:, None]
    seen = face.places[..., None, None, :, 0] * depth[..., None, None]
    off = seen - expected
    noise = _NOISE**2 + (std[:, None] * depth).square()[..., None, None]
    precision = face.confidence[:, None, None] / noise
    total = precision.sum(-1)
    mean = (precision * off).sum(-1) / total.clamp_min(1e-12)
    squared = (precision * (off - mean[..., None]).square()).sum(-1)
    return _Horizontal(mean, squared)


def _visibility(face: FacePoints, turn: Tensor) -> Float[Tensor, "B P"]:
    """Return the log-probability of which points a detector gives and which it does not."""
    outward, hidden = torch.deg2rad(turn.new_tensor(_OUTWARD)), turn.new_tensor(_HIDDEN)
    visible = torch.sigmoid(((turn[:, None] - outward).cos() - hidden) / _SOFT)
    given = _IMAGINED + (_SEEN - _IMAGINED) * visible
    sure = (face.confidence / _SURE).clamp(0.0, 1.0)[:, None]
    logs = sure * given.log() + (1 - sure) * torch.log1p(-given)
    logs = (logs * face.expected.to(logs)).sum(-1)
    lost = _LOST * (1 - sure[:, 0].amax(-1, keepdim=True))
    return ((1 - _LOST) * logs.exp() + lost).log()
