"""Fixed tracks whose gains are shared by all sequences of one history of masks.

Gains come from a graph of mask histories. Constant stretches are solved in blocks and in place; where
the measurements want gradients, step by step.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor
from tqdm.auto import tqdm

from torchpose.filters.base import Measurements
from torchpose.filters.frame_weights import frame_log_likelihood, frame_weights
from torchpose.filters.gains import MAX_EDGES, Edge, GainGraph
from torchpose.filters.mending import mending_of_edges
from torchpose.filters.outputs import FilterOutput, StepOutput, finish_output
from torchpose.filters.recompute import recomputed
from torchpose.filters.scan import Workspace, scan_blocks
from torchpose.filters.tracks import within_and_between
from torchpose.filters.weights import sequence_weights

if TYPE_CHECKING:
    from torchpose.filters.mkf import MixtureKalmanFilter

__all__ = ["RECOMPUTED_FRAMES", "History", "find_history", "run_for_gradients", "run_shared"]

RECOMPUTED_FRAMES = 16
"""Frames at a time that are computed anew for gradients."""

_BUFFER_NUMBERS = 1 << 18  # track means held at a time: 4 MB, which stay in the cache


class History(NamedTuple):
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


def find_history(model: "MixtureKalmanFilter", frames: Measurements) -> History | None:
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
    return History(graph, edges, steady, group)


def _patterns(frames: Measurements) -> Tensor:
    """The measured dimensions as bits [B, T]; finished sequences share those of the longest."""
    n_frames, n_obs = frames.z.shape[1:]
    bits = 2 ** torch.arange(n_obs, device=frames.z.device)
    patterns = (frames.mask * bits).sum(-1)
    over = torch.arange(n_frames, device=frames.z.device) >= frames.lengths[:, None]
    return torch.where(over, patterns[frames.lengths.argmax()], patterns)


def run_shared(
    model: "MixtureKalmanFilter",
    frames: Measurements,
    history: History,
    return_cov: bool,
    progress: bool,
) -> FilterOutput:
    """All frames of a batch, in place and in blocks; no gradient runs through it."""
    batch, n_frames = frames.z.shape[:2]
    means, marginal = model.means.to(model.dtype), _marginal(model, frames)
    carried = model.init(batch).log_weights
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
        own = None if marginal is None else marginal[span]
        posteriors[span], evidences[span], carried = _weigh(model, own, carried, log_likelihood)
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


def run_for_gradients(
    model: "MixtureKalmanFilter",
    frames: Measurements,
    history: History,
    return_cov: bool,
    progress: bool,
) -> FilterOutput:
    """`run_shared` for measurements that want gradients, up to rounding.

    Gains do not depend on what is measured, so nothing runs through covariances; what lies between
    states is computed anew for the gradient, some frames at a time.
    """
    batch, n_frames = frames.z.shape[:2]
    carry = _Carry(
        frames.z.new_zeros(model.n_tracks, batch, model.dim), model.init(batch).log_weights
    )
    marginal = _marginal(model, frames)
    steps = []
    with tqdm(total=n_frames, disable=not progress, unit="frame") as bar:
        for start in range(0, n_frames, RECOMPUTED_FRAMES):
            span = range(start, min(start + RECOMPUTED_FRAMES, n_frames))
            arguments = model, frames, history, marginal, span, return_cov
            carry, step = recomputed(_estimate, carry, *arguments)
            steps.append(step)
            bar.update(len(span))
    mean = torch.cat([step.mean for step in steps], 1)
    log_weights = torch.cat([step.log_weights for step in steps], 1)
    evidence = torch.cat([step.log_evidence for step in steps], 1)
    covs = [step.cov for step in steps if step.cov is not None]
    cov = torch.cat(covs, 1) if covs else None
    work = mending_of_edges(history.edges, history.group)
    return finish_output(mean, log_weights, evidence, cov, frames.lengths, work)


class _Carry(NamedTuple):
    """What a frame leaves to the next: deviations of tracks [M, B, D] and log-weights [B, M]."""

    deviation: Tensor
    log_weights: Tensor


def _estimate(
    carry: _Carry,
    model: "MixtureKalmanFilter",
    frames: Measurements,
    history: History,
    marginal: Tensor | None,
    span: range,
    return_cov: bool,
) -> tuple[_Carry, StepOutput]:
    """Estimates of some frames, batch first."""
    tracks, deviation = _stepped_stretch(model, frames, history, carry.deviation, span)
    log_likelihood = tracks.log_likelihood.permute(1, 3, 2, 0).flatten(0, 1)
    own = None if marginal is None else marginal[span.start : span.stop]
    log_weights, evidence, carried = _weigh(model, own, carry.log_weights, log_likelihood)
    means, mixed = model.means.to(model.dtype), log_weights.exp()
    centred = (mixed[..., None, :] @ tracks.deviation.permute(1, 3, 2, 0, 4).flatten(0, 1))[
        ..., 0, :
    ]
    mean = centred + mixed @ means
    measured = frames.mask[:, span.start : span.stop].any(-1)
    evidence = torch.where(measured, evidence.mT, torch.zeros_like(evidence.mT))
    cov = _covariances(tracks, means, mixed, mean).transpose(0, 1) if return_cov else None
    step = StepOutput(mean.transpose(0, 1), log_weights.transpose(0, 1), evidence, cov)
    return _Carry(deviation, carried), step


def _marginal(model: "MixtureKalmanFilter", frames: Measurements) -> Tensor | None:
    """For weights by frame, log-likelihoods of the components, time first [T, B, M]."""
    if model.weighting != "frame":
        return None
    return frame_log_likelihood(model, frames).transpose(0, 1)


def _weigh(
    model: "MixtureKalmanFilter", marginal: Tensor | None, carried: Tensor, log_likelihood: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Log-weights and log-evidence of frames that come next, and the log-weights to go on from.

    Args:
        marginal: of these frames [T, B, M], for weights by frame. carried: log-weights [B, M].
        log_likelihood: of the tracks [T, B, M].
    """
    log_prior, power = model.log_prior.to(model.dtype), model.likelihood_power
    if marginal is not None:
        return *frame_weights(log_prior, marginal, log_likelihood, power), carried
    return sequence_weights(
        carried, log_prior, log_likelihood, model.uniform_weight, power, model.reset_below
    )


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
    model: "MixtureKalmanFilter", frames: Measurements, history: History, workspace: Workspace
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
            stretch, state = _stepped_stretch(model, frames, history, state, range(t, end))
        yield stretch
        t = end


def _block_length(batch: int) -> int:
    # Longer blocks cost arithmetic and save calls; with many sequences the calls matter less.
    return 8 if batch <= 8 else 4


def _block_stretch(
    model: "MixtureKalmanFilter",
    frames: Measurements,
    history: History,
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
    history: History,
    state: Tensor,
    span: range,
) -> tuple[_Stretch, Tensor]:
    matrix = model.transition(model.burn_in).matrix.to(model.dtype).mT.contiguous()
    offset = model.means[:, None, model.observed].to(model.dtype)
    deviations, likelihoods, covs = [], [], []
    for t in span:
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
    model: "MixtureKalmanFilter", history: History, t: int
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
