"""The objective against dense Gaussians, its gradients by the paper's formulas, and the fit."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from sklearn.decomposition import PCA
from torch import Tensor

from tests.priors.motions import motion
from torchpose.errors import InputError, ShapeError
from torchpose.learning._gplvm_fit import (
    GPLVMFit,
    log_likelihood,
    median_gamma,
    objective,
    principal_start,
    run_fit,
)
from torchpose.priors._manifold.prediction import KernelParameters, covariance, rbf

T, Q, D = 12, 5, 2


@pytest.fixture
def problem() -> tuple[Tensor, Tensor, KernelParameters]:
    generator = torch.Generator().manual_seed(0)
    poses, latents = (torch.randn(T, n, generator=generator, dtype=torch.float64) for n in (Q, D))
    logs = torch.tensor([0.3, -1.2, 0.4, -0.9], dtype=torch.float64)
    return poses, latents, KernelParameters(*logs.unbind())


def dense_covariance(latents: Tensor, kernel: KernelParameters) -> np.ndarray:
    """Element by element (MR 14), with sigma_z^2 on the diagonal."""
    beta, beta0, gamma, sigma = (math.exp(float(value)) for value in kernel)
    z = latents.detach().numpy()
    k = [[beta * math.exp(-gamma / 2 * sum((a - b) ** 2)) + beta0 for b in z] for a in z]
    return np.array(k) + (sigma**2 + 1e-8 * (beta + beta0)) * np.eye(len(z))


def test_the_kernels_are_the_formulas(problem) -> None:
    poses, latents, kernel = problem
    found = covariance(latents, kernel)
    np.testing.assert_allclose(found.numpy(), dense_covariance(latents, kernel), rtol=1e-12)
    gamma = torch.tensor(0.7, dtype=torch.float64)
    expected = torch.exp(-0.35 * torch.cdist(poses[:4], poses).square())
    torch.testing.assert_close(rbf(poses[:4], poses, gamma), expected)


def test_the_likelihood_is_that_of_dense_gaussians(problem) -> None:
    poses, latents, kernel = problem
    dense = multivariate_normal(np.zeros(T), dense_covariance(latents, kernel))
    expected = sum(dense.logpdf(column) for column in poses.T.numpy())
    assert float(log_likelihood(poses, latents, kernel)) == pytest.approx(expected, rel=1e-10)
    regulariser = 0.5 * float(latents.square().sum())
    assert float(objective(poses, latents, kernel)) == pytest.approx(expected - regulariser)


def test_gradients_are_those_of_the_paper(problem) -> None:
    """(MR 17) for dL/dK, (MR 19) for dk/dz, (MR 18) and (MR 20) together, all written out."""
    poses, latents, kernel = problem
    z = latents.clone().requires_grad_()
    (found,) = torch.autograd.grad(objective(poses, z, kernel), z)
    full = covariance(latents, kernel)
    inverse = torch.linalg.inv(full)
    by_kernel = -Q / 2 * inverse + 0.5 * inverse @ poses @ poses.T @ inverse  # (MR 17)
    beta0, gamma = kernel.log_beta0.exp(), kernel.log_gamma.exp()
    expected = torch.zeros_like(latents)
    for t in range(T):
        for i in range(D):
            by_z = torch.zeros_like(full)  # (MR 19)
            for other in set(range(T)) - {t}:
                slope = -gamma * (full[t, other] - beta0) * (latents[t, i] - latents[other, i])
                by_z[t, other] = by_z[other, t] = slope
            expected[t, i] = (by_kernel.T @ by_z).trace() - latents[t, i]  # (MR 18), (MR 20)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


def test_gradients_are_finite_differences(problem) -> None:
    poses, latents, kernel = problem
    logs = torch.stack(list(kernel)).requires_grad_()

    def value(z: Tensor, logs: Tensor) -> Tensor:
        return objective(poses, z, KernelParameters(*logs.unbind()))

    assert torch.autograd.gradcheck(value, (latents.requires_grad_(), logs))


def test_the_scale_of_latent_points_is_arbitrary_but_for_the_regulariser(problem) -> None:
    """Why gamma_z is held: as printed, (MR 16) only gets larger as Z shrinks."""
    poses, latents, kernel = problem
    values = []
    for shrink in (1.0, 0.1, 0.01):
        other = kernel._replace(log_gamma=kernel.log_gamma - 2 * math.log(shrink))
        values.append(float(objective(poses, shrink * latents, other)))
        same = float(log_likelihood(poses, shrink * latents, other))
        assert same == pytest.approx(float(log_likelihood(poses, latents, kernel)), rel=1e-9)
    assert values == sorted(values)


def test_gamma_of_the_median_distance() -> None:
    poses = torch.tensor([[0.0], [1.0], [3.0]], dtype=torch.float64)  # distances 1, 2, 3
    assert median_gamma(poses) == pytest.approx(0.25)
    assert median_gamma(1000 * poses) == pytest.approx(0.25e-6)
    with pytest.raises(InputError, match="gamma_x cannot be told from the median distance"):
        median_gamma(torch.ones(20, 3).double())
    many = motion(2500)
    assert median_gamma(many, seed=1) == pytest.approx(median_gamma(many, seed=2), rel=0.05)


def test_the_start_is_that_of_principal_components() -> None:
    poses = motion(80)
    poses = poses - poses.mean(0)
    expected = PCA(2, whiten=True).fit_transform(poses.numpy()) * math.sqrt(80 / 79)
    found = principal_start(poses, 2).numpy()
    signs = np.sign((found * expected).sum(0))
    np.testing.assert_allclose(found * signs, expected, atol=1e-8)
    more = PCA(4, whiten=True).fit_transform(poses.numpy()) * math.sqrt(80 / 79)
    for start, pair in enumerate([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]):
        found = principal_start(poses, 2, start).numpy()
        np.testing.assert_allclose(abs(found), abs(more[:, pair]), atol=1e-8)
    noisy = principal_start(poses, 2, 6)
    assert torch.equal(noisy, principal_start(poses, 2, 6))
    assert 0.1 < float((noisy - principal_start(poses, 2)).std()) < 0.5
    with pytest.raises(InputError, match="2 latent dimensions need poses that vary in as many"):
        principal_start(torch.arange(12.0).double()[:, None] * torch.ones(3).double(), 2)


def test_back_constraints_start_close_to_principal_components() -> None:
    poses = motion(60)
    fit = GPLVMFit(poses - poses.mean(0), 2, 0.3)
    start = principal_start(fit.poses, 2)
    latents = (fit.features @ fit.coordinates + fit.bias).detach()
    assert float((latents - start).square().mean().sqrt()) < 0.1
    direct = rbf(fit.poses, fit.poses, fit.gamma_x) @ fit.weights.detach()  # (MR 21)
    torch.testing.assert_close(latents, direct, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("optimiser", ["lbfgs", "adam"])
def test_the_objective_grows_and_the_noise_is_found(optimiser) -> None:
    poses = motion(100)
    fit = run_fit(GPLVMFit(poses - poses.mean(0), 2, 0.3, optimiser), 14, tolerance=0)
    assert fit.history[-1] > fit.history[0] + 1
    if optimiser == "lbfgs":
        assert fit.history == sorted(fit.history)
    assert float(fit.kernel.log_sigma.detach().exp()) == pytest.approx(0.01, rel=0.35)
    assert float(fit.kernel.log_gamma.detach()) == 0.0


def test_a_penalty_makes_back_constraints_smoother() -> None:
    poses = motion(60)
    sizes = []
    for smoothness in (0.0, 10.0):
        fit = GPLVMFit(poses - poses.mean(0), 2, 0.3, smoothness=smoothness)
        run_fit(fit, 5)
        coordinates = fit.coordinates.detach()
        latents = fit.features @ coordinates
        sizes.append(float(coordinates.square().sum() / latents.square().sum()))
    assert sizes[1] < sizes[0]


@pytest.mark.parametrize("optimiser", ["lbfgs", "adam"])
def test_a_fit_goes_on_from_its_state(optimiser, tmp_path) -> None:
    poses = motion(50) - motion(50).mean(0)
    whole = run_fit(GPLVMFit(poses, 2, 0.3, optimiser), 6, tolerance=0)
    half = run_fit(GPLVMFit(poses, 2, 0.3, optimiser), 3, tolerance=0)
    torch.save(half.state_dict(), tmp_path / "half.pt")
    resumed = GPLVMFit(poses, 2, 0.3, optimiser)
    resumed.load_state_dict(torch.load(tmp_path / "half.pt", weights_only=True))
    run_fit(resumed, 6, tolerance=0)
    assert resumed.history == whole.history
    for name, value in whole.named_parameters():
        assert torch.equal(value, resumed.get_parameter(name))


def test_a_fit_stops_when_it_gains_nothing() -> None:
    poses = motion(40)
    fit = run_fit(GPLVMFit(poses - poses.mean(0), 2, 0.3), 50, tolerance=1e-2)
    assert len(fit.history) < 20 and fit.history[-1] - fit.history[-2] < 1e-2


def test_bad_settings_are_refused() -> None:
    poses = motion(20)
    for message, options in (
        ("optimiser must be one of lbfgs, adam, got 'sgd'", {"optimiser": "sgd"}),
        ("latent_dim must be from 1 to the number of columns, 30, got 0", {"latent_dim": 0}),
        ("latent_dim must be from 1 to the number of columns, 30, got 31", {"latent_dim": 31}),
        ("gamma_x must be positive, got 0", {"gamma_x": 0.0}),
        ("learning_rate must be positive, got -1", {"learning_rate": -1.0}),
        ("smoothness must not be negative, got -1", {"smoothness": -1.0}),
    ):
        with pytest.raises(InputError, match=message):
            GPLVMFit(poses, **{"latent_dim": 2, "gamma_x": 0.3} | options)
    with pytest.raises(ShapeError, match="poses must have shape"):
        GPLVMFit(poses[0], 2, 0.3)
    with pytest.raises(InputError, match="diverged after 1 steps; take a smaller learning rate"):
        run_fit(GPLVMFit(poses, 2, 0.3, "adam", learning_rate=1e4), 5, tolerance=-1)
