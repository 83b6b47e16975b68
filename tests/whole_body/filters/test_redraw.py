"""Redrawing: the truncated distribution, the probability of acceptance, and how much is computed."""

import math

import pytest
import torch

from tests.draws import generator
from tests.filters.linear_poses import assert_within_error
from torchpose.whole_body._filters.posture_gate import Rows, redraw_until_accepted


def normal_below(limit):
    """Draws from N(0, 1) and accepts what is below the limit; counts the draws."""
    drawn = []

    def draw(rows):
        drawn.append(len(rows.at))
        return rows.normal(1, torch.zeros((), dtype=torch.float64))

    return draw, (lambda x, rows: x[:, 0] < limit), drawn


def all_rows(batch, n, seeds=0):
    return Rows.all(batch, n, generator(seeds), torch.device("cpu"))


def probability_below(limit):
    return 0.5 * (1 + math.erf(limit / math.sqrt(2)))


@pytest.mark.parametrize("limit", [-1.5, 0.0, 1.0])
def test_accepted_draws_have_the_truncated_distribution(limit):
    draw, accept, drawn = normal_below(limit)
    found = redraw_until_accepted(draw, accept, all_rows(1, 20_000), 300)
    assert found.accepted.all() and (found.states[:, 0] < limit).all()
    inside, density = probability_below(limit), math.exp(-(limit**2) / 2) / math.sqrt(2 * math.pi)
    mean = -density / inside  # of a normal variable below the limit
    square = 1 - limit * density / inside
    assert_within_error(found.states[:, 0], torch.tensor(mean, dtype=torch.float64))
    assert_within_error(found.states[:, 0] ** 2, torch.tensor(square, dtype=torch.float64))
    assert_within_error(found.first.double(), torch.tensor(inside, dtype=torch.float64))
    assert_within_error(found.draws.double(), torch.tensor(1 / inside, dtype=torch.float64))
    computed = sum(drawn) / int(found.draws.sum())
    assert 1 <= computed < 1.4 and len(drawn) < 20  # little else was computed, in few rounds
    assert found.share.isnan().all()


@pytest.mark.parametrize("limit", [-1.5, 0.0, 1.0])
@pytest.mark.parametrize("max_redraws", [0, 1, 2, 40])
def test_the_share_is_unbiased_however_soon_it_stops(limit, max_redraws):
    draw, accept, _ = normal_below(limit)
    rows = all_rows(1, 60_000, seeds=3)
    found = redraw_until_accepted(draw, accept, rows, max_redraws, estimate_share=True)
    inside = torch.tensor(probability_below(limit), dtype=torch.float64)
    assert_within_error(found.share, inside)
    assert (found.share[~found.accepted] == 0).all()
    # as a weight: E[Z^ x] is the mean of x over what is accepted
    density = math.exp(-(limit**2) / 2) / math.sqrt(2 * math.pi)
    weighted = torch.where(found.accepted, found.share * found.states[:, 0], 0.0)
    assert_within_error(weighted, torch.tensor(-density, dtype=torch.float64))


def test_what_is_never_accepted_keeps_its_last_draw():
    draw, _, drawn = normal_below(0.0)
    found = redraw_until_accepted(draw, lambda x, rows: x[:, 0] > 99, all_rows(2, 5), 3)
    assert not found.accepted.any() and not found.first.any()
    assert (found.draws == 4).all() and drawn == [10] * 4  # one at a time, at first


def test_an_element_draws_the_same_in_any_batch():
    draw, accept, _ = normal_below(-0.5)
    both = Rows.all(2, 50, [generator(1), generator(2)], torch.device("cpu"))
    alone = Rows.all(1, 50, [generator(2)], torch.device("cpu"))
    found = redraw_until_accepted(draw, accept, both, 30, estimate_share=True)
    expected = redraw_until_accepted(draw, accept, alone, 30, estimate_share=True)
    for part, other in zip(found, expected, strict=True):
        assert torch.equal(part[50:], other)
