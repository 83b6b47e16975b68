"""Persons who come or go: the change of their size in the image tells how their depth changes."""

import math

import pytest
import torch

from tests.upper_body.seen import see_torso
from tests.upper_body.test_articulated import ROW, body, pixels, tracker
from torchpose.upper_body._root_grid import RootGrid
from torchpose.upper_body._seen_size import SeenSize, follow_size

LIKE = torch.zeros((), dtype=torch.float64)
SHOULDERS = [ROW["shoulder_left"], ROW["shoulder_right"]]
UPDATE = 0.1  # seconds


def told(joints, hidden=()):
    """Return the logs of the factors on the depth that joints [T, 8, 3] tell, [T]."""
    known = torch.ones(1, 8, dtype=torch.bool)
    known[:, [ROW[name] for name in hidden]] = False
    size, found = SeenSize.unknown(1, LIKE), []
    for frame in joints:
        size, farther = follow_size(size, see_torso(frame[None], known, 0.005), UPDATE)
        found.append(float(farther))
    return found


def going(distances):
    """Return the same pose at each of these depths, [T, 8, 3]."""
    joints = body(1)[0].repeat(len(distances), 1, 1)
    joints[..., 2] += torch.as_tensor(distances)[:, None] - 2.2
    return joints


@pytest.mark.parametrize(("hidden", "share", "unsure"), [((), 1.0, 0.1), (("head",), 0.4, 0.2)])
def test_who_goes_away_or_comes_back_is_followed(hidden, share, unsure):
    away = torch.cat([torch.linspace(2.2, 3.2, 30), torch.full((30,), 3.2)]).double()
    found = told(going(away), hidden)
    assert sum(found) == pytest.approx(share * (math.log(3.2 / 2.2) - unsure), abs=0.02)
    back = told(going(torch.cat([away, away.flip(0), away[:1].expand(20)])), hidden)
    assert sum(back) == pytest.approx(share * unsure, abs=0.02)


def test_who_stays_moves_by_nothing():
    noisy = going(2.2 + 0.1 * torch.sin(torch.arange(60.0)).double())
    assert told(noisy) == [0.0] * 60


def test_turns_are_no_steps():
    turning = torch.cat([body(1, turn=0.05 * i) for i in range(30)])
    assert told(turning) == pytest.approx([0.0] * 30, abs=1e-9)
    assert max(map(abs, told(turning, ("head",)))) <= 0.4 * 0.5 * UPDATE + 1e-9


def test_without_shoulders_nothing_is_told():
    away = going(torch.linspace(2.2, 3.2, 20).double())
    assert told(away, ("shoulder_left",)) == [0.0] * 20


@pytest.mark.parametrize("farther", [-0.1, 0.0, 0.03, 0.25])
def test_the_belief_about_the_depth_moves_along(farther):
    grid = RootGrid(10.0, LIKE)
    belief = grid.init(1, torch.tensor(0.1, dtype=torch.float64))
    stays, moves = grid.predict(belief), grid.predict(belief, torch.tensor([farther]).double())
    assert float(moves.sum()) == pytest.approx(float(stays.sum()))
    change = (grid.moments(moves).depth / grid.moments(stays).depth).log()
    assert float(change) == pytest.approx(farther, abs=0.01)


def test_who_stays_beside_somebody_who_walks_has_the_same_belief():
    grid = RootGrid(10.0, LIKE)
    belief = grid.init(2, torch.tensor(0.1, dtype=torch.float64))
    moves = grid.predict(belief, torch.tensor([0.0, 0.1]).double())
    assert torch.equal(moves[0], grid.predict(belief)[0])


@pytest.mark.parametrize(("hidden", "least"), [((), 0.9), (("head",), 0.75)])
def test_a_person_who_walks_away_is_not_seen_as_near(hidden, least):
    joints = body(45)
    joints[..., 2] += torch.linspace(0.0, 1.4, 45).double()[:, None]
    seen = pixels(joints, 2.0)[None]
    seen[:, :, [ROW[name] for name in hidden]] = torch.nan
    depth = tracker()(seen).joints3d[0, :, SHOULDERS, 2].mean(1)
    ratio = depth / joints[:, SHOULDERS, 2].mean(1)
    assert least < float(ratio[-1] / ratio[0]) < 1.1
