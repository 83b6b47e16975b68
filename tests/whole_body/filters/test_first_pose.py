"""The first pose from several frames: bodies that walk and stand, turned round, and evidence by hand."""

import math

import pytest
import torch

from tests.draws import generator
from tests.whole_body.filters.walking_body import HEIGHT, WIDTH, rig, walk, walker
from torchpose.errors import InputError, ShapeError
from torchpose.whole_body import count_pixels, find_first_pose, render
from torchpose.whole_body._first_pose import facing_evidence, turned_round
from torchpose.whole_body._silhouettes.likelihood import intersection_over_union

BODY, RIG = walker(), rig()
UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
QUICK = {"n_particles": 1000, "n_tracking": 100, "n_frames": 5}


def ahead(states):
    return BODY.part_rotations(states)[..., 0, :, 2]


def test_who_is_turned_round_stands_in_the_same_place_and_looks_the_other_way():
    states = walk(BODY, 60)[::20]
    turned = turned_round(BODY, states)
    joints, names = BODY.joints(turned), BODY.skeleton.names
    for name in names:
        other = name.replace("left", "*").replace("right", "left").replace("*", "right")
        was = BODY.joints(states)[:, names.index(other)]
        assert (joints[:, names.index(name)] - was).norm(dim=-1).max() < 0.03, name
    assert ((ahead(turned) * ahead(states)).sum(-1) < -0.9).all()
    silhouettes = render(BODY, states, RIG, HEIGHT, WIDTH)
    overlap = intersection_over_union(count_pixels(BODY, turned[:, None], RIG, silhouettes))
    assert float(overlap.min()) > 0.85
    torch.testing.assert_close(
        BODY.joints(turned_round(BODY, turned)), BODY.joints(states), rtol=0, atol=0.05
    )


def test_the_evidence_is_that_of_steps_and_knees():
    standing = torch.zeros(4, BODY.dim, dtype=torch.float64)
    assert abs(float(facing_evidence(BODY, standing, UP))) < 1e-6  # straight legs, no step
    moving = standing.clone()
    moving[:, 2] = torch.tensor([0.0, 0.01, 0.02, 0.05])  # the rest pose faces +z
    assert float(facing_evidence(BODY, moving, UP)) == pytest.approx(3 * math.tanh(0.5))
    moving[:, 1] = torch.linspace(0, 2, 4)  # who is lifted does not walk
    assert float(facing_evidence(BODY, moving, UP)) == pytest.approx(3 * math.tanh(0.5))
    back = moving.clone()
    back[:, 2] = -moving[:, 2]
    both = facing_evidence(BODY, torch.stack([moving, back]), UP)
    assert both.shape == (2,) and float(both.sum()) == pytest.approx(0, abs=1e-9)
    # both knees bent by a right angle with equal lengths a: the knee is a / sqrt 2 off the line
    sitting = standing.clone()
    names = BODY.skeleton.names
    for side in ("left", "right"):
        sitting[:, 3 + 3 * BODY.skeleton.part(f"{side}_shank")] = math.sin(math.pi / 4)
    thigh, shank = (BODY.offsets[names.index(f"left_{n}")].norm() for n in ("knee", "ankle"))
    off = float(thigh * shank / (thigh**2 + shank**2).sqrt())  # height of a right triangle
    slant = float(shank / (thigh**2 + shank**2).sqrt())  # of the line from hip to ankle
    expected = 3 * math.tanh(off * _cosine(slant) / 0.1)
    assert float(facing_evidence(BODY, sitting, UP)) == pytest.approx(expected, rel=1e-6)


def _cosine(sine):
    return math.sqrt(1 - sine**2)


@pytest.mark.parametrize(("seed", "heading"), [(0, 0.0), (1, -1.2)])
def test_a_walk_tells_front_from_back(seed, heading):
    truth = walk(BODY, 20, seed=seed, phase=1.0, heading=heading)
    silhouettes = render(BODY, truth, RIG, HEIGHT, WIDTH)
    found = find_first_pose(BODY, silhouettes, RIG, None, generator(seed), fps=60.0, **QUICK)
    assert found.state.shape == (36,) and found.candidates.shape == (8, 36)
    assert float(ahead(found.state) @ ahead(truth[0])) > 0.4
    torch.testing.assert_close(found.score, 100 * found.log_likelihood + found.evidence)
    torch.testing.assert_close(found.state, found.candidates[found.score.argmax()])
    error = (BODY.joints(found.state) - BODY.joints(truth[0])).norm(dim=-1).mean()
    assert float(error) < 0.2  # images of 80 pixels and no prior


def test_a_known_heading_leaves_one_candidate_and_one_frame_is_enough():
    truth = walk(BODY, 3)
    image = render(BODY, truth[:1], RIG, HEIGHT, WIDTH)
    facing = torch.tensor([0.3, 0.0, 1.0])
    found = find_first_pose(BODY, image, RIG, truth, generator(), facing=facing, **QUICK)
    assert found.candidates.shape == (1, 36)
    assert float(ahead(found.state) @ ahead(truth[0])) > 0.5


def test_frames_in_which_nobody_is_seen_do_not_count():
    truth = walk(BODY, 4)
    silhouettes = render(BODY, truth, RIG, HEIGHT, WIDTH)
    silhouettes[2] = False
    found = find_first_pose(BODY, silhouettes, RIG, truth, generator(), **QUICK)
    assert bool(found.score.isfinite().all())


def test_what_is_refused():
    image = render(BODY, walk(BODY, 2), RIG, HEIGHT, WIDTH)
    with pytest.raises(InputError, match="needs a frame"):
        find_first_pose(BODY, image[:0], RIG)
    with pytest.raises(InputError, match="positive fps"):
        find_first_pose(BODY, image, RIG, fps=0.0)
    with pytest.raises(InputError, match="n_tracking of 20 or more"):
        find_first_pose(BODY, image, RIG, n_tracking=19)
    with pytest.raises(ShapeError):
        find_first_pose(BODY, image[None], RIG)
    with pytest.raises(InputError, match="silhouettes must be a tensor, got ndarray"):
        find_first_pose(BODY, image.numpy(), RIG)
    with pytest.raises(InputError, match="are empty"):
        find_first_pose(BODY, torch.zeros_like(image), RIG)
