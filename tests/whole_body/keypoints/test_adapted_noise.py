"""How the noise of accelerations follows the motion of a body."""

import math

import pytest
import torch

from tests.whole_body.keypoints.scenes import errors, moving_body, ring, seen_by, track
from torchpose.whole_body._keypoints import adapted_noise
from torchpose.whole_body._keypoints.adapted_noise import AdaptedNoise

DT = 1 / 30
ALL = torch.ones(1, dtype=torch.float64)


def corrected(moves, measured=ALL):
    """The noise after corrections [T, 45] that keypoints pulled at with their tenfold."""
    noise = AdaptedNoise.usual(moves[:1])
    for move in moves:
        pulled, moved = 10 * move[None], move[None]
        noise = noise.after(pulled, moved, (pulled * moved).sum(-1), measured, DT)
    return float(noise.factor)


def moves(signs):
    move = torch.randn(45, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return torch.tensor(signs, dtype=torch.float64)[:, None] * move


def test_corrections_that_go_on_make_bodies_brisker_and_those_that_turn_back_calmer():
    assert corrected(moves([1, 1, 1, 1])) == pytest.approx(float(torch.tensor(3 * DT / 0.12).exp()))
    assert corrected(moves([1, -1, 1, -1])) == pytest.approx(
        float(torch.tensor(-3 * DT / 0.12).exp())
    )


def test_the_size_of_corrections_tells_nothing():
    given = torch.randn(9, 45, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert corrected(7 * given) == pytest.approx(corrected(given))
    assert corrected(given) != 1.0


def test_who_is_not_measured_stays_as_brisk():
    assert corrected(moves([1, 1, 1]), 0 * ALL) == 1.0
    assert corrected(moves([0, 0, 0])) == 1.0


def test_the_factor_is_bounded():
    assert corrected(moves([1] * 100)) == 10.0
    assert corrected(moves([1, -1] * 100)) == pytest.approx(0.1)


def jumping_body(n_frames=90):
    """A person who moves up and down by half a metre, twice a second."""
    joints = moving_body(n_frames)
    height = 0.25 * torch.sin(4 * math.pi * DT * torch.arange(n_frames, dtype=joints.dtype))
    return joints + torch.stack([0 * height, height, 0 * height], -1)[:, None]


@pytest.mark.parametrize(
    ("joints", "gain"),
    [
        pytest.param(jumping_body(), 0.9, id="brisk"),
        pytest.param(moving_body(1).expand(90, -1, -1), 0.95, id="still"),
    ],
)
def test_bodies_that_move_more_or_less_than_on_average_are_nearer(monkeypatch, joints, gain):
    given = seen_by(ring(2), joints)
    adapted = errors(track(given), joints)[30:].mean()
    monkeypatch.setattr(adapted_noise, "_FACTORS", (1.0, 1.0))
    average = errors(track(given), joints)[30:].mean()
    assert adapted < gain * average
