"""Tell how much more noise the keypoints of a person have than R says, by how much the torso shakes."""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.module_state import index_tensor, outside_inference
from torchpose.skeleton._joint_sets import UPPER_BODY

_TORSO = tuple(
    UPPER_BODY.index(name) for name in ("shoulder_left", "head", "neck", "shoulder_right")
)
_USUAL = 1.0  # seconds of three joints that R counts for
_MEMORY = 5.0  # seconds
_ACCELERATION = 4.0  # m/s^2: of a coordinate of a torso
_FARTHEST = 9.0  # times the usual square, beyond which a joint jumps
_LEAST = 1e-30  # 1 / pixels squared
_LARGEST = 6.0  # log2 of the factor of the variance


class NoiseLevel(NamedTuple):
    """What second differences of the joints of a torso have said about the noise so far.

    Attributes:
        before: the pixels of these joints and the variance of a coordinate in the last frame and in the one
            before, NaN where missing, [B, 2, 4, 3].
        sums: the discounted sums of their squares over what R makes of them, and of their weights, [B, 2].
            Both begin with what is usual.
    """

    before: Tensor
    sums: Tensor

    @classmethod
    def usual(cls, batch_size: int, dt: float, like: Tensor) -> NoiseLevel:
        """Return the level before the first frame, which is R's.

        Args:
            batch_size: B. dt: seconds between two frames. like: tells dtype and device.
        """
        before = like.new_full((batch_size, 2, len(_TORSO), 3), torch.nan)
        return cls(before, like.new_full((batch_size, 2), 3 * _USUAL / dt))

    @property
    def square(self) -> Float[Tensor, " B"]:
        """Return the factor of R that the noise has, whatever it is."""
        square, weight = self.sums.unbind(1)
        return square / weight

    @property
    def factor(self) -> Float[Tensor, " B"]:
        """Return the factor of R: 1 or a higher power of two, so that many frames have the same one."""
        return self.square.log2().round().clamp(0.0, _LARGEST).exp2()


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
    seen = torch.cat([uv, noise[..., None]], -1).index_select(1, rows)
    seen = seen.masked_fill(~known.index_select(1, rows)[..., None], torch.nan)
    last, earlier = level.before.unbind(1)
    apart = torch.addcmul(seen + earlier, last, _middle_weights(uv.dtype, uv.device))
    moved = (_ACCELERATION * dt**2 * scale).square()[:, None]
    ratio = apart[..., :2].square().mean(-1) / (apart[..., 2] + moved)
    weight = seen[..., 2].reciprocal().where(ratio == ratio, 0.0)
    weight = weight / weight.amax(1, keepdim=True).clamp_min(_LEAST)
    square = weight * ratio.minimum(_FARTHEST * level.square[:, None]).nan_to_num(0.0)
    kept = math.exp(-dt / _MEMORY)
    found = torch.stack([square, weight], 1).sum(-1) + (1 - kept) * 3 * _USUAL / dt
    return NoiseLevel(torch.stack([seen, last], 1), torch.add(found, level.sums, alpha=kept))


@cache
def _middle_weights(dtype: torch.dtype, device: torch.device) -> Float[Tensor, " 3"]:
    """Return the weights of the last pixel and of its variance in a second difference and its variance."""
    with outside_inference():
        return torch.tensor([-2.0, -2.0, 4.0], dtype=dtype, device=device)
