"""Average the noise of keypoints over nearby frames, before poses are found that project onto them."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchpose.filters._lengths import inside_lengths
from torchpose.upper_body._measured_joints import MeasuredJoints

_REACH = 4 / 30  # seconds before and after a frame
_MOST = 2.0  # standard deviations of a keypoint that it is moved by
_FLAT = (
    1e-6  # relative precision of no velocity and no acceleration, where too few frames tell them
)


def frames_of_reach(rate: float, smoothing: int | str | None) -> int:
    """Return the number of frames before, and after, each one that are averaged with it.

    Args:
        rate: frames per second. smoothing: as of `TrackerModel`.
    """
    if smoothing is None:
        return 0
    reach = round(_REACH * rate)
    return min(reach, smoothing) if isinstance(smoothing, int) else reach


def averaged_over_frames(
    measured: MeasuredJoints, lengths: Int[Tensor, " B"] | None, reach: int
) -> MeasuredJoints:
    """Return the measurements with every keypoint moved onto a parabola through those of nearby frames.

    The parabola has the least squares, weighted by the inverse variances w_s of the keypoints:

        a, b, c = argmin sum_s w_s |z_s - (a + b (s - t) + c (s - t)^2)|^2,   |s - t| <= reach

    The keypoint becomes a, but moves by no more than two of its standard deviations: what is farther off is
    motion. Missing keypoints stay missing.

    Args:
        measured: the measurements of whole sequences. lengths: the number of frames of each, [B]; later
            ones are not used. reach: frames before and after each, at least one.
    """
    inside = torch.ones_like(measured.mask[..., 0])
    if lengths is not None:
        inside = inside_lengths(lengths.to(inside.device), inside.shape[1])
    uv = _averaged(measured.uv, measured.mask & inside[..., None], measured.cov, reach)
    middle = measured.middle
    if middle is not None:
        there, cov = (middle.mask & inside)[..., None], middle.cov[..., None, :, :]
        moved = _averaged(middle.uv[:, :, None], there, cov, reach)
        middle = middle._replace(uv=moved[:, :, 0])
    return measured._replace(uv=uv, middle=middle)


def _averaged(
    uv: Float[Tensor, "B T J 2"],
    mask: Bool[Tensor, "B T J"],
    cov: Float[Tensor, "*frames J 2 2"],
    reach: int,
) -> Float[Tensor, "B T J 2"]:
    """Return the keypoints that are measured on their parabolas, and the others as they are."""
    variance = cov.diagonal(dim1=-2, dim2=-1).mean(-1).expand(mask.shape)
    weight = torch.where(mask, variance.reciprocal(), 0.0)[..., None]
    around = (0, 0, 0, 0, reach, reach)
    places, weights = (pad(x, around).unfold(1, 2 * reach + 1, 1) for x in (uv, weight))
    apart = places - uv[..., None]
    weights = weights * variance[..., None, None]  # that of the frame's own keypoint is 1
    step = torch.linspace(-1, 1, 2 * reach + 1, dtype=uv.dtype, device=uv.device)
    powers = torch.stack([torch.ones_like(step), step, step.square()])
    weighed = weights * powers
    square = weighed @ powers.mT + torch.diag(uv.new_tensor([0.0, _FLAT, _FLAT]))
    square = torch.where(mask[..., None, None], square, torch.eye(3).to(uv))
    moved = torch.linalg.solve(square, weighed @ apart.mT)[..., 0, :]
    far = torch.linalg.vector_norm(moved, dim=-1) / (_MOST * variance.sqrt())
    moved = torch.where(mask, far.clamp_min(1.0).reciprocal(), 0.0)[..., None] * moved
    return uv + moved
