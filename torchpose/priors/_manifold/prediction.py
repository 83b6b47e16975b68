"""Compute the kernels of a back-constrained GPLVM (MR 14, 22), and map poses both ways (MR 21-26)."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.math._gaussian import least_exponent, safe_cholesky

_JITTER = 1e-8  # of the kernel's variance, added to the noise: a fit may drive the noise to nothing
_CHUNK = 512  # points per product, so that their kernel values stay in the cache


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
        """Return k(z, z) = beta + beta_0."""
        return self.log_beta.exp() + self.log_beta0.exp()

    @property
    def noise(self) -> Float[Tensor, ""]:
        """Return sigma_z^2, and the jitter that keeps the kernel matrix regular."""
        return (2 * self.log_sigma).exp() + _JITTER * self.variance


def rbf_rows(
    centres: Float[Tensor, "T D"], gamma: Float[Tensor, ""], log_scale: Float[Tensor, ""]
) -> Float[Tensor, "D+2 T"]:
    """Return the terms of `rbf_with_rows` that depend on the centres alone, computed once.

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
    """Return s exp(-gamma / 2 ||x - c||^2) for all pairs, as one product.

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
    """Return k(x, c) = s exp(-gamma / 2 ||x - c||^2)   (MR 22, with s = 1)."""
    log_scale = torch.zeros_like(gamma) if log_scale is None else log_scale
    return rbf_with_rows(x, rbf_rows(centres, gamma, log_scale), gamma)


def covariance(latents: Float[Tensor, "T d"], kernel: KernelParameters) -> Float[Tensor, "T T"]:
    """Return the covariance of a column of noisy poses at latent points, K + sigma_z^2 I   (MR 14, 15)."""
    smooth = rbf(latents, latents, kernel.log_gamma.exp(), kernel.log_beta)
    eye = torch.eye(len(latents), dtype=latents.dtype, device=latents.device)
    return smooth + kernel.log_beta0.exp() + kernel.noise * eye


class Prepared(NamedTuple):
    """Holds the tensors that follow from a fit and stay the same for every pose.

    Attributes:
        latents: z of the training poses [T, d]. mean: the mean of these poses [Q].
        pose_rows: of k_x [Q+2, T]. latent_rows: of k [d+2, T]; see `rbf_rows`.
        factor: Cholesky factor of K + sigma_z^2 I [T, T].
        alpha: (K + sigma_z^2 I)^-1 X, times the scale [T, Q].
        offset: mean pose and the constant part of the kernel, beta_0 sum_t alpha_t [Q].
    """

    latents: Tensor
    mean: Tensor
    pose_rows: Tensor
    latent_rows: Tensor
    factor: Tensor
    alpha: Tensor
    offset: Tensor


class Fitted(NamedTuple):
    """Holds the parameters and points that a fit has found.

    Attributes:
        scale: of columns [Q]. weights: a [T, d]. bias: b [d]. gamma_x: of (MR 22).
        kernel: beta, beta_0, gamma_z, sigma_z.
    """

    scale: Tensor
    weights: Tensor
    bias: Tensor
    gamma_x: Tensor
    kernel: KernelParameters


def prepare(poses: Float[Tensor, "T Q"], fitted: Fitted) -> Prepared:
    """Return the factor of the kernel matrix and alpha = K^-1 X, in double precision.

    Args:
        poses: training poses X. fitted: to them.
    """
    poses = poses.double()
    scale, weights, bias, gamma = (value.double() for value in fitted[:-1])
    kernel, mean = KernelParameters(*(log.double() for log in fitted.kernel)), poses.mean(0)
    target = (poses - mean) / scale
    pose_rows = rbf_rows(target, gamma, torch.zeros_like(gamma))
    latents = rbf_with_rows(target, pose_rows, gamma) @ weights + bias
    factor = safe_cholesky(covariance(latents, kernel))
    alpha = torch.cholesky_solve(target, factor) * scale
    latent_rows = rbf_rows(latents, kernel.log_gamma.exp(), kernel.log_beta)
    offset = mean + kernel.log_beta0.exp() * alpha.sum(0)
    return Prepared(latents, mean, pose_rows, latent_rows, factor, alpha, offset)


def to_latent(x: Float[Tensor, "N Q"], fitted: Fitted, prepared: Prepared) -> Float[Tensor, "N d"]:
    """Return g(x)   (MR 21)."""
    target = (x - prepared.mean) / fitted.scale
    chunks = [
        rbf_with_rows(part, prepared.pose_rows, fitted.gamma_x) @ fitted.weights + fitted.bias
        for part in target.split(_CHUNK)
    ]
    return torch.cat(chunks)


def to_pose_mean(
    z: Float[Tensor, "N d"], fitted: Fitted, prepared: Prepared
) -> Float[Tensor, "N Q"]:
    """Return f(z) = X^T K^-1 k   (MR 25)."""
    chunks = [
        _varying(part, fitted, prepared) @ prepared.alpha + prepared.offset
        for part in z.split(_CHUNK)
    ]
    return torch.cat(chunks)


def to_pose(
    z: Float[Tensor, "N d"], fitted: Fitted, prepared: Prepared
) -> tuple[Float[Tensor, "N Q"], Float[Tensor, " N"]]:
    """Return mean X^T K^-1 k and variance k(z, z) - k^T K^-1 k + sigma_z^2   (MR 24-26)."""
    kernel = fitted.kernel
    means, variances = [], []
    for part in z.split(_CHUNK):
        varying = _varying(part, fitted, prepared)
        means.append(varying @ prepared.alpha + prepared.offset)
        cross = varying + kernel.log_beta0.exp()
        white = torch.linalg.solve_triangular(prepared.factor.mT, cross, upper=True, left=False)
        variances.append((kernel.variance - white.square().sum(-1)).clamp_min(0))
    return torch.cat(means), torch.cat(variances) + kernel.noise


def _varying(z: Tensor, fitted: Fitted, prepared: Prepared) -> Float[Tensor, "N T"]:
    """Return beta exp(...) of points and the training poses'; beta_0 is in the offset."""
    return rbf_with_rows(z, prepared.latent_rows, fitted.kernel.log_gamma.exp())
