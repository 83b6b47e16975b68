"""Lifted bodies are upright where gravity is known, and people who stand tell how a camera is held."""

import copy
import functools
import math

import pytest
import torch

from tests.whole_body.keypoints.scenes import kalman, moving_body
from torchpose.body import BODY_15
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.errors import InputError
from torchpose.math._rotations import rotvec_to_matrix
from torchpose.whole_body import BodyTrack
from torchpose.whole_body._keypoints.camera_tilt import CameraTilt, find_camera_tilt
from torchpose.whole_body._keypoints.lifted_lean import lean_of_network, without_lean

WIDTH, HEIGHT = 1080, 1920
PELVIS = BODY_15.joint("pelvis")
LEGS = [BODY_15.joint(f"{side}_{name}") for side in ("left", "right") for name in ("knee", "ankle")]
UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)


def camera_of(pitch: float = 0.0, roll: float = 0.0) -> PinholeCamera:
    camera = PinholeCamera.from_image_size(WIDTH, HEIGHT)
    return camera.tilted(math.radians(pitch), math.radians(roll)).in_level_world()


def standing_body() -> torch.Tensor:
    """Somebody who looks at the camera and leans a little ahead, as people do who stand."""
    lean = rotvec_to_matrix(torch.tensor([math.radians(4.0), 0.0, 0.0], dtype=torch.float64))
    return moving_body(24) @ lean.T


def seen_by(camera: PinholeCamera, aimed: bool = False) -> torch.Tensor:
    """Keypoints of somebody 4 m away, at the height of the lens or in the middle of the image."""
    joints = standing_body()
    ahead = -camera.rotation_matrix[2] if aimed else torch.tensor([0.0, 0.0, 1.0]).to(joints)
    return camera(joints - 4.0 * ahead)[:, None, :, :2]


def tracked(pixels: torch.Tensor, camera: PinholeCamera, up: str | None = None) -> BodyTrack:
    tracker = kalman([camera], up=up)
    return tracker(keypoints=pixels)


@functools.cache
def standing_before(pitch: float = 0.0, roll: float = 0.0) -> BodyTrack:
    """The track of somebody who stands before a tilted camera that is said to be level."""
    return tracked(seen_by(camera_of(pitch, roll)), camera_of())


@pytest.mark.parametrize("elevation", [-25.0, 0.0, 15.0])
def test_the_turn_of_the_network_is_taken_back_about_the_horizontal_axis(elevation):
    e = torch.tensor(math.radians(elevation), dtype=torch.float64)
    ray = torch.stack([torch.zeros_like(e), -e.tan()])
    body = torch.stack([UP, torch.tensor([1.0, 0, 0]).to(UP)])
    turned = without_lean(body, ray, UP)
    torch.testing.assert_close(turned[1], body[1])  # along the axis
    angle = torch.atan2(turned[0, 2], -turned[0, 1])  # with the head away from the camera
    torch.testing.assert_close(angle, -lean_of_network(e))
    torch.testing.assert_close(turned @ turned.mT, body @ body.mT)


def test_a_body_seen_from_below_is_upright_where_the_tilt_is_known():
    camera = camera_of(20.0)
    pixels = seen_by(camera, aimed=True)
    off = []
    for up in (None, "y"):
        joints = tracked(pixels, camera, up).joints3d
        off.append(float((joints - joints[:, [PELVIS]] - _relative()).norm(dim=-1).mean()))
    assert off[1] < 0.75 * off[0]


def _relative() -> torch.Tensor:
    joints = standing_body()
    return joints - joints[:, [PELVIS]]


@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (12.0, 0.0), (12.0, 8.0), (0.0, -8.0)])
def test_somebody_who_stands_tells_how_the_camera_is_held(pitch, roll):
    track = standing_before(pitch, roll)
    found = find_camera_tilt([track, track], CameraRig([camera_of()]))
    assert found is not None
    angles = [math.degrees(angle) for angle in found]
    assert angles[0] == pytest.approx(pitch, abs=5.0) and angles[1] == pytest.approx(roll, abs=2.0)
    assert 3.0 < angles[2] < 9.0 and 1.0 < angles[3] < 4.0


def test_the_pose_of_the_camera_that_tracked_does_not_matter():
    pixels = seen_by(camera_of(8.0))
    elsewhere = PinholeCamera.from_image_size(WIDTH, HEIGHT)
    elsewhere.translation[:] = torch.tensor([1.0, -2.0, 0.5])
    pairs = [(tracked(pixels, camera), camera) for camera in (camera_of(), elsewhere)]
    found = [find_camera_tilt([track], CameraRig([camera])) for track, camera in pairs]
    torch.testing.assert_close(torch.tensor(found[0]), torch.tensor(found[1]), atol=1e-6, rtol=0)


def test_who_hides_the_legs_or_sits_tells_nothing():
    level = camera_of()
    pixels = seen_by(level)
    pixels[..., LEGS, :] = torch.nan
    assert find_camera_tilt([tracked(pixels, level)], CameraRig([level])) is None
    track = copy.copy(standing_before())
    sitting = track.joints3d.clone()
    ahead = torch.tensor([0.0, 0.4, 0.4]).to(sitting)
    sitting[:, LEGS] += ahead
    track.joints3d = sitting
    assert find_camera_tilt([track], CameraRig([level])) is None


def test_a_tracker_finds_the_tilt_of_its_only_camera():
    camera = camera_of()
    tracker = kalman([camera])
    track = standing_before(12.0)
    assert isinstance(found := tracker.find_tilt([track]), CameraTilt)
    assert found == find_camera_tilt([track], CameraRig([camera]))
    assert tracker.find_tilt([]) is None
    with pytest.raises(InputError, match="without `up`"):
        kalman([camera], up="y").find_tilt([track])
