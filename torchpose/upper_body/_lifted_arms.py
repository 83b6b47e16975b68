"""Lift keypoints to the directions of shoulders and arms, by a network that has seen many bodies.

One camera does not see whether a bone points towards it or away. A causal network tells the joints of the
whole body that go with all keypoints so far (`LiftingNetwork`), with standard deviations s. A bone of the
length L whose direction it puts at v is likelier to point along d by the density of von Mises and Fisher,

    log p(v | d) = k (d^T v - 1) + const,   k = (L / (f s))^2,

with the deviation s of its far end. The factor f is above 1, since the network errs alike in frames of one
motion, and most for forearms of persons to whom it was not fitted.

It has seen few people from below, and bends those forward, arms along with the trunk. Where the camera is
known to look up, bones are turned back by a share of the lean of the lifted trunk (`share_of_lean`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize, pad

from torchpose._core.checks import INLIER
from torchpose._core.module_state import index_tensor, outside_inference
from torchpose.body._skeleton import BODY_15, body_joints
from torchpose.priors._lifting_network import MEMORY, LiftingNetwork, lifting_features
from torchpose.skeleton._joint_sets import canonical_names

_NEEDED = ("shoulder_left", "shoulder_right", "elbow_left", "elbow_right")
_HIPS = ("hip_left", "hip_right")
_LEAST_JOINTS = 6  # keypoints, both shoulders among them, without which a frame is not lifted
# The line from the right shoulder to the left one, then upper arm and forearm of left and right.
_NEAR = ("right_shoulder", "left_shoulder", "left_elbow", "right_shoulder", "right_elbow")
_FAR = ("left_shoulder", "left_elbow", "left_wrist", "right_elbow", "right_wrist")
_LENGTHS = (0.35, 0.28, 0.25, 0.28, 0.25)  # metres
_ENDS = tuple(BODY_15.joint(name) for name in (*_NEAR, *_FAR))
_SHOULDERS = [BODY_15.joint(name) for name in ("left_shoulder", "right_shoulder")]
_TRUNK = tuple(BODY_15.joint(name) for name in ("neck", "left_hip", "right_hip"))
# Share of the lean that is turned back, and pitch of the camera from which on it is that much.
_BACK, _FROM_BELOW = 0.5, math.radians(15.0)
_MOST_LEAN = 0.6  # radians: who leans more bends down
_FACTORS = (2.1, 2.5, 6.0, 2.5, 6.0)  # f; the line between the shoulders has two ends that err
N_BONES = len(_FAR)
"""Number of bones that are lifted."""


class BodyPoints(NamedTuple):
    """Keypoints of the joints of `BODY_15`.

    Attributes:
        places: pixels, [B, T, 15, 2], 0 where missing. confidence: [B, T, 15], 0 where missing.
    """

    places: Tensor
    confidence: Tensor

    def moved(self, places: Tensor, visible: Bool[Tensor, "B T 15"]) -> BodyPoints:
        """Return the keypoints at other places, missing where they are not visible there."""
        sure = self.confidence * visible
        return BodyPoints(torch.where(sure[..., None] > 0, places, 0.0), sure)


class LiftedBones(NamedTuple):
    """What a network tells of the line between the shoulders, and of upper arms and forearms.

    Attributes:
        directions: [..., 5, 3]. precision: k of each, [..., 5], 0 where nothing is told.
    """

    directions: Tensor
    precision: Tensor


def measure_body(
    keypoints: Float[Tensor, "B T J 2"],
    confidence: Float[Tensor, "B T J"] | None,
    mask: Bool[Tensor, "B T J"] | None,
    names: Sequence[str],
) -> BodyPoints | None:
    """Return the keypoints of the whole body, None where shoulders and elbows are not among them.

    Args:
        keypoints, confidence, mask, names: as in `UpperBodyTracker.forward`.
    """
    known = canonical_names(names)
    if not {*_NEEDED} <= {*known}:
        return None
    sure = torch.ones_like(keypoints[..., 0])
    if confidence is not None:
        sure = confidence.to(keypoints).nan_to_num(0.0)
    if mask is not None:
        sure = sure * mask.to(sure)
    absent = [name for name in _HIPS if name not in known]
    table = torch.cat([keypoints, sure[..., None]], -1)
    table = pad(table, (0, 0, 0, len(absent)), value=torch.nan)
    places, sure = body_joints(table, [*known, *absent]).split([2, 1], -1)
    there = places.isfinite().all(-1) & (sure[..., 0] > 0)
    sure = torch.where(there, sure[..., 0].clamp(*INLIER), 0.0)
    return BodyPoints(torch.where(there[..., None], places, 0.0), sure)


def lift(
    network: LiftingNetwork,
    rays: Float[Tensor, "B T 15 2"],
    confidence: Float[Tensor, "B T 15"],
    fps: float,
    memory: Float[Tensor, "B L W"] | None,
    pitch: float | None = None,
) -> tuple[LiftedBones, Float[Tensor, "B L W"]]:
    """Return the directions of bones in T frames, and what the network remembers of them.

    Args:
        network: of the whole body. rays: (x, y) of K^-1 [u, v, 1]. confidence: 0 where there is no keypoint.
        fps: frames per second. memory: of the frames before; None at the beginning.
        pitch: the angle by which the camera looks up, radians; None if it is unknown.
    """
    seen = lifting_features(rays, confidence, fps).to(network.places.weight)
    before = seen.new_zeros(len(seen), *MEMORY) if memory is None else memory
    (joints, std), after = network(seen, before)
    ends = index_tensor(_ENDS, rays.device)
    near, far = joints.index_select(-2, ends).to(rays).split(N_BONES, -2)
    ways, std = far - near, std.index_select(-1, ends[N_BONES:]).to(rays)
    there = confidence > 0
    left, right = _SHOULDERS
    enough = (there.sum(-1) >= _LEAST_JOINTS) & there[..., left] & there[..., right]
    precision = (_ratios(std.dtype, std.device) / std).square()
    if share := share_of_lean(pitch):
        trunk = joints.index_select(-2, index_tensor(_TRUNK, rays.device)).to(rays)
        ways = _turned_back(ways, share * _lean(trunk))
    return LiftedBones(normalize(ways, dim=-1), precision * enough[..., None]), after


def share_of_lean(pitch: float | None) -> float:
    """Return the share of the lean of the lifted trunk by which bones are turned back.

        0.5 min(p / 15 degrees, 1)

    Args:
        pitch: the angle p by which the camera looks up, radians; None if it is unknown, which is 0.
    """
    return _BACK * min(max(pitch or 0.0, 0.0) / _FROM_BELOW, 1.0)


def _lean(trunk: Float[Tensor, "B T 3 3"]) -> Float[Tensor, "B T"]:
    """Return the angle by which a trunk leans away from the camera, radians, in axes that are level.

    Args:
        trunk: neck and both hips.
    """
    neck, left, right = trunk[..., 1:].unbind(-2)
    down, away = (2 * neck - left - right).unbind(-1)
    return torch.atan2(away, -down).clamp(-_MOST_LEAN, _MOST_LEAN)


def _turned_back(
    ways: Float[Tensor, "B T N 3"], lean: Float[Tensor, "B T"]
) -> Float[Tensor, "B T N 3"]:
    """Return directions of a body that leans away by so much, turned to where it is upright."""
    x, y, z = ways.unbind(-1)
    cos, sin = lean.cos()[..., None], lean.sin()[..., None]
    return torch.stack([x, cos * y - sin * z, sin * y + cos * z], -1)


@cache
def _ratios(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "5"]:
    """Return L / f of every bone."""
    with outside_inference():
        ratios = [length / factor for length, factor in zip(_LENGTHS, _FACTORS, strict=True)]
        return torch.tensor(ratios, dtype=dtype, device=device)
