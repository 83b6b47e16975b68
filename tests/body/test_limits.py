"""Limits of the joints against NumPy's quantiles and numerical integration."""

import math

import numpy as np
import pytest
import torch

from tests.body.test_kinematics import random_states, some_body
from torchpose.body import JointLimits
from torchpose.errors import InputError, ShapeError

BODY = some_body()
STATES = random_states(BODY, 401, scale=0.15)


def test_limits_are_quantiles_with_a_margin():
    limits = JointLimits.fit(STATES, quantile=0.01, margin=0.2)
    low = np.quantile(STATES[:, 6:].numpy(), 0.01, axis=0, method="lower")
    high = np.quantile(STATES[:, 6:].numpy(), 0.99, axis=0, method="higher")
    margin = 0.2 * (high - low)
    np.testing.assert_allclose(limits.lower, np.maximum(low - margin, -1))
    np.testing.assert_allclose(limits.upper, np.minimum(high + margin, 1))


def test_parts_that_never_move_have_the_least_margin():
    limits = JointLimits.fit(torch.zeros(3, 4, 36).double())
    assert limits.lower.tolist() == [-0.03] * 30 and limits.upper.tolist() == [0.03] * 30


def test_inside_names_the_part_and_clamp_mends_it():
    limits = JointLimits.fit(STATES, quantile=0.0)
    assert limits.inside(STATES).shape == (401, 10) and bool(limits.inside(STATES).all())
    bent = STATES[:4].clone().unflatten(0, (2, 2))
    bent[0, 1, 6 + 3 * 4 + 1] = 0.99
    inside = limits.inside(bent)
    assert torch.nonzero(~inside).tolist() == [[0, 1, 4]]
    clamped = limits.clamp(bent)
    assert bool(limits.inside(clamped).all())
    untouched = torch.ones_like(bent, dtype=torch.bool)
    untouched[0, 1, 6 + 3 * 4 + 1] = False
    assert torch.equal(clamped[untouched], bent[untouched])


def test_log_prob_is_a_density():
    limits = JointLimits(
        *torch.tensor([[-0.2, 0.0, 0.1], [0.3, 0.4, 0.2], [0.1, 0.05, 0.2]]).double()
    )
    grid = torch.linspace(-2, 2, 40_001, dtype=torch.float64)
    states = torch.zeros(len(grid), 9, dtype=torch.float64)
    at_zero = float(limits.log_prob(torch.zeros(9).double()))
    for column in range(3):
        other = states.clone()
        other[:, 6 + column] = grid
        total = torch.trapezoid((limits.log_prob(other) - at_zero).exp(), grid)
        width = float(limits.upper[column] - limits.lower[column])
        size = width + math.sqrt(2 * math.pi) * float(limits.softness[column])
        excess = max(0.0, float(limits.lower[column])) / float(limits.softness[column])
        assert float(total) == pytest.approx(size * math.exp(0.5 * excess**2), rel=1e-6)
    assert float(limits(torch.zeros(9).double())) == at_zero


def test_log_prob_is_highest_inside_and_has_gradients():
    limits = JointLimits.fit(STATES)
    far = (2 * STATES[:5]).requires_grad_()
    log_prob = limits.log_prob(far)
    assert bool((log_prob <= limits.log_prob(limits.clamp(far))).all())
    log_prob.sum().backward()
    assert bool(torch.isfinite(far.grad).all())


def test_dtype_and_file():
    limits = JointLimits.fit(STATES).float()
    other = JointLimits.fit(STATES + 1)
    other.load_state_dict(limits.state_dict())
    assert torch.equal(other.lower.float(), limits.lower)
    assert limits.log_prob(STATES.float()).dtype == torch.float32


def test_limits_do_not_follow_the_tensors_that_they_were_given():
    lower, upper = torch.zeros(12), torch.ones(12)
    limits = JointLimits(lower, upper, upper)
    lower += 5
    limits.softness.mul_(2)
    assert not limits.lower.any() and torch.equal(limits.upper, torch.ones(12))


def test_bad_input():
    with pytest.raises(InputError, match="at least one recorded state"):
        JointLimits.fit(STATES[:0])
    with pytest.raises(InputError, match="finite"):
        JointLimits.fit(torch.full((3, 36), torch.nan))
    with pytest.raises(InputError, match="quantile must be"):
        JointLimits.fit(STATES, quantile=0.6)
    with pytest.raises(ShapeError, match="6 \\+ 3"):
        JointLimits.fit(torch.zeros(4, 8))
    with pytest.raises(ShapeError, match="36 columns"):
        JointLimits.fit(STATES).inside(torch.zeros(33))
    with pytest.raises(ShapeError, match="in threes"):
        JointLimits(torch.zeros(4), torch.ones(4), torch.ones(4))
    with pytest.raises(InputError, match="softness must be positive"):
        JointLimits(torch.zeros(3), torch.ones(3), torch.zeros(3))
    with pytest.raises(InputError, match="column 0"):
        JointLimits(torch.ones(3), torch.zeros(3), torch.ones(3))
