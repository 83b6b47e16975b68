"""Weigh the M K candidates of split tracks, candidates innermost.

What a candidate needs of its predicted covariance is the block of measured dimensions, linear in P of its
track: with r_z the rows of H F_j,

(H F_j P F_j^T H^T)_zw = sum_{d <= e} g_{zw,de} P_de,   g_{zw,de} = r_zd r_we + r_ze r_wd  (half that, d = e),

one product of the symmetric parts of all P with g, which is made once. The small blocks are eliminated
column by column, S = L diag(s) L^T, each step over all candidates at once; with u = L^-1 (z - H x),

log N(z | i, j) = -1/2 (sum_z u_z^2 / s_z + log prod_z s_z + Z log 2 pi),

one logarithm for each candidate, where the product is within range.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.module_state import derived
from torchpose.filters._joint_tracks import JointProblem, JointTracks, joint_model
from torchpose.filters._mkf import MixtureKalmanFilter

_FEW_TRACKS = 48  # with which products are faster as rows than as columns


class SharedCandidates(NamedTuple):
    """Holds what all frames share, for the Y = Z (Z + 1) / 2 pairs z >= w, the diagonal first.

    Attributes:
        quadratic: g [Y K, D (D + 1) / 2]. noise: H N_j H^T [Y, K, 1, 1]. rows: -H F_j [Z K, D].
        offset: -H b_j [Z, K, 1, 1]. packed: places of d <= e, then of the mean, in a flat joint matrix.
    """

    quadratic: Tensor
    noise: Tensor
    rows: Tensor
    offset: Tensor
    packed: Tensor


class CandidateProblem(NamedTuple):
    """Holds what B elements measure in one frame, the same for all candidates of an element.

    Attributes:
        z, mask: [Z, 1, B, 1]. noise, both: of the pairs [Y, 1, B, 1], noise that all elements share
            [Y, 1, 1, 1]. log_norm: [B, 1]. As in `JointProblem`.
    """

    z: Tensor
    noise: Tensor
    both: Tensor | None
    mask: Tensor
    log_norm: Tensor


def block_numbers(model: MixtureKalmanFilter) -> tuple[int, int]:
    """Return how many numbers the blocks of one element are, and the product that makes them."""
    n_obs, n_components = len(model.observed), len(model.means)
    blocks = n_obs * (n_obs + 1) // 2 * n_components
    return blocks * model.n_tracks, blocks * model.dim * (model.dim + 1) // 2


def candidates(model: MixtureKalmanFilter, time: int) -> SharedCandidates:
    """Return what the candidates of a frame share with those of others, kept after the burn-in."""

    def make() -> SharedCandidates:
        dim, n_obs = model.dim, len(model.observed)
        matrix, noise = joint_model(model, time)
        rows, device = matrix.mT[:, :n_obs, :dim].transpose(0, 1), matrix.device
        row, column = _pairs(n_obs, device)
        d, e = torch.triu_indices(dim, dim, device=device)
        left, right = rows[row], rows[column]
        quadratic = left[..., d] * right[..., e]
        quadratic = quadratic + (d != e) * left[..., e] * right[..., d]
        width = matrix.shape[-1]
        mean = torch.arange(dim, device=device) * width + dim
        return SharedCandidates(
            quadratic.flatten(0, 1),
            noise[:, row, column].T[..., None, None].contiguous(),
            -rows.flatten(0, 1),
            -noise[:, :n_obs, dim].T[..., None, None],
            torch.cat([d * width + e, mean]),
        )

    if time < model.burn_in:
        return make()
    return derived(model, "candidates", model.sources, make)


def candidate_problems(problems: Sequence[JointProblem]) -> list[CandidateProblem]:
    """Return what is measured in every frame, for `CandidateRoom.log_likelihood`."""
    rows = _pairs(len(problems[0].z), problems[0].z.device)

    def of_pairs(values: list[Tensor]) -> tuple[Tensor, ...]:
        return _of_elements(torch.stack(values)[:, :, :, 0].transpose(1, 2)[..., *rows])

    noise = of_pairs([problem.noise for problem in problems])
    gaps = [problem.both for problem in problems if problem.both is not None]
    both = of_pairs(gaps) if gaps else [None] * len(problems)
    z = _of_elements(torch.stack([problem.z for problem in problems])[..., 0].mT)
    mask = _of_elements(torch.stack([problem.mask for problem in problems])[..., 0, 0].mT)
    norms = [problem.log_norm for problem in problems]
    return [*map(CandidateProblem, z, noise, both, mask, norms)]


def _of_elements(values: Float[Tensor, "T B Y"]) -> tuple[Float[Tensor, "Y 1 B 1"], ...]:
    """Return the values of each frame, beside candidates."""
    return values.mT[:, :, None, :, None].unbind()


def _pairs(n_obs: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return z and w of the pairs z >= w: the diagonal, then columns below it."""
    column, row = torch.triu_indices(n_obs, n_obs, 1, device=device)
    diagonal = torch.arange(n_obs, device=device)
    return torch.cat([diagonal, row]), torch.cat([diagonal, column])


class CandidateRoom:
    """Weighs the candidates of M tracks of B elements in memory that is used again, with the views of it."""

    def __init__(self) -> None:
        self._size: torch.Size | None = None

    def _make_room(self, shared: SharedCandidates, state: Tensor) -> None:
        """Allocate memory for as many tracks as there are, and take the views of every column of S."""
        self._size = state.shape
        width, n_obs = state.shape[-1] ** 2, len(shared.offset)
        first = width * torch.arange(self._size[:2].numel(), device=state.device)[:, None]
        self._places = (first + shared.packed).flatten()
        self._block, self._residual = (
            state.new_empty(*like.shape[:2], *self._size[:2])
            for like in (shared.noise, shared.offset)
        )
        self._pivots = self._block[:n_obs]
        self._least = torch.finfo(state.dtype).tiny ** (1 / n_obs)
        share = torch.empty_like(self._pivots[1:])
        columns = self._block[n_obs:].split([*range(n_obs - 1, 0, -1)])
        # Of each column of S below its pivot, what it is divided by, and what it takes from the rest.
        self._columns = []
        for c, below in enumerate(columns):
            part = share[c:]
            rest = [
                (self._pivots[c + 1 :], below, part),
                (self._residual[c + 1 :], part, self._residual[c]),
            ]
            rest += [(columns[c + i], below[i:], part[i - 1]) for i in range(1, len(below))]
            self._columns.append((below, self._pivots[c], part, rest))

    def log_likelihood(
        self, shared: SharedCandidates, tracks: JointTracks, problem: CandidateProblem
    ) -> Float[Tensor, "K B M"] | None:
        """Return log N(z | track continued by component), None if a block is not positive definite.

        Args:
            shared: of the frame. tracks: before the prediction. problem: what is measured.
        """
        if tracks.state.shape != self._size:
            self._make_room(shared, tracks.state)
        self._innovate(shared, tracks, problem)
        # With the pivot s and the column S_c below it, the rest of S loses S_c S_c^T / s, and the rest of
        # the residual S_c r_c / s.
        for below, pivot, share, rest in self._columns:
            torch.div(below, pivot, out=share)
            for left, column, row in rest:
                left.addcmul_(column, row, value=-1)
        log_det = self._log_det()
        if log_det is None:
            return None
        squares = self._residual.square_().div_(self._pivots).sum(0)
        return torch.add(problem.log_norm, squares.add_(log_det), alpha=-0.5)

    def _log_det(self) -> Float[Tensor, "K B M"] | None:
        """Return log det S, by one logarithm where every product of pivots is within range.

        None if a pivot is not positive, not finite or NaN.
        """
        least, largest = (float(bound) for bound in self._pivots.aminmax())
        if least > self._least and largest < 1 / self._least:
            return self._pivots.prod(0).log_()
        return self._pivots.log().sum(0) if least > 0 and largest < math.inf else None

    def _innovate(
        self, shared: SharedCandidates, tracks: JointTracks, problem: CandidateProblem
    ) -> None:
        """Form the measured blocks of S of all candidates, and the innovations."""
        pairs = shared.quadratic.shape[1]
        packed = tracks.state.view(-1).index_select(0, self._places).view(-1, len(shared.packed))
        noise, target = shared.noise, shared.offset
        if problem.both is None:
            noise, target = noise + problem.noise, target + problem.z
        covs, means = packed[:, :pairs], packed[:, pairs:]
        if len(packed) <= _FEW_TRACKS:
            product = covs @ shared.quadratic.T
            torch.add(noise, product.T.view(self._block.shape), out=self._block)
        else:
            _add_product(self._block, noise, shared.quadratic, covs.T)
        _add_product(self._residual, target, shared.rows, means.T)
        if problem.both is not None:
            self._block.mul_(problem.both).add_(problem.noise)
            self._residual.add_(problem.z).mul_(problem.mask)


def _add_product(
    out: Float[Tensor, "Y K B M"],
    start: Float[Tensor, "Y K #B 1"],
    left: Float[Tensor, "YK R"],
    right: Float[Tensor, "R BM"],
) -> None:
    """Put start + left right into memory."""
    out.copy_(start).view(len(left), -1).addmm_(left, right)
