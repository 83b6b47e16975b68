"""Put recorded bodies into a seat, since recordings have few people who sit, and hardly any for long.

The upper body moves as recorded, about a pelvis that stays in its place. Thighs are about level and shanks
about upright, knees closer or farther apart, feet tucked in or stretched out, and the trunk leans. All that
is drawn for each piece. Legs drift by some degrees, and some shanks swing.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from benchmarks.keypoint_bodies.clips import pair_of
from torchpose.body import BODY_15

__all__ = ["seated"]

_LEAN = 10.0  # degrees, standard deviation
_THIGH_DOWN, _THIGH_OUT = (5.0, 10.0, 5.0), (8.0, 8.0, 6.0)
_SHANK_AHEAD, _SHANK_OUT = (5.0, 20.0, 10.0), (0.0, 0.0, 6.0)
# Degrees: means, and standard deviations of what both legs share and of what each has for itself.
_DRIFT, _SWING, _SHARE_SWINGS = 3.0, 30.0, 0.2  # degrees over a piece, and share of the shanks
_PELVIS = BODY_15.joint("pelvis")
_HIPS, _KNEES, _ANKLES = map(pair_of, ("hip", "knee", "ankle"))
_TRUNK = [j for j in range(len(BODY_15.names)) if j not in {_PELVIS, *_HIPS, *_KNEES, *_ANKLES}]
_OUT = torch.tensor([1.0, -1.0])  # to the left, of the left and the right leg


def seated(
    joints: Float[Tensor, "N T 15 3"], up: Float[Tensor, "N 3"], generator: torch.Generator
) -> Float[Tensor, "N T 15 3"]:
    """Return bodies that sit, with bones of the same lengths.

    Args:
        joints: of pieces of recordings, metres. up: of their rooms. generator: of seats.
    """
    draw = _Angles(joints.shape[0], joints.shape[1], generator)
    bodies = joints - joints[:, :, [_PELVIS]] + joints[:, :1, [_PELVIS]]
    upward = up[:, None, None].expand(*joints.shape[:2], 1, 3)
    across = bodies[:, :, _HIPS[:1]] - bodies[:, :, _HIPS[1:]]
    left = normalize(across - (across * upward).sum(-1, keepdim=True) * upward, dim=-1)
    ahead = torch.linalg.cross(left, upward)

    pelvis = bodies[:, :, [_PELVIS]]
    bodies[:, :, _TRUNK] = pelvis + _turned(bodies[:, :, _TRUNK] - pelvis, left, draw.lean())
    down, out = draw.of_legs(_THIGH_DOWN), _OUT[:, None] * draw.of_legs(_THIGH_OUT)
    thigh = down.cos() * (out.cos() * ahead + out.sin() * left) - down.sin() * upward
    tilt, out = draw.of_legs(_SHANK_AHEAD, swings=True), draw.of_legs(_SHANK_OUT)
    shank = out.cos() * (tilt.sin() * ahead - tilt.cos() * upward) + out.sin() * left
    bodies[:, :, _KNEES] = bodies[:, :, _HIPS] + _length(joints, _HIPS, _KNEES) * thigh
    bodies[:, :, _ANKLES] = bodies[:, :, _KNEES] + _length(joints, _KNEES, _ANKLES) * shank
    return bodies


class _Angles:
    """Draws angles of pieces, radians.

    Args:
        pieces, frames: how many. generator: of random numbers.
    """

    def __init__(self, pieces: int, frames: int, generator: torch.Generator) -> None:
        self.pieces, self.generator = pieces, generator
        self.time = torch.linspace(-0.5, 0.5, frames)[:, None, None]

    def lean(self) -> Float[Tensor, "N 1 1 1"]:
        """Return how far trunks lean forwards from where they were."""
        return torch.deg2rad(_LEAN * self._normal(1))

    def of_legs(
        self, spread: tuple[float, float, float], swings: bool = False
    ) -> Float[Tensor, "N T 2 1"]:
        """Return an angle of both legs.

        Args:
            spread: mean, and standard deviations of both legs and of each. swings: whether some do.
        """
        mean, both, each = spread
        drift = _DRIFT * self._normal(2)
        if swings:
            chosen = torch.rand(self.pieces, 1, 2, 1, generator=self.generator) < _SHARE_SWINGS
            drift = torch.where(chosen, _SWING / _DRIFT * drift, drift)
        angles = mean + both * self._normal(1) + each * self._normal(2) + drift * self.time
        return torch.deg2rad(angles)

    def _normal(self, legs: int) -> Float[Tensor, "N 1 L 1"]:
        return torch.randn(self.pieces, 1, legs, 1, generator=self.generator)


def _turned(
    vectors: Float[Tensor, "N T J 3"],
    axis: Float[Tensor, "N T 1 3"],
    angle: Float[Tensor, "N 1 1 1"],
) -> Float[Tensor, "N T J 3"]:
    """Return vectors turned about unit axes (Rodrigues' formula)."""
    axis = axis.expand_as(vectors)
    along = (axis * vectors).sum(-1, keepdim=True) * axis
    across = torch.linalg.cross(axis, vectors)
    return angle.cos() * (vectors - along) + angle.sin() * across + along


def _length(
    joints: Float[Tensor, "N T 15 3"], start: list[int], end: list[int]
) -> Float[Tensor, "N T 2 1"]:
    return (joints[:, :, end] - joints[:, :, start]).norm(dim=-1, keepdim=True)
