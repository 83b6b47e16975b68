"""Gaussian mixture against scipy, 80-bit arithmetic, finite differences and its own samples."""

import math

import numpy as np
import pytest
import torch
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from tests.data import data_dir_or_skip
from tests.priors.mixtures import long_double_log_prob, random_mixture, released_mixture
from torchpose.errors import CovarianceError, InputError, ShapeError
from torchpose.filters import FixedTrackFilter
from torchpose.priors import GaussianMixture


def scipy_terms(mixture, x):
    parameters = (p.numpy() for p in mixture.parameters_tuple())
    return np.stack(
        [
            math.log(w) + np.atleast_1d(multivariate_normal(m, c).logpdf(x.numpy()))
            for w, m, c in zip(*parameters, strict=True)
        ],
        -1,
    )


@pytest.mark.parametrize("shape", [(), (7,), (2, 3), (600,), (0,), (2, 0)])
def test_log_prob_is_scipys(shape):
    mixture = random_mixture()
    x = 2 * torch.randn(*shape, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    terms = mixture.component_log_prob(x)
    assert terms.shape == (*shape, 4)
    assert mixture.log_prob(x).shape == shape
    if x.numel():
        expected = scipy_terms(mixture, x.reshape(-1, 3)).reshape(*shape, 4)
        np.testing.assert_allclose(terms, expected, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(mixture(x), logsumexp(expected, -1), rtol=1e-11, atol=1e-11)


@pytest.mark.data
@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("name", ["Training20_02", "Training26_02"])
def test_log_prob_of_released_priors_in_80_bits(name, side):
    mixture = released_mixture(data_dir_or_skip("signer"), name, side)
    x = mixture.sample((20,), torch.Generator().manual_seed(0))
    expected = long_double_log_prob(mixture, x)
    error = (mixture.component_log_prob(x).numpy() - expected) / np.maximum(1, abs(expected))
    assert abs(error).max() < 1e-8


def test_float32_is_kept_and_is_close():
    mixture, single = random_mixture(), random_mixture(dtype=torch.float32)
    x = torch.randn(50, 3, dtype=torch.float32, generator=torch.Generator().manual_seed(1))
    assert single.log_prob(x).dtype == torch.float32
    assert mixture.log_prob(x).dtype == torch.float64
    torch.testing.assert_close(
        single.log_prob(x).double(), mixture.log_prob(x), rtol=1e-5, atol=1e-5
    )
    assert single.sample((3,)).dtype == torch.float32


def test_gradients_against_finite_differences():
    mixture = random_mixture(3, 3)
    x = torch.randn(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    leaves = [p.clone().requires_grad_() for p in (*mixture.parameters_tuple(), x)]

    def log_prob(weights, means, covariances, x):
        spd = (covariances + covariances.mT) / 2
        return GaussianMixture(weights / weights.sum(), means, spd).log_prob(x)

    def conditional(weights, means, covariances, x):
        spd = (covariances + covariances.mT) / 2
        given = GaussianMixture(weights / weights.sum(), means, spd).condition([2, 0], x[:, :2])
        return given.log_weights, given.means, given.covariances

    assert torch.autograd.gradcheck(log_prob, leaves)
    assert torch.autograd.gradcheck(conditional, leaves)


def test_buffers_keep_the_graph():
    means = random_mixture().means.clone().requires_grad_()
    given = random_mixture()
    mixture = GaussianMixture(given.weights, means, given.covariances)
    assert mixture.means is means
    mixture.log_prob(torch.zeros(3, dtype=torch.float64)).backward()
    assert means.grad is not None and bool((means.grad != 0).any())


def test_marginal_is_scipys():
    mixture = random_mixture()
    part = mixture.marginal([2, 0])
    x = torch.randn(9, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    pick = np.ix_([2, 0], [2, 0])
    expected = [
        math.log(w) + multivariate_normal(m[[2, 0]].numpy(), c.numpy()[pick]).logpdf(x.numpy())
        for w, m, c in zip(*mixture.parameters_tuple(), strict=True)
    ]
    np.testing.assert_allclose(part.log_prob(x), logsumexp(expected, 0), rtol=1e-11)
    torch.testing.assert_close(part.means, mixture.marginal(torch.tensor([-1, 0])).means)


def test_conditional_times_marginal_is_the_joint():
    mixture = random_mixture(4, 5)
    x = torch.randn(6, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    seen, hidden = [3, 1], [0, 2, 4]
    given = mixture.condition(seen, x[:, seen])
    assert given.means.shape == (6, 4, 3) and given.covariances.shape == (4, 3, 3)
    marginal = mixture.marginal(seen).log_prob(x[:, seen])
    for n in range(6):
        terms = [
            float(given.log_weights[n, k])
            + multivariate_normal(given.means[n, k].numpy(), given.covariances[k].numpy()).logpdf(
                x[n, hidden].numpy()
            )
            for k in range(4)
        ]
        joint = float(marginal[n]) + logsumexp(terms)
        assert joint == pytest.approx(float(mixture.log_prob(x[n])), rel=1e-10)


def test_conditional_on_nothing_and_on_everything():
    mixture = random_mixture()
    nothing = mixture.condition([], torch.zeros(2, 0, dtype=torch.float64))
    torch.testing.assert_close(nothing.log_weights[0].exp(), mixture.weights)
    torch.testing.assert_close(nothing.means[1], mixture.means)
    torch.testing.assert_close(nothing.covariances, mixture.covariances)
    everything = mixture.condition([0, 1, 2], torch.zeros(3, dtype=torch.float64))
    assert everything.means.shape == (4, 0)


def test_samples_have_the_moments_of_the_mixture():
    mixture = random_mixture()
    x = mixture.sample((100, 1000), torch.Generator().manual_seed(5)).reshape(-1, 3)
    mean, covariance = mixture.moments()
    share = (mixture.means * mixture.weights[:, None]).sum(0)
    torch.testing.assert_close(mean, share)
    standard_error = (covariance.diagonal() / len(x)).sqrt()
    assert bool(((x.mean(0) - mean).abs() < 5 * standard_error).all())
    torch.testing.assert_close(torch.cov(x.T), covariance, rtol=0.05, atol=0.05)
    # the mean log density of the samples is what integrating over the samples of each term gives
    by_component = mixture.component_log_prob(x).softmax(-1).mean(0)
    torch.testing.assert_close(by_component, mixture.weights, rtol=0.05, atol=0.01)


def test_samples_follow_the_generator_and_the_shape():
    mixture = random_mixture()
    draws = [mixture.sample((4,), torch.Generator().manual_seed(6)) for _ in range(2)]
    assert torch.equal(*draws)
    assert mixture.sample().shape == (3,)
    assert mixture.sample((0,)).shape == (0, 3)
    assert mixture.sample((2, 5000)).shape == (2, 5000, 3)


def test_state_dict_round_trip():
    mixture, other = random_mixture(), random_mixture(seed=1)
    other.load_state_dict(mixture.state_dict())
    x = torch.zeros(3, dtype=torch.float64)
    assert float(other.log_prob(x)) == float(mixture.log_prob(x))


def test_weights_that_are_a_parameter_are_refused():
    given = (torch.tensor([[0.0], [1.0]]), torch.ones(2, 1, 1))
    with pytest.raises(InputError, match=r"logits\.softmax"):
        GaussianMixture(torch.nn.Parameter(torch.tensor([0.5, 0.5])), *given)
    logits = torch.nn.Parameter(torch.zeros(2))
    GaussianMixture(logits.softmax(-1), *given).log_prob(torch.zeros(1)).backward()
    assert logits.grad is not None and bool((logits.grad != 0).all())


def test_weights_are_normalised_up_to_rounding_only():
    given = random_mixture()
    weights = given.weights * (1 + 1e-9)
    assert float(GaussianMixture(weights, given.means, given.covariances).weights.sum()) == (
        pytest.approx(1, abs=1e-15)
    )
    with pytest.raises(InputError, match=r"sum to 1, got 1\.01"):
        GaussianMixture(given.weights * 1.01, given.means, given.covariances)


def bad(name):
    weights, means, covariances = (p.clone() for p in random_mixture().parameters_tuple())
    if name == "zero weight":
        weights[1] += weights[0]
        weights[0] = 0
    elif name == "negative weight":
        weights[1] += 2 * weights[0]
        weights[0] *= -1
    elif name == "nan mean":
        means[0, 0] = torch.nan
    elif name == "skew":
        covariances[0, 0, 1] += 0.1
    elif name == "indefinite":
        covariances[0] -= 100 * torch.eye(3)
    elif name == "infinite":
        covariances[0, 0, 0] = torch.inf
    elif name == "weights shape":
        weights = weights[:, None]
    elif name == "means shape":
        means = means[:3]
    elif name == "covariances shape":
        covariances = covariances[:, :2, :2]
    elif name == "dtype":
        means = means.float()
    elif name == "integers":
        means = means.long()
    elif name == "no dimension":
        means, covariances = means[:, :0], covariances[:, :0, :0]
    return weights, means, covariances


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("zero weight", InputError),
        ("negative weight", InputError),
        ("nan mean", InputError),
        ("skew", CovarianceError),
        ("indefinite", CovarianceError),
        ("infinite", InputError),
        ("weights shape", ShapeError),
        ("means shape", ShapeError),
        ("covariances shape", ShapeError),
        ("dtype", InputError),
        ("integers", InputError),
        ("no dimension", ShapeError),
    ],
)
def test_bad_parameters_are_refused(name, error):
    with pytest.raises(error):
        GaussianMixture(*bad(name))


def test_bad_arguments_are_refused():
    mixture = random_mixture()
    with pytest.raises(ShapeError, match=r"\[\.\.\., 3\], got \[4\]"):
        mixture.log_prob(torch.zeros(4))
    with pytest.raises(InputError, match="distinct"):
        mixture.marginal([0, 0])
    for wrong in ([0.5], [True, False], torch.tensor([True, False, True])):
        with pytest.raises(InputError, match="indices must be whole numbers"):
            mixture.marginal(wrong)
    with pytest.raises(InputError, match="n_components must be a whole number"):
        GaussianMixture.fit(torch.randn(20, 3), 2.5)
    with pytest.raises(InputError, match=r"0\.\.2"):
        mixture.condition([3], torch.zeros(1))
    with pytest.raises(ShapeError):
        mixture.condition([0, 1], torch.zeros(1))
    with pytest.raises(InputError, match="x must be real"):
        mixture.log_prob(torch.zeros(3, dtype=torch.complex64))
    with pytest.raises(InputError, match="values must be real"):
        mixture.condition([0], torch.zeros(1, dtype=torch.complex64))


def test_rounded_mixtures_stay_positive_definite_and_change_no_more_than_rounding_does():
    g = torch.Generator().manual_seed(0)
    factor = torch.randn(5, 40, 40, generator=g, dtype=torch.float64)
    factor[1:, 20:] = factor[1:, :20] @ torch.eye(40, dtype=torch.float64)  # twenty free dimensions
    scale = torch.logspace(-3, 2, 40, dtype=torch.float64)
    cov = (factor @ factor.mT + 3e-8 * torch.eye(40, dtype=torch.float64)) * scale * scale[:, None]
    mixture = GaussianMixture(
        torch.full((5,), 0.2, dtype=torch.float64), torch.zeros(5, 40, dtype=torch.float64),
        (cov + cov.mT) / 2,
    )  # fmt: skip
    plain = mixture.covariances.float().double()
    assert int((torch.linalg.cholesky_ex(plain).info != 0).sum()) == 4  # what it is there for
    rounded = mixture.rounded()
    assert torch.equal(rounded.covariances.float().double(), rounded.covariances)
    assert torch.equal(rounded.covariances[0], plain[0])
    relative = (rounded.covariances - mixture.covariances).abs() / (
        scale * scale[:, None] * mixture.covariances.diagonal(dim1=-2, dim2=-1).amax()
    )
    assert float(relative.max()) < 1e-4


@pytest.mark.parametrize("shape", [5, 2.5, None, (2.5,), (-1,)])
def test_a_shape_of_draws_that_is_none_is_named(shape):
    mixture = GaussianMixture(torch.ones(1), torch.zeros(1, 2), torch.eye(2)[None])
    with pytest.raises(InputError, match=r"shape must be a sequence of sizes, such as \(5,\), got"):
        mixture.sample(shape)


def test_a_covariance_that_was_learnt_out_of_its_range_is_named() -> None:
    kind = {"dtype": torch.float64}
    covariances = torch.nn.Parameter(torch.eye(2, **kind).repeat(2, 1, 1))
    mixture = GaussianMixture(torch.full((2,), 0.5, **kind), torch.zeros(2, 2, **kind), covariances)
    with torch.no_grad():
        covariances[1] = torch.tensor([[1.0, 2.0], [2.0, 1.0]])
    point, noise = torch.zeros(2, **kind), torch.ones(2)
    for use in (
        lambda: mixture.log_prob(point),
        lambda: mixture.sample((3,)),
        lambda: mixture.condition([1], point[:1]),
        lambda: FixedTrackFilter(mixture, noise, noise[:1], [0]),
    ):
        with pytest.raises(CovarianceError, match=r"not at index \[1\]; what is learnt stays"):
            use()


def test_lists_arrays_and_seeds_are_told_what_to_give() -> None:
    mixture = random_mixture()
    for use in (
        lambda: mixture.log_prob([0.0, 0.0, 0.0]),
        lambda: mixture.log_prob(np.zeros(3)),
        lambda: mixture.condition([0], [0.0]),
        lambda: GaussianMixture.fit(np.zeros((9, 2)), 1),
    ):
        with pytest.raises(
            InputError, match=r"must be a tensor, got .*; convert it with torch.as_tensor"
        ):
            use()
    with pytest.raises(
        InputError, match=r"generator must be a torch.Generator, got 3; torch.Generator"
    ):
        mixture.sample((2,), generator=3)
