"""Gaussian algebra against SciPy, plain inverses and Monte Carlo."""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from tests.filters.oracles import random_covariance, tensor
from torchpose.errors import InputError, ShapeError
from torchpose.math import _gaussian as gaussian


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def test_log_prob_is_scipys(rng):
    mean, cov, x = rng.standard_normal(4), random_covariance(rng, 4), rng.standard_normal((5, 4))
    ours = gaussian.log_prob(tensor(x), tensor(mean), torch.linalg.cholesky(tensor(cov)))
    np.testing.assert_allclose(ours, multivariate_normal(mean, cov).logpdf(x), rtol=1e-12)


def test_a_product_of_densities_is_a_density_times_a_constant(rng):
    a, b, x = rng.standard_normal((3, 4))
    cov_a, cov_b = random_covariance(rng, 4), random_covariance(rng, 4, 0.5)
    mean, cov, log_c = gaussian.product(tensor(a), tensor(cov_a), tensor(b), tensor(cov_b))
    inverse = np.linalg.inv(np.linalg.inv(cov_a) + np.linalg.inv(cov_b))
    np.testing.assert_allclose(cov, inverse, atol=1e-12)
    product = multivariate_normal(a, cov_a).logpdf(x) + multivariate_normal(b, cov_b).logpdf(x)
    ours = gaussian.log_prob(tensor(x), mean, torch.linalg.cholesky(cov)) + log_c
    np.testing.assert_allclose(ours, product, rtol=1e-10)


def test_conditional_times_marginal_is_the_joint(rng):
    mean, cov, x = rng.standard_normal(5), random_covariance(rng, 5), rng.standard_normal(5)
    known, rest = [3, 1], [0, 2, 4]
    index = torch.tensor(known)
    new_mean, new_cov, log_known = gaussian.condition(
        tensor(mean), tensor(cov), index, tensor(x[known])
    )
    part_mean, part_cov = gaussian.marginal(tensor(mean), tensor(cov), index)
    np.testing.assert_allclose(
        log_known, multivariate_normal(part_mean.numpy(), part_cov.numpy()).logpdf(x[known])
    )
    log_rest = multivariate_normal(new_mean.numpy(), new_cov.numpy()).logpdf(x[rest])
    joint = multivariate_normal(mean, cov).logpdf(x)
    np.testing.assert_allclose(log_rest + float(log_known), joint, rtol=1e-10)


@pytest.mark.parametrize("mask", [None, [True, True], [True, False], [False, False]])
def test_an_update_is_that_of_plain_inverses_and_of_gain_and_correction(rng, mask):
    mean, z = rng.standard_normal((3, 4)), rng.standard_normal((3, 2))
    cov = np.stack([random_covariance(rng, 4) for _ in range(3)])
    noise, observed = random_covariance(rng, 2), torch.tensor([2, 0])
    seen = None if mask is None else torch.tensor(mask).expand(3, 2)
    arguments = tensor(noise), observed, seen
    new_mean, new_cov, log_likelihood = gaussian.kalman_update(
        tensor(mean), tensor(cov), tensor(z), *arguments
    )
    gain, apart_cov = gaussian.kalman_gain(tensor(cov), *arguments)
    apart_mean, apart_log = gaussian.kalman_correct(tensor(mean), tensor(z), gain, observed, seen)
    torch.testing.assert_close(new_mean, apart_mean)
    torch.testing.assert_close(new_cov, apart_cov)
    torch.testing.assert_close(log_likelihood, apart_log)
    kept = [k for k in range(2) if mask is None or mask[k]]
    rows = observed.numpy()[kept]
    for i in range(3):
        s = cov[i][np.ix_(rows, rows)] + noise[np.ix_(kept, kept)]
        k = cov[i][:, rows] @ np.linalg.inv(s)
        residual = z[i, kept] - mean[i, rows]
        np.testing.assert_allclose(new_mean[i], mean[i] + k @ residual, atol=1e-12)
        np.testing.assert_allclose(new_cov[i], cov[i] - k @ s @ k.T, atol=1e-12)
        expected = multivariate_normal(np.zeros(len(kept)), s).logpdf(residual) if kept else 0.0
        np.testing.assert_allclose(log_likelihood[i], expected, atol=1e-12)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("shared_cov", [False, True])
def test_a_step_is_that_of_plain_inverses_whatever_is_shared(rng, batch, shared_cov):
    dim, rows = 5, np.array([4, 1])
    mean, z = rng.standard_normal((*batch, dim)), rng.standard_normal((*batch, 2))
    cov, noise = random_covariance(rng, dim), random_covariance(rng, dim, 0.1)
    F, b, R = rng.standard_normal((dim, dim)), rng.standard_normal(dim), random_covariance(rng, 2)
    covs = tensor(cov) if shared_cov else tensor(cov).expand(*batch, -1, -1)
    predicted = gaussian.kalman_predict(tensor(mean), covs, tensor(F), tensor(b), tensor(noise))
    assert predicted[1].shape == covs.shape and torch.equal(predicted[1], predicted[1].mT)
    mean, cov = mean @ F.T + b, F @ cov @ F.T + noise
    np.testing.assert_allclose(predicted[0], mean, atol=1e-12)
    np.testing.assert_allclose(predicted[1], np.broadcast_to(cov, covs.shape), atol=1e-12)
    new_mean, new_cov, log_likelihood = gaussian.kalman_update(
        *predicted, tensor(z), tensor(R), torch.tensor(rows)
    )
    S = cov[np.ix_(rows, rows)] + R
    K = cov[:, rows] @ np.linalg.inv(S)
    residual = z - mean[..., rows]
    np.testing.assert_allclose(new_mean, mean + residual @ K.T, atol=1e-11)
    np.testing.assert_allclose(new_cov - tensor(cov - K @ S @ K.T), 0, atol=1e-11)
    expected = multivariate_normal(np.zeros(2), S).logpdf(residual)
    np.testing.assert_allclose(log_likelihood, expected, rtol=1e-11)


def test_gradients_flow_through_a_step(rng):
    cov = random_covariance(rng, 3)
    start = tensor(np.stack([rng.standard_normal(3), *cov])).requires_grad_()

    def step(start):
        root, eye = start[1:], torch.eye(3, dtype=start.dtype)
        state = gaussian.kalman_predict(start[0], root @ root.mT, root, start[0], eye)
        z, seen = torch.ones(2, dtype=start.dtype), torch.tensor([0, 2])
        return gaussian.kalman_update(*state, z, eye[:2, :2], seen)

    assert torch.autograd.gradcheck(step, start)


def test_a_step_factorises_once_and_loses_only_what_is_not_positive_definite(rng, monkeypatch):
    calls, plain = [], torch.linalg.cholesky_ex
    monkeypatch.setattr(torch.linalg, "cholesky_ex", lambda a: calls.append(a) or plain(a))
    cov = tensor(np.stack([random_covariance(rng, 3) for _ in range(2)]))
    mean, z, R = cov.new_zeros(2, 3), cov.new_ones(2, 2), torch.eye(2, dtype=cov.dtype)
    observed = torch.tensor([0, 1])
    expected = gaussian.kalman_update(mean, cov, z, R, observed)
    assert len(calls) == 1
    cov[1] = -9 * torch.eye(3, dtype=cov.dtype)
    for found, value in zip(
        gaussian.kalman_update(mean, cov, z, R, observed), expected, strict=True
    ):
        assert torch.equal(found[0], value[0]) and bool(torch.isnan(found[1]).any())


def indefinite_correlations(rng, dim, lowest):
    """A symmetric matrix of unit diagonal whose smallest eigenvalue is `lowest`, in long double."""
    a = rng.standard_normal((dim, dim - 1)).astype(np.longdouble)
    a /= np.sqrt((a**2).sum(1, keepdims=True))
    return (a @ a.T - np.diag(np.full(dim, -lowest))) / (1 + lowest)


@pytest.mark.parametrize("lowest", [-3e-15, -3e-13, -3e-11, -3e-9, -3e-7])
def test_a_mended_matrix_keeps_every_variance_whatever_its_unit(rng, lowest):
    scale = np.array([1e2, 30.0, 1.0, 1e-2, 1e-3])  # pixels, metres, radians
    matrices, least = [], []
    for _ in range(20):
        correlations = indefinite_correlations(rng, 5, lowest)
        matrices.append(np.float64(scale[:, None] * correlations * scale))
        least.append(np.linalg.eigvalsh(np.float64(correlations))[0])
    factor, jitter = gaussian.mended_cholesky(tensor(np.stack(matrices)))
    expected = 10.0 ** (2 * np.ceil(np.log10(-np.array(least)) / 2))
    if lowest < -1e-13:  # smaller ones are no more than rounding of the matrix itself
        np.testing.assert_array_equal(jitter, expected)
    assert float(jitter.max()) <= max(-30 * lowest, 1e-12)
    for found, share, matrix in zip(factor, jitter, matrices, strict=True):
        change = (found @ found.mT).numpy() - matrix
        relative = change / np.sqrt(np.outer(matrix.diagonal(), matrix.diagonal()))
        np.testing.assert_allclose(relative, float(share) * np.eye(5), atol=3e-15)


def test_what_is_positive_definite_keeps_its_factor_beside_what_is_mended_or_lost(rng):
    good = np.stack([random_covariance(rng, 3) * 10.0**k for k in (-8, 0, 8)])
    thin = np.outer([1.0, 2.0, 4.0], [1.0, 2.0, 4.0])
    hopeless = [-np.eye(3), np.eye(3) * np.nan, np.ones((3, 3)) - 1e-3 * np.eye(3)]
    hopeless.append(np.array([[1.0, 9.0, 0.0], [9.0, 1.0, 0.0], [0.0, 0.0, 1e9]]))
    matrices = tensor(np.stack([*good, thin, np.zeros((3, 3)), *hopeless])).requires_grad_()
    factor, jitter = gaussian.mended_cholesky(matrices)
    assert torch.equal(factor[:3], torch.linalg.cholesky(matrices[:3]))
    assert jitter.tolist() == [0, 0, 0, 1e-14, 1e-14, 0, 0, 0, 0]
    torch.testing.assert_close(factor[3] @ factor[3].mT, tensor(thin), atol=1e-12, rtol=0)
    assert torch.isfinite(factor[4]).all() and factor[4].abs().max() < 1e-8
    assert torch.isnan(factor[5:]).all()
    (slope,) = torch.autograd.grad(factor[:4].sum(), matrices)
    assert torch.isfinite(slope[:4]).all()
    assert gaussian.mended_cholesky(matrices[:3].detach())[1] is None


@pytest.mark.parametrize("variance", [0.0, -1e-13, 1e-18])
def test_a_variance_that_is_rounding_is_mended_by_the_scale_of_the_others(variance):
    matrix = np.diag([1.0, 3.0, variance])
    matrix[0, 2] = matrix[2, 0] = 1e-8
    factor, jitter = gaussian.mended_cholesky(tensor(matrix))
    expected = matrix + float(jitter) * np.diag([1.0, 3.0, 4 / 3])
    np.testing.assert_allclose((factor @ factor.mT).numpy(), expected, atol=1e-15)
    assert 0 < float(jitter) <= 1e-12


def test_moments_of_a_mixture_are_those_of_its_draws(rng):
    weights, means = rng.dirichlet(np.ones(3)), rng.standard_normal((3, 2)) * 3
    covs = np.stack([random_covariance(rng, 2, 0.5) for _ in range(3)])
    mean, cov = gaussian.mixture_moments(tensor(np.log(weights)), tensor(means), tensor(covs))
    n = 200_000
    chosen = rng.choice(3, n, p=weights)
    noise = rng.standard_normal((n, 2, 1))
    draws = means[chosen] + (np.linalg.cholesky(covs)[chosen] @ noise)[..., 0]
    np.testing.assert_allclose(mean, draws.mean(0), atol=5 * draws.std() / n**0.5)
    np.testing.assert_allclose(cov, np.cov(draws.T), atol=0.1)


PREDICTION = {"mean": (4,), "cov": (4, 4), "transition": (4, 4), "offset": (4,), "noise": (4, 4)}
UPDATE = {"mean": (4,), "cov": (4, 4), "z": (2,), "measurement_cov": (2, 2)}


@pytest.mark.parametrize(
    ("step", "sizes", "wrong"),
    [(gaussian.kalman_predict, PREDICTION, {name: (3, 3)}) for name in PREDICTION if name != "mean"]
    + [(gaussian.kalman_predict, PREDICTION, {"mean": ()})]
    + [(gaussian.kalman_update, UPDATE, {name: (3, 3)}) for name in UPDATE if name != "mean"]
    + [
        (gaussian.kalman_predict, PREDICTION, {"mean": (3, 4), "noise": (2, 4, 4)}),
        (gaussian.kalman_update, UPDATE, {"mean": (3, 4), "cov": (2, 4, 4)}),
    ],
)
def test_sizes_that_do_not_fit_are_named(step, sizes, wrong):
    values = {name: torch.zeros(wrong.get(name, size)) for name, size in sizes.items()}
    if step is gaussian.kalman_update:
        values["observed"] = torch.tensor([2, 0])
    with pytest.raises(ShapeError, match=f"{list(wrong)[-1]}"):
        step(**values)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"observed": [2, 0]}, "observed must be a tensor, got list"),
        ({"observed": torch.tensor([4, 0])}, r"observed must lie in 0..3, got \[4, 0\]"),
        ({"observed": torch.tensor([True, False])}, "observed must hold indices"),
        ({"mask": torch.ones(2)}, "mask must be bool, got torch.float32"),
        ({"mask": torch.ones(3).bool()}, r"mask must have shape \[..., 2\], got \[3\]"),
        ({"cov": np.eye(4)}, "cov must be a tensor, got ndarray"),
    ],
)
def test_what_does_not_say_which_dimensions_are_measured_is_named(wrong, said):
    values = {name: torch.zeros(size) for name, size in UPDATE.items()}
    with pytest.raises((InputError, ShapeError), match=said):
        gaussian.kalman_update(**(values | {"observed": torch.tensor([2, 0])} | wrong))
