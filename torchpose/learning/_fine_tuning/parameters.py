"""Parametrise mixtures and noise without constraints, and measure the error that they are tuned by."""

from dataclasses import replace
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose.math._mixture_steps import MixtureParameters
from torchpose.metrics._pose_errors import ALIGN_JOINTS, procrustes
from torchpose.priors._gaussian_mixture import GaussianMixture
from torchpose.priors._prior_file import PriorInfo
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.priors._window import WindowPrior
from torchpose.upper_body._estimator import ARMS

MEASURED = ("hand", "head", "neck")
_MIXTURE_RATE = 0.04
_SMOOTH = 1e-3  # metres: distances below it count as squares, so that they have a gradient


class TunableMixture(nn.Module):
    """Holds a Gaussian mixture with free parameters, as steps from a given one along each component's axes.

    pi_k prop. to pi0_k exp(a_k),   mu_k = mu0_k + L0_k b_k,   Sigma_k = (L0_k T_k) (L0_k T_k)^T,

    where T_k is lower triangular with the diagonal exp(t_k) and Sigma0_k = L0_k L0_k^T. All
    parameters are zero at the start. A change by one is about a standard deviation. Any values give a
    mixture.

    Args:
        start: the mixture to start from.
    """

    def __init__(self, start: GaussianMixture) -> None:
        super().__init__()
        self.register_buffer("start_log_weights", start.weights.double().log())
        self.register_buffer("start_means", start.means.double())
        self.register_buffer("start_factor", start.cholesky().double())
        k, dim = start.means.shape
        self.log_weights = nn.Parameter(torch.zeros(k, dtype=torch.float64))
        self.steps = nn.Parameter(torch.zeros(k, dim, dtype=torch.float64))
        self.shapes = nn.Parameter(torch.zeros(k, dim, dim, dtype=torch.float64))

    start_log_weights: Tensor
    start_means: Tensor
    start_factor: Tensor

    def _shape(self) -> Float[Tensor, "K D D"]:
        diagonal = self.shapes.diagonal(dim1=-2, dim2=-1).exp()
        return self.shapes.tril(-1) + torch.diag_embed(diagonal)

    def forward(self) -> MixtureParameters:
        """Return weights, means and covariances, with their graph."""
        weights = (self.start_log_weights + self.log_weights).softmax(0)
        means = self.start_means + (self.start_factor @ self.steps[..., None])[..., 0]
        factor = self.start_factor @ self._shape()
        return MixtureParameters(weights, means, factor @ factor.mT)

    def mixture(self) -> GaussianMixture:
        """Return the mixture at its current parameters, without a graph."""
        weights, means, covariances = (value.detach() for value in self())
        return GaussianMixture(weights, means, (covariances + covariances.mT) / 2)

    def departure(self) -> Float[Tensor, ""]:
        """Return an upper bound of the divergence KL(tuned, start), that of the components.

        sum_k pi_k (log pi_k / pi0_k + (|T_k|^2 + |b_k|^2 - D) / 2 - sum log diag T_k)
        """
        log_weights = (self.start_log_weights + self.log_weights).log_softmax(0)
        spread = self._shape().square().sum((-2, -1)) + self.steps.square().sum(-1)
        log_det = self.shapes.diagonal(dim1=-2, dim2=-1).sum(-1)
        each = (spread - self.steps.shape[1]) / 2 - log_det
        return (log_weights.exp() * (log_weights - self.start_log_weights + each)).sum()


def departure_of(mixtures: nn.ModuleDict) -> Float[Tensor, ""]:
    """Return the sum of the departures of both arms, zero where mixtures are not tuned."""
    parts = [module.departure() for module in mixtures.values()]  # type: ignore[operator]
    return torch.stack(parts).sum() if parts else torch.zeros((), dtype=torch.float64)


def tuned_mixtures(
    mixtures: nn.ModuleDict, start: UpperBodyPrior | WindowPrior
) -> tuple[GaussianMixture, GaussianMixture]:
    """Return the mixtures of the left and right arm, those of the start where they are not tuned."""
    found = [
        cast(TunableMixture, mixtures[side]).mixture() if side in mixtures else getattr(start, side)
        for side in ARMS
    ]
    return found[0], found[1]


class Positive(nn.Module):
    """Holds positive numbers with a free parameter each: start exp(parameter)."""

    def __init__(self, start: Tensor) -> None:
        super().__init__()
        self.register_buffer("start", start.detach().double().clone())
        self.log_ratio = nn.Parameter(torch.zeros_like(self.start))

    start: Tensor

    def forward(self) -> Tensor:
        return self.start * self.log_ratio.exp()


class Fraction(nn.Module):
    """Holds numbers in (0, 1) with a logit each as free parameter."""

    def __init__(self, start: Tensor) -> None:
        super().__init__()
        self.logit = nn.Parameter(torch.logit(start.detach().double().clamp(1e-3, 1 - 1e-3)))

    def forward(self) -> Tensor:
        return self.logit.sigmoid()


def parameter_groups(model: nn.Module, learning_rate: float) -> list[dict[str, Any]]:
    """Return parameters for an optimiser; mixtures have a twenty-fifth of the noise's learning rate.

    Args:
        model: `TunableKalman` or `TunableWindow`. learning_rate: of the noise, such as 0.1.
    """
    mixtures = list(cast(nn.ModuleDict, model.mixtures).parameters())
    own = {id(parameter) for parameter in mixtures}
    rest = [parameter for parameter in model.parameters() if id(parameter) not in own]
    groups = [{"params": rest, "lr": learning_rate}]
    if mixtures:
        groups.append({"params": mixtures, "lr": _MIXTURE_RATE * learning_rate})
    return groups


def pose_error(
    estimate: Float[Tensor, "*batch 8 3"], truth: Float[Tensor, "*batch 8 3"]
) -> Float[Tensor, "*batch 8"]:
    """Return distances after fixed-scale Procrustes on head, neck and shoulders (BL section 6), metres.

    The motion itself is taken as given by the gradient, since what it does to the joints that it is
    made of is little beside the arms; distances below a millimetre count as squares.
    """
    chosen = list(ALIGN_JOINTS)
    with torch.no_grad():
        motion = procrustes(estimate[..., chosen, :], truth[..., chosen, :])
    moved = estimate @ motion.rotation.mT + motion.translation[..., None, :]
    return ((moved - truth).square().sum(-1) + _SMOOTH**2).sqrt() - _SMOOTH


def tuned_info(prior: UpperBodyPrior, what: str) -> PriorInfo:
    tuned = sorted({*prior.info.extra.get("tuned", ()), what})
    return replace(prior.info, extra=prior.info.extra | {"tuned": tuned})
