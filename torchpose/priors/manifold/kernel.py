"""The two kernels of a back-constrained GPLVM: of latent points (MR 14) and of poses (MR 22)."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.math.gaussian import least_exponent

__all__ = ["KernelParameters", "covariance", "rbf", "rbf_rows", "rbf_with_rows"]

_JITTER = 1e-8  # of the kernel's variance, added to the noise: a fit may drive the noise to nothing


class KernelParameters(NamedTuple):
    """Logarithms of the four numbers of the Gaussian process (MR 13, 14), scalar tensors.

    Attributes:
        log_beta: of beta, the variance of what varies. log_beta0: of beta_0, that of what is constant.
        log_gamma: of gamma_z, one over a squared length in latent space.
        log_sigma: of sigma_z, the standard deviation of the noise.
    """

    log_beta: Tensor
    log_beta0: Tensor
    log_gamma: Tensor
    log_sigma: Tensor

    @property
    def variance(self) -> Float[Tensor, ""]:
        """k(z, z) = beta + beta_0."""
        return self.log_beta.exp() + self.log_beta0.exp()

    @property
    def noise(self) -> Float[Tensor, ""]:
        """sigma_z^2, and what keeps the kernel matrix regular."""
        return (2 * self.log_sigma).exp() + _JITTER * self.variance


def rbf_rows(
    centres: Float[Tensor, "T D"], gamma: Float[Tensor, ""], log_scale: Float[Tensor, ""]
) -> Float[Tensor, "D+2 T"]:
    """What `rbf_with_rows` needs of the centres, computed once.

    The exponent log s - gamma / 2 ||x - c||^2 is the product of [gamma x, -gamma / 2 ||x||^2, 1]
    with a column [c, 1, log s - gamma / 2 ||c||^2].

    Args:
        centres: c. gamma: one over a squared length. log_scale: log s.
    """
    last = log_scale - 0.5 * gamma * centres.square().sum(-1)
    return torch.cat([centres.mT, torch.stack([torch.ones_like(last), last])])


def rbf_with_rows(
    x: Float[Tensor, "N D"], rows: Float[Tensor, "D+2 T"], gamma: Float[Tensor, ""]
) -> Float[Tensor, "N T"]:
    """s exp(-gamma / 2 ||x - c||^2) for all pairs, as one product.

    Args:
        x: points. rows: of the centres, see `rbf_rows`. gamma: the same as there.
    """
    squared = x.square().sum(-1, keepdim=True)
    left = torch.cat([gamma * x, -0.5 * gamma * squared, torch.ones_like(squared)], -1)
    return (left @ rows).clamp_min(least_exponent(x.dtype)).exp()


def rbf(
    x: Float[Tensor, "N D"],
    centres: Float[Tensor, "T D"],
    gamma: Float[Tensor, ""],
    log_scale: Float[Tensor, ""] | None = None,
) -> Float[Tensor, "N T"]:
    """k(x, c) = s exp(-gamma / 2 ||x - c||^2)   (MR 22, with s = 1)."""
    log_scale = torch.zeros_like(gamma) if log_scale is None else log_scale
    return rbf_with_rows(x, rbf_rows(centres, gamma, log_scale), gamma)


def covariance(latents: Float[Tensor, "T d"], kernel: KernelParameters) -> Float[Tensor, "T T"]:
    """Covariance of a column of noisy poses at latent points, K + sigma_z^2 I   (MR 14, 15)."""
    smooth = rbf(latents, latents, kernel.log_gamma.exp(), kernel.log_beta)
    eye = torch.eye(len(latents), dtype=latents.dtype, device=latents.device)
    return smooth + kernel.log_beta0.exp() + kernel.noise * eye
