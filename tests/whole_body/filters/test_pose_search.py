"""The first pose: where rays meet, which way is up, and a search that starts from nothing."""

import pytest
import torch

from tests.draws import generator
from tests.whole_body.filters.walking_body import HEIGHT, WIDTH, rig, rotation_vector, walk, walker
from torchpose.body import Limbs
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.errors import CameraError, InputError, ShapeError
from torchpose.whole_body import find_pose, render
from torchpose.whole_body._pose_search import (
    find_candidates,
    place_from_silhouettes,
    upward_direction,
)
from torchpose.whole_body._silhouettes.rendering import render_limbs

BODY, RIG = walker(), rig()


def pillar(x, y, z, tall=1.7, radius=0.1):
    """Silhouettes of an upright rod with round ends, `tall` in all."""
    middle = torch.tensor([[x, y, z]], dtype=torch.float64)
    half = torch.tensor([[0.0, tall / 2 - radius, 0.0]], dtype=torch.float64)
    return Limbs(middle - half, middle + half, torch.full((1, 2), radius, dtype=torch.float64))


@pytest.mark.parametrize("where", [(0.0, 0.95, 0.0), (0.4, 0.9, -0.3)])
def test_rays_meet_at_the_middle_of_the_body(where):
    image = render_limbs(pillar(*where), RIG, HEIGHT, WIDTH)
    three = place_from_silhouettes(image[None], RIG, 1.7)
    assert (three.position[0] - torch.tensor(where)).norm() < 0.04
    # one camera: across the ray as well, along it by the person's height
    one = place_from_silhouettes(image[None, :1], RIG.select([0]), 1.7)
    assert (one.position[0] - torch.tensor(where)).norm() < 0.3
    ahead = RIG.rotation[0, 2]
    assert float(ahead @ one.cov[0] @ ahead) > 8 * float(one.cov[0, 1, 1])
    # a camera that sees nothing does not count
    blind = image.clone()
    blind[1] = False
    two = place_from_silhouettes(blind[None], RIG, 1.7).position
    expected = place_from_silhouettes(image[None, [0, 2]], RIG.select([0, 2]), 1.7).position
    torch.testing.assert_close(two, expected)


def test_up_is_the_axis_against_the_cameras_y():
    assert upward_direction(RIG).tolist() == [0, 1, 0]
    # a room whose z axis points up, seen by a camera that looks down by 30 degrees
    ahead = torch.tensor([0.0, 3**0.5 / 2, -0.5], dtype=torch.float64)
    right = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    rotation = torch.stack([right, torch.linalg.cross(ahead, right), ahead])
    tilted = PinholeCamera(90, 90, 40, 30, rotation=rotation_vector(rotation).tolist())
    assert upward_direction(CameraRig([tilted])).tolist() == [0, 0, 1]
    rolled = PinholeCamera(90, 90, 40, 30, rotation=(0.0, 0.0, 0.785398))
    with pytest.raises(InputError, match="give `up`"):
        upward_direction(CameraRig([rolled, PinholeCamera(90, 90, 40, 30, rotation=(0.9, 0, 0))]))


def test_a_pose_is_found_without_one():
    states = walk(BODY, 60)
    truth = states[[20, 45]]
    silhouettes = render(BODY, truth, RIG, HEIGHT, WIDTH)
    facing = torch.tensor([0.3, 0.0, 1.0])
    found = find_pose(
        BODY, silhouettes, RIG, walk(BODY, 60, seed=1), generator(), n_particles=300,
        n_layers=8, facing=facing,
    )  # fmt: skip
    assert found.shape == (2, 36)
    error = (BODY.joints(found) - BODY.joints(truth)).norm(dim=-1)
    assert (error.mean(-1) < 0.09).all()
    # without a hint, the body still stands where it is, upright, if perhaps turned by half a turn
    blind = find_pose(BODY, silhouettes[0], RIG, truth, generator(1), n_particles=800, n_layers=8)
    assert blind.shape == (36,)
    joints, expected = BODY.joints(blind), BODY.joints(truth[0])
    assert (joints[[0, 1, 2]] - expected[[0, 1, 2]]).norm(dim=-1).mean() < 0.12


def test_the_pose_found_is_the_best_candidate():
    silhouettes = render(BODY, walk(BODY, 2), RIG, HEIGHT, WIDTH)
    few = {"n_particles": 60, "n_layers": 2, "n_headings": 3}
    found = find_candidates(BODY, silhouettes, RIG, None, generator(), **few)
    assert found.states.shape == (2, 3, 36) and found.log_likelihood.shape == (2, 3)
    best = find_pose(BODY, silhouettes, RIG, None, generator(), **few)
    assert torch.equal(best[1], found.states[1, found.log_likelihood[1].argmax()])


def test_what_the_search_refuses():
    image = render(BODY, walk(BODY, 3)[1], RIG, HEIGHT, WIDTH)
    with pytest.raises(InputError, match="are empty"):
        find_pose(BODY, torch.zeros_like(image), RIG)
    with pytest.raises(CameraError):
        find_pose(BODY, image[:2], RIG)
    with pytest.raises(ShapeError):
        find_pose(BODY, image[0], RIG)
    with pytest.raises(InputError, match="bool"):
        find_pose(BODY, image.float(), RIG)
    with pytest.raises(InputError, match="prior must be"):
        find_pose(BODY, image, RIG, torch.zeros(4, 7))
    with pytest.raises(InputError, match="likelihood"):
        find_pose(BODY, image, RIG, likelihood="edges")
    with pytest.raises(InputError, match="layers"):
        find_pose(BODY, image, RIG, n_layers=1)
    with pytest.raises(InputError, match="direction"):
        find_pose(BODY, image, RIG, up=torch.zeros(3))
    with pytest.raises(
        InputError, match=r"along the floor.*vertical, which is \[0\.0, 1\.0, 0\.0\]"
    ):
        find_pose(BODY, image, RIG, facing=torch.tensor([0.1, -1.0, 0.0]))
    with pytest.raises(InputError, match="must hold 2, one for each sequence, got 1"):
        find_pose(BODY, torch.stack([image, image]), RIG, None, [generator()])
