"""Step tracks that may change their component in every frame, mean and covariance as one matrix.

A track is A = [P, x; x^T, c], filled up by zeros to a width that products are fast at. Under component k
a step is two products of that width, the rows of the measured dimensions, and one product of rank Z,

A <- [F, 0; 0, 1] A [F, 0; 0, 1]^T + [N, b; b^T, 0],   W = L^-1 [H P, H x - z],   A <- A - W^T W,

with L L^T = H P H^T + R; the last column of W is minus the whitened innovation, and c loses the square
of that. The measured dimensions come first, so that H P is a slice. W comes from eliminating the columns of
S = L L^T in [H P, H x - z, S], one measured dimension of all tracks at a time: a factorisation and a solve
of each small matrix take twice as long for some hundred tracks.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchpose._core.module_state import derived
from torchpose.filters._frame_noise import frame_noise
from torchpose.filters._measurements import Measurements
from torchpose.filters._mkf import MixtureKalmanFilter
from torchpose.filters._outputs import (
    FilterOutput,
    Mending,
    StepOutput,
    finish_output,
    mending,
    stacked_mending,
)
from torchpose.filters._weights import estimate_of
from torchpose.math._gaussian import mended_cholesky, spare_columns, symmetrise

_TRACK_NUMBERS = 1 << 17  # in the tracks that are stepped at a time: 1 MB, which stay in the cache
_SHARED_NUMBERS = 1 << 18  # the same where one product serves all, or small operations wait
_LOGS = 16  # standard deviations whose product is within range, and costs one logarithm


class JointModel(NamedTuple):
    """Holds the prediction by every component: [F, 0; 0, 1]^T and [N, b; b^T, 0], both [K, E, E]."""

    matrix: Tensor
    noise: Tensor


class JointProblem(NamedTuple):
    """Holds what is measured in one frame by B elements.

    Attributes:
        z: [Z, B, 1], 0 where missing. noise, both: of `FrameNoise` [Z, B, 1, Z]; noise that all elements
            share is [Z, 1, 1, Z]. mask: [Z, B, 1, 1]. log_norm: constant of the likelihood [B, 1].
    """

    z: Tensor
    noise: Tensor
    both: Tensor | None
    mask: Tensor
    log_norm: Tensor


def joint_chunks(model: MixtureKalmanFilter, batch: int, numbers: int = 0) -> list[slice]:
    """Return equal shares of a batch, of which the tracks stay in the cache.

    Args:
        numbers: of an element, beside those of its tracks, which one product makes for all elements of a
            share; shares are then twice as large, since what it multiplies has to be read for each.
    """
    width = model.dim + spare_columns(model.dim)
    each = max(model.n_tracks * width**2, numbers)
    shared = numbers > 0 or model.observed.device.type != "cpu"
    most = _SHARED_NUMBERS if shared else _TRACK_NUMBERS
    count = max(1, min(batch, round(batch * each / most)))
    edges = [round(batch * i / count) for i in range(count + 1)]
    return [slice(*pair) for pair in itertools.pairwise(edges)]


def joint_order(model: MixtureKalmanFilter) -> tuple[Tensor, Tensor]:
    """Return the dimensions of the state with the measured ones first, and the way back."""
    first = torch.zeros(model.dim, dtype=torch.long, device=model.observed.device)
    first[model.observed] = torch.arange(len(model.observed), 0, -1, device=first.device)
    order = first.argsort(descending=True, stable=True)
    return order, order.argsort()


def joint_model(model: MixtureKalmanFilter, time: int) -> JointModel:
    """Return the prediction into a frame, kept after the burn-in."""

    def make() -> JointModel:
        order = joint_order(model)[0]
        matrix, offset, noise = model.transition(time)
        offset = offset[:, order]
        matrix, noise = (part[:, order[:, None], order] for part in (matrix, noise))
        spare = spare_columns(model.dim) - 1
        joint = pad(torch.cat([noise, offset[..., None]], -1), (0, spare, 0, spare + 1))
        joint[:, model.dim, : model.dim] = offset
        square = pad(matrix.mT, (0, spare + 1, 0, spare + 1))
        square[:, model.dim, model.dim] = 1
        return JointModel(square, joint)

    return make() if time < model.burn_in else derived(model, "joint", model.sources, make)


def joint_models(model: MixtureKalmanFilter, n_frames: int) -> list[JointModel]:
    """Return the predictions into the first frames."""
    steady = joint_model(model, model.burn_in)
    return [steady if t >= model.burn_in else joint_model(model, t) for t in range(n_frames)]


def joint_problems(frames: Measurements) -> list[JointProblem]:
    """Return what is measured in every frame, for `JointTracks.correct`."""
    cov = frames.cov[None, None] if frames.cov.ndim == 2 else frames.cov
    noise, both, mask, log_norm = frame_noise(cov, frames.mask)
    if frames.cov.ndim == 2 and both is None:
        noise = noise[:1]
    n_frames = frames.z.shape[1]
    gaps = [None] * n_frames if both is None else _of_rows(both)
    z, seen = frames.z.to(noise).movedim(2, 0)[..., None].unbind(2), _of_rows(mask[..., None])
    rows = zip(z, _of_rows(noise), gaps, seen, log_norm.unbind(1), strict=True)
    return [JointProblem(*row) for row in rows]


def _of_rows(values: Float[Tensor, "B T Z N"]) -> tuple[Float[Tensor, "Z B 1 N"], ...]:
    """Return the values of each frame, those of one measured dimension together."""
    return values.movedim(2, 0)[..., None, :].unbind(2)


class _Room:
    """Holds memory for the tracks, and the views of it that steps use, which take long to make.

    Args:
        state: the tracks [B, M, E, E]. dim: D. n_observed: Z.

    Attributes:
        flat: one after the other [B M, E, E]. rows, block: [H P, H x] [Z, B, M, E], H P H^T [Z, B, M, Z].
        mean: [B, M, D]. cov: [B, M, D, D]. corner: c [B, M].
    """

    def __init__(self, state: Tensor, dim: int, n_observed: int) -> None:
        self.state, self.flat = state, state.flatten(0, 1)
        self.rows = state[..., :n_observed, :].movedim(2, 0)
        self.block = self.rows[..., :n_observed]
        self.mean, self.corner = state[..., :dim, dim], state[..., dim, dim]
        self.cov = state[..., :dim, :dim]


class JointTracks:
    """Steps M tracks of B elements in memory that is used again: fresh pages cost as much as the products.

    Args:
        model: the filter. mean: [B, M, D]. cov: [B, M, D, D].

    Attributes:
        back: the place of every dimension of the filter's state among those of a track, [D].
    """

    def __init__(
        self,
        model: MixtureKalmanFilter,
        mean: Float[Tensor, "B M D"],
        cov: Float[Tensor, "B M D D"],
    ) -> None:
        order, self.back = joint_order(model)
        mean, cov = mean[..., order], cov[..., order[:, None], order]
        self.dim, self.n_observed = model.dim, len(model.observed)
        width = self.dim + spare_columns(self.dim)
        state = cov.new_zeros(*mean.shape[:-1], width, width)
        state[..., : self.dim, : self.dim] = cov
        state[..., : self.dim, self.dim] = mean
        state[..., self.dim, : self.dim] = mean
        self._make_room(state)

    def _make_room(self, state: Tensor) -> None:
        """Allocate the memory that every step uses again."""
        sizes = self.dim, self.n_observed
        self._now, self._other = _Room(state, *sizes), _Room(torch.empty_like(state), *sizes)
        self._matrix = torch.empty_like(self._now.flat)
        self._make_work(state)
        self._first = state.shape[1] * torch.arange(len(state), device=state.device)[:, None]

    def _make_work(self, state: Tensor) -> None:
        """Allocate memory for [H P, H x - z, S], and take the views of every column of S."""
        (batch, n_tracks, width), n_obs = state.shape[:3], self.n_observed
        work = state.new_zeros(n_obs, batch, n_tracks, width + n_obs)
        self._measured, self._block = work.split([width, n_obs], -1)
        self._innovation = self._measured[..., self.dim]
        self._white = self._measured.flatten(1, 2).transpose(0, 1)
        self._turned = self._white.mT
        self._pivots = self._block.diagonal(dim1=0, dim2=3).movedim(-1, 0)[..., None]
        self._columns = []
        for c in range(n_obs - 1):
            column = self._block[c:, ..., c : c + 1]
            share = torch.empty_like(column[1:])
            self._columns.append((column[1:], column[:1], share, work[c + 1 :], work[c]))

    @property
    def state(self) -> Float[Tensor, "B M E E"]:
        """Return the tracks."""
        return self._now.state

    @property
    def mean(self) -> Float[Tensor, "B M D"]:
        """Return the means, in the order of the filter's state."""
        return self._now.mean[..., self.back]

    @property
    def cov(self) -> Float[Tensor, "B M D D"]:
        """Return the covariances, in the order of the filter's state."""
        return self.state[..., self.back[:, None], self.back]

    @property
    def moments(self) -> tuple[Float[Tensor, "B M D"], Float[Tensor, "B M D D"]]:
        """Return views of the means and covariances, in the order of the tracks."""
        return self._now.mean, self._now.cov

    def take(self, parent: Int[Tensor, "B M"]) -> None:
        """Replace the tracks of every element by some of them, of which some may be taken again."""
        index = (parent + self._first).flatten()
        if len(index) != len(self._now.flat):
            self._make_room(self._now.flat[index].unflatten(0, parent.shape))
            return
        torch.index_select(self._now.flat, 0, index, out=self._other.flat)
        self._now, self._other = self._other, self._now

    def predict(self, model: JointModel, component: Int[Tensor, "B M"]) -> None:
        """Predict the tracks by a component each (BL 34, 37)."""
        chosen, tracks, moved = component.flatten(), self._now.flat, self._other.flat
        torch.index_select(model.matrix, 0, chosen, out=self._matrix)
        # A F^T, then F (A F^T): products with F^T on the right would take a quarter longer
        torch.bmm(tracks, self._matrix, out=moved)
        torch.index_select(model.noise, 0, chosen, out=tracks)
        tracks.baddbmm_(self._matrix.mT, moved)

    def correct(self, problem: JointProblem) -> Float[Tensor, "B M"] | None:
        """Update the tracks by a measurement (BL 38-41), and return the jitter of `mended_cholesky`."""
        return self._correct(problem)[1]

    def weigh(
        self, problem: JointProblem
    ) -> tuple[Float[Tensor, "B M"], Float[Tensor, "B M"] | None]:
        """Update the tracks as `correct` does, and return their log-likelihood and the jitter."""
        self._now.corner.zero_()  # which loses the squared innovation
        scale, jitter = self._correct(problem)
        log_norm = problem.log_norm + _log_product(scale[..., 0])
        return torch.add(log_norm, self._now.corner, alpha=0.5), jitter

    def _correct(
        self, problem: JointProblem
    ) -> tuple[Float[Tensor, "Z B M 1"], Float[Tensor, "B M"] | None]:
        """Update the tracks, and return the inverse of the diagonal of L and the jitter of S."""
        self._innovate(problem)
        for below, pivot, share, rest, row in self._columns:
            torch.div(below, pivot, out=share)
            rest.addcmul_(share, row, value=-1)
        if self._pivots.amin().item() > 0:  # none is NaN
            scale, jitter = self._pivots.rsqrt(), None
            self._measured.mul_(scale)
        else:
            scale, jitter = self._mend(problem)
        self._now.flat.baddbmm_(self._turned, self._white, alpha=-1)
        return scale, jitter

    def _innovate(self, problem: JointProblem) -> None:
        """Put [H P, H x - z, S] into memory."""
        now = self._now
        if problem.both is None:
            self._measured.copy_(now.rows)
            torch.add(now.block, problem.noise, out=self._block)
        else:
            torch.mul(now.rows, problem.mask, out=self._measured)
            torch.addcmul(problem.noise, problem.both, now.block, out=self._block)
        self._innovation.sub_(problem.z)

    def _mend(
        self, problem: JointProblem
    ) -> tuple[Float[Tensor, "Z B M 1"], Float[Tensor, "B M"] | None]:
        """Whiten [H P, H x - z] where S of some tracks is not positive definite, as `_correct` returns it."""
        self._innovate(problem)
        factor, jitter = mended_cholesky(self._block.movedim(0, 2))
        measured = self._measured.movedim(0, 2)
        measured.copy_(torch.linalg.solve_triangular(factor, measured, upper=False))
        return factor.diagonal(dim1=-2, dim2=-1).movedim(-1, 0)[..., None].reciprocal(), jitter


def _log_product(scale: Float[Tensor, "Z *batch"]) -> Float[Tensor, "*batch"]:
    """Return the logarithm of a product, of few factors by one logarithm, whose product is within range."""
    return scale.prod(0).log() if len(scale) <= _LOGS else scale.log().sum(0)


def joint_estimate(
    tracks: JointTracks,
    log_weights: Float[Tensor, "B M"],
    log_evidence: Float[Tensor, "B *M"],
    jitters: Sequence[Tensor | None],
    return_cov: bool,
) -> StepOutput:
    """Return the estimate of a frame (BL 48), in the order of the tracks, for `stacked`.

    Without covariances its mean is that of the tracks [B, M, D].

    Args:
        log_evidence: also where nothing is measured; or the log-weights before they are normalised [B, M],
            whose sum it is. jitters: of its covariances.
    """
    mean, cov = tracks.moments
    mean = mean.to(log_weights, copy=True)  # the next frame overwrites it
    mended = any(jitter is not None for jitter in jitters)
    work = mending(log_weights, *jitters) if mended else (None, None)
    if not return_cov:
        return StepOutput(mean, log_weights, log_evidence, None, *work)
    estimate, total = estimate_of(log_weights, mean, cov)
    total = None if total is None else symmetrise(total)
    return StepOutput(estimate, log_weights, log_evidence, total, *work)


def stacked(tracks: JointTracks, steps: Sequence[StepOutput], frames: Measurements) -> FilterOutput:
    """Stack the frames of some sequences, in the order of the filter's state.

    Means of tracks are averaged, their weights summed and dimensions sorted for all frames at once.
    """
    log_weights = torch.stack([step.log_weights for step in steps], 1)
    mean = torch.stack([step.mean for step in steps], 1)
    if mean.ndim == 4:
        mean = (log_weights.exp()[..., None, :] @ mean)[..., 0, :]
    mean = mean[..., tracks.back]
    evidence = torch.stack([step.log_evidence for step in steps], 1)
    if evidence.ndim == 3:
        evidence = torch.logsumexp(evidence, -1)
    evidence = torch.where(frames.mask.any(-1), evidence, torch.zeros_like(evidence))
    covs = [step.cov for step in steps if step.cov is not None]
    cov = torch.stack(covs, 1)[..., tracks.back[:, None], tracks.back] if covs else None
    none = mending(evidence)
    work = stacked_mending([
        none if s.mended is None or s.jitter is None else Mending(s.mended, s.jitter) for s in steps
    ])  # fmt: skip
    return FilterOutput(mean, log_weights, evidence, cov, none.mended, *work)


def joined(parts: Sequence[FilterOutput], lengths: Tensor) -> FilterOutput:
    """Join what `stacked` returned for the shares of a batch, and finish it."""
    mean = torch.cat([part.mean for part in parts])
    log_weights = torch.cat([part.log_weights for part in parts])
    evidence = torch.cat([part.log_evidence for part in parts])
    covs = [part.cov for part in parts if part.cov is not None]
    mended = torch.cat([part.mended for part in parts if part.mended is not None])
    jitter = torch.cat([part.jitter for part in parts if part.jitter is not None])
    cov = torch.cat(covs) if covs else None
    return finish_output(mean, log_weights, evidence, cov, lengths, Mending(mended, jitter))
