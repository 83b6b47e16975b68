"""Smooth fixed tracks: over the whole sequence, or with a fixed lag.

The state of a track is smoothed by Rauch-Tung-Striebel recursion, and the indicator of the tracks by the
forward-backward algorithm, on the chain whose forward pass is the filter itself. The states of different
tracks are not mixed, so this is an approximation when the indicator changes.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose._core.rows import joined
from torchpose._core.value_checks import values_visible
from torchpose.filters._lengths import inside_lengths
from torchpose.filters._measurements import Measurements
from torchpose.filters._memoryless import frame_log_likelihood
from torchpose.filters._mkf import MixtureKalmanFilter, MKFState
from torchpose.filters._outputs import (
    FilterOutput,
    Mending,
    finish_output,
    mending,
    stacked_mending,
)
from torchpose.filters._track_steps import step_tracks, weigh_tracks
from torchpose.filters._weights import WeightRule, mix_uniform, normalise, within_and_between
from torchpose.math._gaussian import mended_cholesky, symmetrise

_BUFFER_NUMBERS = 1 << 26  # numbers held for one part of the batch: half a gigabyte


class _Pass(NamedTuple):
    """Holds a forward pass, time first.

    Attributes:
        mean: filtered track means [T, B, M, D]. correction: filtered minus predicted [T, B, M, D].
        log_likelihood, log_weights: [T, B, M]. log_evidence: of the filter [T, B].
        cov, predicted_cov: per frame, [G, M, D, D]. group: per frame, row for each element [B].
        jitter: per frame, of the innovation covariances [B, M], or None.
    """

    mean: Tensor
    correction: Tensor
    log_likelihood: Tensor
    log_weights: Tensor
    log_evidence: Tensor
    cov: list[Tensor]
    predicted_cov: list[Tensor]
    group: list[Tensor]
    jitter: list[Tensor | None]


def smooth_fixed_tracks(
    model: MixtureKalmanFilter,
    rule: WeightRule,
    frames: Measurements,
    lag: int | None,
    return_cov: bool,
) -> FilterOutput:
    """Return estimates given all measurements of a sequence, or those up to `lag` frames later.

    m_t|n = m_t + C_t (m_t+1|n - m^_t+1),  C_t = P_t F^T P^_t+1^-1,
    P_t|n = P_t + C_t (P_t+1|n - P^_t+1) C_t^T                                    in each track j;
    w_t|n(j) prop. to w_t(j) beta_t(j),  beta_t(i) = sum_j T_ij N_t+1,j beta_t+1(j),  beta_n = 1,
    T_ij = ((1 - e) delta_ij + e / M) pi_j,  e = M epsilon / (1 + M epsilon)      over the tracks.

    T is the chain whose forward pass alpha_t(j) = N_tj sum_i alpha_t-1(i) T_ij gives the weights w_t of
    the filter (BL 49): its rows do not sum to one, since every step multiplies by pi. So what uses no
    later frame, a lag of 0 or the last frame, is the filter.

    Args:
        model: a filter with fixed tracks. rule: of their weights. frames: checked measurements.
        lag: number of later frames that an estimate may use, at least 0; None is all.
        return_cov: whether to return covariances.
    """
    batch, n_frames, _ = frames.z.shape
    n_tracks, dim = model.means.shape
    per_sequence = n_frames * n_tracks * dim * (3 * dim if return_cov else 4)
    part = max(1, _BUFFER_NUMBERS // per_sequence)
    outputs = []
    for first in range(0, batch, part):
        rows = slice(first, first + part)
        outputs.append(_smooth(model, rule, frames.some(rows), lag, return_cov))
    mean, log_weights, evidence, covs, work = zip(*outputs, strict=True)
    return finish_output(
        joined(mean), joined(log_weights), joined(evidence), joined(covs) if return_cov else None,
        frames.lengths, joined(work),
    )  # fmt: skip


def _smooth(
    model: MixtureKalmanFilter,
    rule: WeightRule,
    frames: Measurements,
    lag: int | None,
    return_cov: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Mending]:
    past = _forward(model, rule, frames, return_cov)
    n_frames = frames.z.shape[1]
    reach = n_frames - 1 if lag is None else min(lag, n_frames - 1)
    gains, jitters = _smoother_gains(model, past)
    later = inside_lengths(frames.lengths - 1, n_frames)
    means = past.mean + _mean_corrections(past, gains, later.mT, reach)
    log_weights = past.log_weights
    if not rule.by_frame:
        log_weights = _smoothed_weights(rule, past, later.mT, reach)
    covs = _smoothed_covs(past, gains, later, reach) if return_cov else None
    estimate = (log_weights.exp()[:, :, None] @ means)[:, :, 0]
    total = None
    if covs is not None:
        finest = past.group[-1]
        frames_of = zip(log_weights.exp(), means, estimate, covs, strict=True)
        total = torch.stack([within_and_between(w, m, e, c[finest]) for w, m, e, c in frames_of], 1)
    evidence = past.log_evidence.mT
    pairs = zip(past.jitter, jitters, strict=True)
    work = stacked_mending([mending(past.mean[0], *pair) for pair in pairs])
    return estimate.transpose(0, 1), log_weights.transpose(0, 1), evidence, total, work


def _forward(
    model: MixtureKalmanFilter, rule: WeightRule, frames: Measurements, by_length: bool
) -> _Pass:
    """Filter, and return what the backward pass needs."""
    state = model.init(frames.z.shape[0])
    if by_length and values_visible():  # unseen, every element has a history of its own
        # Smoothed covariances depend on where a sequence ends: lengths make histories distinct.
        lengths, group = torch.unique(frames.lengths, return_inverse=True)
        state = state._replace(cov=state.cov.expand(lengths.numel(), -1, -1, -1), group=group)
    means, corrections, likelihoods, weights, evidences = [], [], [], [], []
    covs, predicted_covs, groups, jitters = [], [], [], []
    for t in range(frames.z.shape[1]):
        frame = frames.frame(t)
        step = step_tracks(model, state, frame, model.transition(t))
        marginal = frame_log_likelihood(model, rule, frame.as_sequences())
        own = None if marginal is None else marginal[:, 0]
        log_weights, evidence = weigh_tracks(
            rule, state.log_weights, step.log_likelihood, own, frame
        )
        means.append(step.mean)
        corrections.append(step.mean - step.predicted)
        likelihoods.append(step.log_likelihood)
        weights.append(log_weights)
        evidences.append(evidence)
        covs.append(step.cov)
        predicted_covs.append(step.predicted_cov)
        groups.append(step.group)
        jitters.append(step.jitter)
        carried = mix_uniform(log_weights, rule.uniform_weight)
        state = MKFState(carried, step.mean, step.cov, step.group, t + 1)
    values = (means, corrections, likelihoods, weights, evidences)
    mean, correction, likelihood, weight, evidence = (torch.stack(frames) for frames in values)
    covariances = covs, predicted_covs, groups, jitters
    return _Pass(mean, correction, likelihood, weight, evidence, *covariances)


def _smoother_gains(
    model: MixtureKalmanFilter, past: _Pass
) -> tuple[list[Tensor], list[Tensor | None]]:
    """Return C_t for t = 0..T-2, in the groups of frame t+1 [G, M, D, D]; the jitter of each P^_t [B, M]."""
    gains: list[Tensor] = []
    jitters: list[Tensor | None] = [None]
    for t in range(len(past.cov) - 1):
        matrix = model.transition(t + 1).matrix
        count = len(past.predicted_cov[t + 1])
        cov = past.cov[t][_parents(past.group[t], past.group[t + 1], count)]
        factor, jitter = mended_cholesky(past.predicted_cov[t + 1])
        jitters.append(None if jitter is None else jitter[past.group[t + 1]])
        gains.append(torch.cholesky_solve(matrix @ cov, factor).mT)
    return gains, jitters


def _parents(group: Tensor, following: Tensor, count: int) -> Tensor:
    """Return the group of frame t that each of the `count` groups of frame t+1 came from."""
    parents = torch.zeros(count, dtype=torch.long, device=group.device)
    return parents.index_put((following,), group)


def _mean_corrections(past: _Pass, gains: list[Tensor], later: Tensor, reach: int) -> Tensor:
    """Return m_t|t+reach - m_t by Horner's rule: e_t = C_t (d_t+1 + e_t+1), from e = 0, [T, B, M, D].

    With a short reach all frames take each of the `reach` steps at once; when the reach is the
    whole sequence a single pass backwards over time gives the same.
    """
    n_frames = past.mean.shape[0]
    if reach >= n_frames - 1:
        totals = [torch.zeros_like(past.mean[0])]
        for t in range(n_frames - 2, -1, -1):
            step = past.correction[t + 1] + totals[-1]
            moved = _pull_back(gains[t : t + 1], past.group[t + 1 : t + 2], step[None])[0]
            totals.append(torch.where(later[t][:, None, None], moved, torch.zeros_like(moved)))
        return torch.stack(totals[::-1])
    total = torch.zeros_like(past.mean)
    for _ in range(reach):
        moved = _pull_back(gains, past.group[1:], past.correction[1:] + total[1:])
        moved = torch.where(later[:-1][..., None, None], moved, torch.zeros_like(moved))
        total = torch.cat([moved, torch.zeros_like(total[-1:])])
    return total


def _pull_back(gains: list[Tensor], groups: list[Tensor], step: Tensor) -> Tensor:
    """Return C_t step_t for each frame, [T, B, M, D]; gains are [G, M, D, D] in the groups given."""
    if all(gain.shape[0] == 1 for gain in gains):
        shared = torch.cat(gains).to(step.dtype)
        return (shared @ step.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)
    moved = [
        (gain[group].to(step.dtype) @ frame[..., None])[..., 0]
        for gain, group, frame in zip(gains, groups, step, strict=True)
    ]
    return torch.stack(moved)


def _smoothed_weights(rule: WeightRule, past: _Pass, later: Tensor, reach: int) -> Tensor:
    """Return log w_t|t+reach = log w_t + log beta_t, normalised, [T, B, M]."""
    factors = rule.log_prior + rule.power * past.log_likelihood
    n_frames = len(factors)

    def pulled(after: Tensor, is_later: Tensor) -> Tensor:
        """Return log beta_t up to a constant, from pi_j N_t+1,j beta_t+1(j)."""
        beta = mix_uniform(normalise(after), rule.uniform_weight)
        return torch.where(is_later[..., None], beta, torch.zeros_like(beta))

    if reach >= n_frames - 1:
        betas = [torch.zeros_like(factors[0])]
        for t in range(n_frames - 2, -1, -1):
            betas.append(pulled(factors[t + 1] + betas[-1], later[t]))
        return normalise(past.log_weights + torch.stack(betas[::-1]))
    beta = torch.zeros_like(factors)
    for _ in range(reach):
        beta = torch.cat([pulled(factors[1:] + beta[1:], later[:-1]), beta[-1:]])
    return normalise(past.log_weights + beta)


def _smoothed_covs(past: _Pass, gains: list[Tensor], later: Tensor, reach: int) -> list[Tensor]:
    """Return P_t|t+reach per frame, in the groups of the last frame, the finest, [G, M, D, D]."""
    n_frames = len(past.cov)
    finest = past.group[-1]
    elements = torch.arange(finest.numel(), device=finest.device)
    first = _parents(elements, finest, len(past.cov[-1]))
    at = [group[first] for group in past.group]
    filtered = [cov[rows] for cov, rows in zip(past.cov, at, strict=True)]
    predicted = [cov[rows] for cov, rows in zip(past.predicted_cov, at, strict=True)]
    smoother = [gain[rows] for gain, rows in zip(gains, at[1:], strict=True)]
    reachable = later[first]

    def pulled(t: int, following: Tensor) -> Tensor:
        change = smoother[t] @ (following - predicted[t + 1]) @ smoother[t].mT
        smoothed = symmetrise(filtered[t] + change)
        return torch.where(reachable[:, t, None, None, None], smoothed, filtered[t])

    current = list(filtered)
    if reach >= n_frames - 1:
        for t in range(n_frames - 2, -1, -1):
            current[t] = pulled(t, current[t + 1])
        return current
    for _ in range(reach):
        current = [*(pulled(t, current[t + 1]) for t in range(n_frames - 1)), filtered[-1]]
    return current
