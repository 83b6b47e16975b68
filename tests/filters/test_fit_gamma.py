"""gamma of simulated processes, and against the likelihood on a grid."""

import numpy as np
import pytest
import torch
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from tests.filters.oracles import random_mixture, tensor
from torchpose.errors import InputError, ShapeError
from torchpose.filters import MixtureKalmanFilter, fit_gamma
from torchpose.priors import GaussianMixture

TRUTH = np.array([0.95, 0.6, 0.2])


def simulate(rng, parameters, gammas, n_sequences, n_frames):
    """The Markov process whose stationary law is the mixture, one draw after the other."""
    weights, means, covs = parameters
    densities = [multivariate_normal(m, c) for m, c in zip(means, covs, strict=True)]
    sequences = []
    for _ in range(n_sequences):
        i = rng.choice(len(weights), p=weights)
        x = [rng.multivariate_normal(means[i], covs[i])]
        for _ in range(n_frames - 1):
            terms = np.array([w * d.pdf(x[-1]) for w, d in zip(weights, densities, strict=True)])
            i = rng.choice(len(weights), p=terms / terms.sum())
            g = gammas[i]
            centre = g * x[-1] + (1 - g) * means[i]
            x.append(rng.multivariate_normal(centre, (1 - g**2) * covs[i]))
        sequences.append(np.array(x))
    return sequences


def log_likelihood(sequences, parameters, gammas):
    """Sum of log p(x_t | x_{t-1}) by scipy, frame by frame."""
    total = 0.0
    for x in sequences:
        terms, marginals = [], []
        for w, m, c, g in zip(*parameters, gammas, strict=True):
            here = np.log(w) + multivariate_normal(m, c).logpdf(x[:-1])
            centre = g * x[:-1] + (1 - g) * m
            step = multivariate_normal(np.zeros(len(m)), (1 - g**2) * c).logpdf(x[1:] - centre)
            terms.append(here + step)
            marginals.append(here)
        total += (logsumexp(terms, 0) - logsumexp(marginals, 0)).sum()
    return total


def mixture(parameters):
    return GaussianMixture(*(tensor(value) for value in parameters))


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(0)
    parameters = random_mixture(rng, 3, 3, 2.0)
    return parameters, simulate(rng, parameters, TRUTH, 4, 500)


def test_known_gammas_are_found(scene):
    parameters, sequences = scene
    found = fit_gamma(mixture(parameters), [tensor(x) for x in sequences])
    assert found.shape == (3,) and found.dtype == torch.float64
    np.testing.assert_allclose(found, TRUTH, atol=0.06)


def test_no_gamma_on_a_grid_is_likelier(scene):
    parameters, sequences = scene
    sequences = [x[:150] for x in sequences]
    found = fit_gamma(mixture(parameters), [tensor(x) for x in sequences]).numpy()
    best = log_likelihood(sequences, parameters, found)
    grid = np.linspace(0.0, 0.98, 15)
    for i in range(3):
        for g in grid:
            other = found.copy()
            other[i] = g
            assert log_likelihood(sequences, parameters, other) <= best + 1e-9
        near = found + 1e-3 * np.eye(3)[i]
        assert log_likelihood(sequences, parameters, near) < best


def test_one_gamma_for_all_is_the_best_of_a_grid(scene):
    parameters, sequences = scene
    sequences = [x[:150] for x in sequences]
    found = fit_gamma(mixture(parameters), [tensor(x) for x in sequences], shared=True)
    assert found.shape == ()
    grid = np.linspace(0.0, 0.99, 100)
    values = [log_likelihood(sequences, parameters, np.full(3, g)) for g in grid]
    assert abs(float(found) - grid[int(np.argmax(values))]) <= 0.01
    best = log_likelihood(sequences, parameters, np.full(3, float(found)))
    assert best >= max(values) - 1e-9


def test_with_one_component_and_one_dimension_it_is_the_maximum_by_brute_force():
    """Also where the states stand nearly still, or are far less spread than the prior says."""
    rng = np.random.default_rng(1)
    grid = np.linspace(0, 1, 20001)[:-1]
    for scale, g in ((1.0, 0.7), (0.1, 0.9), (0.3, 0.0), (3.0, 0.99), (1.0, -0.5)):
        x = [0.0]
        for _ in range(60):
            x.append(g * x[-1] + scale * rng.standard_normal())
        x = np.array(x)
        free = 1 - grid**2
        squared = ((x[1:, None] - grid * x[:-1, None]) ** 2).sum(0)
        values = -0.5 * (60 * np.log(free) + squared / free)
        gmm = GaussianMixture(torch.ones(1), torch.zeros(1, 1), torch.ones(1, 1, 1))
        found = float(fit_gamma(gmm, [tensor(x)[:, None]]))
        assert abs(found - grid[values.argmax()]) < 1e-4


def test_a_subspace_moves_with_gamma_and_the_rest_is_drawn_anew():
    rng = np.random.default_rng(2)
    directions = np.linalg.qr(rng.standard_normal((4, 4)))[0]
    spread = np.array([0.2, 0.4, 3.0, 5.0])
    y = np.zeros((4000, 4))
    for t in range(1, len(y)):
        noise = rng.standard_normal(4)
        y[t] = np.where(spread > 1, 0.9 * y[t - 1] + np.sqrt(1 - 0.81) * noise, noise)
    x = (y * spread) @ directions.T + 7.0
    cov = directions @ np.diag(spread**2) @ directions.T
    gmm = GaussianMixture(
        torch.ones(1).double(), torch.full((1, 4), 7.0).double(), tensor(cov)[None]
    )
    assert abs(float(fit_gamma(gmm, [tensor(x)], subspace=2)) - 0.9) < 0.02
    assert float(fit_gamma(gmm, [tensor(x)])) < 0.8


def test_lengths_leave_out_what_comes_after(scene):
    parameters, sequences = scene
    padded = tensor(np.stack(sequences))[:2]
    lengths = torch.tensor([300, 120])
    cut = [padded[0, :300], padded[1, :120]]
    expected = fit_gamma(mixture(parameters), cut)
    padded[1, 120:] = torch.nan
    torch.testing.assert_close(fit_gamma(mixture(parameters), padded, lengths), expected)


def test_a_component_that_nobody_visits_gets_the_common_gamma(scene):
    parameters, sequences = scene
    _, means, covs = parameters
    far = np.concatenate([means, means[:1] + 1e4])
    wide = (np.full(4, 0.25), far, np.concatenate([covs, covs[:1]]))
    found = fit_gamma(mixture(wide), [tensor(x) for x in sequences])
    assert 0.2 < float(found[3]) < 0.95
    assert torch.isfinite(found).all()


def test_the_filter_takes_it_and_explains_the_measurements_better(scene):
    parameters, sequences = scene
    gmm, x = mixture(parameters), tensor(np.stack(sequences))
    noise = 0.01 * torch.ones(2, dtype=torch.float64)

    def evidence(gamma):
        model = MixtureKalmanFilter(
            gmm, torch.ones(3), noise, [0, 1], "sampled", 50, transition="ou", gamma=gamma
        )
        z = x[:, :100, :2]
        return float(model(z, generator=torch.Generator().manual_seed(0)).log_evidence.sum())

    fitted = fit_gamma(gmm, x)
    assert evidence(fitted) > evidence(0.0)
    assert evidence(fitted) > evidence(0.99)


@pytest.mark.parametrize(
    ("states", "options", "error", "message"),
    [
        (torch.zeros(1, 5, 2), {}, ShapeError, "states"),
        ([torch.zeros(5, 2)], {}, ShapeError, r"states\[0\]"),
        ([torch.full((5, 3), float("nan"))], {}, InputError, "finite"),
        ([torch.zeros(1, 3)], {}, InputError, "two consecutive frames"),
        ([torch.zeros(5, 3)], {"lengths": torch.tensor([3])}, InputError, "lengths"),
        (torch.zeros(1, 5, 3), {"lengths": torch.tensor([6])}, InputError, "from 1 to 5"),
        (torch.zeros(1, 5, 3), {"lengths": torch.tensor([2.5])}, InputError, "integers from 1"),
        ([torch.zeros(5, 3)], {"subspace": 4}, InputError, "subspace"),
    ],
)
def test_what_does_not_fit_is_refused(scene, states, options, error, message):
    with pytest.raises(error, match=message):
        fit_gamma(mixture(scene[0]), states, **options)
