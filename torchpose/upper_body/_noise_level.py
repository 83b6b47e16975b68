"""Tell how much more noise the keypoints of a person have than R says, by how much the torso shakes."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.module_state import index_tensor
from torchpose.skeleton._joint_sets import UPPER_BODY

_TORSO = tuple(
    UPPER_BODY.index(name) for name in ("shoulder_left", "head", "neck", "shoulder_right")
)
_USUAL = 1.0  # seconds of three joints that R counts for
_MEMORY = 5.0  # seconds
_ACCELERATION = 4.0  # m/s^2: of a coordinate of a torso
_FARTHEST = 9.0  # times the usual square, beyond which a joint jumps
_LARGEST = 6.0  # log2 of the factor of the variance


class NoiseLevel(NamedTuple):
    """What second differences of the joints of a torso have said about the noise so far.

    Attributes:
        before: the pixels of these joints in the last frame and in the one before, NaN where missing,
            [B, 2, 4, 2]. noise: the variances of a coordinate of these, [B, 2, 4].
        square: the discounted sum of their squares over what R makes of them, [B]. weight: that of their
            weights, [B]. Both begin with what is usual.
    """

    before: Tensor
    noise: Tensor
    square: Tensor
    weight: Tensor

    @classmethod
    def usual(cls, batch_size: int, dt: float, like: Tensor) -> NoiseLevel:
        """Return the level before the first frame, which is R's.

        Args:
            batch_size: B. dt: seconds between two frames. like: tells dtype and device.
        """
        before = like.new_full((batch_size, 2, len(_TORSO), 2), torch.nan)
        usual = like.new_full((batch_size,), 3 * _USUAL / dt)
        return cls(before, torch.zeros_like(before[..., 0]), usual, usual)

    @property
    def factor(self) -> Float[Tensor, " B"]:
        """Return the factor of R: 1 or a higher power of two, so that many frames have the same one."""
        return (self.square / self.weight).log2().round().clamp(0.0, _LARGEST).exp2()


def follow_noise(
    level: NoiseLevel,
    uv: Float[Tensor, "B 8 2"],
    known: Bool[Tensor, "B 8"],
    noise: Float[Tensor, "B 8"],
    scale: Float[Tensor, " B"],
    dt: float,
) -> NoiseLevel:
    """Return the level after a frame.

    Torsos hardly accelerate within two frames, so what is left of second differences is noise,

        d = z_t - 2 z_t-1 + z_t-2,   r = |d|^2 / (2 (R_t + 4 R_t-1 + R_t-2 + (a dt^2)^2)),
        s^2 = (n_0 + sum w min(r, 9 s^2)) / (n_0 + sum w),

    of which s^2 is the factor of R, with the sums over joints and the last seconds, and w the smallest R of
    the frame over that of the joint.

    Args:
        level: that after the frame before. uv, known: the eight joints. noise: the variance R of their
            coordinates. scale: pixels for each metre. dt: seconds between two frames.
    """
    rows = index_tensor(_TORSO, uv.device)
    place = uv[:, rows].masked_fill(~known[:, rows, None], torch.nan)
    variance, (last, earlier), (of_last, of_earlier) = (
        noise[:, rows], level.before.unbind(1), level.noise.unbind(1)
    )  # fmt: skip
    shaken = (place - 2 * last + earlier).square().mean(-1)
    moved = (_ACCELERATION * dt**2 * scale).square()[:, None]
    ratio = shaken / (variance + 4 * of_last + of_earlier + moved)
    there = ratio.isfinite()
    lowest = variance.masked_fill(~there, math.inf).amin(1, keepdim=True)
    weight = torch.where(there, lowest / variance, 0.0)
    most = _FARTHEST * (level.square / level.weight)[:, None]
    square = (weight * torch.where(there, ratio.minimum(most), 0.0)).sum(1)
    kept = math.exp(-dt / _MEMORY)
    usual = (1 - kept) * 3 * _USUAL / dt
    return NoiseLevel(
        torch.stack([place, last], 1), torch.stack([variance, of_last], 1),
        kept * level.square + usual + square, kept * level.weight + usual + weight.sum(1),
    )  # fmt: skip
