"""Expectation-maximisation against scikit-learn, against itself in other forms, and on bad data."""

import warnings

import numpy as np
import pytest
import torch
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import GaussianMixture as Sklearn

from tests.priors.mixtures import random_mixture
from torchpose.errors import CovarianceError, InputError, ShapeError
from torchpose.math import _mixture_steps as mixture_steps
from torchpose.math import expectation_maximisation
from torchpose.math._mixture_start import STARTS, floor_variances, k_means, start_mixture
from torchpose.math._mixture_steps import (
    CyclicFeatures,
    MixtureParameters,
    cyclic_order,
    e_step,
    m_step,
    natural_parameters,
)
from torchpose.priors import GaussianMixture


def sample(n=3000, k=5, dim=4, seed=0):
    return random_mixture(k, dim, seed).sample((n,), torch.Generator().manual_seed(seed))


def random_start(x, k=5, seed=1):
    g = torch.Generator().manual_seed(seed)
    covariance = torch.cov(x.T).expand(k, -1, -1).clone()
    return MixtureParameters(
        torch.full((k,), 1 / k, dtype=x.dtype),
        x[torch.randperm(len(x), generator=g)[:k]],
        covariance,
    )


def fit_sklearn(x, start, steps, reg):
    model = Sklearn(
        len(start.weights),
        tol=0,
        max_iter=steps,
        reg_covar=reg,
        weights_init=start.weights.numpy(),
        means_init=start.means.numpy(),
        precisions_init=torch.linalg.inv(start.covariances).numpy(),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return model.fit(x.numpy())


@pytest.mark.parametrize("reg", [1e-6, 1e-2])
def test_twenty_steps_are_scikit_learns(reg):
    x = sample() * torch.tensor([100.0, 1.0, 0.01, 1.0], dtype=torch.float64) + 50
    start = random_start(x)
    floor = torch.full((4,), reg, dtype=torch.float64)
    mine, report = expectation_maximisation(x, start, max_iter=20, tol=0, floor=floor)
    theirs = fit_sklearn(x, start, 20, reg)
    assert report.iterations == 20 and report.reseeded == 0
    np.testing.assert_allclose(mine.weights, theirs.weights_, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(mine.means, theirs.means_, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(mine.covariances, theirs.covariances_, rtol=1e-6, atol=1e-6)
    assert report.log_likelihood[-1] == pytest.approx(theirs.score(x.numpy()), abs=1e-9)


def test_features_times_theta_is_the_log_density():
    mixture = random_mixture()
    x = sample(20, dim=3)
    rows, columns = torch.triu_indices(3, 3)
    phi = torch.cat([torch.ones(20, 1), x, x[:, rows] * x[:, columns]], 1)
    theta = natural_parameters(mixture.parameters_tuple())
    torch.testing.assert_close(phi @ theta.T, mixture.component_log_prob(x))


@pytest.mark.parametrize(("k", "dim"), [(1, 1), (5, 2), (4, 3), (6, 8), (3, 21)])
def test_statistics_are_the_sums_they_say(k, dim, monkeypatch):
    monkeypatch.setattr(mixture_steps, "POINTS", 600 // torch.get_num_threads())  # several chunks
    mixture, x = random_mixture(k, dim), sample(2500, dim=dim)
    r = mixture.component_log_prob(x).softmax(-1)
    statistics = e_step(x, mixture.parameters_tuple())
    rows, columns = torch.triu_indices(dim, dim)
    torch.testing.assert_close(statistics.table[:, 0], r.sum(0))
    torch.testing.assert_close(statistics.table[:, 1 : 1 + dim], r.T @ x)
    torch.testing.assert_close(statistics.table[:, 1 + dim :], r.T @ (x[:, rows] * x[:, columns]))
    assert float(statistics.log_likelihood) == pytest.approx(float(mixture.log_prob(x).sum()))
    assert float(statistics.weight) == 2500


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_points_far_from_every_component_have_responsibilities(dtype):
    mixture, x = random_mixture(5, 2), torch.tensor([[1e9, 0.0], [0.0, -1e12]], dtype=dtype)
    statistics = e_step(x, mixture.parameters_tuple())
    assert float(statistics.table[:, 0].sum()) == pytest.approx(2)
    expected = float(mixture.log_prob(x.double()).sum())
    assert float(statistics.log_likelihood) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("dim", range(1, 8))
def test_cyclic_features_are_all_products(dim):
    x = sample(50, dim=dim)
    rows, columns = torch.triu_indices(dim, dim)
    phi = torch.cat([torch.ones(50, 1), x, x[:, rows] * x[:, columns]], 1)
    order = cyclic_order(dim, x.device)
    assert sorted(order.tolist()) == list(range(phi.shape[1]))
    features = CyclicFeatures(x, 16)
    for chunk, expected in zip(x.split(16), phi.split(16), strict=True):
        assert torch.equal(features.of(chunk.T).T, expected[:, order])


def test_statistics_of_parts_merge():
    parameters, x = random_mixture().parameters_tuple(), sample(2500, dim=3)
    parts = [e_step(part, parameters) for part in x.split([100, 1400, 1000])]
    whole = e_step(x, parameters)
    for merged, value in zip(parts[0].merge(*parts[1:]), whole, strict=True):
        torch.testing.assert_close(merged, value)
    floor = 1e-9 * torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(
        m_step(parts[0].merge(*parts[1:]), floor)[0], m_step(whole, floor)[0]
    )


@pytest.mark.parametrize("seed", range(4))
def test_log_likelihood_never_falls(seed):
    x = sample(seed=seed)
    start = random_start(x, seed=seed)
    _, report = expectation_maximisation(x, start, max_iter=60, tol=0)
    assert report.reseeded == 0
    assert min(np.diff(report.log_likelihood)) > -1e-12


def test_integer_weights_are_repetitions():
    x = sample(400)
    count = torch.randint(0, 4, (400,), generator=torch.Generator().manual_seed(2))
    start = random_start(x)
    weighted, a = expectation_maximisation(x, start, count.double(), max_iter=20, tol=0)
    repeated, b = expectation_maximisation(x.repeat_interleave(count, 0), start, max_iter=20, tol=0)
    for mine, theirs in zip(weighted, repeated, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(a.log_likelihood, b.log_likelihood, rtol=1e-10)


def test_scale_of_the_weights_does_not_matter():
    x = sample(500)
    weight = torch.rand(500, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    a, b = (GaussianMixture.fit(x, 3, sample_weight=w) for w in (weight, 1e-3 * weight))
    torch.testing.assert_close(a.means, b.means, rtol=1e-8, atol=1e-9)


def test_units_of_the_data_do_not_matter():
    x = sample(1000)
    scale = torch.tensor([1e4, 1.0, 1e-4, 1.0], dtype=torch.float64)
    fit, scaled = GaussianMixture.fit(x, 3), GaussianMixture.fit(x * scale - 7, 3)
    torch.testing.assert_close(scaled.means, fit.means * scale - 7, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(
        scaled.covariances / torch.outer(scale, scale), fit.covariances, rtol=1e-7, atol=1e-9
    )


def test_float32_products_are_close():
    x, start = sample(), random_start(sample())
    _, double = expectation_maximisation(x, start, max_iter=20, tol=0)
    mixture, single = expectation_maximisation(x, start, max_iter=20, tol=0, dtype=torch.float32)
    assert mixture.means.dtype == torch.float64
    assert single.log_likelihood[-1] == pytest.approx(double.log_likelihood[-1], abs=1e-3)


def test_fit_finds_what_scikit_learn_finds():
    x = sample(4000)
    mine = GaussianMixture.fit(x, 5, seed=0, n_init=3, tol=1e-6)
    theirs = Sklearn(5, n_init=3, random_state=0, tol=1e-6, max_iter=500).fit(x.numpy())
    assert mine.fit_report.converged and len(mine.fit_report.starts) == 3
    assert mine.fit_report.log_likelihood[-1] == max(mine.fit_report.starts)
    assert float(mine.log_prob(x).mean()) > theirs.score(x.numpy()) - 0.01
    assert float(mine.log_prob(x).mean()) == pytest.approx(mine.fit_report.log_likelihood[-1])


@pytest.mark.parametrize("init", STARTS)
def test_fit_follows_its_seed(init):
    x = sample(600)
    fits = [GaussianMixture.fit(x, 4, seed=seed, init=init, max_iter=5) for seed in (0, 0, 1)]
    assert torch.equal(fits[0].means, fits[1].means)
    assert not torch.equal(fits[0].means, fits[2].means)
    g = torch.Generator().manual_seed(0)
    assert torch.equal(
        GaussianMixture.fit(x, 4, seed=g, init=init, max_iter=5).means, fits[0].means
    )


def test_far_and_duplicate_starts_are_moved():
    x = sample(2000)
    start = random_start(x)
    start.means[0] += 1e4  # explains nothing
    start.covariances[0] *= 1e-4
    mixture, report = expectation_maximisation(x, start, max_iter=50)
    assert report.reseeded >= 1 and report.converged
    assert float(mixture.weights.min()) > 1e-3


def test_components_on_single_points_are_moved():
    x = sample(2000)
    start = random_start(x)
    start.covariances[:2] = 1e-8 * torch.eye(4, dtype=torch.float64)
    mixture, report = expectation_maximisation(x, start, max_iter=100)
    assert report.reseeded >= 2
    assert float(torch.linalg.eigvalsh(mixture.covariances).min()) > 1e-4
    assert float(mixture.weights.min()) > 1e-3


def test_split_keeps_mean_and_covariance():
    x = sample(1000)
    parameters = random_start(x, 2)
    parameters.means[1] += 1e4
    floor = torch.zeros(4, 4, dtype=torch.float64)
    (weights, means, covariances), moved = m_step(e_step(x, parameters), floor)
    assert moved == 1
    whole = GaussianMixture(weights, means, covariances)
    mean, covariance = whole.moments()
    torch.testing.assert_close(mean, x.mean(0))
    torch.testing.assert_close(covariance, torch.cov(x.T, correction=0))


@pytest.mark.parametrize("n_distinct", [1, 2, 7])
def test_repeated_points_end_in_a_valid_mixture(n_distinct):
    x = sample(n_distinct).repeat(50, 1)
    mixture = GaussianMixture.fit(x, 5, max_iter=10)
    assert mixture.n_components == 5
    assert bool(torch.isfinite(mixture.log_prob(x)).all())


def test_constant_and_dependent_dimensions():
    x = sample(500)
    x = torch.cat([x, x[:, :1] - x[:, 1:2], torch.full((500, 1), 3.0)], 1)
    mixture = GaussianMixture.fit(x, 3, covariance_floor=1e-6)
    assert bool(torch.isfinite(mixture.log_prob(x)).all())
    assert float(mixture.covariances[:, 5, 5].max()) == pytest.approx(1e-6, rel=1e-6)


def test_floor_bounds_the_covariances():
    x = sample(2000)
    mixture = GaussianMixture.fit(x, 5, covariance_floor=0.1)
    floor = torch.diag(floor_variances(x, 0.1))
    assert float(torch.linalg.eigvalsh(mixture.covariances - floor).min()) > -1e-9
    torch.testing.assert_close(floor.diagonal(), 0.1 * x.var(0, correction=0))


def test_few_points_and_many_components():
    x = sample(12)
    mixture = GaussianMixture.fit(x, 10)
    assert mixture.n_components == 10 and bool((mixture.weights > 0).all())
    assert GaussianMixture.fit(x, 1).n_components == 1
    assert GaussianMixture.fit(x[:, :1], 2).dim == 1


def test_one_component_is_mean_and_covariance():
    x = sample(300)
    mixture = GaussianMixture.fit(x, 1, covariance_floor=1e-12)
    torch.testing.assert_close(mixture.means[0], x.mean(0))
    torch.testing.assert_close(mixture.covariances[0], torch.cov(x.T, correction=0))


def test_k_means_lowers_the_distance_of_its_seeds():
    x = sample(2000)
    shares = torch.full((2000,), 1 / 2000, dtype=torch.float64)
    spread = []
    for steps in (0, 10):
        centres, labels = k_means(x, 5, torch.Generator().manual_seed(0), shares, steps)
        spread.append(float((x - centres[labels]).square().sum(-1).mean()))
        assert torch.equal(labels, torch.cdist(x, centres).argmin(1))
    assert spread[1] < spread[0]


def test_start_is_a_mixture():
    x = sample(500)
    for init in STARTS:
        start = start_mixture(
            x, 5, torch.Generator().manual_seed(0), floor_variances(x, 1e-6), init=init
        )
        GaussianMixture(*start)


def test_progress_bar_shows_and_goes(capsys):
    pytest.importorskip("tqdm")
    GaussianMixture.fit(sample(100), 2, progress=True, max_iter=3, tol=0)
    assert "log-likelihood" in capsys.readouterr().err


def test_bad_points_are_refused():
    x, start = sample(100), random_start(sample(100))
    with pytest.raises(InputError, match="missing joints"):
        GaussianMixture.fit(torch.full_like(x, torch.nan), 2)
    with pytest.raises(InputError, match="at least as many points as components, got 3"):
        GaussianMixture.fit(x[:3], 4)
    with pytest.raises(ShapeError):
        GaussianMixture.fit(x[0], 1)
    with pytest.raises(InputError, match="n_components"):
        GaussianMixture.fit(x, 0)
    with pytest.raises(InputError, match="k-means"):
        GaussianMixture.fit(x, 2, init="best")
    with pytest.raises(InputError, match="covariance_floor"):
        GaussianMixture.fit(x, 2, covariance_floor=0.0)
    with pytest.raises(ShapeError):
        expectation_maximisation(x[:, :3], start)
    for weight in (torch.zeros(100), torch.full((100,), -1.0), torch.full((100,), torch.nan)):
        with pytest.raises(InputError):
            expectation_maximisation(x, start, weight)
        with pytest.raises(InputError):
            GaussianMixture.fit(x, 2, sample_weight=weight)
    with pytest.raises(ShapeError):
        GaussianMixture.fit(x, 2, sample_weight=torch.ones(99))


def test_singular_start_is_refused():
    x, start = sample(100), random_start(sample(100))
    start.covariances[1] = 0
    with pytest.raises(CovarianceError, match="positive definite"):
        expectation_maximisation(x, start)
