"""Check what a network that lifts keypoints tells articulated arms."""

import copy
import math

import pytest
import torch

from tests.data import data_dir_or_skip
from torchpose import PinholeCamera, UpperBodyTracker, load_prior
from torchpose.body import BODY_15
from torchpose.io import read_recordings
from torchpose.math import euler_to_matrix
from torchpose.priors._lifting_network import shipped_lifting_network
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body._lifted_arms import N_BONES, lift, measure_body

ARMS = [f"{joint}_{side}" for joint in ("shoulder", "elbow", "hand") for side in ("left", "right")]
CAMERA = PinholeCamera(525.0, 525.0, 319.5, 239.5)


def seen_from(pitch, turn):
    """Return somebody who is turned, before a camera that looks down, degrees, camera axes, [T, 8, 3]."""
    clip = data_dir_or_skip("kinect_laban") / "Ges03_drawlines.csv"
    (recording,) = read_recordings([clip])
    joints = recording.upper_body().joints[:40].double()
    joints = joints - joints[:, [UPPER_BODY.index("neck")]]
    angles = torch.deg2rad(torch.tensor([0.0, pitch, turn], dtype=torch.float64))
    return joints @ euler_to_matrix(angles).mT + torch.tensor([0.0, -0.3, 3.0])


@pytest.fixture(scope="module")
def turned():
    """Return somebody who is turned by 75 degrees, seen from above by 20."""
    return seen_from(20.0, -75.0)


def pixels(joints):
    return 525.0 * joints[..., :2] / joints[..., 2:] + torch.tensor([319.5, 239.5])


def off(joints, camera=CAMERA):
    """Return the mean error of elbows and hands from the middle of the shoulders, metres."""
    rows = [UPPER_BODY.index(name) for name in ARMS]
    tracker = UpperBodyTracker(load_prior("kinect-upper-body-small"), camera, "articulated")
    names = [*ARMS, "neck"]
    seen = pixels(joints)[:, [UPPER_BODY.index(name) for name in names]]
    found = tracker(seen[None], names=names).joints3d[0]
    found, true = (x[:, rows] - x[:, rows[:2]].mean(1, keepdim=True) for x in (found, joints))
    return float((found - true)[:, 2:].norm(dim=-1).mean())


def test_somebody_who_is_turned_is_followed_by_what_the_network_tells(turned, monkeypatch):
    with_network = off(turned)
    assert with_network < 0.12
    monkeypatch.setattr(
        "torchpose.upper_body._articulated.ArticulatedFilter._lifted", lambda *_: (None, None)
    )
    assert off(turned) > 1.5 * with_network


def test_people_from_below_are_not_bent_forward_where_the_tilt_is_known(monkeypatch):
    below, camera = seen_from(-20.0, 0.0), CAMERA.tilted(math.radians(20.0))
    turned_back = off(below, camera)
    monkeypatch.setattr("torchpose.upper_body._lifted_arms.share_of_lean", lambda _: 0.0)
    assert turned_back < 0.9 * off(below, camera)


@pytest.mark.parametrize("pitch", [None, -0.4, 0.0])
def test_bones_stay_unless_the_camera_is_known_to_look_up(pitch):
    body = measure_body(scattered(3), None, None, ARMS)
    network = shipped_lifting_network("upper-body")
    as_lifted, _ = lift(network, *body, 30.0, None)
    found, _ = lift(network, *body, 30.0, None, pitch)
    assert torch.equal(found.directions, as_lifted.directions)


@pytest.mark.parametrize(("pitch", "share"), [(5.0, 1 / 6), (15.0, 0.5), (40.0, 0.5)])
@pytest.mark.parametrize("lean", [-25.0, 10.0])
def test_bones_are_turned_back_by_a_share_of_the_lean(pitch, share, lean):
    seen = measure_body(scattered(3), None, None, ARMS)
    found, _ = lift(of_stiff_body(lean), *seen, 30.0, None, math.radians(pitch))
    expected, _ = lift(of_stiff_body((1 - share) * lean), *seen, 30.0, None)
    torch.testing.assert_close(found.directions, expected.directions)


def of_stiff_body(lean):
    """Return a network that sees a stiff body lean away from the camera by an angle, degrees."""
    joints = torch.randn(15, 3, generator=torch.Generator().manual_seed(1))
    for name, place in {
        "neck": (0.1, -1, 0),
        "left_hip": (0.2, 0, 0),
        "right_hip": (-0.2, 0, 0),
    }.items():
        joints[BODY_15.joint(name)] = torch.tensor(place, dtype=joints.dtype)
    cos, sin = math.cos(math.radians(lean)), math.sin(math.radians(lean))
    joints = joints @ torch.tensor([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])
    network = copy.deepcopy(shipped_lifting_network("upper-body"))
    network.forward = lambda _, memory: (
        (joints.expand(1, 3, 15, 3), torch.ones(1, 3, 15)),
        memory,
    )
    return network


def test_nothing_is_told_without_shoulders_and_elbows():
    seen = torch.zeros(1, 2, 4, 2)
    assert measure_body(seen, None, None, ["head", "neck", "hand_left", "hand_right"]) is None


def scattered(n_frames):
    """Return keypoints of `ARMS` anywhere."""
    return torch.rand(1, n_frames, 6, 2, generator=torch.Generator().manual_seed(0))


def test_frames_with_few_keypoints_tell_nothing():
    seen = scattered(3)
    seen[0, 1, ARMS.index("shoulder_left")] = torch.nan
    body = measure_body(seen, None, None, ARMS)
    bones, _ = lift(shipped_lifting_network("upper-body"), *body, 30.0, None)
    assert bones.directions.shape == (1, 3, N_BONES, 3)
    assert (bones.precision > 0).all(-1).tolist() == [[True, False, True]]
    torch.testing.assert_close(bones.directions.norm(dim=-1), torch.ones(1, 3, N_BONES))


def test_memory_goes_on_from_block_to_block():
    body = measure_body(scattered(4), None, None, ARMS)
    network = shipped_lifting_network("upper-body")
    whole, _ = lift(network, *body, 30.0, None)
    _, memory = lift(network, *(x[:, :2] for x in body), 30.0, None)
    later, _ = lift(network, *(x[:, 2:] for x in body), 30.0, memory)
    torch.testing.assert_close(later.directions, whole.directions[:, 2:])
