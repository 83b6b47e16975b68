"""Weigh the M K candidates of split tracks, candidates innermost.

What a candidate needs of its predicted covariance is the block of measured dimensions, linear in P of its
track: with r_z the rows of H F_j,

(H F_j P F_j^T H^T)_zw = sum_{d <= e} g_{zw,de} P_de,   g_{zw,de} = r_zd r_we + r_ze r_wd  (half that, d = e),

one product of the symmetric parts of all P with g, which is made once. The small blocks are factorised
column by column, each step over all candidates at once.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.module_state import derived
from torchpose.filters._joint_tracks import JointProblem, JointTracks, joint_model
from torchpose.filters._mkf import MixtureKalmanFilter

_LOGS = 8  # standard deviations whose product is within range, and costs one logarithm


class SharedCandidates(NamedTuple):
    """Holds what all frames share, for the Y = Z (Z + 1) / 2 pairs z >= w, column by column.

    Attributes:
        quadratic: g [D (D + 1) / 2, Y K]. noise: H N_j H^T [Y, K, 1, 1]. rows: -H F_j [D, Z K].
        offset: H b_j [Z, K, 1, 1]. packed: places of d <= e, then of the mean, in a flat joint matrix.
    """

    quadratic: Tensor
    noise: Tensor
    rows: Tensor
    offset: Tensor
    packed: Tensor


class CandidateProblem(NamedTuple):
    """Holds what B elements measure in one frame, the same for all candidates of an element.

    Attributes:
        z, mask: [Z, 1, B, 1]. noise, both: of the pairs [Y, 1, B, 1]. log_norm: [B, 1]. As in `JointProblem`.
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
        rows, device = matrix[:, :n_obs, :dim].transpose(0, 1), matrix.device
        row, column = _pairs(n_obs, device)
        d, e = torch.triu_indices(dim, dim, device=device)
        left, right = rows[row], rows[column]
        quadratic = left[..., d] * right[..., e]
        quadratic = quadratic + (d != e) * left[..., e] * right[..., d]
        width = matrix.shape[-1]
        mean = torch.arange(dim, device=device) * width + dim
        return SharedCandidates(
            quadratic.flatten(0, 1).T.contiguous(),
            noise[:, row, column].T[..., None, None].contiguous(),
            -rows.flatten(0, 1).T.contiguous(),
            noise[:, :n_obs, dim].T[..., None, None].contiguous(),
            torch.cat([d * width + e, mean]),
        )

    if time < model.burn_in:
        return make()
    return derived(model, "candidates", model.sources, make)


def candidate_problems(problems: Sequence[JointProblem]) -> list[CandidateProblem]:
    """Return what is measured in every frame, for `CandidateRoom.log_likelihood`."""
    rows = _pairs(problems[0].z.shape[-1], problems[0].z.device)

    def of_pairs(values: list[Tensor]) -> tuple[Tensor, ...]:
        return _of_elements(torch.stack(values)[:, :, 0, *rows])

    noise = of_pairs([problem.noise for problem in problems])
    gaps = [problem.both for problem in problems if problem.both is not None]
    both = of_pairs(gaps) if gaps else [None] * len(problems)
    z = _of_elements(torch.stack([problem.z for problem in problems])[:, :, 0])
    mask = _of_elements(torch.stack([problem.mask for problem in problems])[:, :, 0, :, 0])
    norms = [problem.log_norm for problem in problems]
    return [*map(CandidateProblem, z, noise, both, mask, norms)]


def _of_elements(values: Float[Tensor, "T B Y"]) -> tuple[Float[Tensor, "Y 1 B 1"], ...]:
    """Return the values of each frame, beside candidates."""
    return values.mT[:, :, None, :, None].unbind()


def _pairs(n_obs: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return z and w of the pairs z >= w, column by column."""
    column, row = torch.triu_indices(n_obs, n_obs, device=device)
    return row, column


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
        self._white = [*self._residual]
        columns = [*self._block.split([*range(n_obs, 0, -1)])]
        self._columns, self._pivots = columns, [column[0] for column in columns]
        # Of each column of S, what it takes from the residuals and the columns behind it.
        self._taken = []
        for c, column in enumerate(columns):
            below = [(self._residual[c + 1 :], column[1:], self._white[c])]
            later = [(columns[c + i], column[i:], column[i]) for i in range(1, n_obs - c)]
            self._taken.append(below + later if later else [])

    def log_likelihood(
        self, shared: SharedCandidates, tracks: JointTracks, problem: CandidateProblem
    ) -> Float[Tensor, "K B M"]:
        """Return log N(z | track continued by component), not finite where a block is not positive definite.

        Args:
            shared: of the frame. tracks: before the prediction. problem: what is measured.
        """
        if tracks.state.shape != self._size:
            self._make_room(shared, tracks.state)
        self._innovate(shared, tracks, problem)
        # With the pivot s and the column l = S_c / s^1/2, the rest of S = L L^T loses l l^T, and the rest
        # of the residual loses l v with v = residual_c / s^1/2.
        columns = zip(self._columns, self._pivots, self._white, self._taken, strict=True)
        for column, pivot, white, taken in columns:
            scale = pivot.rsqrt()
            column.mul_(scale)
            white.mul_(scale)
            for rest, below, beside in taken:
                rest.addcmul_(below, beside, value=-1)
        found = self._residual.square_().sum(0)
        return torch.add(problem.log_norm - self._half_log_det(), found, alpha=-0.5)

    def _innovate(
        self, shared: SharedCandidates, tracks: JointTracks, problem: CandidateProblem
    ) -> None:
        """Form the measured blocks of S of all candidates, and the innovations."""
        pairs = len(shared.quadratic)
        packed = tracks.state.view(-1).index_select(0, self._places).view(-1, len(shared.packed))
        _product(packed[:, :pairs], shared.quadratic, self._block)
        _product(packed[:, pairs:], shared.rows, self._residual)
        if problem.both is None:
            self._block.add_(problem.noise + shared.noise)
            self._residual.add_(problem.z - shared.offset)
        else:
            self._block.add_(shared.noise).mul_(problem.both).add_(problem.noise)
            self._residual.add_(problem.z - shared.offset).mul_(problem.mask)

    def _half_log_det(self) -> Tensor:
        total = None
        for first in range(0, len(self._pivots), _LOGS):
            product = self._pivots[first]
            for pivot in self._pivots[first + 1 : first + _LOGS]:
                product = product.mul_(pivot)
            total = product.log() if total is None else total + product.log()
        assert total is not None
        return total


def _product(left: Float[Tensor, "n R"], right: Float[Tensor, "R C"], out: Tensor) -> None:
    """Put (left right)^T into memory of C n numbers; the product in this order takes up to half the time."""
    out.view(right.shape[1], len(left)).copy_(torch.mm(left, right).T)
