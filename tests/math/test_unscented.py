"""The unscented transform against closed forms, NumPy's moments and Monte Carlo."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from tests.filters.oracles import random_covariance, tensor
from torchpose.errors import InputError, ShapeError
from torchpose.math import unscented_transform, unscented_update
from torchpose.math._unscented import floor_eigenvalues, moments, sigma_points

OPTIONS = [(c, d) for c in (False, True) for d in ("eigen", "cholesky")]


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.mark.parametrize(("centre", "directions"), OPTIONS)
@pytest.mark.parametrize("dim", [1, 3, 7])
def test_the_points_have_the_moments_of_the_gaussian(rng, centre, directions, dim):
    mean, cov = rng.standard_normal(dim), random_covariance(rng, dim)
    points = sigma_points(tensor(mean), tensor(cov), centre=centre, directions=directions).numpy()
    assert points.shape == (2 * dim + centre, dim)
    np.testing.assert_allclose(points.mean(0), mean, atol=1e-12)
    np.testing.assert_allclose(np.atleast_2d(np.cov(points.T, bias=True)), cov, atol=1e-12)
    if centre:
        np.testing.assert_array_equal(points[0], mean)


def test_the_points_lie_where_the_paper_puts_them():
    cov = tensor(np.diag([0.04, 0.01, 0.09]))
    points = sigma_points(torch.zeros(3).double(), cov)
    reach = points.norm(dim=-1).reshape(2, 3)
    expected = tensor(np.sqrt(3 * np.array([0.01, 0.04, 0.09])))  # sqrt(D v), by size
    torch.testing.assert_close(reach, expected.expand(2, 3))
    torch.testing.assert_close(points[:3], -points[3:])
    seven = sigma_points(torch.zeros(3).double(), cov, centre=True)[1:]
    torch.testing.assert_close(seven, points * math.sqrt(3.5 / 3))


@pytest.mark.parametrize(("centre", "directions"), OPTIONS)
def test_it_is_exact_for_linear_maps_and_means_of_squares(rng, centre, directions):
    mean, cov = rng.standard_normal(4), random_covariance(rng, 4)
    matrix = rng.standard_normal((3, 4))
    options = {"centre": centre, "directions": directions}
    new_mean, new_cov = unscented_transform(
        lambda x: x @ tensor(matrix).mT, tensor(mean), tensor(cov), **options
    )
    np.testing.assert_allclose(new_mean, matrix @ mean, atol=1e-12)
    np.testing.assert_allclose(new_cov, matrix @ cov @ matrix.T, atol=1e-12)
    squares, _ = unscented_transform(torch.square, tensor(mean), tensor(cov), **options)
    np.testing.assert_allclose(squares, mean**2 + np.diag(cov), atol=1e-12)


@pytest.mark.parametrize(("centre", "directions"), OPTIONS)
def test_the_update_of_a_linear_measurement_is_kalmans(rng, centre, directions):
    mean, cov = rng.standard_normal((2, 4)), random_covariance(rng, 4)
    matrix, noise = rng.standard_normal((2, 4)), random_covariance(rng, 2)
    z = rng.standard_normal((2, 2))
    new_mean, new_cov, log_likelihood = unscented_update(
        lambda x: x @ tensor(matrix).mT, tensor(mean), tensor(cov).expand(2, 4, 4), tensor(z),
        tensor(noise), centre=centre, directions=directions,
    )  # fmt: skip
    innovation = matrix @ cov @ matrix.T + noise
    gain = cov @ matrix.T @ np.linalg.inv(innovation)
    np.testing.assert_allclose(new_mean, mean + (z - mean @ matrix.T) @ gain.T, atol=1e-12)
    expected = np.broadcast_to(cov - gain @ innovation @ gain.T, (2, 4, 4))
    np.testing.assert_allclose(new_cov, expected, atol=1e-12)
    density = [
        multivariate_normal(matrix @ m, innovation).logpdf(v) for m, v in zip(mean, z, strict=True)
    ]
    np.testing.assert_allclose(log_likelihood, density, atol=1e-10)


def test_weighted_moments_are_numpys(rng):
    points, weights = rng.standard_normal((5, 7, 3)), rng.uniform(size=(5, 7))
    weights[:, 2] = 0
    with np.errstate(divide="ignore"):
        log_weights = tensor(np.log(weights) - 700)
    mean, cov = moments(tensor(points), log_weights)
    for i in range(5):
        np.testing.assert_allclose(mean[i], np.average(points[i], axis=0, weights=weights[i]))
        expected = np.cov(points[i].T, aweights=weights[i], bias=True)
        np.testing.assert_allclose(cov[i], expected, atol=1e-12)
    assert torch.equal(cov, cov.mT)


def test_uniform_likelihoods_leave_the_gaussian_as_it_is(rng):
    mean, cov = tensor(rng.standard_normal(3)), tensor(random_covariance(rng, 3))
    points = sigma_points(mean, cov, centre=True)
    new_mean, new_cov = moments(points, torch.full((7,), -3.0).double())
    torch.testing.assert_close(new_mean, mean)
    torch.testing.assert_close(new_cov, cov)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("directions", ["eigen", "cholesky"])
def test_singular_covariances(dtype, directions):
    axis = torch.tensor([0.3, -0.5, 0.2], dtype=dtype)
    covs = torch.stack([torch.zeros(3, 3, dtype=dtype), axis[:, None] * axis])
    mean = torch.ones(2, 3, dtype=dtype)
    points = sigma_points(mean, covs, centre=True, directions=directions)
    assert points.dtype == dtype
    back_mean, back = moments(points)
    # A factor that is not definite is mended with a millionth of its diagonal at most
    torch.testing.assert_close(back, covs, atol=2e-7, rtol=1e-5)
    torch.testing.assert_close(back_mean, mean)


def test_a_lost_element_stays_alone():
    covs = torch.eye(3).double().repeat(3, 1, 1)
    covs[1, 0, 0] = math.nan
    points = sigma_points(torch.zeros(3, 3).double(), covs)
    assert points.isfinite().flatten(1).all(1).tolist() == [True, False, True]


def test_leading_shapes(rng):
    covs = tensor(np.stack([random_covariance(rng, 3) for _ in range(10)])).reshape(2, 5, 3, 3)
    means = tensor(rng.standard_normal((2, 5, 3)))
    points = sigma_points(means, covs)
    for i, j in np.ndindex(2, 5):
        torch.testing.assert_close(points[i, j], sigma_points(means[i, j], covs[i, j]))
    assert sigma_points(means[:0], covs[:0]).shape == (0, 5, 6, 3)


def test_a_floor_raises_small_eigenvalues_only(rng):
    vectors = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    cov = tensor(vectors * np.array([0.0, 0.2, 3.0]) @ vectors.T)
    raised = floor_eigenvalues(cov, 0.5)
    expected = vectors * np.array([0.5, 0.5, 3.0]) @ vectors.T
    np.testing.assert_allclose(raised, expected, atol=1e-12)
    assert torch.equal(raised, raised.mT)
    torch.testing.assert_close(floor_eigenvalues(cov, 0.0), cov)


def test_bad_input():
    with pytest.raises(InputError, match="directions must be one of eigen, cholesky, got 'pca'"):
        sigma_points(torch.zeros(3), torch.eye(3), directions="pca")
    with pytest.raises(ShapeError, match="covariance must have shape"):
        sigma_points(torch.zeros(3), torch.eye(4))
    with pytest.raises(ShapeError, match="log_weights must have shape"):
        moments(torch.zeros(7, 3), torch.zeros(6))
    with pytest.raises(InputError, match="least must be a variance"):
        floor_eigenvalues(torch.eye(3), -1.0)


@pytest.mark.parametrize(
    ("measured", "noise", "message"),
    [
        (torch.ones(1), torch.eye(2), r"noise must have shape \[\.\.\., 1, 1\], got \[2, 2\]"),
        (torch.ones(1), torch.eye(1), r"what function returns must have shape \[\.\.\., 6, 1\]"),
        (torch.ones(2), torch.ones(2), r"noise must have shape \[\.\.\., 2, 2\], got \[2\]"),
        (torch.tensor(1.0), torch.eye(2), r"measured must have shape \[\.\.\., Z\], got \[\]"),
    ],
)
def test_an_update_by_other_sizes_is_refused(measured, noise, message):
    with pytest.raises(ShapeError, match=message):
        unscented_update(lambda x: x[..., :2], torch.zeros(3), torch.eye(3), measured, noise)
