"""Cameras that look up or down or are rolled: their level axes, and pixels in these."""

import math

import pytest
import torch

from torchpose import PinholeCamera
from torchpose.camera import load_cameras, project, save_cameras
from torchpose.camera._choice import held_camera, resolve_camera
from torchpose.camera._tilt import Turn, angles_of_up
from torchpose.errors import CameraError, InputError

CAMERA = PinholeCamera(520.0, 530.0, 310.0, 245.0, 640, 480, skew=2.0)
ANGLES = [(0.4, 0.0), (-0.4, 0.1), (0.1, math.pi / 2), (0.0, -2.0)]
EYE = torch.eye(3, dtype=torch.float64)


def seen(points, camera):
    return project(points, camera.matrix, EYE, torch.zeros(3, dtype=torch.float64))[..., :2]


@pytest.fixture
def points():
    """Points that are 2 m before any of these cameras."""
    generator = torch.Generator().manual_seed(0)
    off = 0.3 * torch.randn(12, 3, generator=generator, dtype=torch.float64)
    return off + torch.tensor([0.0, 0.0, 2.0])


@pytest.mark.parametrize(("pitch", "roll"), ANGLES)
def test_level_axes_have_gravity_downwards_and_the_heading_of_the_camera(pitch, roll):
    camera = CAMERA.tilted(pitch, roll)
    rotation = camera.level_rotation
    torch.testing.assert_close(rotation @ rotation.mT, EYE)
    assert float(torch.linalg.det(rotation)) == pytest.approx(1.0)
    torch.testing.assert_close(rotation @ camera.up, -EYE[1])
    ahead = rotation[:, 2]  # the optical axis in level axes: straight ahead, and up by the pitch
    torch.testing.assert_close(ahead, ahead.new_tensor([0, -math.sin(pitch), math.cos(pitch)]))
    assert angles_of_up(camera.up) == pytest.approx((pitch, roll))


@pytest.mark.parametrize(("pitch", "roll"), ANGLES)
def test_the_level_world_of_a_camera_has_y_up_and_its_heading(pitch, roll):
    camera = CAMERA.tilted(pitch, roll).in_level_world()
    rotation = camera.rotation_matrix
    torch.testing.assert_close(rotation[:, 1], camera.up)
    ahead = rotation[2]  # the optical axis in the world: no component to the right
    torch.testing.assert_close(ahead, ahead.new_tensor([0, math.sin(pitch), -math.cos(pitch)]))
    torch.testing.assert_close(camera.with_world_up("y").up, camera.up)
    assert not bool(camera.translation.any())
    level = CAMERA.in_level_world()
    torch.testing.assert_close(level.rotation_matrix, torch.diag(EYE.new_tensor([1.0, -1, -1])))


def test_a_tilted_camera_keeps_its_precision():
    camera = PinholeCamera(525, 525, 319.5, 239.5).float()
    assert {x.dtype for x in camera.tilted(0.2).in_level_world().buffers()} == {torch.float32}


def test_a_camera_that_is_rolled_clockwise_sees_the_sky_on_its_left():
    assert CAMERA.tilted(0.0, math.pi / 2).up.tolist() == pytest.approx([-1, 0, 0])
    assert CAMERA.tilted(0.3).up.tolist() == pytest.approx([0, -math.cos(0.3), math.sin(0.3)])


@pytest.mark.parametrize(("pitch", "roll"), ANGLES)
def test_turned_pixels_are_those_of_the_level_camera(points, pitch, roll):
    camera = CAMERA.tilted(pitch, roll)
    turn = Turn.to_level(camera.up, camera.matrix)
    uv, level = seen(points, camera), seen(points @ camera.level_rotation.mT, camera)
    torch.testing.assert_close(turn.points(uv), level)
    torch.testing.assert_close(turn.back(camera.matrix).points(level), uv)
    cov = torch.tensor([[9.0, 2.0], [2.0, 4.0]], dtype=torch.float64)
    slopes = torch.stack([torch.autograd.functional.jacobian(turn.points, x) for x in uv])
    torch.testing.assert_close(turn.covariances(cov, uv), slopes @ cov @ slopes.mT)


def test_borders_of_the_image_are_turned_along(points):
    camera = CAMERA.tilted(-0.3, 0.2)
    turn, uv = Turn.to_level(camera.up, camera.matrix), seen(points, camera)
    lines = torch.tensor([[0.0, 1.0, -250.0], [-1.0, 0.0, 300.0]], dtype=torch.float64)

    def beyond(uv, lines):
        return torch.nn.functional.pad(uv, (0, 1), value=1.0) @ lines.mT > 0

    assert beyond(uv, lines).any() and not beyond(uv, lines).all()
    assert torch.equal(beyond(turn.points(uv), turn.lines(lines)), beyond(uv, lines))


def test_what_is_behind_the_level_camera_is_not_visible():
    camera = CAMERA.tilted(math.radians(-60))
    turn = Turn.to_level(camera.up, camera.matrix)
    rows = torch.tensor([[310.0, y] for y in (0.0, 245.0, 480.0, 700.0)], dtype=torch.float64)
    assert turn.visible(rows, camera.matrix).tolist() == [True, True, True, False]


def test_files_keep_where_up_is(tmp_path):
    path = tmp_path / "cameras.toml"
    tilted = PinholeCamera(525, 525, 320, 240, 640, 480, "a", up=(0.1, -2.0, 0.4))
    save_cameras([tilted, PinholeCamera(525, 525, 320, 240, name="b")], path)
    cameras = load_cameras(path)
    torch.testing.assert_close(cameras["a"].up, tilted.up, rtol=0, atol=0)
    assert float(tilted.up.norm()) == pytest.approx(1.0)
    assert cameras["b"].up is None and torch.equal(cameras["b"].level_rotation, EYE)
    camera, _ = resolve_camera(str(path), "a", (320, 240), None, "clip.mp4")
    assert camera.image_size == (320, 240)
    torch.testing.assert_close(camera.up, tilted.up)


def test_a_camera_of_a_rig_says_by_its_rotation_where_up_is():
    rotation = [math.radians(90 - 20), 0.0, 0.0]  # of a world with z up: forward, and 20 degrees up
    camera = PinholeCamera(525, 525, 320, 240, rotation=rotation).with_world_up("z")
    pitch, roll = angles_of_up(camera.up)
    assert math.degrees(pitch) == pytest.approx(20) and roll == pytest.approx(0)
    torch.testing.assert_close(camera.up, camera.rotation_matrix[:, 2])
    assert camera.rotation.tolist() == rotation


@pytest.mark.parametrize(
    ("up", "says"),
    [((0, 0, 0), "direction"), ((0, -1), "3 numbers"), ((0, 0.1, 1), "looks up by 84"),
     ((0, -0.1, -1), "looks down by 84"), ((0, math.nan, 0), "finite"), ("y", "numbers")],
)  # fmt: skip
def test_what_is_no_direction_is_refused(up, says):
    with pytest.raises(CameraError, match=says):
        PinholeCamera(525, 525, 320, 240, up=up)


@pytest.mark.parametrize("angles", [(-20.0, 0.0), (0.1, 5.0)])
def test_angles_in_degrees_are_refused(angles):
    with pytest.raises(CameraError, match=r"math\.radians"):
        CAMERA.tilted(*angles)


def test_options_state_where_up_is():
    assert held_camera(CAMERA, None, None, None, None) is CAMERA
    tilted = held_camera(CAMERA, -15.0, None, None, None)
    assert math.degrees(angles_of_up(tilted.up)[0]) == pytest.approx(-15)
    assert tilted.matrix.tolist() == CAMERA.matrix.tolist() and tilted.image_size == (640, 480)
    with pytest.raises(InputError, match="one of them"):
        held_camera(CAMERA, 10.0, None, "z", "cameras.toml")
    with pytest.raises(InputError, match="--camera FILE"):
        held_camera(CAMERA, None, None, "z", "525,525,320,240")
    with pytest.raises(InputError, match="axis must be one of y, z"):
        held_camera(CAMERA, None, None, "x", "cameras.toml")
    with pytest.raises(CameraError, match="at most 60"):
        held_camera(CAMERA, 75.0, None, None, None)
