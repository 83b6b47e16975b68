"""Mixture Kalman filter with fixed tracks: one step, and whole batches of sequences.

A track never changes its component, so its covariances depend only on which joints were measured.
`run` takes the gains from a graph of mask histories, solves constant stretches in blocks, and falls
back to the plain recursion for gradients, for noise that changes in each frame, and for burn-in.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor
from tqdm.auto import tqdm

from torchpose.filters.base import FilterOutput, Measurements, StepOutput, collect, finish_output
from torchpose.filters.columns import run_columns, suits_columns
from torchpose.filters.frame_weights import (
    advance_memoryless,
    frame_log_likelihood,
    frame_weights,
    run_memoryless,
)
from torchpose.filters.gains import MAX_EDGES, Edge, GainGraph
from torchpose.filters.mending import mending, mending_of_edges
from torchpose.filters.scan import Workspace, scan_blocks
from torchpose.filters.tracks import MKFState, estimate_of, within_and_between
from torchpose.filters.weights import mix_uniform, sequence_weights, step_weights
from torchpose.gaussian import Gain, kalman_correct, kalman_gain, symmetrise

if TYPE_CHECKING:
    from torchpose.filters.mkf import MixtureKalmanFilter

_BUFFER_NUMBERS = 1 << 18  # track means held at a time: 4 MB, which stay in the cache


class TrackStep(NamedTuple):
    """All tracks after one step, before their weights.

    Attributes:
        predicted, mean: track means before and after the measurement [B, M, D].
        log_likelihood: [B, M]. predicted_cov, cov: before and after, [G, M, D, D].
        group: row of the covariances for each element [B].
        jitter: of the innovation covariances [B, M], or None; see `mended_cholesky`.
    """

    predicted: Tensor
    mean: Tensor
    log_likelihood: Tensor
    predicted_cov: Tensor
    cov: Tensor
    group: Tensor
    jitter: Tensor | None


def step_tracks(model: "MixtureKalmanFilter", state: MKFState, frame: Measurements) -> TrackStep:
    """Predict and correct every track (BL 34-41); elements of one history share their gains."""
    matrix, offset, noise = model.transition(state.time)
    cov, group, mask, noise_cov = distinct_histories(state, frame)
    predicted_cov = symmetrise(matrix @ cov @ matrix.mT + noise)
    gain, cov = kalman_gain(predicted_cov, noise_cov, model.observed, mask)
    gain = gain.to(model.dtype)
    moving = matrix.to(model.dtype), offset.to(model.dtype)
    if cov.shape[0] == 1:
        means = _correct_shared(model, state.mean, moving, gain, frame)
    else:
        predicted = (moving[0] @ state.mean[..., None])[..., 0] + moving[1]
        own = gain.of(group)
        z, seen = frame.z[:, None], frame.mask[:, None]
        means = predicted, *kalman_correct(predicted, z, own, model.observed, seen)
    jitter = None if gain.jitter is None else gain.jitter[group]
    return TrackStep(*means, predicted_cov, cov, group, jitter)


def step_fixed_weights(
    model: "MixtureKalmanFilter", state: MKFState, log_likelihood: Tensor, frame: Measurements
) -> tuple[Tensor, Tensor]:
    """Log-weights of the estimate [B, M] and log-evidence, 0 where nothing is measured [B]."""
    log_prior, power = model.log_prior.to(model.dtype), model.likelihood_power
    if model.weighting == "frame":
        marginal = frame_log_likelihood(model, frame.as_sequences())[:, 0]
        log_weights, log_evidence = frame_weights(log_prior, marginal, log_likelihood, power)
    else:
        log_weights, log_evidence = step_weights(
            state.log_weights, log_prior, log_likelihood, power, model.reset_below
        )
    measured = frame.mask.any(-1)
    return log_weights, torch.where(measured, log_evidence, torch.zeros_like(log_evidence))


def advance(
    model: "MixtureKalmanFilter", state: MKFState, frame: Measurements, return_cov: bool
) -> tuple[MKFState, StepOutput]:
    """One step (BL 34-41, 48-49)."""
    if model.is_memoryless:
        return advance_memoryless(model, state, frame, return_cov)
    step = step_tracks(model, state, frame)
    log_weights, log_evidence = step_fixed_weights(model, state, step.log_likelihood, frame)
    covs = step.cov[step.group] if return_cov else None
    estimate, total = estimate_of(log_weights, step.mean, covs)
    carried = mix_uniform(log_weights, model.uniform_weight)
    new_state = MKFState(carried, step.mean, step.cov, step.group, state.time + 1)
    work = mending(estimate, step.jitter)
    return new_state, StepOutput(estimate, log_weights, log_evidence, total, *work)


def _correct_shared(
    model: "MixtureKalmanFilter",
    mean: Tensor,
    moving: tuple[Tensor, Tensor],
    gain: Gain,
    frame: Measurements,
) -> tuple[Tensor, Tensor, Tensor]:
    """Predicted and corrected means and likelihoods of elements that share one gain."""
    matrix, offset = moving
    predicted = torch.baddbmm(offset[:, None], mean.transpose(0, 1), matrix.mT)
    residual = frame.z - predicted.index_select(-1, model.observed)
    residual = torch.where(frame.mask[0], residual, torch.zeros_like(residual))
    white = torch.linalg.solve_triangular(gain.factor[0], residual.mT, upper=False)
    corrected = torch.baddbmm(predicted, white.mT, gain.white[0])
    log_likelihood = gain.log_norm[0] - 0.5 * white.square().sum(1).mT
    return predicted.transpose(0, 1), corrected.transpose(0, 1), log_likelihood


def distinct_histories(
    state: MKFState, frame: Measurements
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Covariances, groups, masks and noise for the distinct histories of this frame."""
    if frame.cov.ndim == 3:
        own = torch.arange(frame.z.shape[0], device=frame.z.device)
        return state.cov[state.group], own, frame.mask[:, None], frame.cov[:, None]
    if state.cov.shape[0] == 1 and bool((frame.mask == frame.mask[:1]).all()):
        return state.cov, state.group, frame.mask[:1, None], frame.cov
    bits = 2 ** torch.arange(frame.mask.shape[1], device=frame.mask.device)
    code = state.group * 2 ** frame.mask.shape[1] + (frame.mask * bits).sum(-1)
    _, group = torch.unique(code, return_inverse=True)
    n_groups = int(group.max()) + 1
    first = torch.zeros(n_groups, dtype=torch.long, device=group.device)
    first[group] = torch.arange(group.numel(), device=group.device)
    return state.cov[state.group[first]], group, frame.mask[first, None], frame.cov


def run(
    model: "MixtureKalmanFilter", frames: Measurements, return_cov: bool, progress: bool
) -> FilterOutput:
    """All frames of a batch."""
    if model.is_memoryless:
        return run_memoryless(model, frames, return_cov, progress)
    history = None if _needs_plain_loop(model, frames) else _history(model, frames)
    if history is None:
        state = model.init(frames.z.shape[0])
        steps = []
        for t in tqdm(range(frames.z.shape[1]), disable=not progress, unit="frame"):
            state, out = advance(model, state, frames.frame(t), return_cov)
            steps.append(out)
        return collect(steps, frames.lengths)
    shared = all(len(edges) == 1 for edges in history.edges)
    if not return_cov and suits_columns(model, frames, shared):
        return run_columns(model, frames, [edges[0] for edges in history.edges], progress)
    return _run_shared(model, frames, history, return_cov, progress)


def _needs_plain_loop(model: "MixtureKalmanFilter", frames: Measurements) -> bool:
    return _learning(model, frames) or frames.cov.ndim == 4 or model.burn_in > 0


def _learning(model: "MixtureKalmanFilter", frames: Measurements) -> bool:
    tensors = (frames.z, frames.cov, *model.sources)
    return torch.is_grad_enabled() and any(t.requires_grad for t in tensors)


class _History(NamedTuple):
    """Steps through the gain graph for H distinct histories of masks.

    Attributes:
        graph: the graph. edges: per frame, one edge for each history, or a single one for all.
        steady: per frame, the steady node that all elements stay at, or -1.
        group: the history of each element, [B].
    """

    graph: GainGraph
    edges: list[list[Edge]]
    steady: list[int]
    group: Tensor


def _history(model: "MixtureKalmanFilter", frames: Measurements) -> _History | None:
    """Walk the gain graph; None if the masks have too many histories to be worth sharing."""
    graph = model.gain_graph(frames.cov)
    patterns = _patterns(frames)
    distinct, group = torch.unique(patterns, dim=0, return_inverse=True)
    nodes = [0] * distinct.shape[0]
    edges, steady = [], []
    for row in distinct.T.tolist():
        keys = set(zip(nodes, row, strict=True))
        found = {key: graph.edge(*key) for key in keys}
        if len(graph.edges) > MAX_EDGES:
            return None
        first = (nodes[0], row[0])
        same = len(keys) == 1
        steady.append(nodes[0] if same and graph.is_steady(*first) else -1)
        taken = [found[key] for key in zip(nodes, row, strict=True)]
        edges.append(taken[:1] if same else taken)
        nodes = [edge.target for edge in taken]
    return _History(graph, edges, steady, group)


def _patterns(frames: Measurements) -> Tensor:
    """The measured dimensions as bits [B, T]; finished sequences share those of the longest."""
    n_frames, n_obs = frames.z.shape[1:]
    bits = 2 ** torch.arange(n_obs, device=frames.z.device)
    patterns = (frames.mask * bits).sum(-1)
    over = torch.arange(n_frames, device=frames.z.device) >= frames.lengths[:, None]
    return torch.where(over, patterns[frames.lengths.argmax()], patterns)


def _run_shared(
    model: "MixtureKalmanFilter",
    frames: Measurements,
    history: _History,
    return_cov: bool,
    progress: bool,
) -> FilterOutput:
    batch, n_frames = frames.z.shape[:2]
    means = model.means.to(model.dtype)
    weights = _Weights(model, frames)
    # Results are written in place, time first: gathering them afterwards would copy all of them.
    estimates = means.new_empty(n_frames, batch, model.dim)
    posteriors = means.new_empty(n_frames, batch, model.n_tracks)
    evidences = means.new_empty(n_frames, batch)
    covs = means.new_empty(n_frames, batch, model.dim, model.dim) if return_cov else None
    workspace = Workspace()
    bar = tqdm(total=n_frames, disable=not progress, unit="frame")
    done = 0
    for tracks in _stretches(model, frames, history, workspace):
        log_likelihood = tracks.log_likelihood.permute(1, 3, 2, 0).flatten(0, 1)
        span = slice(done, done + len(log_likelihood))
        posteriors[span], evidences[span] = weights.update(log_likelihood, span)
        mixed = posteriors[span].exp()
        shares = mixed.view(*tracks.deviation.shape[1:4:2], batch, -1).permute(3, 0, 2, 1)
        weighted = workspace.take("weighted", tuple(tracks.deviation.shape), means)
        torch.mul(tracks.deviation, shares[..., None], out=weighted)
        centred = weighted.sum(0).transpose(1, 2).flatten(0, 1)
        torch.add(centred, mixed @ means, out=estimates[span])
        if covs is not None:
            covs[span] = _covariances(tracks, means, mixed, estimates[span])
        bar.update(len(log_likelihood))
        done += len(log_likelihood)
    bar.close()
    evidence = torch.where(frames.mask.any(-1), evidences.mT, torch.zeros_like(evidences.mT))
    cov = None if covs is None else covs.transpose(0, 1)
    work = mending_of_edges(history.edges, history.group)
    return finish_output(
        estimates.transpose(0, 1), posteriors.transpose(0, 1), evidence, cov, frames.lengths, work
    )


class _Weights:
    """Weights and evidence of consecutive stretches of frames, time first."""

    def __init__(self, model: "MixtureKalmanFilter", frames: Measurements) -> None:
        self._model = model
        self._log_prior = model.log_prior.to(model.dtype)
        self._carried = model.init(frames.z.shape[0]).log_weights
        by_frame = model.weighting == "frame"
        self._marginal = frame_log_likelihood(model, frames).transpose(0, 1) if by_frame else None

    def update(self, log_likelihood: Tensor, span: slice) -> tuple[Tensor, Tensor]:
        """Log-weights [T, B, M] and log-evidence [T, B] of the frames `span`, which come next."""
        model, power = self._model, self._model.likelihood_power
        if self._marginal is not None:
            return frame_weights(self._log_prior, self._marginal[span], log_likelihood, power)
        estimate, evidence, self._carried = sequence_weights(
            self._carried,
            self._log_prior,
            log_likelihood,
            model.uniform_weight,
            power,
            model.reset_below,
        )
        return estimate, evidence


class _Stretch(NamedTuple):
    """Tracks over a stretch of T = N L frames, N blocks of L.

    Attributes:
        deviation: track means minus component means [M, N, B, L, D].
        log_likelihood: [M, N, B, L]. cov: per frame, track covariances [H, M, D, D].
        group: row of `cov` for each element [B].
    """

    deviation: Tensor
    log_likelihood: Tensor
    cov: list[Tensor]
    group: Tensor


def _stretches(
    model: "MixtureKalmanFilter", frames: Measurements, history: _History, workspace: Workspace
) -> Iterator[_Stretch]:
    """Track means and likelihoods, a bounded stretch of frames at a time."""
    batch, n_frames, _ = frames.z.shape
    n_tracks, dim = model.means.shape
    state = torch.zeros(n_tracks, batch, dim, dtype=model.dtype, device=frames.z.device)
    length = _block_length(batch)
    longest = max(length, _BUFFER_NUMBERS // (batch * n_tracks * dim))
    t = 0
    while t < n_frames:
        node, end = history.steady[t], t + 1
        while end < n_frames and end - t < longest and history.steady[end] == node:
            end += 1
        if node >= 0 and end - t >= length:
            end = t + (end - t) // length * length
            stretch, state = _block_stretch(model, frames, history, state, (t, end), workspace)
        else:
            stretch, state = _stepped_stretch(model, frames, history, state, (t, end))
        yield stretch
        t = end


def _block_length(batch: int) -> int:
    # Longer blocks cost arithmetic and save calls; with many sequences the calls matter less.
    return 8 if batch <= 8 else 4


def _block_stretch(
    model: "MixtureKalmanFilter",
    frames: Measurements,
    history: _History,
    state: Tensor,
    span: tuple[int, int],
    workspace: Workspace,
) -> tuple[_Stretch, Tensor]:
    start, end = span
    edge, node = history.edges[start][0], history.steady[start]
    length = _block_length(frames.z.shape[0])
    blocks = history.graph.blocks(node, model.means, length, model.dtype)
    deviation, squared, state = scan_blocks(blocks, state, frames.z[:, start:end], workspace)
    log_norm = edge.log_norm.to(model.dtype)[:, None, None, None]
    cov = [history.graph.nodes[node][None]] * (end - start)
    return _Stretch(deviation, log_norm - 0.5 * squared, cov, history.group), state


def _stepped_stretch(
    model: "MixtureKalmanFilter",
    frames: Measurements,
    history: _History,
    state: Tensor,
    span: tuple[int, int],
) -> tuple[_Stretch, Tensor]:
    matrix = model.transition(model.burn_in).matrix.to(model.dtype).mT.contiguous()
    offset = model.means[:, None, model.observed].to(model.dtype)
    deviations, likelihoods, covs = [], [], []
    for t in range(*span):
        inverse, white, log_norm = _frame_gains(model, history, t)
        state = torch.bmm(state, matrix)
        residual = frames.z[:, t] - offset - state[..., model.observed]
        if inverse.ndim == 3:
            residual = torch.bmm(residual, inverse.mT)
            state = torch.baddbmm(state, residual, white)
        else:
            residual = (inverse @ residual[..., None])[..., 0]
            state = state + (white.mT @ residual[..., None])[..., 0]
        likelihoods.append(log_norm - 0.5 * residual.square().sum(-1))
        deviations.append(state)
        targets = [history.graph.nodes[edge.target] for edge in history.edges[t]]
        covs.append(torch.stack(targets) if len(targets) > 1 else targets[0][None])
    deviation, likelihood = torch.stack(deviations, 1), torch.stack(likelihoods, 1)
    return _Stretch(deviation[:, :, :, None], likelihood[..., None], covs, history.group), state


def _frame_gains(
    model: "MixtureKalmanFilter", history: _History, t: int
) -> tuple[Tensor, Tensor, Tensor]:
    """L^-1, W and the likelihood's constant of frame t: [M, ...], or [M, B, ...] if they differ."""
    edges, dtype = history.edges[t], model.dtype
    if len(edges) == 1:
        edge = edges[0]
        log_norm = edge.log_norm[:, None].to(dtype)
        return edge.inverse_factor.to(dtype), edge.white.to(dtype), log_norm
    inverse = torch.stack([edge.inverse_factor for edge in edges], 1)[:, history.group]
    white = torch.stack([edge.white for edge in edges], 1)[:, history.group]
    log_norm = torch.stack([edge.log_norm for edge in edges], 1)[:, history.group]
    return inverse.to(dtype), white.to(dtype), log_norm.to(dtype)


def _covariances(tracks: _Stretch, means: Tensor, weights: Tensor, mean: Tensor) -> Tensor:
    positions = tracks.deviation.permute(1, 3, 2, 0, 4).flatten(0, 1) + means
    frames = []
    for t, cov in enumerate(tracks.cov):
        shared = cov[0] if cov.shape[0] == 1 else cov[tracks.group]
        frames.append(within_and_between(weights[t], positions[t], mean[t], shared))
    return torch.stack(frames)
