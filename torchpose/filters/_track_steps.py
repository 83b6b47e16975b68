"""Step fixed tracks: the Kalman filter of every track, the weights, and the plain loop over them.

A track never changes its component, so its covariances depend only on which joints were measured:
elements whose histories of masks and noise are the same share them, and their gains.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from tqdm.auto import tqdm

from torchpose._core.value_checks import values_visible
from torchpose.filters._measurements import Measurements
from torchpose.filters._memoryless import frame_log_likelihood
from torchpose.filters._mkf import MixtureKalmanFilter, MKFState
from torchpose.filters._outputs import FilterOutput, StepOutput, collect, mending
from torchpose.filters._recompute import RECOMPUTED_FRAMES, recomputed, wants_gradient
from torchpose.filters._transition import Transition
from torchpose.filters._weights import WeightRule, estimate_of, mix_uniform, step_weights
from torchpose.math._gaussian import Gain, kalman_correct, kalman_gain, symmetrise


class TrackStep(NamedTuple):
    """Holds all tracks after one step, before their weights.

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


def step_tracks(
    model: MixtureKalmanFilter, state: MKFState, frame: Measurements, transition: Transition
) -> TrackStep:
    """Predict and correct every track (BL 34-41)."""
    matrix, offset, noise = transition
    cov, group, mask, noise_cov = _distinct_histories(state, frame)
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


def weigh_tracks(
    rule: WeightRule,
    log_weights: Tensor,
    log_likelihood: Tensor,
    log_marginal: Tensor | None,
    frame: Measurements,
) -> tuple[Tensor, Tensor]:
    """Return log-weights of the estimate [B, M], and log-evidence, 0 where nothing is measured [B].

    Args:
        rule, log_weights, log_likelihood, log_marginal: as `step_weights`. frame: its measurements.
    """
    log_weights, log_evidence = step_weights(rule, log_weights, log_likelihood, log_marginal)
    measured = frame.mask.any(-1)
    return log_weights, torch.where(measured, log_evidence, torch.zeros_like(log_evidence))


def step_estimate(
    model: MixtureKalmanFilter,
    rule: WeightRule,
    state: MKFState,
    frame: Measurements,
    transition: Transition,
    log_marginal: Tensor | None,
    return_cov: bool,
) -> tuple[MKFState, StepOutput]:
    """Return the state after one frame, and its estimate (BL 34-41, 48-49).

    Args:
        transition: into this frame. log_marginal: of this frame [B, M], for weights by frame.
    """
    step = step_tracks(model, state, frame, transition)
    log_weights, log_evidence = weigh_tracks(
        rule, state.log_weights, step.log_likelihood, log_marginal, frame
    )
    covs = step.cov[step.group] if return_cov else None
    estimate, total = estimate_of(log_weights, step.mean, covs)
    carried = mix_uniform(log_weights, rule.uniform_weight)
    new_state = MKFState(carried, step.mean, step.cov, step.group, state.time + 1)
    work = mending(estimate, step.jitter)
    return new_state, StepOutput(estimate, log_weights, log_evidence, total, *work)


def run_steps(
    model: MixtureKalmanFilter,
    rule: WeightRule,
    frames: Measurements,
    return_cov: bool,
    progress: bool,
) -> FilterOutput:
    """Filter all frames one after the other; for gradients, some are computed anew at a time."""
    batch, n_frames = frames.z.shape[:2]
    # What all frames share, here: it is not among what a gradient computes anew for some of them.
    steady = model.transition(model.burn_in)
    marginal = frame_log_likelihood(model, rule, frames)
    learning = wants_gradient(frames.z, frames.cov, *model.sources)
    state, steps = model.init(batch), []
    with tqdm(total=n_frames, disable=not progress, unit="frame") as bar:
        for start in range(0, n_frames, RECOMPUTED_FRAMES):
            span = range(start, min(start + RECOMPUTED_FRAMES, n_frames))
            arguments = model, rule, state, frames, steady, marginal, span, return_cov
            state, some = (
                recomputed(_some_steps, *arguments) if learning else _some_steps(*arguments)
            )
            steps += some
            bar.update(len(span))
    return collect(steps, frames.lengths)


def _some_steps(
    model: MixtureKalmanFilter,
    rule: WeightRule,
    state: MKFState,
    frames: Measurements,
    steady: Transition,
    marginal: Tensor | None,
    span: range,
    return_cov: bool,
) -> tuple[MKFState, list[StepOutput]]:
    steps = []
    for t in span:
        transition = steady if t >= model.burn_in else model.transition(t)
        own = None if marginal is None else marginal[:, t]
        frame = frames.frame(t)
        state, out = step_estimate(model, rule, state, frame, transition, own, return_cov)
        steps.append(out)
    return state, steps


def _correct_shared(
    model: MixtureKalmanFilter,
    mean: Tensor,
    moving: tuple[Tensor, Tensor],
    gain: Gain,
    frame: Measurements,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return predicted and corrected means and likelihoods of elements that share one gain."""
    matrix, offset = moving
    predicted = torch.baddbmm(offset[:, None], mean.transpose(0, 1), matrix.mT)
    residual = frame.z - predicted.index_select(-1, model.observed)
    residual = torch.where(frame.mask[0], residual, torch.zeros_like(residual))
    white = torch.linalg.solve_triangular(gain.factor[0], residual.mT, upper=False)
    corrected = torch.baddbmm(predicted, white.mT, gain.white[0])
    log_likelihood = gain.log_norm[0] - 0.5 * white.square().sum(1).mT
    return predicted.transpose(0, 1), corrected.transpose(0, 1), log_likelihood


def _distinct_histories(
    state: MKFState, frame: Measurements
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return covariances, groups, masks and noise of the distinct histories of this frame."""
    if frame.cov.ndim == 3 or not values_visible():
        own = torch.arange(frame.z.shape[0], device=frame.z.device)
        noise = frame.cov if frame.cov.ndim == 2 else frame.cov[:, None]
        return state.cov[state.group], own, frame.mask[:, None], noise
    if state.cov.shape[0] == 1 and bool((frame.mask == frame.mask[:1]).all()):
        return state.cov, state.group, frame.mask[:1, None], frame.cov
    bits = 2 ** torch.arange(frame.mask.shape[1], device=frame.mask.device)
    code = state.group * 2 ** frame.mask.shape[1] + (frame.mask * bits).sum(-1)
    _, group = torch.unique(code, return_inverse=True)
    n_groups = int(group.max()) + 1
    first = torch.zeros(n_groups, dtype=torch.long, device=group.device)
    first[group] = torch.arange(group.numel(), device=group.device)
    return state.cov[state.group[first]], group, frame.mask[first, None], frame.cov
