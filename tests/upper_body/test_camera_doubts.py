"""Cameras without the size of their image, and persons whom single poses put into the lens."""

import pytest
import torch

import torchpose
from tests.upper_body.test_articulated import PRIOR, body
from torchpose.upper_body import UpperBodyTracker


def seen(camera, aside=0.0, depth=2.2):
    """Return keypoints of a body that stands so far to the right, metres."""
    joints = body(6, depth=depth) + torch.tensor([aside, 0.0, 0.0])
    return camera(joints)[None, ..., :2]


def outliers(camera, uv):
    track = UpperBodyTracker(PRIOR, camera, "articulated", fps=30.0)(uv)
    return int((track.inlier_probability < 0.5).sum()), track.notes


@pytest.mark.parametrize(("cx", "aside"), [(100.0, 1.7), (0.0, 2.0), (-300.0, 3.0)])
def test_persons_of_images_that_are_cut_are_no_outliers(cx, aside):
    camera = torchpose.PinholeCamera(525.0, 525.0, cx, 240.0)
    found, notes = outliers(camera, seen(camera, aside))
    assert found == 0
    assert notes == ()


def test_keypoints_beyond_the_image_that_is_guessed_are_noted():
    uv = seen(torchpose.PinholeCamera(525.0, 525.0, 320.0, 240.0), 2.2)
    for size, noted in ((None, True), (1280, False)):
        camera = torchpose.PinholeCamera(525.0, 525.0, 320.0, 240.0, width=size, height=size)
        _, notes = outliers(camera, uv)
        assert any("beyond 640 x 480 pixels" in note for note in notes) is noted


@pytest.mark.parametrize(("depth", "noted"), [(2.2, False), (0.2, True)])
def test_single_poses_in_the_lens_are_noted(depth, noted):
    camera = PRIOR.camera
    uv = seen(camera, depth=2.2)
    neck = uv[:, :, 4:5].clone()
    tracker = UpperBodyTracker(PRIOR, camera, "mkf-fixed", fps=30.0, outliers=False)
    notes = tracker(neck + 2.2 / depth * (uv - neck)).notes
    assert any("0.3 m before the camera" in note for note in notes) is noted
