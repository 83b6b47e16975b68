"""Maximum likelihood of gamma, the rate of the transition "ou"."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.errors import InputError, check_finite, check_shape
from torchpose.filters.weights import normalise
from torchpose.priors.gaussian_mixture import GaussianMixture

__all__ = ["fit_gamma"]

_PAIRS = 2048  # of frames, whitened at a time
_LARGEST = 1 - 1e-9
_LEAST_SHARE = 1.0  # pairs of frames that a component needs for a gamma of its own


class _Pairs(NamedTuple):
    """Of N pairs of consecutive frames, what the likelihood of gamma depends on, [N, K].

    Attributes:
        later, both, earlier: y_t^T y_t, y_t^T y_{t-1} and y_{t-1}^T y_{t-1} of the whitened states, in
            the directions that gamma moves. rest: log-density that no gamma changes.
    """

    later: Tensor
    both: Tensor
    earlier: Tensor
    rest: Tensor


@torch.no_grad()
def fit_gamma(
    gmm: GaussianMixture,
    states: Float[Tensor, "B T D"] | Sequence[Float[Tensor, "T D"]],
    lengths: Int[Tensor, " B"] | None = None,
    *,
    shared: bool = False,
    subspace: int | None = None,
    n_iterations: int = 200,
    tolerance: float = 1e-8,
) -> Float[Tensor, "*K"]:
    r"""Fit gamma of the transition "ou" to sequences of states, by maximum likelihood.

    The process whose stationary law is the mixture Phi moves by
        p(x_t | x_{t-1}) Phi(x_{t-1}) = sum_i pi_i N(x_{t-1}; mu_i, Sigma_i) N(x_t; m_i, S_i),
        m_i = gamma_i x_{t-1} + (1 - gamma_i) mu_i,  S_i = (1 - gamma_i^2) Sigma_i.
    EM: the responsibilities r of the components for a pair of frames are proportional to the terms of
    the sum; then, with y the states less mu_i whitened by Sigma_i and n = sum_t r, gamma_i is the best
    root in [0, 1) of
        n D g^3 - B g^2 + (A + C - n D) g - B = 0,
        A = sum r |y_t|^2,  B = sum r y_t^T y_{t-1},  C = sum r |y_{t-1}|^2.

    Args:
        gmm: the mixture, K components over D dimensions; it is kept as it is.
        states: B sequences [B, T, D], or a list of sequences [T, D] of any lengths, in the units of the
            mixture and at the frame rate of the filter (at r times as many frames per second gamma is
            gamma^(1/r)).
        lengths: frames of each sequence, only with one tensor.
        shared: fit one gamma for all components.
        subspace: number of leading principal directions that gamma moves, as in `make_transition`.
        n_iterations: of EM at most. tolerance: largest change of gamma at which it ends.

    Returns:
        gamma [K] in [0, 1), float64, or [] if `shared`. A component that is responsible for less than
        one pair of frames gets the gamma of all components together.

    Raises:
        ShapeError, InputError: states of another size, values that are not finite, or no two
        consecutive frames.

    Reference:
        A. P. Dempster, N. M. Laird, D. B. Rubin, "Maximum likelihood from incomplete data via the EM
        algorithm" (1977).

    Example:
        >>> import torch
        >>> gmm = GaussianMixture(torch.ones(1), torch.zeros(1, 2), torch.eye(2)[None])
        >>> x, generator = [torch.zeros(2)], torch.Generator().manual_seed(0)
        >>> for _ in range(4000):
        ...     x.append(0.8 * x[-1] + 0.6 * torch.randn(2, generator=generator))
        >>> fit_gamma(gmm, [torch.stack(x)]).round(decimals=1)
        tensor([0.8000], dtype=torch.float64)
    """
    dim = gmm.dim
    if subspace is not None and not 1 <= subspace <= dim:
        raise InputError(f"subspace must lie between 1 and {dim}, got {subspace}")
    earlier, later = _consecutive(states, lengths, gmm)
    moved = subspace or dim
    pairs = _statistics(gmm, earlier, later, moved)
    gamma = _best_rate(pairs, torch.zeros_like(pairs.rest), moved, True).expand(gmm.n_components)
    for _ in range(n_iterations):
        new = _best_rate(pairs, _log_terms(pairs, gamma, moved), moved, shared)
        change = (new - gamma).abs().max()
        gamma = new.expand(gmm.n_components)
        if change <= tolerance:
            break
    return gamma[0].clone() if shared else gamma.clone()


def _consecutive(
    states: Tensor | Sequence[Tensor], lengths: Tensor | None, gmm: GaussianMixture
) -> tuple[Tensor, Tensor]:
    """Return all pairs of consecutive frames, [N, D] each."""
    if isinstance(states, Tensor):
        check_shape("states", states, ["B", "T", gmm.dim])
        count = states.shape[1]
        if lengths is None:
            lengths = torch.full((len(states),), count)
        check_shape("lengths", lengths, [len(states)])
        if bool(((lengths < 1) | (lengths > count)).any()):
            raise InputError(f"lengths must be from 1 to {count}, got {lengths.tolist()}")
        sequences = [x[:n] for x, n in zip(states, lengths.tolist(), strict=True)]
    else:
        if lengths is not None:
            raise InputError("lengths are of one tensor of states; a list has its own")
        sequences = list(states)
    for i, sequence in enumerate(sequences):
        check_shape(f"states[{i}]", sequence, ["T", gmm.dim])
        check_finite(f"states[{i}]", sequence)
    if not any(len(sequence) > 1 for sequence in sequences):
        raise InputError("gamma needs two consecutive frames, got none in any of the sequences")
    kind = {"dtype": torch.float64, "device": gmm.means.device}
    earlier = torch.cat([sequence[:-1] for sequence in sequences]).to(**kind)
    return earlier, torch.cat([sequence[1:] for sequence in sequences]).to(**kind)


def _statistics(gmm: GaussianMixture, earlier: Tensor, later: Tensor, moved: int) -> _Pairs:
    """Return the pairs in the whitened principal directions of every component."""
    weights, means, covariances = (x.double() for x in gmm.parameters_tuple())
    variances, directions = torch.linalg.eigh(covariances)
    whitener = directions / variances.clamp_min(torch.finfo(torch.float64).tiny).sqrt()[:, None]
    constant = weights.log() - variances.log().sum(-1)  # the density of two frames has it twice
    parts = []
    for first, second in zip(earlier.split(_PAIRS), later.split(_PAIRS), strict=True):
        before, after = (
            torch.einsum("nkd,kde->nke", x[:, None] - means, whitener) for x in (first, second)
        )
        leading, others = before[..., -moved:], after[..., -moved:]
        rest = after[..., : after.shape[-1] - moved].square().sum(-1) + before.square().sum(-1)
        parts.append(
            _Pairs(
                others.square().sum(-1),
                (others * leading).sum(-1),
                leading.square().sum(-1),
                constant - 0.5 * rest,
            )
        )
    return _Pairs(*(torch.cat(values) for values in zip(*parts, strict=True)))


def _log_terms(pairs: _Pairs, gamma: Tensor, moved: int) -> Tensor:
    """Return log of pi_i N(x_{t-1}; i) N(x_t | x_{t-1}, i) up to a constant, [N, K]."""
    free = 1 - gamma.square()
    squared = pairs.later - 2 * gamma * pairs.both + gamma.square() * pairs.earlier
    return pairs.rest - 0.5 * (moved * free.log() + squared / free)


def _best_rate(pairs: _Pairs, log_terms: Tensor, moved: int, shared: bool) -> Tensor:
    """Return the likeliest gamma given the responsibilities, [K], or [] for all components together."""
    share = normalise(log_terms).exp()
    values = (torch.ones_like(share), pairs.later, pairs.both, pairs.earlier)
    sums = tuple((share * value).sum(0) for value in values)
    together = _likeliest(tuple(value.sum() for value in sums), moved)
    if shared:
        return together
    own = _likeliest(sums, moved)
    return torch.where(sums[0] >= _LEAST_SHARE, own, together)


def _likeliest(sums: tuple[Tensor, ...], moved: int) -> Tensor:
    """Return the best of 0 and the real roots in [0, 1) of the likelihood's derivative."""
    count, later, both, earlier = sums
    size = (count * moved).clamp_min(torch.finfo(torch.float64).tiny)
    companion = torch.zeros(*count.shape, 3, 3, dtype=count.dtype, device=count.device)
    companion[..., 1, 0] = companion[..., 2, 1] = 1
    companion[..., 0, 2] = both / size
    companion[..., 1, 2] = -(later + earlier) / size + 1
    companion[..., 2, 2] = both / size
    roots = torch.linalg.eigvals(companion)
    real = torch.where(roots.imag.abs() < 1e-6, roots.real, torch.zeros_like(roots.real))
    rates = torch.cat([torch.zeros_like(real[..., :1]), real], -1).clamp(0, _LARGEST)
    free = 1 - rates.square()
    squared = later[..., None] - 2 * rates * both[..., None] + rates.square() * earlier[..., None]
    gain = -0.5 * (size[..., None] * free.log() + squared / free)
    return rates.gather(-1, gain.argmax(-1, keepdim=True))[..., 0]
