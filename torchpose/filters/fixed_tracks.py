"""Mixture Kalman filter with fixed tracks: one step, and whole batches of sequences.

A track never changes its component, so its covariances depend only on which joints were measured.
`run` shares the gains of all sequences with one history of masks, and falls back to the plain recursion
for noise that changes in each frame, for burn-in, and where gradients of model or noise are wanted.
"""

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor
from tqdm.auto import tqdm

from torchpose._core.value_checks import values_visible
from torchpose.filters.base import Measurements
from torchpose.filters.columns import run_columns, suits_columns
from torchpose.filters.frame_weights import (
    advance_memoryless,
    frame_log_likelihood,
    frame_weights,
    run_memoryless,
)
from torchpose.filters.mending import mending
from torchpose.filters.outputs import FilterOutput, StepOutput, collect
from torchpose.filters.recompute import recomputed, wants_gradient
from torchpose.filters.shared_gains import (
    RECOMPUTED_FRAMES,
    find_history,
    run_for_gradients,
    run_shared,
)
from torchpose.filters.tracks import MKFState, estimate_of
from torchpose.filters.transition import Transition
from torchpose.filters.weights import mix_uniform, step_weights
from torchpose.math.gaussian import Gain, kalman_correct, kalman_gain, symmetrise

if TYPE_CHECKING:
    from torchpose.filters.mkf import MixtureKalmanFilter


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


def step_tracks(
    model: "MixtureKalmanFilter", state: MKFState, frame: Measurements, transition: Transition
) -> TrackStep:
    """Predict and correct every track (BL 34-41); elements of one history share their gains."""
    matrix, offset, noise = transition
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
    marginal = None
    if model.weighting == "frame":
        marginal = frame_log_likelihood(model, frame.as_sequences())[:, 0]
    return _weigh(model, state.log_weights, log_likelihood, marginal, frame)


def _weigh(
    model: "MixtureKalmanFilter",
    log_weights: Tensor,
    log_likelihood: Tensor,
    marginal: Tensor | None,
    frame: Measurements,
) -> tuple[Tensor, Tensor]:
    log_prior, power = model.log_prior.to(model.dtype), model.likelihood_power
    if marginal is not None:
        log_weights, log_evidence = frame_weights(log_prior, marginal, log_likelihood, power)
    else:
        log_weights, log_evidence = step_weights(
            log_weights, log_prior, log_likelihood, power, model.reset_below
        )
    measured = frame.mask.any(-1)
    return log_weights, torch.where(measured, log_evidence, torch.zeros_like(log_evidence))


def advance(
    model: "MixtureKalmanFilter", state: MKFState, frame: Measurements, return_cov: bool
) -> tuple[MKFState, StepOutput]:
    """One step (BL 34-41, 48-49)."""
    if not values_visible():
        return _advance_unseen(model, state, frame, return_cov)
    if model.is_memoryless:
        return advance_memoryless(model, state, frame, return_cov)
    return _advance_tracks(model, state, frame, return_cov)


def _advance_unseen(
    model: "MixtureKalmanFilter", state: MKFState, frame: Measurements, return_cov: bool
) -> tuple[MKFState, StepOutput]:
    """One step while nobody may look whether the rate is 0; without medians it makes no difference."""
    new_state, out = _advance_tracks(model, state, frame, return_cov)
    if model.gamma is None or not len(model.medians) or not model.weighs_frames_alone:
        return new_state, out
    _, alone = advance_memoryless(model, state, frame, return_cov)
    still = (model.gamma == 0).all()
    pairs = zip(alone, out, strict=True)
    chosen = (a if a is None or b is None else torch.where(still, a, b) for a, b in pairs)
    return new_state, StepOutput(*chosen)  # type: ignore[arg-type]


def _advance_tracks(
    model: "MixtureKalmanFilter", state: MKFState, frame: Measurements, return_cov: bool
) -> tuple[MKFState, StepOutput]:
    step = step_tracks(model, state, frame, model.transition(state.time))
    weights = step_fixed_weights(model, state, step.log_likelihood, frame)
    return _estimate(model, state, step, *weights, return_cov)


def _estimate(
    model: "MixtureKalmanFilter",
    state: MKFState,
    step: TrackStep,
    log_weights: Tensor,
    log_evidence: Tensor,
    return_cov: bool,
) -> tuple[MKFState, StepOutput]:
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


def run(
    model: "MixtureKalmanFilter", frames: Measurements, return_cov: bool, progress: bool
) -> FilterOutput:
    """All frames of a batch."""
    if model.is_memoryless:
        return run_memoryless(model, frames, return_cov, progress)
    model_learns = wants_gradient(frames.cov, *model.sources)
    if model_learns or frames.cov.ndim == 4 or model.burn_in > 0:
        return _run_steps(model, frames, return_cov, progress)
    history = find_history(model, frames)
    if history is None:
        return _run_steps(model, frames, return_cov, progress)
    if wants_gradient(frames.z):
        return run_for_gradients(model, frames, history, return_cov, progress)
    shared = all(len(edges) == 1 for edges in history.edges)
    if not return_cov and suits_columns(model, frames, shared):
        return run_columns(model, frames, [edges[0] for edges in history.edges], progress)
    return run_shared(model, frames, history, return_cov, progress)


def _run_steps(
    model: "MixtureKalmanFilter", frames: Measurements, return_cov: bool, progress: bool
) -> FilterOutput:
    """All frames one after the other; for gradients, some are computed anew at a time."""
    batch, n_frames = frames.z.shape[:2]
    # What all frames share, here: it is not among what a gradient computes anew for some of them.
    steady = model.transition(model.burn_in)
    marginal = frame_log_likelihood(model, frames) if model.weighting == "frame" else None
    learning = wants_gradient(frames.z, frames.cov, *model.sources)
    state, steps = model.init(batch), []
    with tqdm(total=n_frames, disable=not progress, unit="frame") as bar:
        for start in range(0, n_frames, RECOMPUTED_FRAMES):
            span = range(start, min(start + RECOMPUTED_FRAMES, n_frames))
            arguments = model, state, frames, steady, marginal, span, return_cov
            state, some = (
                recomputed(_some_steps, *arguments) if learning else _some_steps(*arguments)
            )
            steps += some
            bar.update(len(span))
    return collect(steps, frames.lengths)


def _some_steps(
    model: "MixtureKalmanFilter",
    state: MKFState,
    frames: Measurements,
    steady: Transition,
    marginal: Tensor | None,
    span: range,
    return_cov: bool,
) -> tuple[MKFState, list[StepOutput]]:
    steps = []
    for t in span:
        frame = frames.frame(t)
        transition = steady if t >= model.burn_in else model.transition(t)
        step = step_tracks(model, state, frame, transition)
        own = None if marginal is None else marginal[:, t]
        weights = _weigh(model, state.log_weights, step.log_likelihood, own, frame)
        state, out = _estimate(model, state, step, *weights, return_cov)
        steps.append(out)
    return state, steps
