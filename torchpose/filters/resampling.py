"""Resampling of weighted particles: batched, on log-weights, without a loop over particles.

Every method returns ancestor indices. Each batch element draws the same number of random numbers
whatever its weights are, so that its result does not depend on its neighbours.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.errors import InputError, check_shape
from torchpose.filters.base import Generators, uniform

__all__ = ["RESAMPLING", "multinomial", "resample", "residual", "stratified", "systematic"]

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
    u = _uniform(log_weights, 1, generator)
    return _search(_weights(log_weights), (_steps(log_weights, n) + u) / n)


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
    if method not in RESAMPLING:
        raise InputError(f"resampling must be one of {', '.join(RESAMPLING)}, got {method!r}")
    check_shape("log_weights", log_weights, ["B", "N"])
    if log_weights.numel() == 0:
        raise InputError(f"log_weights must hold particles, got {list(log_weights.shape)}")
    if n_samples is not None and n_samples < 1:
        raise InputError(f"n_samples must be at least 1, got {n_samples}")
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
    edges = weights.cumsum(-1)
    # Divided by its own end, the last edge is exactly 1, and right=True steps over zero weights.
    edges = edges / edges[:, -1:]
    dead = ~torch.isfinite(edges[:, -1:])
    positions = torch.where(dead, 0.0, positions.clamp_max(BELOW_ONE))
    index = torch.searchsorted(edges, positions.contiguous(), right=True)
    last = weights.shape[1] - 1
    steps = torch.arange(index.shape[1], device=index.device).clamp_max(last)
    return torch.where(dead, steps, index.clamp_max(last))
