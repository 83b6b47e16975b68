"""Mixture Kalman filter with sampled indicators (BL 43-48)."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpose._core.value_checks import values_visible
from torchpose.filters.base import Generators, Measurements, uniform
from torchpose.filters.mending import mending
from torchpose.filters.outputs import StepOutput, effective_sample_size
from torchpose.filters.resampling import systematic
from torchpose.filters.tracks import MKFState, estimate_of
from torchpose.filters.weights import normalise
from torchpose.math.gaussian import kalman_predict, mended_update

if TYPE_CHECKING:
    from torchpose.filters.mkf import MixtureKalmanFilter


def init(model: "MixtureKalmanFilter", batch: int, generator: Generators) -> MKFState:
    """M tracks with components drawn from pi, at their means."""
    drawn = _draw_components(model, batch, generator)
    log_weights = torch.zeros(drawn.shape, dtype=model.dtype, device=drawn.device)
    group = torch.arange(batch, device=drawn.device)
    mean, cov = model.means.to(model.dtype)[drawn], model.start_cov[drawn]
    return MKFState(normalise(log_weights), mean, cov, group, 0)


def advance(
    model: "MixtureKalmanFilter",
    state: MKFState,
    frame: Measurements,
    generator: Generators,
    return_cov: bool,
) -> tuple[MKFState, StepOutput]:
    """Draw an indicator for each track, filter, weight (BL 47), and resample if needed (BL 25)."""
    drawn = _draw_components(model, frame.z.shape[0], generator)
    matrix, offset, noise = (part[drawn] for part in model.transition(state.time))
    wide = torch.float64
    mean, cov = kalman_predict(state.mean.to(wide), state.cov, matrix, offset, noise)
    noise_cov = frame.cov if frame.cov.ndim == 2 else frame.cov[:, None]
    mask = frame.mask[:, None].expand(*mean.shape[:2], -1)
    mean, cov, log_likelihood, jitter = mended_update(
        mean, cov, frame.z[:, None].to(wide), noise_cov, model.observed, mask
    )
    mean = mean.to(model.dtype)
    joint = state.log_weights + log_likelihood.to(model.dtype)
    log_evidence = torch.logsumexp(joint, -1)
    log_weights = joint - log_evidence[:, None]
    log_evidence = torch.where(frame.mask.any(-1), log_evidence, torch.zeros_like(log_evidence))
    estimate, total = estimate_of(log_weights, mean, cov if return_cov else None)
    carried = _resample(model, log_weights, mean, cov, generator)
    group = torch.arange(frame.z.shape[0], device=mean.device)
    return (
        MKFState(*carried, group, state.time + 1),
        StepOutput(estimate, log_weights, log_evidence, total, *mending(estimate, jitter)),
    )


def _draw_components(model: "MixtureKalmanFilter", batch: int, generator: Generators) -> Tensor:
    cumulative = model.log_prior.exp().cumsum(0)
    draws = uniform(batch, (model.n_tracks,), generator, cumulative)
    return torch.searchsorted(cumulative, draws).clamp_max(cumulative.numel() - 1)


def _resample(
    model: "MixtureKalmanFilter",
    log_weights: Tensor,
    mean: Tensor,
    cov: Tensor,
    generator: Generators,
) -> tuple[Tensor, Tensor, Tensor]:
    """Resampled tracks with equal weights, for the elements that need it; all of them draw."""
    resampled = systematic(log_weights, generator)
    needed = effective_sample_size(log_weights) < model.resample_threshold * model.n_tracks
    if values_visible() and not bool(needed.any()):
        return log_weights, mean, cov
    own = torch.arange(model.n_tracks, device=mean.device)
    index = torch.where(needed[:, None], resampled, own)
    rows = torch.arange(index.shape[0], device=mean.device)[:, None]
    equal = normalise(torch.zeros_like(log_weights))
    log_weights = torch.where(needed[:, None], equal, log_weights)
    return log_weights, mean[rows, index], cov[rows, index]
