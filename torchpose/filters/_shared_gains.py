"""Run fixed tracks whose gains are shared by all sequences of one history of masks.

Gains come from the graph of mask histories. Where the measurements want gradients, frames are stepped
through; else constant stretches are solved in blocks and in place. Under constant gains the means are a
linear recursion over time,

d_t = A d_{t-1} + K (z_t - H mu),  v_t = L^-1 (z_t - H mu) - L^-1 H F d_{t-1},  d = m - mu.

Within a block of n frames everything is a matrix product of the state at its start and the block's
measurements; only those starts form a sequence, n times shorter than the frames.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from torchpose.filters._gain_graph import BlockModel, History, mending_of_edges
from torchpose.filters._measurements import Measurements
from torchpose.filters._memoryless import frame_log_likelihood
from torchpose.filters._mkf import MixtureKalmanFilter
from torchpose.filters._outputs import FilterOutput, StepOutput, finish_output
from torchpose.filters._recompute import RECOMPUTED_FRAMES, recomputed
from torchpose.filters._weights import WeightRule, sequence_weights, within_and_between

_BUFFER_NUMBERS = 1 << 18  # track means held at a time: 4 MB, which stay in the cache


def run_shared(
    model: MixtureKalmanFilter,
    rule: WeightRule,
    frames: Measurements,
    history: History,
    return_cov: bool,
    progress: bool,
) -> FilterOutput:
    """Filter all frames of a batch, in place and in blocks; no gradient runs through it.

    Args:
        model: with fixed tracks. rule: of their weights. frames: all that is measured. history: of their
            masks. return_cov: whether to return covariances. progress: whether to show a progress bar.
    """
    batch, n_frames = frames.z.shape[:2]
    means, marginal = model.means.to(model.dtype), _marginal(model, rule, frames)
    carried = model.init(batch).log_weights
    # Results are written in place, time first: gathering them afterwards would copy all of them.
    estimates = means.new_empty(n_frames, batch, model.dim)
    posteriors = means.new_empty(n_frames, batch, model.n_tracks)
    evidences = means.new_empty(n_frames, batch)
    covs = means.new_empty(n_frames, batch, model.dim, model.dim) if return_cov else None
    workspace = _Workspace()
    bar = tqdm(total=n_frames, disable=not progress, unit="frame")
    done = 0
    for tracks in _stretches(model, frames, history, workspace):
        log_likelihood = tracks.log_likelihood.permute(1, 3, 2, 0).flatten(0, 1)
        span = slice(done, done + len(log_likelihood))
        own = None if marginal is None else marginal[span]
        posteriors[span], evidences[span], carried = sequence_weights(
            rule, carried, log_likelihood, own
        )
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
    model: MixtureKalmanFilter,
    rule: WeightRule,
    frames: Measurements,
    history: History,
    return_cov: bool,
    progress: bool,
) -> FilterOutput:
    """Filter all frames as `run_shared` does, up to rounding, for measurements that want gradients.

    Gains do not depend on what is measured, so nothing runs through covariances; what lies between
    states is computed anew for the gradient, some frames at a time.
    """
    batch, n_frames = frames.z.shape[:2]
    carry = _Carry(
        frames.z.new_zeros(model.n_tracks, batch, model.dim), model.init(batch).log_weights
    )
    marginal = _marginal(model, rule, frames)
    steps = []
    with tqdm(total=n_frames, disable=not progress, unit="frame") as bar:
        for start in range(0, n_frames, RECOMPUTED_FRAMES):
            span = range(start, min(start + RECOMPUTED_FRAMES, n_frames))
            arguments = model, rule, frames, history, marginal, span, return_cov
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
    """Holds the state handed from frame to frame: deviations of tracks [M, B, D] and log-weights [B, M]."""

    deviation: Tensor
    log_weights: Tensor


def _estimate(
    carry: _Carry,
    model: MixtureKalmanFilter,
    rule: WeightRule,
    frames: Measurements,
    history: History,
    marginal: Tensor | None,
    span: range,
    return_cov: bool,
) -> tuple[_Carry, StepOutput]:
    """Return the state after some frames, and their estimates, batch first."""
    tracks, deviation = _stepped_stretch(model, frames, history, carry.deviation, span)
    log_likelihood = tracks.log_likelihood.permute(1, 3, 2, 0).flatten(0, 1)
    own = None if marginal is None else marginal[span.start : span.stop]
    log_weights, evidence, carried = sequence_weights(rule, carry.log_weights, log_likelihood, own)
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


def _marginal(model: MixtureKalmanFilter, rule: WeightRule, frames: Measurements) -> Tensor | None:
    """Return log-likelihoods of the components for weights by frame, time first [T, B, M]."""
    found = frame_log_likelihood(model, rule, frames)
    return None if found is None else found.transpose(0, 1)


class _Workspace:
    """Holds the memory shared by all stretches of a run: fresh pages cost more than the products in them."""

    def __init__(self) -> None:
        self._held: dict[str, Tensor] = {}

    def take(self, name: str, shape: tuple[int, ...], like: Tensor) -> Tensor:
        """Return a tensor of this shape with arbitrary contents, valid until the name is taken again."""
        size = math.prod(shape)
        held = self._held.get(name)
        if held is None or held.numel() < size:
            held = like.new_empty(size)
            self._held[name] = held
        return held[:size].view(shape)


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
    model: MixtureKalmanFilter, frames: Measurements, history: History, workspace: _Workspace
) -> Iterator[_Stretch]:
    """Yield track means and likelihoods, a bounded stretch of frames at a time."""
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
    model: MixtureKalmanFilter,
    frames: Measurements,
    history: History,
    state: Tensor,
    span: tuple[int, int],
    workspace: _Workspace,
) -> tuple[_Stretch, Tensor]:
    start, end = span
    edge, node = history.edges[start][0], history.steady[start]
    length = _block_length(frames.z.shape[0])
    blocks = history.graph.blocks(node, model.means, length, model.dtype)
    deviation, squared, state = _scan_blocks(blocks, state, frames.z[:, start:end], workspace)
    log_norm = edge.log_norm.to(model.dtype)[:, None, None, None]
    cov = [history.graph.nodes[node][None]] * (end - start)
    return _Stretch(deviation, log_norm - 0.5 * squared, cov, history.group), state


def _scan_blocks(
    model: BlockModel,
    start: Float[Tensor, "M B D"],
    z: Float[Tensor, "B T Z"],
    workspace: _Workspace,
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


def _stepped_stretch(
    model: MixtureKalmanFilter,
    frames: Measurements,
    history: History,
    state: Tensor,
    span: range,
) -> tuple[_Stretch, Tensor]:
    matrix = model.transition(model.burn_in).matrix.to(model.dtype).mT.contiguous()
    observed = model.observed
    offset = model.means[:, None, observed].to(model.dtype)
    deviations, likelihoods, covs = [], [], []
    for t in span:
        inverse, white, log_norm = _frame_gains(model, history, t)
        state = torch.bmm(state, matrix)
        residual = frames.z[:, t] - offset - state.index_select(-1, observed)
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
    model: MixtureKalmanFilter, history: History, t: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return L^-1, W and the likelihood's constant of frame t: [M, ...], or [M, B, ...] if they differ."""
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
