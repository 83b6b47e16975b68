"""Cameras and keypoints of other conventions: each is refused, and the message says what they are."""

import copy

import pytest
import torch

from tests.whole_body.keypoints.scenes import (
    FPS,
    NAMES,
    camera_at,
    kalman,
    moving_body,
    ring,
    scene,
)
from torchpose.camera import CameraRig
from torchpose.errors import CameraError
from torchpose.math._rotations import matrix_to_rotvec, rotvec_to_matrix
from torchpose.whole_body._keypoints.camera_order import notes_on_order
from torchpose.whole_body._keypoints.keypoint_body_tracker import KeypointBodyTracker
from torchpose.whole_body._keypoints.keypoint_notes import notes_on_a_rolled_camera, notes_on_up

WIDTH, HEIGHT = 1920, 1080
FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
POSES = {
    "from camera to world": lambda R, t: (R.mT, -R.mT @ t),
    "the places of the cameras": lambda R, t: (R, -R.mT @ t),
    "and translations are not": lambda R, t: (R.mT, t),
    "OpenGL and Blender; give": lambda R, t: (FLIP @ R, FLIP @ t),
    "Blender, and poses are": lambda R, t: ((FLIP @ R).mT, -R.mT @ t),
}
PIXELS = {
    "of 1/2 of the calibrated size": lambda u, v: (u / 2, v / 2),
    "v, u, a row": lambda u, v: (v, u),
    "from the lower edge": lambda u, v: (u, HEIGHT - 1 - v),
    "are mirrored": lambda u, v: (WIDTH - 1 - u, v),
    "upside down": lambda u, v: (WIDTH - 1 - u, HEIGHT - 1 - v),
    "90 degrees clockwise": lambda u, v: (HEIGHT - 1 - v, u),
    "90 degrees counterclockwise": lambda u, v: (v, WIDTH - 1 - u),
}


def rig_of_poses(rig, change):
    """The rig with other numbers for the poses of its cameras."""
    cameras = []
    for c in range(len(rig)):
        camera = copy.deepcopy(camera_at(0.0, 1.0, rig.names[c]))
        R, t = change(rig.rotation[c], rig.translation[c])
        camera.rotation.copy_(matrix_to_rotvec(R))
        camera.translation.copy_(t)
        cameras.append(camera)
    return CameraRig(cameras)


@pytest.fixture(scope="module")
def seen():
    return scene(3, n_frames=20)


def track(rig, keypoints, up=None, **options):
    tracker = kalman(rig, up=up)
    return tracker(keypoints=keypoints, **options)


@pytest.mark.parametrize(
    ("word", "cameras"),
    # two cameras at a right angle agree nearly as well if their rotations are transposed
    [(word, n) for word in POSES for n in (2, 3) if (word, n) != ("and translations are not", 2)],
)
def test_poses_of_other_programs_are_refused(seen, word, cameras):
    rig = rig_of_poses(seen.rig.select(range(cameras)), POSES[word])
    with pytest.raises(CameraError, match=word):
        track(rig, seen.keypoints[:, :cameras])


@pytest.mark.parametrize("word", PIXELS)
def test_keypoints_of_other_images_are_refused(seen, word):
    other = torch.stack(PIXELS[word](*seen.keypoints.unbind(-1)), -1)
    with pytest.raises(CameraError, match=word):
        track(seen.rig, other)


@pytest.mark.parametrize("word", ["from camera to world", "and translations are not"])
def test_other_conventions_are_refused_of_several_persons_too(seen, word):
    rig = rig_of_poses(seen.rig, POSES[word])
    with pytest.raises(CameraError, match=word):
        track(rig, seen.keypoints[:, :, None], persons="all")


def test_keypoints_of_other_images_are_refused_of_several_persons_too(seen):
    upside_down = torch.stack(PIXELS["from the lower edge"](*seen.keypoints.unbind(-1)), -1)
    with pytest.raises(CameraError, match="from the lower edge"):
        track(seen.rig, upside_down[:, :, None], persons="all")


def test_right_cameras_with_errors_are_not_refused(seen):
    """Neither noise nor turned cameras, other delays or few keypoints look like another convention."""
    generator = torch.Generator().manual_seed(1)
    noise = 15 * torch.randn(seen.keypoints.shape, generator=generator).double()
    turn = torch.tensor([0.05, -0.05, 0.03], dtype=torch.float64)
    turned = copy.deepcopy(seen.rig)
    turned.rotation[1] = rotvec_to_matrix(turn) @ turned.rotation[1]
    late = seen.keypoints.clone()
    late[:, 1] = late[:, 1].roll(6, 0)
    few = seen.keypoints.clone()
    few[:, :, 7:] = torch.nan
    for rig, keypoints in (
        (seen.rig, seen.keypoints + noise), (turned, seen.keypoints), (seen.rig, late), (seen.rig, few),
    ):  # fmt: skip
        single = KeypointBodyTracker(rig, FPS)
        single.check_cameras(single.reader.frames_and_feet(keypoints[None], None, NAMES, None)[0])


def test_an_order_that_is_wrong_is_said_where_several_fit():
    """Cameras in a ring around a person who stays in the middle agree alike if all move on by one."""
    rig = ring(4)
    single = KeypointBodyTracker(rig, FPS)
    keypoints = rig(moving_body(20)).pixels
    frames = single.reader.frames_and_feet(keypoints[:, [3, 2, 1, 0]], None, NAMES, None)[0]
    (note,) = notes_on_order(rig.names, single.tracker.filter.maps, frames)
    assert "another order" in note
    right = single.reader.frames_and_feet(keypoints, None, NAMES, None)[0]
    assert notes_on_order(rig.names, single.tracker.filter.maps, right) == ()


def test_an_axis_that_does_not_point_up_is_said(seen):
    assert notes_on_up("y", seen.joints) == notes_on_up(None, seen.joints) == ()
    lying = track(seen.rig, seen.keypoints, up="z")
    assert any("degrees away from z, which was given as up" in note for note in lying.notes)


def test_a_person_upside_down_in_one_camera_is_said():
    pixels = ring(1)(moving_body(40)).pixels[:, 0]
    there = torch.ones(pixels.shape[:-1], dtype=torch.bool)
    assert notes_on_a_rolled_camera("a", pixels, there) == ()
    pixels = torch.stack([pixels[..., 0], HEIGHT - 1 - pixels[..., 1]], -1)
    (note,) = notes_on_a_rolled_camera("a", pixels, there)
    assert "upside down" in note


@pytest.mark.parametrize("cameras", [2, 3])
def test_a_live_stream_is_refused_at_its_beginning(seen, cameras):
    rig = rig_of_poses(seen.rig.select(range(cameras)), POSES["from camera to world"])
    tracker = kalman(rig)
    with pytest.raises(CameraError, match="from camera to world"):
        tracker.step(tracker.init(names=NAMES), keypoints=seen.keypoints[0, :cameras])
    tracker = kalman(seen.rig)
    state, _ = tracker.step(tracker.init(names=NAMES), keypoints=seen.keypoints[0])
    upside_down = torch.stack(PIXELS["upside down"](*seen.keypoints[1].unbind(-1)), -1)
    tracker.step(state, keypoints=upside_down)  # one frame of a stream that has begun stops nothing
