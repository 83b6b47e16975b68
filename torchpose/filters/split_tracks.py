"""Mixture Kalman filter with split tracks (Smith & Winter, as cited in paper section 3.4)."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpose.filters.base import Measurements
from torchpose.filters.mending import mending
from torchpose.filters.outputs import StepOutput
from torchpose.filters.tracks import MKFState, estimate_of
from torchpose.filters.weights import normalise
from torchpose.math.gaussian import kalman_correct, kalman_gain, symmetrise

if TYPE_CHECKING:
    from torchpose.filters.mkf import MixtureKalmanFilter


def advance(
    model: "MixtureKalmanFilter", state: MKFState, frame: Measurements, return_cov: bool
) -> tuple[MKFState, StepOutput]:
    """Continue each of the M tracks with each of the K components; keep the M likeliest.

    Only the measured block of the M K predicted covariances is formed before the selection.
    """
    wide = torch.float64
    track_cov = state.cov[state.group]
    mean = state.mean.to(wide)
    log_joint, choice_jitter = _candidate_weights(model, state, mean, track_cov, frame)
    flat = log_joint.flatten(1)
    log_evidence = torch.logsumexp(flat, -1)
    # The first frames may have fewer candidates than tracks: the rest stays empty, at weight zero.
    spare = max(0, model.n_tracks - flat.shape[1])
    padded = torch.nn.functional.pad(flat, (0, spare), value=-torch.inf)
    kept, chosen = padded.topk(model.n_tracks, dim=1)
    chosen = torch.where(chosen < flat.shape[1], chosen, torch.zeros_like(chosen))
    log_weights = normalise(kept).to(model.dtype)
    log_evidence = torch.where(frame.mask.any(-1), log_evidence, torch.zeros_like(log_evidence))
    n_components = model.means.shape[0]
    parent, component = chosen // n_components, chosen % n_components
    mean, cov, jitter = _continue(model, state.time, mean, track_cov, parent, component, frame)
    mean = mean.to(model.dtype)
    estimate, total = estimate_of(log_weights, mean, cov if return_cov else None)
    group = torch.arange(mean.shape[0], device=mean.device)
    new_state = MKFState(log_weights, mean, cov, group, state.time + 1)
    work = mending(estimate, choice_jitter, jitter)
    log_evidence = log_evidence.to(model.dtype)
    return new_state, StepOutput(estimate, log_weights, log_evidence, total, *work)


def _candidate_weights(
    model: "MixtureKalmanFilter", state: MKFState, mean: Tensor, cov: Tensor, frame: Measurements
) -> tuple[Tensor, Tensor | None]:
    """log w_i pi_j N(z | track i continued by component j) [B, M, K], and the jitter of its S."""
    matrix, offset, noise = model.transition(state.time)
    rows = matrix[:, model.observed]
    expected = torch.einsum("kzd,bmd->bmkz", rows, mean) + offset[:, model.observed]
    block = torch.einsum("kzd,bmde->bmkze", rows, cov) @ rows.mT
    block = symmetrise(block + noise[:, model.observed][..., model.observed])
    noise_cov = frame.cov if frame.cov.ndim == 2 else frame.cov[:, None, None]
    everything = torch.arange(model.observed.numel(), device=mean.device)
    mask = frame.mask[:, None, None].expand(expected.shape)
    gain, _ = kalman_gain(block, noise_cov, everything, mask)
    z = frame.z[:, None, None].to(expected.dtype)
    _, log_likelihood = kalman_correct(expected, z, gain, everything, mask)
    log_weights = state.log_weights.to(expected.dtype)
    return log_weights[..., None] + model.log_prior + log_likelihood, gain.jitter


def _continue(
    model: "MixtureKalmanFilter",
    time: int,
    mean: Tensor,
    cov: Tensor,
    parent: Tensor,
    component: Tensor,
    frame: Measurements,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Full Kalman step of the kept tracks, and the jitter of its innovation covariances."""
    rows = torch.arange(mean.shape[0], device=mean.device)[:, None]
    matrix, offset, noise = (part[component] for part in model.transition(time))
    mean = (matrix @ mean[rows, parent][..., None])[..., 0] + offset
    cov = symmetrise(matrix @ cov[rows, parent] @ matrix.mT + noise)
    noise_cov = frame.cov if frame.cov.ndim == 2 else frame.cov[:, None]
    mask = frame.mask[:, None].expand(*mean.shape[:2], -1)
    gain, cov = kalman_gain(cov, noise_cov, model.observed, mask)
    mean, _ = kalman_correct(mean, frame.z[:, None].to(mean.dtype), gain, model.observed, mask)
    return mean, cov, gain.jitter
