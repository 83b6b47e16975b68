"""Resample particles by their log-weights, and sharpen weights to a survival rate.

Every method returns ancestor indices. Each batch element draws the same number of random numbers
whatever its weights are, so that its result does not depend on its neighbours."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose._core.checks import check_choice, check_count, check_positive, check_shape
from torchpose.errors import InputError
from torchpose.filters._recursive_filter import Generators, uniform

BELOW_ONE = 1.0 - 2.0**-53  # the largest float64 under 1: (n - 1 + u) / n may round up to 1


def systematic(
    log_weights: Float[Tensor, "B N"], generator: Generators = None, n_samples: int | None = None
) -> Int[Tensor, "B n"]:
    """Return ancestors at the positions (i + u) / n of the cumulative weights, one u per element.

    A particle of weight w is taken floor(n w) or ceil(n w) times. Ancestors are in rising order,
    which keeps the gather that follows in cache.

    Args:
        log_weights: [B, N], normalised or not; -inf is a weight of zero.
        generator: one generator, or a list of one for each element.
        n_samples: number n of ancestors; as many as there are particles if None.

    Returns:
        Indices [B, n]. A row whose weights are all zero, or hold NaN, gets 0, 1, 2, ...

    Reference:
        Kitagawa (1996), Monte Carlo filter and smoother, doi:10.2307/1390750.
    """
    n = log_weights.shape[1] if n_samples is None else n_samples
    positions = systematic_positions(_uniform(log_weights, 1, generator), n)
    return _search(_weights(log_weights), positions)


def systematic_positions(u: Float[Tensor, "*B 1"], n: int) -> Float[Tensor, "*B n"]:
    """Return the positions (i + u) / n of `systematic`, below one, for numbers u that were drawn before."""
    return ((_steps(u, n) + u) / n).clamp_max(BELOW_ONE)


def stratified(
    log_weights: Float[Tensor, "B N"], generator: Generators = None, n_samples: int | None = None
) -> Int[Tensor, "B n"]:
    """Return ancestors at the positions (i + u_i) / n, with an own u_i in each of the n strata.

    Args, Returns, Reference: as `systematic`.
    """
    n = log_weights.shape[1] if n_samples is None else n_samples
    u = _uniform(log_weights, n, generator)
    return _search(_weights(log_weights), (_steps(log_weights, n) + u) / n)


def multinomial(
    log_weights: Float[Tensor, "B N"], generator: Generators = None, n_samples: int | None = None
) -> Int[Tensor, "B n"]:
    """Return ancestors drawn independently of each other, with the weights as probabilities.

    Args, Returns: as `systematic`. Its variance is the largest of the four.

    Reference:
        Gordon, Salmond & Smith (1993), doi:10.1049/ip-f-2.1993.0015.
    """
    n = log_weights.shape[1] if n_samples is None else n_samples
    return _search(_weights(log_weights), _uniform(log_weights, n, generator))


def residual(
    log_weights: Float[Tensor, "B N"], generator: Generators = None, n_samples: int | None = None
) -> Int[Tensor, "B n"]:
    """Return floor(n w) copies of each particle, and draw the rest from the fractions n w - floor(n w).

    Args, Returns: as `systematic`.

    Reference:
        Liu & Chen (1998), Sequential Monte Carlo methods for dynamic systems,
        doi:10.1080/01621459.1998.10473765.
    """
    n = log_weights.shape[1] if n_samples is None else n_samples
    u = _uniform(log_weights, n, generator)
    expected = n * _weights(log_weights)
    # 1 / N times N is a whole number only up to rounding
    copies = (expected + 1e-9).floor()
    fraction = (expected - copies).clamp_min(0)
    steps = _steps(log_weights, n)
    kept = copies.cumsum(-1).nan_to_num()
    whole = torch.searchsorted(kept, steps + torch.zeros_like(kept[:, :1]), right=True)
    drawn = _search(fraction, u)
    chosen = torch.where(steps < kept[:, -1:], whole, drawn)
    return torch.where(torch.isfinite(expected).all(-1, keepdim=True), chosen, drawn)


RESAMPLING = {
    "systematic": systematic,
    "stratified": stratified,
    "multinomial": multinomial,
    "residual": residual,
}


def resample(
    log_weights: Float[Tensor, "B N"],
    method: str = "systematic",
    generator: Generators = None,
    n_samples: int | None = None,
) -> Int[Tensor, "B n"]:
    """Return ancestor indices by the named method.

    All four are unbiased: particle j is taken n w_j times on average.

    Args:
        log_weights: [B, N], normalised or not; -inf is a weight of zero.
        method: "systematic", "stratified", "multinomial" or "residual".
        generator: one generator, or a list of one for each element.
        n_samples: number n of ancestors; as many as there are particles if None.

    Returns:
        Indices [B, n]. A row whose weights are all zero, or hold NaN, gets 0, 1, 2, ...

    Raises:
        InputError: an unknown method, no particles, or a number of samples below one.
        ShapeError: not two dimensions.

    >>> weights = torch.tensor([[0.5, 0.0, 0.25, 0.25]])
    >>> resample(weights.log(), generator=torch.Generator().manual_seed(0)).tolist()
    [[0, 0, 2, 3]]
    """
    check_choice("resampling", method, RESAMPLING)
    check_shape("log_weights", log_weights, ["B", "N"])
    if log_weights.numel() == 0:
        raise InputError(f"log_weights must hold particles, got {list(log_weights.shape)}")
    if n_samples is not None:
        check_count("n_samples", n_samples)
    return RESAMPLING[method](log_weights, generator, n_samples)


def _uniform(log_weights: Tensor, count: int, generator: Generators) -> Tensor:
    like = log_weights.new_empty(0, dtype=torch.float64)
    return uniform(log_weights.shape[0], (count,), generator, like)


def _weights(log_weights: Tensor) -> Tensor:
    return log_weights.double().softmax(-1)


def _steps(log_weights: Tensor, n: int) -> Tensor:
    return torch.arange(n, dtype=torch.float64, device=log_weights.device)


def _search(weights: Float[Tensor, "B N"], positions: Float[Tensor, "B n"]) -> Int[Tensor, "B n"]:
    """Return the particle whose share of the cumulative weights holds each position in [0, 1)."""
    edges = _edges(weights)
    dead = ~torch.isfinite(edges[:, -1:])
    index = _first_above(edges, torch.where(dead, 0.0, positions.clamp_max(BELOW_ONE)))
    steps = torch.arange(index.shape[1], device=index.device).clamp_max(weights.shape[1] - 1)
    return torch.where(dead, steps, index)


def ancestors(weights: Float[Tensor, "B N"], positions: Float[Tensor, "B n"]) -> Int[Tensor, "B n"]:
    """Return the particle whose share of the cumulative weights holds each position in [0, 1).

    Of weights that are all zero, or hold NaN, it may be any.
    """
    return _first_above(_edges(weights), positions)


def _edges(weights: Float[Tensor, "B N"]) -> Float[Tensor, "B N"]:
    """Return the cumulative shares: divided by its own end, the last one is exactly 1."""
    edges = weights.cumsum(-1)
    return edges / edges[:, -1:]


def _first_above(
    edges: Float[Tensor, "B N"], positions: Float[Tensor, "B n"]
) -> Int[Tensor, "B n"]:
    """Return the first edge above each position; right=True steps over zero weights."""
    index = torch.searchsorted(edges, positions.contiguous(), right=True)
    return index.clamp_max(edges.shape[1] - 1)


LEAST_SURVIVORS = 2.0
"""Particles that a survival rate must leave: one alone is no distribution."""

_REACH = 30.0  # of the search, in log beta, on either side of where it starts
_MOST_STEPS = 60
_TOLERANCE = 1e-9  # in log alpha


def survival_rate(log_weights: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch"]:
    """Return the share of the particles that resampling is expected to keep.

    alpha = (sum_n w_n)^2 / (N sum_n w_n^2)

    Args:
        log_weights: [..., N], normalised or not; -inf is a weight of zero.

    Returns:
        alpha [...], from 1 / N to 1; NaN where every weight is zero.

    Reference:
        Deutscher & Reid (2005), doi:10.1023/B:VISI.0000043757.18370.9c, section 4.

    >>> survival_rate(torch.tensor([0.5, 0.5, 0.0, 0.0]).log())
    tensor(0.5000)
    """
    n = log_weights.shape[-1]
    total = torch.logsumexp(log_weights, -1)
    return torch.exp(2 * total - torch.logsumexp(2 * log_weights, -1) - math.log(n))


def survival_exponent(
    log_weights: Float[Tensor, "*batch N"], rate: float
) -> Float[Tensor, "*batch"]:
    """Return the exponent beta for which a given share of the particles survives.

    alpha = (sum_n w_n^beta)^2 / (N sum_n w_n^(2 beta))

    alpha falls from 1 to the share of the best particle as beta rises, so the root is unique; it is
    found by Newton's method in log beta, kept inside a bracket.

    Args:
        log_weights: [..., N], normalised or not; -inf is a weight of zero and stays one.
        rate: alpha, between 0 and 1.

    Returns:
        beta [...], float64. 1 where all weights are equal (or all zero). Where no exponent reaches
        the rate, the nearest end: about 0 if fewer particles than that are alive, very large if more
        than that share the largest weight.

    Raises:
        InputError: a rate that is not between 0 and 1.

    Reference:
        Deutscher & Reid (2005), doi:10.1023/B:VISI.0000043757.18370.9c, section 4.2; Daubney & Xie,
        section 7.

    >>> log_weights = torch.linspace(-1, 0, 100, dtype=torch.float64)
    >>> beta = survival_exponent(log_weights, 0.5)
    >>> survival_rate(beta * log_weights)
    tensor(0.5000, dtype=torch.float64)
    """
    if not 0 < rate < 1:
        raise InputError(f"a survival rate must lie between 0 and 1, got {rate}")
    relative = log_weights.double()
    relative = relative - relative.amax(-1, keepdim=True)
    alive = torch.isfinite(relative)
    relative = torch.where(alive, relative, 0.0)
    n_alive = alive.sum(-1).clamp_min(1)
    mean = relative.sum(-1) / n_alive
    spread = torch.where(alive, relative - mean[..., None], 0.0).square().sum(-1) / n_alive
    level = spread <= 1e-30
    # exact for log-weights that are normally distributed: alpha = exp(-beta^2 var)
    start = 0.5 * (math.log(-math.log(rate)) - torch.where(level, 1.0, spread).log())
    beta = _solve(relative, alive, start, math.log(rate * relative.shape[-1])).exp()
    return torch.where(level, torch.ones_like(beta), beta)


def _solve(relative: Tensor, alive: Tensor, start: Tensor, target: float) -> Tensor:
    """Return log beta at which 2 log sum w^beta - log sum w^(2 beta) is the target."""
    low, high, u = start - _REACH, start + _REACH, start
    for _ in range(_MOST_STEPS):
        beta = u.exp()
        scaled = torch.where(alive, beta[..., None] * relative, -torch.inf)
        once, twice = torch.logsumexp(scaled, -1), torch.logsumexp(2.0 * scaled, -1)
        value = 2.0 * once - twice - target
        done = value.abs() < _TOLERANCE
        if bool(done.all()):
            break
        low, high = torch.where(value > 0, u, low), torch.where(value > 0, high, u)
        gap = (scaled - once[..., None]).exp() - (2.0 * scaled - twice[..., None]).exp()
        slope = 2.0 * beta * (gap * relative).sum(-1)
        newton = u - value / slope
        inside = (newton > low) & (newton < high)
        # what is found stays: it must not depend on how long others in the batch take
        u = torch.where(done, u, torch.where(inside, newton, (low + high) / 2.0))
    return u


def check_survival_rate(rate: float, n_particles: int) -> None:
    """Raise unless a share of this many particles can survive.

    2 / N <= alpha < 1. No exponent leaves fewer than one particle, alpha = 1 / N; a rate near it
    hands the whole frame to the best particle.

    Args:
        rate: alpha, per frame. n_particles: N.

    Raises:
        InputError: a rate that is not below 1, or that leaves fewer than `LEAST_SURVIVORS`.
    """
    if not 0 < rate < 1:
        raise InputError(f"survival_rate must lie between 0 and 1, got {rate}")
    if rate * n_particles < LEAST_SURVIVORS * (1 - 1e-9):
        least = LEAST_SURVIVORS / n_particles
        way = f"ask for {least:.3g} or more" if least < 1 else "take more particles"
        raise InputError(
            f"survival_rate of {rate:.3g} leaves {rate * n_particles:.2g} of {n_particles} particles, "
            f"fewer than {LEAST_SURVIVORS:g}; {way}. With a rate per "
            "second, fewer particles survive a frame if the frame rate is lower"
        )


def survival_rate_per_frame(per_second: float, fps: float) -> float:
    """Return the rate per frame that keeps the same share of the particles over a second.

    alpha = exp(ln(alpha_c) / N_t)

    Args:
        per_second: alpha_c, between 0 and 1. fps: N_t, frames per second.

    Raises:
        InputError: a rate that is not between 0 and 1, or a frame rate that is not positive.

    Reference:
        Daubney & Xie, section 7: 0.01 at 60 Hz is 0.93 per frame.

    >>> round(survival_rate_per_frame(0.01, 60.0), 2)
    0.93
    """
    if not 0 < per_second < 1:
        raise InputError(f"a survival rate must lie between 0 and 1, got {per_second}")
    check_positive("fps", fps)
    return per_second ** (1 / fps)
