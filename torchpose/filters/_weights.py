"""Weigh tracks, and compute their joint estimate and the evidence.

Fixed tracks are weighted by the sequence (BL 49), one step at a time or all of it at once, or by every
frame alone.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.math._gaussian import least_exponent


class WeightRule(NamedTuple):
    """Holds the settings of the weights of fixed tracks.

    Attributes:
        log_prior: log pi [M], in the dtype of the weights.
        uniform_weight: epsilon, mixed in after every step; see `mix_uniform`.
        power: exponent of the likelihood in the weights; 1 as published.
        reset_below: weights go back to pi where logsumexp_j(log pi_j + log w_j + log N_j) is below this,
            as in the authors' released code, whose linear weights are then all zero. None is never.
        by_frame: whether the weights of a frame are those that its measurement gives alone.
    """

    log_prior: Tensor
    uniform_weight: float
    power: float
    reset_below: float | None
    by_frame: bool


def normalise(log_weights: Float[Tensor, "*batch M"]) -> Float[Tensor, "*batch M"]:
    """Return log-weights whose exponentials sum to one."""
    return log_weights - torch.logsumexp(log_weights, -1, keepdim=True)


def mix_uniform(
    log_weights: Float[Tensor, "*batch M"], epsilon: float
) -> Float[Tensor, "*batch M"]:
    """Return (w + epsilon) / (1 + M epsilon), in logarithms (paper, after BL 49)."""
    if epsilon == 0:
        return log_weights
    total = 1 + log_weights.shape[-1] * epsilon
    floor = torch.full_like(log_weights, math.log(epsilon / total))
    return torch.logaddexp(log_weights - math.log(total), floor)


def estimate_of(
    log_weights: Float[Tensor, "B M"], mean: Float[Tensor, "B M D"], cov: Tensor | None
) -> tuple[Float[Tensor, "B D"], Tensor | None]:
    """Return the weighted mean (BL 48), and the covariance of the mixture if `cov` is given.

    Args:
        log_weights: normalised. mean: of the tracks. cov: of the tracks, as in `within_and_between`.
    """
    weights = log_weights.exp()
    estimate = (weights[:, None, :] @ mean)[:, 0]
    if cov is None:
        return estimate, None
    return estimate, within_and_between(weights, mean, estimate, cov)


def within_and_between(weights: Tensor, mean: Tensor, estimate: Tensor, cov: Tensor) -> Tensor:
    """Return the covariance of a mixture, sum_j w_j (P_j + (m_j - m)(m_j - m)^T), [B, D, D].

    Args:
        weights: w [B, M]. mean: m_j [B, M, D]. estimate: m [B, D]. cov: P [M, D, D] or [B, M, D, D].
    """
    own = cov.ndim > mean.ndim
    within = mixed(weights[:, None], cov)[:, 0] if own else mixed(weights, cov)
    return within + between(weights, mean, estimate)


def mixed(weights: Float[Tensor, "*batch N M"], covs: Tensor) -> Tensor:
    """Return sum_j w_j P_j, [*batch, N, ...], of whole covariances or those of points, [*batch, M, ...]."""
    first = weights.ndim - 1
    return (weights @ covs.flatten(first).to(weights)).unflatten(-1, covs.shape[first:])


def between(
    weights: Float[Tensor, "*batch M"],
    mean: Float[Tensor, "*batch M D"],
    estimate: Float[Tensor, "*batch D"],
) -> Float[Tensor, "*batch D D"]:
    """Return sum_j w_j (m_j - m)(m_j - m)^T; see `within_and_between`."""
    spread = (mean - estimate[..., None, :]) * weights[..., None].sqrt()
    return spread.mT @ spread


def step_weights(
    rule: WeightRule,
    log_weights: Float[Tensor, "*batch M"],
    log_likelihood: Float[Tensor, "*batch M"],
    log_marginal: Float[Tensor, "*batch M"] | None = None,
) -> tuple[Float[Tensor, "*batch M"], Float[Tensor, "*batch"]]:
    """Return the track weights after one step (BL 49), and the increment of the log-evidence.

    a_j prop. to pi_j w_{t-1,j}, normalised before the likelihood;
    log p(z_t | z_1:t-1) = logsumexp_j(log a_j + log N_j);   w_j prop. to a_j N_j^power.

    Args:
        rule: settings of the weights. log_weights: log w_{t-1}, epsilon already mixed in.
        log_likelihood: log N_j of the tracks' predictions (BL 41). log_marginal: for weights by frame,
            which are those of `frame_weights`.

    Returns:
        log w_t, normalised [..., M], and the increment of the log-evidence [...].
    """
    if log_marginal is not None:
        return frame_weights(rule, log_marginal, log_likelihood)
    joint = log_weights + rule.log_prior
    new, log_evidence = _posterior(normalise(joint), log_likelihood, rule.power)
    if rule.reset_below is not None:
        mass = torch.logsumexp(joint + log_likelihood, -1, keepdim=True)
        new = torch.where(mass < rule.reset_below, normalise(rule.log_prior).expand_as(new), new)
    return new, log_evidence


def frame_weights(
    rule: WeightRule,
    log_marginal: Float[Tensor, "*batch M"],
    log_likelihood: Float[Tensor, "*batch M"],
) -> tuple[Float[Tensor, "*batch M"], Float[Tensor, "*batch"]]:
    """Return the weights that frames give alone, and sum_j pi_j N_j as evidence.

    w_j prop. to pi_j N(z_t; H mu_j, H Sigma_j H^T + R)^power

    Args:
        rule: settings of the weights. log_marginal: log N(z_t; H mu_j, H Sigma_j H^T + R).
        log_likelihood: log N_j of the tracks' predictions (BL 41).

    Returns:
        log w_t, normalised [..., M], and the increment of the log-evidence [...].
    """
    log_prior = normalise(rule.log_prior)
    evidence = torch.logsumexp(log_prior + log_likelihood, -1)
    return normalise(log_prior + rule.power * log_marginal), evidence


def sequence_weights(
    rule: WeightRule,
    log_weights: Float[Tensor, "B M"],
    log_likelihood: Float[Tensor, "T B M"],
    log_marginal: Float[Tensor, "T B M"] | None,
) -> tuple[Float[Tensor, "T B M"], Float[Tensor, "T B"], Float[Tensor, "B M"]]:
    """Return the weights by `step_weights` over T frames, time first.

    Without epsilon the weights are a cumulative sum. With it they are a linear recursion,
    alpha_t = N_t pi (c_1 alpha_{t-1} + c_2 sum alpha_{t-1}), which runs on scaled linear numbers:
    epsilon keeps every predicted weight above c_2 pi_j, so nothing is lost to underflow.

    Args:
        rule, log_weights, log_likelihood, log_marginal: as `step_weights`.

    Returns:
        log w_t before epsilon [T, B, M], log-evidence increments [T, B], and the log-weights that
        the next frame starts from, with epsilon [B, M].
    """
    if log_marginal is not None:
        return *frame_weights(rule, log_marginal, log_likelihood), log_weights
    log_prior, epsilon, power = rule.log_prior, rule.uniform_weight, rule.power
    differentiable = torch.is_grad_enabled() and (
        log_likelihood.requires_grad or log_prior.requires_grad or log_weights.requires_grad
    )
    safe = epsilon == 0 or steps_between_rescaling(log_prior, epsilon) >= 1
    if differentiable or rule.reset_below is not None or not safe:
        return _stepwise(rule, log_weights, log_likelihood)
    if epsilon == 0:
        predicted = _cumulative(log_weights, log_prior, power * log_likelihood)
    else:
        predicted = _scaled_linear(log_weights, log_prior, power * log_likelihood, epsilon)
    estimate, evidence = _posterior(predicted, log_likelihood, power)
    return estimate, evidence, mix_uniform(estimate[-1], epsilon)


def _posterior(predicted: Tensor, log_likelihood: Tensor, power: float) -> tuple[Tensor, Tensor]:
    """Return normalised log-weights and log-evidence from predicted log-weights."""
    joint = predicted + log_likelihood
    log_evidence = torch.logsumexp(joint, -1)
    if power == 1:
        return joint - log_evidence[..., None], log_evidence
    return normalise(predicted + power * log_likelihood), log_evidence


def _stepwise(
    rule: WeightRule, log_weights: Tensor, log_likelihood: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    estimates, evidences = [], []
    for frame in log_likelihood:
        estimate, evidence = step_weights(rule, log_weights, frame)
        estimates.append(estimate)
        evidences.append(evidence)
        log_weights = mix_uniform(estimate, rule.uniform_weight)
    return torch.stack(estimates), torch.stack(evidences), log_weights


def _cumulative(log_weights: Tensor, log_prior: Tensor, log_likelihood: Tensor) -> Tensor:
    """Return predicted log-weights log a_t without epsilon."""
    joint = (log_prior + log_likelihood).cumsum(0) + log_weights
    return normalise(joint - log_likelihood)


def _scaled_linear(
    log_weights: Tensor, log_prior: Tensor, log_likelihood: Tensor, epsilon: float
) -> Tensor:
    """Return predicted log-weights log a_t with epsilon."""
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


def steps_between_rescaling(log_prior: Float[Tensor, " M"], epsilon: float) -> int:
    """Return the number of steps of the linear recursion without rescaling that stay in its dtype's range."""
    share = epsilon / (1 + log_prior.numel() * epsilon)
    smallest = math.log(share) + float(log_prior.detach().min())
    room = -0.85 * math.log(torch.finfo(log_prior.dtype).tiny)
    return int(min(32, room // max(-smallest, 1e-9)))


def indicator_mixing(log_prior: Float[Tensor, " M"], epsilon: float) -> Float[Tensor, "M M"]:
    """Return C_ij = ((1 - e) delta_ij + e / M) pi_j, e = M epsilon / (1 + M epsilon).

    alpha C is the predicted weight, up to a factor, of weights alpha before epsilon.
    """
    n_tracks = log_prior.numel()
    total = 1 + n_tracks * epsilon
    kind = {"dtype": log_prior.dtype, "device": log_prior.device}
    mixing = torch.full((n_tracks, n_tracks), epsilon / total, **kind)
    mixing.diagonal().add_(1 / total)
    return mixing * log_prior.exp()
