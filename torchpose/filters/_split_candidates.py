"""Weigh the M K candidates of split tracks, candidates innermost.

What a candidate needs of its predicted covariance is the block of measured dimensions, linear in P of its
track: with r_z the rows of H F_j,

(H F_j P F_j^T H^T)_zw = sum_{d <= e} g_{zw,de} P_de,   g_{zw,de} = r_zd r_we + r_ze r_wd  (half that, d = e),

one product of the symmetric parts of all P with g, which is made once. The small blocks are factorised
column by column, each step over all candidates at once.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.module_state import derived
from torchpose.filters._joint_tracks import JointProblem, JointTracks, joint_model
from torchpose.filters._mkf import MixtureKalmanFilter

_LOGS = 4  # pivots whose product is within range, and costs one logarithm


class _Candidates(NamedTuple):
    """Holds what all frames share, for the Y = Z (Z + 1) / 2 pairs z >= w, column by column.

    Attributes:
        quadratic: g [Y K, D (D + 1) / 2]. noise: H N_j H^T [Y, K, 1]. rows: H F_j [Z K, D].
        offset: H b_j [Z, K, 1]. upper: places of d <= e in a flat joint matrix.
        row, column: z and w of each pair [Y].
    """

    quadratic: Tensor
    noise: Tensor
    rows: Tensor
    offset: Tensor
    upper: Tensor
    row: Tensor
    column: Tensor


def block_numbers(model: MixtureKalmanFilter) -> tuple[int, int]:
    """Return how many numbers the blocks of one element are, and the product that makes them."""
    n_obs, n_components = len(model.observed), len(model.means)
    blocks = n_obs * (n_obs + 1) // 2 * n_components
    return blocks * model.n_tracks, blocks * model.dim * (model.dim + 1) // 2


def candidate_log_likelihood(
    model: MixtureKalmanFilter, tracks: JointTracks, problem: JointProblem, time: int
) -> Float[Tensor, "B M K"]:
    """Return log N(z | track continued by component); not finite where a block is not positive definite.

    Args:
        tracks: before the prediction. problem: what is measured. time: number of the frame.
    """
    shared = _candidates(model, time)
    batch, n_tracks, width, _ = tracks.state.shape
    flat = tracks.state.view(batch * n_tracks, width * width)
    packed = flat.index_select(1, shared.upper)
    block = torch.mm(shared.quadratic, packed.T).view(*shared.noise.shape[:2], -1)
    mean = flat.view(-1, width, width)[:, : model.dim, model.dim]
    residual = torch.mm(shared.rows, mean.T).view(*shared.offset.shape[:2], -1)
    # What is measured is the same for all tracks of an element.
    own = torch.arange(batch, device=flat.device).repeat_interleave(n_tracks)
    noise = problem.noise[:, 0, shared.row, shared.column].T[:, own]
    if problem.both is None:
        block += shared.noise + noise[:, None]
    else:
        both = problem.both[:, 0, shared.row, shared.column].T[:, own]
        block = torch.addcmul(noise[:, None], both[:, None], block + shared.noise)
    residual = problem.z[:, 0].T[:, own][:, None] - (residual + shared.offset)
    if problem.both is not None:
        residual *= problem.mask[:, 0, :, 0].T[:, own][:, None]
    found = _log_density(block, residual).view(-1, batch, n_tracks).permute(1, 2, 0)
    return found + problem.log_norm[:, :, None]


def _candidates(model: MixtureKalmanFilter, time: int) -> _Candidates:
    def make() -> _Candidates:
        dim, n_obs = model.dim, len(model.observed)
        matrix, noise = joint_model(model, time)
        rows, device = matrix[:, :n_obs, :dim].transpose(0, 1), matrix.device
        column, row = torch.triu_indices(n_obs, n_obs, device=device)
        d, e = torch.triu_indices(dim, dim, device=device)
        left, right = rows[row], rows[column]
        quadratic = left[..., d] * right[..., e]
        quadratic = quadratic + (d != e) * left[..., e] * right[..., d]
        return _Candidates(
            quadratic.flatten(0, 1).contiguous(),
            noise[:, row, column].T[..., None].contiguous(),
            rows.flatten(0, 1).contiguous(),
            noise[:, :n_obs, dim].T[..., None].contiguous(),
            d * matrix.shape[-1] + e,
            row,
            column,
        )

    if time < model.burn_in:
        return make()
    return derived(model, "candidates", model.sources, make)


def _log_density(
    block: Float[Tensor, "Y K n"], residual: Float[Tensor, "Z K n"]
) -> Float[Tensor, "K n"]:
    """Return log N(residual | 0, S) + Z/2 log 2 pi, in place.

    S = L D L^T by columns c: with the pivot s and the column l = S_c / s^1/2 below it, the rest of S loses
    l l^T, and the rest of the residual loses l v with v = residual_c / s^1/2.

    Args:
        block: the lower triangle of S, column by column.
    """
    n_obs, start = len(residual), 0
    columns = []
    for size in range(n_obs, 0, -1):
        columns.append(block[start : start + size])
        start += size
    total, pivots = torch.zeros_like(residual[0]), []
    for c, column in enumerate(columns):
        pivots.append(column[0].clone())
        column *= column[:1].rsqrt()
        white = residual[c].div_(column[0])
        total.addcmul_(white, white)
        residual[c + 1 :].addcmul_(column[1:], white, value=-1)
        for later in range(c + 1, n_obs):
            columns[later].addcmul_(column[later - c :], column[later - c], value=-1)
    for first in range(0, n_obs, _LOGS):
        product = pivots[first]
        for pivot in pivots[first + 1 : first + _LOGS]:
            product = product.mul_(pivot)
        total += product.log_()
    return total.mul_(-0.5)
