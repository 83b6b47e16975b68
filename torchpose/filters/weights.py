"""Weights and evidence of fixed tracks, one step at a time or a whole sequence at once."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.math.gaussian import least_exponent

__all__ = [
    "indicator_mixing",
    "mix_uniform",
    "normalise",
    "sequence_weights",
    "step_weights",
    "steps_between_rescaling",
]


def normalise(log_weights: Float[Tensor, "*batch M"]) -> Float[Tensor, "*batch M"]:
    """Log-weights whose exponentials sum to one."""
    return log_weights - torch.logsumexp(log_weights, -1, keepdim=True)


def mix_uniform(
    log_weights: Float[Tensor, "*batch M"], epsilon: float
) -> Float[Tensor, "*batch M"]:
    """w <- (w + epsilon) / (1 + M epsilon), in logarithms (paper, after BL 49)."""
    if epsilon == 0:
        return log_weights
    total = 1 + log_weights.shape[-1] * epsilon
    floor = torch.full_like(log_weights, math.log(epsilon / total))
    return torch.logaddexp(log_weights - math.log(total), floor)


def step_weights(
    log_weights: Float[Tensor, "*batch M"],
    log_prior: Float[Tensor, " M"],
    log_likelihood: Float[Tensor, "*batch M"],
    power: float = 1.0,
    reset_below: float | None = None,
) -> tuple[Float[Tensor, "*batch M"], Float[Tensor, "*batch"]]:
    """One update of the track weights (BL 49).

    a_j prop. to pi_j w_{t-1,j}, normalised before the likelihood;
    log p(z_t | z_1:t-1) = logsumexp_j(log a_j + log N_j);   w_j prop. to a_j N_j^power.

    Args:
        log_weights: log w_{t-1}, epsilon already mixed in. log_prior: log pi.
        log_likelihood: log N_j. power: exponent of the likelihood in the weights, 1 as published.
        reset_below: weights go back to pi where logsumexp(log pi_j + log w_j + log N_j) is below
            this, as in the authors' released code, whose linear weights then are all zero.

    Returns:
        log w_t, normalised [..., M], and the increment of the log-evidence [...].
    """
    predicted = normalise(log_weights + log_prior)
    new, log_evidence = _posterior(predicted, log_likelihood, power)
    if reset_below is not None:
        mass = torch.logsumexp(log_weights + log_prior + log_likelihood, -1, keepdim=True)
        new = torch.where(mass < reset_below, normalise(log_prior).expand_as(new), new)
    return new, log_evidence


def _posterior(predicted: Tensor, log_likelihood: Tensor, power: float) -> tuple[Tensor, Tensor]:
    """Normalised log-weights and log-evidence from predicted log-weights."""
    joint = predicted + log_likelihood
    log_evidence = torch.logsumexp(joint, -1)
    if power == 1:
        return joint - log_evidence[..., None], log_evidence
    return normalise(predicted + power * log_likelihood), log_evidence


def sequence_weights(
    log_weights: Float[Tensor, "B M"],
    log_prior: Float[Tensor, " M"],
    log_likelihood: Float[Tensor, "T B M"],
    epsilon: float,
    power: float = 1.0,
    reset_below: float | None = None,
) -> tuple[Float[Tensor, "T B M"], Float[Tensor, "T B"], Float[Tensor, "B M"]]:
    """`step_weights` over T frames, time first.

    Without epsilon the weights are a cumulative sum. With it they are a linear recursion,
    alpha_t = N_t pi (c_1 alpha_{t-1} + c_2 sum alpha_{t-1}), which runs on scaled linear numbers:
    epsilon keeps every predicted weight above c_2 pi_j, so nothing is lost to underflow.

    Returns:
        log w_t before epsilon [T, B, M], log-evidence increments [T, B], and the log-weights that
        the next frame starts from, with epsilon [B, M].
    """
    differentiable = torch.is_grad_enabled() and (
        log_likelihood.requires_grad or log_prior.requires_grad or log_weights.requires_grad
    )
    safe = epsilon == 0 or steps_between_rescaling(log_prior, epsilon) >= 1
    if differentiable or reset_below is not None or not safe:
        return _stepwise(log_weights, log_prior, log_likelihood, epsilon, power, reset_below)
    if epsilon == 0:
        predicted = _cumulative(log_weights, log_prior, power * log_likelihood)
    else:
        predicted = _scaled_linear(log_weights, log_prior, power * log_likelihood, epsilon)
    estimate, evidence = _posterior(predicted, log_likelihood, power)
    return estimate, evidence, mix_uniform(estimate[-1], epsilon)


def _stepwise(
    log_weights: Tensor,
    log_prior: Tensor,
    log_likelihood: Tensor,
    epsilon: float,
    power: float,
    reset_below: float | None,
) -> tuple[Tensor, Tensor, Tensor]:
    estimates, evidences = [], []
    for frame in log_likelihood:
        estimate, evidence = step_weights(log_weights, log_prior, frame, power, reset_below)
        estimates.append(estimate)
        evidences.append(evidence)
        log_weights = mix_uniform(estimate, epsilon)
    return torch.stack(estimates), torch.stack(evidences), log_weights


def _cumulative(log_weights: Tensor, log_prior: Tensor, log_likelihood: Tensor) -> Tensor:
    """Predicted log-weights log a_t without epsilon."""
    joint = (log_prior + log_likelihood).cumsum(0) + log_weights
    return normalise(joint - log_likelihood)


def steps_between_rescaling(log_prior: Float[Tensor, " M"], epsilon: float) -> int:
    """How many steps the linear recursion may go without rescaling, in the range of its dtype."""
    share = epsilon / (1 + log_prior.numel() * epsilon)
    smallest = math.log(share) + float(log_prior.detach().min())
    room = -0.85 * math.log(torch.finfo(log_prior.dtype).tiny)
    return int(min(32, room // max(-smallest, 1e-9)))


def indicator_mixing(log_prior: Float[Tensor, " M"], epsilon: float) -> Float[Tensor, "M M"]:
    """C_ij = ((1 - e) delta_ij + e / M) pi_j, e = M epsilon / (1 + M epsilon).

    alpha C is the predicted weight, up to a factor, of weights alpha before epsilon.
    """
    n_tracks = log_prior.numel()
    total = 1 + n_tracks * epsilon
    kind = {"dtype": log_prior.dtype, "device": log_prior.device}
    mixing = torch.full((n_tracks, n_tracks), epsilon / total, **kind)
    mixing.diagonal().add_(1 / total)
    return mixing * log_prior.exp()


def _scaled_linear(
    log_weights: Tensor, log_prior: Tensor, log_likelihood: Tensor, epsilon: float
) -> Tensor:
    """Predicted log-weights log a_t with epsilon."""
    top = log_likelihood.amax(-1, keepdim=True)
    likelihood = (log_likelihood - top).clamp_min_(least_exponent(log_likelihood.dtype)).exp_()
    prior = log_prior.exp()
    transition = indicator_mixing(log_prior, epsilon)
    predicted = torch.empty_like(log_likelihood)
    alpha = log_weights.exp()
    every = steps_between_rescaling(log_prior, epsilon)
    for t, (now, frame) in enumerate(zip(predicted.unbind(), likelihood.unbind(), strict=True)):
        if t:
            torch.mm(alpha, transition, out=now)
        else:
            torch.mul(alpha, prior, out=now)
        alpha = now * frame
        if t % every == every - 1:
            alpha /= alpha.sum(-1, keepdim=True)
    return normalise(predicted.log_())
