"""Make transition models, a discrete Ornstein-Uhlenbeck process per component, and fit their rate."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Integer
from torch import Tensor

from torchpose._core.checks import (
    check_choice,
    check_finite,
    check_real,
    check_shape,
    check_tensors,
)
from torchpose._core.rows import joined
from torchpose._core.value_checks import values_visible
from torchpose.errors import InputError
from torchpose.filters._measurements import check_lengths
from torchpose.filters._weights import normalise
from torchpose.math._gaussian import safe_cholesky, symmetrise
from torchpose.priors._gaussian_mixture import GaussianMixture

TRANSITIONS = ("paper", "stationary", "ou")
BURN_IN_SCALE = 100.0
"""Factor of Q in the first frame of a burn-in, where none is given."""


class Transition(NamedTuple):
    """Holds one linear-Gaussian model per component, x_t = F x_{t-1} + b + N(0, N).

    Attributes:
        matrix: F [K, D, D]. offset: b = (I - F) mu [K, D]. noise: N [K, D, D].
    """

    matrix: Tensor
    offset: Tensor
    noise: Tensor


def check_transition_options(
    kind: str,
    gamma: Any,
    subspace: int | None,
    burn_in: int,
    burn_in_scale: float | None,
) -> None:
    """Refuse a transition that does not exist, and options that the chosen one does not use.

    Args:
        kind: one of `TRANSITIONS`. gamma, subspace: of "ou", None where they were not given.
        burn_in: number of frames with an inflated Q, which "ou" has not. burn_in_scale: factor of Q
            in the first of them, None where it was not given.

    Raises:
        InputError: an unknown kind, an option without use, or a burn-in out of range.
    """
    check_choice("transition", kind, TRANSITIONS)
    for name, value in (("gamma", gamma), ("subspace", subspace)):
        if kind != "ou" and value is not None:
            raise InputError(f"{name} does not apply to transition {kind!r}; it is of 'ou'")
    whole = isinstance(burn_in, int) and not isinstance(burn_in, bool)
    scale = BURN_IN_SCALE if burn_in_scale is None else burn_in_scale
    if not whole or burn_in < 0 or not (math.isfinite(scale) and scale > 0):
        raise InputError(
            "burn_in must be a number of frames >= 0 and burn_in_scale a positive factor of Q, "
            f"got {burn_in} and {scale}"
        )
    if burn_in and kind == "ou":
        raise InputError("burn_in inflates Q, which transition 'ou' does not use; leave it at 0")
    if burn_in == 0 and burn_in_scale is not None:
        raise InputError(f"burn_in_scale is of a burn-in: got {scale} and burn_in = 0")


def inflation(time: int, burn_in: int, scale: float) -> float:
    """Return the factor of Q in frame `time` (0-based): from `scale` geometrically to 1.

    Q_t = scale^(1 - t / burn_in) Q, and Q after the burn-in.
    """
    return 1.0 if time >= burn_in else scale ** (1 - time / burn_in)


def make_transition(
    kind: str,
    means: Float[Tensor, "K D"],
    covariances: Float[Tensor, "K D D"],
    process_cov: Float[Tensor, "D D"],
    gamma: Float[Tensor, "*K"] | float | None = None,
    subspace: int | None = None,
) -> Transition:
    """Return the transition of every component.

    - ``paper``: F = Sigma (Q + Sigma)^-1, N = Sigma (Q + Sigma)^-1 Q   (BL 31-32, 35-37). It settles
      at Sigma (2 Sigma + Q)^-1 (Sigma + Q), less than Sigma: hidden joints come out too certain.
    - ``stationary``: the paper's F with N = Sigma - F Sigma F^T, which settles at Sigma itself.
    - ``ou``: F = gamma I, N = (1 - gamma^2) Sigma, one gamma per component, which settles at Sigma.
      With `subspace` d, gamma acts on the d leading principal directions U of each Sigma,
      F = gamma U U^T, and the others are drawn anew in each step; N = Sigma - F Sigma F^T.

    Sigma is never inverted: with S = Q + Sigma, F = Sigma S^-1 and I - F = Q S^-1 come from one
    Cholesky factor, and N = F Q F^T + (I - F) Sigma (I - F)^T is symmetric term by term.

    Args:
        kind: "paper", "stationary" or "ou".
        means, covariances: the means and covariances of the prior's components, [K, D] and [K, D, D].
        process_cov: Q [D, D]; not used by "ou".
        gamma: [K] or one number, in [0, 1); only for "ou".
        subspace: number of principal directions, only for "ou".

    Returns:
        `Transition` with F [K, D, D], b [K, D] and N [K, D, D], symmetric.

    Raises:
        InputError: unknown kind, gamma missing or outside [0, 1), or an option that the kind does not use.
        ShapeError: variances in place of Q, or another number of gammas than of components.
    """
    check_transition_options(kind, gamma, subspace, 0, None)
    check_tensors(means=means, covariances=covariances)
    check_shape("means", means, ["K", "D"])
    check_shape("covariances", covariances, [*means.shape, means.shape[-1]])
    if kind == "ou":
        return _scalar_rate(means, covariances, gamma, subspace)
    check_tensors(process_cov=process_cov)
    check_shape("process_cov", process_cov, list(covariances.shape[-2:]))
    factor = safe_cholesky(covariances + process_cov)
    matrix = torch.cholesky_solve(covariances, factor).mT
    rest = torch.cholesky_solve(process_cov.expand_as(covariances), factor).mT
    offset = (rest @ means[..., None])[..., 0]
    noise = matrix @ process_cov @ matrix.mT + rest @ covariances @ rest.mT
    if kind == "stationary":
        # Sigma - F Sigma F^T = N + (I - F) Sigma F^T, and (I - F) Sigma is the paper's N itself.
        noise = noise + noise @ matrix.mT
    return Transition(matrix, offset, symmetrise(noise))


def _scalar_rate(
    means: Tensor, covariances: Tensor, gamma: Tensor | float | None, subspace: int | None
) -> Transition:
    if gamma is None:
        raise InputError(
            "transition 'ou' needs gamma, [K] or a number in [0, 1), got None; "
            "fit it with torchpose.filters.fit_gamma or pass for instance 0.95"
        )
    check_real("gamma", gamma)
    gamma = torch.as_tensor(gamma).to(means)
    if gamma.numel() != 1:
        check_shape("gamma", gamma, [len(means)])
    with torch.no_grad():
        outside = (gamma < 0) | (gamma >= 1) | ~torch.isfinite(gamma)
        if values_visible() and bool(outside.any()):
            raise InputError(f"gamma must lie in [0, 1), got {gamma.tolist()}")
    rate = gamma.reshape(-1).expand(len(means))[:, None, None]
    dim = means.shape[-1]
    eye = torch.eye(dim, dtype=means.dtype, device=means.device)
    if subspace is None:
        matrix = rate * eye
        noise = (1 - rate.square()) * covariances
    else:
        if not 1 <= subspace <= dim:
            raise InputError(f"subspace must lie between 1 and {dim}, got {subspace}")
        directions = torch.linalg.eigh(covariances)[1][..., dim - subspace :]
        matrix = rate * (directions @ directions.mT)
        noise = covariances - matrix @ covariances @ matrix.mT
    offset = ((eye - matrix) @ means[..., None])[..., 0]
    return Transition(matrix, offset, symmetrise(noise))


_PAIRS = 2048  # of frames, whitened at a time
_LARGEST = 1 - 1e-9
_LEAST_SHARE = 1.0  # pairs of frames that a component needs for a gamma of its own


class _Pairs(NamedTuple):
    """Statistics of N pairs of consecutive frames that the likelihood of gamma depends on, [N, K].

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
    lengths: Integer[Tensor, " B"] | None = None,
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
        lengths = check_lengths(lengths, len(states), count, states.device)
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
    return joined(parts)


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
