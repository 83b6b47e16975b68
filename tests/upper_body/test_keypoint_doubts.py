"""Keypoints that are no pixels of a person as torchpose reads them are refused, or a note says so."""

import math

import pytest
import torch

import torchpose
from torchpose.body import BODY_15
from torchpose.camera import PinholeCamera
from torchpose.errors import InputError
from torchpose.io import Keypoints
from torchpose.upper_body._keypoint_doubts import doubts_about

# Of somebody who faces the camera: pixels of head, nose, neck, shoulders, elbows, wrists.
PLACES = {
    "head": (320, 80), "nose": (320, 100), "neck": (320, 150), "left_shoulder": (380, 170),
    "right_shoulder": (260, 170), "left_elbow": (400, 260), "right_elbow": (240, 260),
    "left_wrist": (390, 330), "right_wrist": (250, 330),
}  # fmt: skip
NAMES = tuple(PLACES)
MIDDLE = torch.tensor([320.0, 240.0], dtype=torch.float64)


def keypoints(n_frames: int = 5, **changes: object) -> Keypoints:
    points = torch.tensor(list(PLACES.values()), dtype=torch.float64).repeat(n_frames, 1, 1)
    return Keypoints(**{"keypoints": points, "names": NAMES, **changes})


def turned(degrees: float) -> Keypoints:
    """Return what a camera that is rolled clockwise by so much sees."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    rotation = torch.tensor([[c, s], [-s, c]], dtype=torch.float64)
    whole = keypoints()
    return keypoints(keypoints=(whole.keypoints - MIDDLE) @ rotation.mT + MIDDLE)


def camera(roll: float = 0.0) -> PinholeCamera:
    return PinholeCamera.from_image_size(640, 480).tilted(0.0, math.radians(roll))


def notes(given: Keypoints, up: torch.Tensor | None = None, told: bool = True) -> str:
    return "\n".join(doubts_about(given, told, up))


def test_somebody_who_faces_the_camera_raises_no_doubt():
    assert notes(keypoints()) == ""
    assert notes(keypoints(), told=False) == ""  # a neck like Kinect's
    assert notes(keypoints(), camera().up) == ""


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_forearm_that_is_much_shorter_than_the_other(side):
    given = keypoints(40)
    elbow, wrist = (NAMES.index(f"{side}_{joint}") for joint in ("elbow", "wrist"))
    whole = given.keypoints[:, wrist] - given.keypoints[:, elbow]
    shares = torch.linspace(0.05, 0.7, 40, dtype=torch.float64)[:, None]
    given.keypoints[:, wrist] = given.keypoints[:, elbow] + shares * whole
    assert notes(given) == ""
    given.keypoints[:, wrist] = given.keypoints[:, elbow] + 0.5 * shares * whole
    assert f"the {side} forearm looks at most 33 % as long" in notes(given)
    given.keypoints[10:, wrist] = torch.nan
    assert notes(given) == ""


def test_rows_that_count_upwards():
    flipped = keypoints()
    flipped.keypoints[..., 1] = 480 - flipped.keypoints[..., 1]
    assert "count downwards" in notes(flipped)


@pytest.mark.parametrize("roll", [90.0, -90.0, 180.0])
def test_a_rolled_camera_is_no_doubt_if_it_is_stated(roll):
    seen = turned(roll)
    assert ("beside shoulders" if abs(roll) == 90 else "count downwards") in notes(seen)
    assert notes(seen, camera(roll).up) == ""
    wrong = notes(seen, camera(-roll).up if abs(roll) == 90 else camera(0.0).up)
    assert "count downwards" in wrong


def test_coordinates_in_the_other_order():
    assert "v was given before u" in notes(keypoints(keypoints=keypoints().keypoints.flip(-1)))


def test_a_head_and_a_neck_tell_it_where_no_trunk_is_seen():
    """Of head, neck and hands, which the prior takes, the hands may be anywhere."""
    names = ("head", "neck", "left_hand", "right_hand")
    seen = torch.tensor([[320, 80], [320, 120], [380, 40], [280, 330]]).double().repeat(5, 1, 1)
    upwards = torch.stack([seen[..., 0], 480 - seen[..., 1]], -1)
    assert notes(keypoints(keypoints=seen, names=names)) == ""
    assert "the head lies below the neck" in notes(keypoints(keypoints=upwards, names=names))
    assert "the head lies beside the neck" in notes(keypoints(keypoints=seen.flip(-1), names=names))


def test_sides_from_behind_beside_a_face():
    exchanged = [
        name.replace("left", "#").replace("right", "left").replace("#", "right") for name in NAMES
    ]
    assert "exchange them" in notes(keypoints(names=tuple(exchanged)))
    confidence = torch.ones(5, len(NAMES), dtype=torch.float64)
    confidence[:, NAMES.index("nose")] = 0.1  # seen from behind
    assert notes(keypoints(names=tuple(exchanged), confidence=confidence)) == ""


def test_a_neck_between_the_shoulders():
    given = keypoints()
    given.keypoints[:, NAMES.index("neck")] = torch.tensor([320.0, 168.0], dtype=torch.float64)
    assert "--neck mid-shoulder" in notes(given, told=False)
    assert notes(given, told=True) == ""


def test_the_neck_beside_a_face_is_the_middle_of_the_shoulders():
    prior = torchpose.load_prior("kinect-upper-body-small")
    tracker = torchpose.UpperBodyTracker(prior, camera(), "articulated", fps=30)
    names = NAMES[1:]  # without a head, as OpenPose has them without legs
    points = keypoints(3).keypoints[None, :, 1:]
    by_names = tracker(points, names=names)
    stated = torchpose.UpperBodyTracker(
        prior, camera(), "articulated", fps=30, neck="mid-shoulder"
    )(points, names=names)
    assert torch.equal(by_names.joints3d, stated.joints3d)
    assert any("mid-shoulder" in note for note in by_names.notes)


@pytest.mark.parametrize("scale", ["shares", "half"])
def test_what_does_not_hold_pixels_is_refused(scale):
    prior = torchpose.load_prior("kinect-upper-body-small")
    tracker = torchpose.UpperBodyTracker(prior, camera(), "window-mixture")
    points = keypoints().keypoints[None]
    bad = points / 640 if scale == "shares" else points.bfloat16()
    message = r"pixels.*width and height" if scale == "shares" else "float32.*bfloat16"
    with pytest.raises(InputError, match=message):
        tracker(bad, names=NAMES)
    with pytest.raises(InputError, match=message):
        tracker.step(tracker.init(1, NAMES), bad[:, 0])
    body = torchpose.BodyTracker(camera(), "kalman")
    whole = torch.full((4, 1, 15, 2), 300.0) + torch.arange(15.0)[:, None]
    whole = whole / 640 if scale == "shares" else whole.bfloat16()
    with pytest.raises(InputError, match=message):
        body(keypoints=whole, names=BODY_15.names)


def test_a_frame_of_zeros_does_not_end_a_stream():
    """Some detectors write zeros where they find nobody, and a camera goes on."""
    prior = torchpose.load_prior("kinect-upper-body-small")
    tracker = torchpose.UpperBodyTracker(prior, camera(), "window-mixture")
    points = keypoints().keypoints[None]
    state, _ = tracker.step(tracker.init(1, NAMES), points[:, 0])
    _, pose = tracker.step(state, torch.zeros_like(points[:, 0]))
    assert bool(pose.joints3d.isfinite().all())
