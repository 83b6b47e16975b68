"""The size of a torso stays, so that it is no evidence about the depth of every frame anew."""

import pytest
import torch

from tests.upper_body.seen import see_torso
from torchpose.upper_body._root_grid import RootGrid
from torchpose.upper_body._torso_likelihood import TorsoLengths, torso_places

LIKE = torch.zeros((), dtype=torch.float64)
STD = 2.0 / 525.0


@pytest.fixture(scope="module")
def grid():
    return RootGrid(30.0, LIKE)


def lengths(width=0.34, height=0.19):
    sizes = (width, height, 0.04, 0.02)
    return TorsoLengths.of(*(torch.tensor([size], dtype=torch.float64) for size in sizes))


def seen(depth, size=1.0, turn=0.0):
    """Return the torso of a person who faces the camera, as measured."""
    own = lengths()
    half = size * own.width[:, None, None] / 2 * torch.ones(1, 1, 2)
    place = torso_places(torch.tensor([[turn]]).double(), half.double(), own)[0, 0]
    place[2:] *= size
    place[:, 2] += depth
    rays = torch.zeros(1, 8, 3, dtype=torch.float64)
    rays[..., 2] = 1.0
    rays[0, [2, 5, 4, 3]] = place / place[:, 2:]
    known = torch.zeros(1, 8, dtype=torch.bool)
    known[:, [2, 3, 4, 5]] = True
    return see_torso(rays, known, STD)


def test_larger_torsos_look_like_nearer_ones(grid):
    evidence = grid.likelihood(seen(2.0), lengths()).log()
    assert evidence.shape == (1, len(grid.log_size), len(grid.depth), len(grid.turn))
    shift = round(float(grid.log_size.diff()[0] / grid.depth.log().diff()[0]))
    torch.testing.assert_close(evidence[:, 1:, shift:], evidence[:, :-1, :-shift])


def test_beliefs_begin_with_the_usual_size(grid):
    belief = grid.init(2, torch.tensor(0.1, dtype=torch.float64))
    torch.testing.assert_close(belief.sum((1, 2, 3)), torch.ones(2, dtype=torch.float64))
    found = grid.moments(belief)
    torch.testing.assert_close(found.size, torch.ones(2, dtype=torch.float64))
    assert found.of_size.sqrt().tolist() == pytest.approx([0.1, 0.1], abs=0.002)
    none = grid.moments(grid.init(1, torch.tensor(0.0, dtype=torch.float64)))
    assert float(none.of_size) == pytest.approx(0.0, abs=1e-9)


def test_what_else_tells_the_depth_adds_up_against_the_usual_size(grid):
    """A torso looks like most at 2 m, but arms say a little in each frame that it is at 2.5 m."""
    torso, true = seen(2.0), 2.5
    belief = grid.init(1, torch.tensor(0.12, dtype=torch.float64))
    for _ in range(60):
        believed = grid.predict(belief) * grid.likelihood(torso, lengths())
        root = grid.best(believed, 10)
        said = -0.5 * ((root.depth / true).log() / 0.2).square()
        belief = grid.belief(believed, root, said, torch.tensor([True]))
    found = grid.moments(belief)
    assert float(found.depth) == pytest.approx(true, rel=0.04)
    assert float(found.size) == pytest.approx(true / 2.0, rel=0.06)


def test_depths_at_which_arms_cannot_be_are_ruled_out(grid):
    """Arms that fit best at 2 m say nothing about 2.2 m, and much against 5 m."""
    belief = grid.init(1, torch.tensor(0.12, dtype=torch.float64))
    root = grid.at_all_depths(belief)
    assert root.depth[0, ::2].tolist() == root.depth[0, 1::2].tolist() == grid.depth[::4].tolist()
    assert bool((root.turn[:, ::2] < 0).all() and (root.turn[:, 1::2] >= 0).all())
    said = -0.5 * ((root.depth / 2.0).log() / 0.07).square()
    both = torch.tensor([[True, True]])
    against = grid.ruled_out(said[:, None].expand(-1, 2, -1), both)
    assert against.shape == belief[:, 0].shape
    near = (grid.depth / 2.0).log().abs() < 0.15
    assert float(against[:, near].abs().max()) == 0.0
    assert float(against[:, grid.depth > 5.0].max()) < -20.0
    # an arm whose hand is an outlier says nothing alone; one that is the only one does
    misled = -0.5 * ((root.depth / 0.8).log() / 0.07).square()
    apart = torch.stack([0 * said, misled], 1)
    assert float(grid.ruled_out(apart, both).abs().max()) == 0.0
    alone = grid.ruled_out(apart, torch.tensor([[False, True]]))
    assert float(alone[:, grid.depth > 2.0].max()) < -5.0
