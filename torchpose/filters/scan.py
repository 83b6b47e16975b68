"""Means of fixed tracks under constant gains: a linear recursion over time, solved in blocks.

d_t = A d_{t-1} + K (z_t - H mu),  v_t = L^-1 (z_t - H mu) - L^-1 H F d_{t-1},  d = m - mu

Within a block of n frames everything is a matrix product of the state at its start and the block's
measurements; only those starts form a sequence, n times shorter than the frames.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["BlockModel", "Workspace", "block_model", "scan_blocks"]


class BlockModel(NamedTuple):
    """The recursion of M tracks over blocks of n frames, for row vectors.

    Attributes:
        length: n. outputs: [M, D + n Z + 1, n (D + Z)] takes a row (start, measurements, 1) to the
            n deviations and the n whitened innovations of a block; the 1 carries the means.
        carry: start to end [M, D, D]. inputs_to_end: (measurements, 1) to end [M, n Z + 1, D].
    """

    length: int
    outputs: Tensor
    carry: Tensor
    inputs_to_end: Tensor


def block_model(
    inverse_factor: Float[Tensor, "M Z Z"],
    white: Float[Tensor, "M Z D"],
    matrix: Float[Tensor, "M D D"],
    means: Float[Tensor, "M D"],
    observed: Tensor,
    length: int,
) -> BlockModel:
    """Unroll the steady recursion over `length` frames.

    Args:
        inverse_factor: L^-1. white: W = L^-1 H P, so that the gain is K = W^T L^-1. matrix: F.
        means: mu. observed: measured state dimensions [Z].
    """
    n_tracks, dim = means.shape
    n_obs = observed.numel()
    gain = white.mT @ inverse_factor
    whiten = inverse_factor @ matrix[:, observed, :]
    closed = matrix - gain @ matrix[:, observed, :]
    offset = means[:, observed, None]
    width = dim + length * n_obs + 1
    state = torch.zeros(n_tracks, dim, width, dtype=means.dtype, device=means.device)
    state[:, :, :dim] = torch.eye(dim, dtype=means.dtype, device=means.device)
    states, innovations = [], []
    for i in range(length):
        at = slice(dim + i * n_obs, dim + (i + 1) * n_obs)
        innovation = -whiten @ state
        innovation[:, :, at] += inverse_factor
        innovation[:, :, -1:] -= inverse_factor @ offset
        state = closed @ state
        state[:, :, at] += gain
        state[:, :, -1:] -= gain @ offset
        states.append(state)
        innovations.append(innovation)
    return BlockModel(
        length,
        torch.cat(states + innovations, 1).mT.contiguous(),
        state[:, :, :dim].mT.contiguous(),
        state[:, :, dim:].mT.contiguous(),
    )


class Workspace:
    """Memory that all stretches of a run share: fresh pages cost more than the products in them."""

    def __init__(self) -> None:
        self._held: dict[str, Tensor] = {}

    def take(self, name: str, shape: tuple[int, ...], like: Tensor) -> Tensor:
        """A tensor of this shape with arbitrary contents, valid until the name is taken again."""
        size = math.prod(shape)
        held = self._held.get(name)
        if held is None or held.numel() < size:
            held = like.new_empty(size)
            self._held[name] = held
        return held[:size].view(shape)


def scan_blocks(
    model: BlockModel,
    start: Float[Tensor, "M B D"],
    z: Float[Tensor, "B T Z"],
    workspace: Workspace,
) -> tuple[Float[Tensor, "M N B L D"], Float[Tensor, "M N B L"], Float[Tensor, "M B D"]]:
    """Run T = N L frames, N blocks of L.

    Args:
        start: deviations d_0 from the component means. z: measurements. workspace: for the results.

    Returns:
        Deviations [M, N, B, L, D], squared whitened innovations ||v||^2 [M, N, B, L], and the
        deviations after the last frame [M, B, D]. The first two lie in the workspace.
    """
    n_tracks, batch, dim = start.shape
    n_obs, length = z.shape[2], model.length
    n_blocks = z.shape[1] // length
    n_rows, width = n_blocks * batch, dim + length * n_obs + 1
    rows = workspace.take("rows", (n_tracks, n_blocks, batch, width), start)
    rows[..., dim:-1] = z.reshape(batch, n_blocks, -1).transpose(0, 1)
    rows[..., -1] = 1
    ends = workspace.take("ends", (n_tracks, n_rows, dim), start)
    torch.bmm(rows[..., dim:].flatten(1, 2), model.inputs_to_end, out=ends)
    ends = ends.view(n_tracks, n_blocks, batch, dim)
    state = start
    for block, end in zip(rows.unbind(1), ends.unbind(1), strict=True):
        block[..., :dim] = state
        state = torch.baddbmm(end, state, model.carry)
    out = workspace.take("out", (n_tracks, n_rows, length * (dim + n_obs)), start)
    torch.bmm(rows.flatten(1, 2), model.outputs, out=out)
    out = out.view(n_tracks, n_blocks, batch, -1)
    split = length * dim
    whitened = out[..., split:].unflatten(-1, (length, n_obs))
    squared = workspace.take("squared", tuple(whitened.shape), start)
    torch.mul(whitened, whitened, out=squared)
    return out[..., :split].unflatten(-1, (length, dim)), squared.sum(-1), state
