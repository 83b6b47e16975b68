"""Both ways through a back-constrained GPLVM that was fitted: g to latent points, f to poses (MR 21-26)."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.math.gaussian import safe_cholesky
from torchpose.priors.manifold.kernel import KernelParameters, covariance, rbf_rows, rbf_with_rows

__all__ = ["Fitted", "Prepared", "prepare", "to_latent", "to_pose", "to_pose_mean"]

_CHUNK = 512  # points per product, so that their kernel values stay in the cache


class Prepared(NamedTuple):
    """What follows from a fit and stays the same for every pose.

    Attributes:
        latents: z of the training poses [T, d]. mean: of these poses [Q].
        pose_rows: of k_x [Q+2, T]. latent_rows: of k [d+2, T]; see `rbf_rows`.
        factor: of K + sigma_z^2 I [T, T]. alpha: (K + sigma_z^2 I)^-1 X, times the scale [T, Q].
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
    """What a fit has found.

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
    """The factor of the kernel matrix and alpha = K^-1 X, in double precision.

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
    """g(x)   (MR 21)."""
    target = (x - prepared.mean) / fitted.scale
    chunks = [
        rbf_with_rows(part, prepared.pose_rows, fitted.gamma_x) @ fitted.weights + fitted.bias
        for part in target.split(_CHUNK)
    ]
    return torch.cat(chunks)


def to_pose_mean(
    z: Float[Tensor, "N d"], fitted: Fitted, prepared: Prepared
) -> Float[Tensor, "N Q"]:
    """f(z) = X^T K^-1 k   (MR 25)."""
    chunks = [
        _varying(part, fitted, prepared) @ prepared.alpha + prepared.offset
        for part in z.split(_CHUNK)
    ]
    return torch.cat(chunks)


def to_pose(
    z: Float[Tensor, "N d"], fitted: Fitted, prepared: Prepared
) -> tuple[Float[Tensor, "N Q"], Float[Tensor, " N"]]:
    """Mean X^T K^-1 k and variance k(z, z) - k^T K^-1 k + sigma_z^2   (MR 24-26)."""
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
    """beta exp(...) of points and the training poses'; beta_0 is in the offset."""
    return rbf_with_rows(z, prepared.latent_rows, fitted.kernel.log_gamma.exp())
