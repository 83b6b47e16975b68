"""Noise of constant velocity models against motions whose accelerations are known."""

import pytest
import torch

from tests.filters.linear_poses import LinearBody
from tests.whole_body.filters.walking_body import walk, walker
from torchpose.errors import InputError
from torchpose.whole_body import constant_velocity_std
from torchpose.whole_body._filters.motion import next_velocity

BODY = LinearBody(3)
SCALE = torch.tensor([0.1, 1.0, 3.0], dtype=torch.float64)


def kicked(n, seed):
    """A motion that white accelerations drive, seen at every tenth of their steps."""
    g = torch.Generator().manual_seed(seed)
    kicks = SCALE * torch.randn(10 * n, 3, generator=g, dtype=torch.float64)
    return kicks.cumsum(0).cumsum(0)[::10]


def test_white_accelerations_are_found_at_every_rate():
    """The variance of x(2h) - 2 x(h) + x(0) is 2/3 q h^3 for an integrated Wiener process."""
    states = [kicked(4000, seed) for seed in range(3)]
    for target, h in ((30.0, 1), (15.0, 2), (60.0, 0.5), (12.0, 2.5)):
        std = constant_velocity_std(BODY, states, 30.0, target)
        expected = SCALE * (2 / 3 * (10 * h) ** 3) ** 0.5
        assert torch.allclose(std, expected, rtol=0.06)


def test_constant_velocity_is_predicted_without_error_and_the_root_turns():
    body = walker()
    steps = torch.zeros(20, body.dim, dtype=torch.float64)
    steps[:, :3], steps[:, 4] = 0.02, 0.05
    state, states = steps[0], []
    for step in steps:
        state = body.perturb(state, step)
        states.append(state)
    states = torch.stack(states)
    assert constant_velocity_std(body, states).abs().max() < 1e-7
    assert (constant_velocity_std(body, states, floor=0.01) == 0.01).all()
    gap = states.clone()
    gap[7] = torch.nan
    assert constant_velocity_std(body, gap).abs().max() < 1e-7
    lagging = constant_velocity_std(body, states, velocity_rate=0.5)
    assert lagging[0] > 1e-3  # the velocity starts from none


def test_next_velocity_is_the_published_recursion():
    body, states = walker(), walk(walker(), 12)
    velocity = torch.zeros(body.dim, dtype=torch.float64)
    for t in range(2, 12):
        velocity = next_velocity(body, velocity, states[t - 1], states[t - 2])
    t = torch.arange(1, 11)
    share = 0.5 ** (11 - t).double()
    expected = share @ body.difference(states[1:11], states[:10])
    assert torch.allclose(velocity, expected)


def test_too_few_frames_or_no_rate():
    with pytest.raises(InputError, match="three frames 1 apart"):
        constant_velocity_std(BODY, torch.zeros(2, 3))
    with pytest.raises(InputError, match="target_fps must be positive"):
        constant_velocity_std(BODY, torch.zeros(9, 3), 30.0, 0.0)
    with pytest.raises(InputError, match="target_fps=15 needs the frame rate of the sequences"):
        constant_velocity_std(BODY, torch.zeros(9, 3), target_fps=15.0)
    with pytest.raises(InputError, match="velocity_rate must be from 0 to below 1, got 2"):
        constant_velocity_std(BODY, torch.zeros(9, 3), velocity_rate=2)
