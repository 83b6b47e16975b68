"""Survival rates and the exponents that bring them about, against their definition."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchpose.errors import InputError
from torchpose.filters._resampling import (
    check_survival_rate,
    survival_exponent,
    survival_rate,
    survival_rate_per_frame,
)


def rate_by_definition(weights):
    return weights.sum() ** 2 / (len(weights) * (weights**2).sum())


@settings(max_examples=60, deadline=None)
@given(
    log_weights=st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=40),
    scale=st.floats(1e-6, 1e3),
    rate=st.floats(0.02, 0.98),
)
def test_the_exponent_brings_the_rate_about(log_weights, scale, rate):
    values = scale * torch.tensor(log_weights, dtype=torch.float64)
    # the share of the largest weight bounds what any exponent reaches; ties are tested apart
    if len(set(values.tolist())) < len(values) or rate < 1.2 / len(values):
        return
    gaps = values.sort().values.diff()
    if float(gaps.min()) < 1e-6 * float(values.max() - values.min()):
        return
    beta = survival_exponent(values, rate)
    assert float(beta) > 0
    weights = ((values - values.max()) * beta).exp()
    assert float(rate_by_definition(weights)) == pytest.approx(rate, abs=1e-6)
    assert float(survival_rate(beta * values)) == pytest.approx(rate, abs=1e-6)


@pytest.mark.parametrize("n", [3, 114, 800])
def test_the_exponent_is_that_of_a_search_through_exponents(n):
    values = np.random.default_rng(n).normal(0, 30, n)
    grid = np.exp(np.linspace(np.log(1e-4), np.log(50), 40_001))
    weights = np.exp(np.outer(grid, values - values.max()))
    rates = weights.sum(1) ** 2 / (n * (weights**2).sum(1))
    for rate in (2 / n, 0.16 if n > 12 else 0.7, 0.926):
        expected = grid[np.abs(rates - rate).argmin()]
        beta = float(survival_exponent(torch.from_numpy(values), rate))
        assert beta == pytest.approx(expected, rel=1e-3)


def test_rates_that_leave_fewer_than_two_particles_are_refused():
    # 60 frames a second: 0.16 of 114; 15: 0.0006 of them, 0.07 hypotheses
    check_survival_rate(survival_rate_per_frame(1e-48, 60.0), 114)
    with pytest.raises(InputError, match=r"leaves 0\.072 of 114 .* fewer than 2; ask for 0\.0175"):
        check_survival_rate(survival_rate_per_frame(1e-48, 15.0), 114)
    check_survival_rate(2 / 114, 114)
    with pytest.raises(InputError, match="fewer than 2"):
        check_survival_rate(1.99 / 114, 114)
    with pytest.raises(InputError, match="take more particles"):
        check_survival_rate(0.9, 2)
    for rate in (0.0, 1.0, float("nan")):
        with pytest.raises(InputError, match="between 0 and 1"):
            check_survival_rate(rate, 114)


def test_a_scale_of_the_log_weights_cancels_and_rows_are_independent():
    g = torch.Generator().manual_seed(0)
    values = torch.randn(4, 3, 200, generator=g, dtype=torch.float64)
    beta = survival_exponent(values, 0.5)
    assert beta.shape == (4, 3)
    torch.testing.assert_close(survival_exponent(50 * values + 7, 0.5), beta / 50)
    skewed = values.exp() * torch.tensor([0.1, 1.0, 30.0], dtype=torch.float64)[:, None]
    alone = torch.stack([survival_exponent(row, 0.5) for row in skewed.flatten(0, 1)])
    assert torch.equal(
        survival_exponent(skewed, 0.5).flatten(), alone
    )  # whatever its neighbours take
    # normal log-weights: alpha = exp(-beta^2)
    assert float(beta.mean()) == pytest.approx(0.69315**0.5, rel=0.1)


def test_equal_dead_and_tied_weights():
    level = torch.full((6,), -3.0)
    assert float(survival_exponent(level, 0.5)) == 1
    assert float(survival_exponent(torch.full((6,), -torch.inf), 0.5)) == 1
    assert bool(survival_rate(torch.full((6,), -torch.inf)).isnan())
    # two of six alive: at most a third survives, and the exponent goes to zero
    dead = torch.full((6,), -torch.inf)
    dead[:2] = torch.tensor([0.0, -1.0])
    assert float(survival_exponent(dead, 0.5)) < 1e-6
    assert float(survival_rate(survival_exponent(dead, 0.25) * dead[:2])) < 1
    # four of six share the best: at least two thirds survive
    tied = torch.tensor([0.0, 0.0, 0.0, 0.0, -1.0, -2.0])
    beta = survival_exponent(tied, 0.5)
    assert bool(beta.isfinite())
    assert float(survival_rate(beta * tied)) == pytest.approx(4 / 6)


def test_rates_that_are_none():
    for rate in (0.0, 1.0, -0.5, float("nan")):
        with pytest.raises(InputError, match="between 0 and 1"):
            survival_exponent(torch.zeros(3), rate)
        with pytest.raises(InputError, match="between 0 and 1"):
            survival_rate_per_frame(rate, 60.0)
    with pytest.raises(InputError, match="fps"):
        survival_rate_per_frame(0.5, 0.0)


def test_the_rate_per_frame_keeps_the_share_over_a_second():
    assert survival_rate_per_frame(0.01, 30.0) ** 30 == pytest.approx(0.01)
