"""Run fixed tracks over sequences of which each has noise or gaps of its own, so that no two share gains.

Tracks are filtered in coordinates in which their transitions are diagonal. Mean and covariance of a
track are one symmetric matrix A, of which a step is one elementwise product and two small products:

A = [P, y; y^T, 0],   A <- (f f^T) o A + N,   W = L^-1 [H P, H y - (z - H mu)],   A <- A - W^T W,

with L L^T = H P H^T + R. The corner of A is then minus the squared innovation, -|L^-1 (z - H x)|^2. A
missing dimension has no row of H, and that of the identity in R: it changes nothing, exactly.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from torchpose.filters._diagonal_model import DiagonalModel, DiagonalMoves, diagonal_moves
from torchpose.filters._frame_noise import frame_noise
from torchpose.filters._measurements import Measurements
from torchpose.filters._memoryless import frame_log_likelihood
from torchpose.filters._mkf import MixtureKalmanFilter
from torchpose.filters._outputs import FilterOutput, Mending, finish_output, mending
from torchpose.filters._weights import WeightRule, sequence_weights
from torchpose.math._gaussian import mended_cholesky, spare_columns, symmetrise

_STATE_NUMBERS = 300_000  # of tracks at a time: 2.4 MB, which stay in the cache
_SPAN_NUMBERS = 1 << 20  # of their means over a span of frames
_COV_NUMBERS = 1 << 21  # of their covariances, where these are asked for
_LONGEST_SPAN = 64


class _Results(NamedTuple):
    """Holds what is written chunk by chunk, for B sequences of T frames; as `FilterOutput`."""

    mean: Tensor
    log_weights: Tensor
    log_evidence: Tensor
    cov: Tensor | None
    mended: Tensor
    jitter: Tensor


class _Span(NamedTuple):
    """Holds tracks over T frames.

    Attributes:
        column: y and minus the squared innovation [T, B, M, D + 1]. log_likelihood: [T, B, M].
        cov: in the coordinates of y [T, B, M, D, D], or None. work: of every frame.
    """

    column: Tensor
    log_likelihood: Tensor
    cov: Tensor | None
    work: list[Mending] | None


def run_own_histories(
    model: MixtureKalmanFilter,
    diagonal: DiagonalModel,
    rule: WeightRule,
    frames: Measurements,
    return_cov: bool,
    progress: bool,
) -> FilterOutput:
    """Filter all frames, some sequences and frames at a time; no gradient runs through it.

    Args:
        model: with fixed tracks. diagonal: its coordinates. rule: of the weights. frames: all that is
            measured. return_cov: whether to return covariances. progress: whether to show a progress bar.
    """
    batch, n_frames = frames.z.shape[:2]
    marginal = frame_log_likelihood(model, rule, frames)
    results = _empty_results(model, frames, return_cov)
    width = model.dim + spare_columns(model.dim)
    n_chunks = math.ceil(batch * model.n_tracks * width**2 / _STATE_NUMBERS)
    at_a_time = math.ceil(batch / n_chunks)
    bar = tqdm(total=batch * n_frames, disable=not progress, unit="frame")
    for start in range(0, batch, at_a_time):
        chunk = slice(start, min(start + at_a_time, batch))
        carried = model.init(chunk.stop - chunk.start).log_weights
        taken = frames.some(chunk)
        for span, tracks in _spans(model, diagonal, taken, return_cov):
            likelihood = tracks.log_likelihood.to(model.dtype)
            own = None if marginal is None else marginal[chunk, span].transpose(0, 1)
            weights, evidence, carried = sequence_weights(rule, carried, likelihood, own)
            at = (chunk, span)
            results.log_weights[at], results.log_evidence[at] = weights.transpose(0, 1), evidence.mT
            mean, cov = _estimate(model, diagonal, weights.exp(), tracks)
            results.mean[at] = mean.transpose(0, 1)
            if results.cov is not None and cov is not None:
                results.cov[at] = cov.transpose(0, 1)
            if tracks.work is not None:
                results.mended[at] = torch.stack([work.mended for work in tracks.work], 1)
                results.jitter[at] = torch.stack([work.jitter for work in tracks.work], 1)
            bar.update(likelihood.shape[0] * likelihood.shape[1])
    bar.close()
    results.log_evidence.masked_fill_(~frames.mask.any(-1), 0)
    found, work = results[:4], Mending(results.mended, results.jitter)
    return finish_output(*found, frames.lengths, work)


def _empty_results(model: MixtureKalmanFilter, frames: Measurements, return_cov: bool) -> _Results:
    size = frames.z.shape[:2]
    kind = {"dtype": model.dtype, "device": frames.z.device}
    mended = torch.zeros(size, dtype=torch.long, device=frames.z.device)
    return _Results(
        torch.empty(*size, model.dim, **kind),
        torch.empty(*size, model.n_tracks, **kind),
        torch.empty(size, **kind),
        torch.empty(*size, model.dim, model.dim, **kind) if return_cov else None,
        mended,
        mended.double(),
    )


def _spans(
    model: MixtureKalmanFilter, diagonal: DiagonalModel, frames: Measurements, return_cov: bool
) -> Iterator[tuple[slice, _Span]]:
    """Yield the tracks of some sequences, a span of frames at a time."""
    batch, n_frames, _ = frames.z.shape
    width = model.dim + spare_columns(model.dim)
    state = diagonal.basis.new_zeros(batch, model.n_tracks, width, width)
    state[..., : model.dim, : model.dim] = diagonal.start
    before = torch.empty_like(state)
    rows = diagonal.rows.expand(batch, -1, -1, -1).flatten(0, 1)
    length = _SPAN_NUMBERS // (batch * model.n_tracks * width)
    if return_cov:
        length = min(length, _COV_NUMBERS // state.numel())
    length = max(1, min(length, _LONGEST_SPAN))
    for start in range(0, n_frames, length):
        span = slice(start, min(start + length, n_frames))
        moves = [diagonal_moves(model, diagonal, t) for t in range(span.start, span.stop)]
        problem = _problem(model, frames, span)
        before.copy_(state)
        tracks = _filter_span(state, rows, moves, problem, return_cov, mend=False)
        if tracks is None:
            state.copy_(before)
            tracks = _filter_span(state, rows, moves, problem, return_cov, mend=True)
            assert tracks is not None
        yield span, tracks


class _Problem(NamedTuple):
    """Holds what is measured in T frames, time first.

    Attributes:
        residual: z - H mu [T, B M, Z], 0 where missing. noise, both: of `FrameNoise`, [T, B, 1, Z, Z].
            mask: [T, B, 1, Z, 1]. log_norm: [T, B, 1], the
            constant of the likelihood.
    """

    residual: Tensor
    noise: Tensor
    both: Tensor | None
    mask: Tensor
    log_norm: Tensor


def _problem(model: MixtureKalmanFilter, frames: Measurements, span: slice) -> _Problem:
    mask = frames.mask[:, span].transpose(0, 1)
    cov = frames.cov if frames.cov.ndim == 2 else frames.cov[:, span].transpose(0, 1)
    noise, both, seen, log_norm = frame_noise(cov, mask)
    z = frames.z[:, span].transpose(0, 1).to(noise)[:, :, None]
    residual = (z - model.means.to(noise)[:, model.observed]) * seen[:, :, None]
    both = None if both is None else both[:, :, None]
    return _Problem(
        residual.flatten(1, 2), noise[:, :, None], both, seen[:, :, None, :, None], log_norm
    )


def _filter_span(
    state: Float[Tensor, "B M E E"],
    rows: Float[Tensor, "BM Z D"],
    moves: list[DiagonalMoves],
    problem: _Problem,
    return_cov: bool,
    mend: bool,
) -> _Span | None:
    """Filter T frames, and leave their last state in `state`; None if a covariance has to be mended.

    Args:
        rows: H V of every track. moves: into every frame. mend: whether to mend covariances.
    """
    n_frames, dim, n_obs = len(moves), rows.shape[-1], rows.shape[1]
    tracks = state.shape[:2]
    flat = state.flatten(0, 1)
    column = state.new_empty(n_frames, len(flat), dim + 1)
    diagonal = state.new_empty(n_frames, len(flat), n_obs)
    covs = state.new_empty(n_frames, len(flat), dim, dim) if return_cov else None
    infos, works, columns = [], [], rows.mT
    for t, move in enumerate(moves):
        torch.addcmul(move.noise, move.factor, state, out=state)
        joint = torch.bmm(rows, flat[:, :dim])
        innovation = torch.bmm(joint[..., :dim], columns).view(*tracks, n_obs, n_obs)
        if problem.both is None:
            innovation += problem.noise[t]
        else:
            innovation = torch.addcmul(problem.noise[t], problem.both[t], innovation)
            joint.view(*tracks, n_obs, -1).mul_(problem.mask[t])
        joint[..., dim] -= problem.residual[t]
        if mend:
            factor, jitter = mended_cholesky(innovation)
            works.append(mending(state, jitter))
        else:
            factor, info = torch.linalg.cholesky_ex(innovation)
            infos.append(info)
        factor = factor.flatten(0, 1)
        white = torch.linalg.solve_triangular(factor, joint, upper=False)
        flat.baddbmm_(white.mT, white, alpha=-1)
        column[t] = flat[:, : dim + 1, dim]
        diagonal[t] = factor.diagonal(dim1=-2, dim2=-1)
        if covs is not None:
            covs[t] = flat[:, :dim, :dim]
    if not mend and bool(torch.stack(infos).any()):
        return None
    likelihood = 0.5 * column[..., dim] - diagonal.log_().sum(-1)
    return _Span(
        column.unflatten(1, tracks),
        likelihood.unflatten(1, tracks) + problem.log_norm,
        None if covs is None else covs.unflatten(1, tracks),
        works if mend else None,
    )


def _estimate(
    model: MixtureKalmanFilter,
    diagonal: DiagonalModel,
    weights: Float[Tensor, "T B M"],
    tracks: _Span,
) -> tuple[Float[Tensor, "T B D"], Float[Tensor, "T B D D"] | None]:
    """Return the means sum_j w_j (mu_j + V_j y_j) (BL 48) and, where tracks have them, covariances."""
    centres, back = model.means.to(torch.float64), diagonal.basis.mT
    weights, moved = weights.to(centres), tracks.column[..., : model.dim]
    shares = (moved * weights[..., None]).flatten(-2)
    mean = weights @ centres + shares @ back.flatten(0, 1)
    if tracks.cov is None:
        return mean.to(model.dtype), None
    half = (tracks.cov @ back * weights[..., None, None]).flatten(-3, -2)
    within = diagonal.basis.transpose(0, 1).flatten(1) @ half
    apart = centres - mean[..., None, :] + (moved[..., None, :] @ back)[..., 0, :]
    apart = apart * weights[..., None].sqrt()
    total = symmetrise(within) + apart.mT @ apart
    return mean.to(model.dtype), total.to(model.dtype)
