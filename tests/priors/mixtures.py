"""Mixtures and densities that the tests of the priors share."""

import numpy as np
import torch
from torch import Tensor

from torchpose.priors import GaussianMixture


def random_mixture(k: int = 4, dim: int = 3, seed: int = 0, dtype=torch.float64) -> GaussianMixture:
    """A mixture whose components overlap a little."""
    g = torch.Generator().manual_seed(seed)
    weights = torch.rand(k, generator=g, dtype=torch.float64) + 0.3
    factor = torch.randn(k, dim, dim, generator=g, dtype=torch.float64)
    covariances = factor @ factor.mT + 0.3 * torch.eye(dim, dtype=torch.float64)
    means = 2 * torch.randn(k, dim, generator=g, dtype=torch.float64)
    return GaussianMixture(*(p.to(dtype) for p in (weights / weights.sum(), means, covariances)))


def released_mixture(folder, name: str = "Training20_02", side: str = "left") -> GaussianMixture:
    """An arm of a prior that the authors released."""
    with np.load(folder / f"released_prior_{name}.npz") as arrays:
        parts = [
            torch.from_numpy(arrays[f"{side}_{p}"]) for p in ("weights", "means", "covariances")
        ]
    return GaussianMixture(*parts)


def long_double_log_prob(mixture: GaussianMixture, x: Tensor) -> np.ndarray:
    """Component terms [N, K] in 80-bit arithmetic, one component and one dimension at a time."""
    wide = np.longdouble
    points = x.double().numpy().astype(wide)
    terms = []
    for weight, mean, covariance in zip(
        *(p.numpy() for p in mixture.parameters_tuple()), strict=True
    ):
        dim = len(mean)
        factor = np.zeros((dim, dim), wide)
        for i in range(dim):
            for j in range(i + 1):
                rest = wide(covariance[i, j]) - (factor[i, :j] * factor[j, :j]).sum()
                factor[i, j] = np.sqrt(rest) if i == j else rest / factor[j, j]
        y = np.zeros_like(points)
        for i in range(dim):
            y[:, i] = (points[:, i] - mean[i] - y[:, :i] @ factor[i, :i]) / factor[i, i]
        log_det = np.log(np.diag(factor)).sum()
        norm = log_det + wide(dim) / 2 * np.log(2 * wide(np.pi))
        terms.append(np.log(wide(weight)) - norm - (y**2).sum(1) / 2)
    return np.stack(terms, 1)
