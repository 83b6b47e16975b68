"""The float32 density of particle filters against float64, and against 80-bit arithmetic."""

import numpy as np
import pytest
import torch

from tests.data import data_dir_or_skip
from tests.priors.mixtures import long_double_log_prob, random_mixture, released_mixture
from torchpose.errors import ShapeError
from torchpose.priors import FastMixtureDensity, GaussianMixture

BAR = 5e-3  # in the log density


def largest_error(mixture, x):
    fast = FastMixtureDensity(mixture).log_prob(x)
    return float((fast.double() - mixture.log_prob(x.double())).abs().max())


@pytest.mark.data
@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("name", ["Training20_02", "Training26_02"])
def test_error_on_released_priors(name, side):
    mixture = released_mixture(data_dir_or_skip("signer"), name, side)
    x = mixture.sample((10_000,), torch.Generator().manual_seed(0)).float()
    assert largest_error(mixture, x) < BAR / 20
    expected = np.logaddexp.reduce(long_double_log_prob(mixture, x[:20]), 1)
    np.testing.assert_allclose(FastMixtureDensity(mixture)(x[:20]), expected, atol=BAR / 20)


@pytest.mark.data
def test_error_far_from_the_prior():
    mixture = released_mixture(data_dir_or_skip("signer"))
    x = mixture.sample((2_000,), torch.Generator().manual_seed(0)).float() * 1.5 + 3
    exact = mixture.log_prob(x.double())
    error = (FastMixtureDensity(mixture)(x).double() - exact).abs() / exact.abs().clamp_min(1)
    assert float(error.max()) < 1e-5


def test_error_where_scales_span_ten_orders():
    g = torch.Generator().manual_seed(1)
    scale = torch.logspace(-3, 2, 21, dtype=torch.float64)
    base = random_mixture(30, 21)
    rotation = torch.linalg.qr(torch.randn(21, 21, generator=g, dtype=torch.float64)).Q
    matrix = scale[:, None] * rotation
    mixture = GaussianMixture(
        base.weights, base.means @ matrix.T + 100, matrix @ base.covariances @ matrix.T
    )
    x = mixture.sample((5_000,), g)
    assert largest_error(mixture, x.float()) < BAR


@pytest.mark.parametrize("shape", [(), (5,), (2, 3), (1300,), (0,)])
def test_shapes_and_terms(shape):
    mixture = random_mixture()
    fast = FastMixtureDensity(mixture)
    x = torch.randn(*shape, 3, generator=torch.Generator().manual_seed(2))
    terms = fast.component_log_prob(x)
    assert terms.shape == (*shape, 4) and terms.dtype == torch.float32
    torch.testing.assert_close(
        terms.double(), mixture.component_log_prob(x.double()), rtol=1e-5, atol=1e-5
    )
    torch.testing.assert_close(fast(x), terms.logsumexp(-1), rtol=1e-6, atol=1e-6)


def test_calls_share_no_memory_and_input_stays():
    fast = FastMixtureDensity(random_mixture())
    x = torch.randn(20, 3, generator=torch.Generator().manual_seed(3))
    before = x.clone()
    first, kept = fast(x), fast(x).clone()
    fast(x + 1)
    assert torch.equal(first, kept) and torch.equal(x, before)


def test_a_lost_particle_harms_no_other():
    fast = FastMixtureDensity(random_mixture())
    x = torch.zeros(4, 3)
    x[1], x[2] = torch.nan, 1e30
    log_prob = fast(x)
    assert bool(torch.isnan(log_prob[1])) and float(log_prob[2]) < -1e30
    assert float(log_prob[0]) == float(log_prob[3])


def test_conversion_to_float32_changes_nothing():
    mixture = random_mixture()
    x = torch.randn(50, 3, generator=torch.Generator().manual_seed(4))
    assert torch.equal(FastMixtureDensity(mixture)(x), FastMixtureDensity(mixture).float()(x))


def test_wrong_size_is_refused():
    with pytest.raises(ShapeError):
        FastMixtureDensity(random_mixture())(torch.zeros(2, 4))
