"""Joints that no camera sees for some frames: what stood still stays, and later frames reach into gaps."""

import math

import pytest
import torch

from tests.whole_body.keypoints.scenes import FPS, errors, kalman, ring, seen_by
from torchpose.body import BODY_15, Body
from torchpose.whole_body._keypoints.body_kalman import Speeds
from torchpose.whole_body._keypoints.body_smoothing import beginnings, from_last_seen
from torchpose.whole_body._keypoints.still_joints import StillJoints

J = BODY_15.joint
LEGS = [J("left_knee"), J("left_ankle")]
ARM = [J("right_elbow"), J("right_wrist")]
GAP = slice(20, 28)


@pytest.fixture(scope="module")
def standing():
    """Who stands, and throws the right arm up while it is hidden, in four cameras."""
    body = Body.of_height(BODY_15, 1.7)
    state = torch.zeros(42, body.dim, dtype=torch.float64)
    at = {name: 3 + 3 * i for i, name in enumerate(BODY_15.parts)}
    frames = torch.arange(42, dtype=torch.float64)
    state[:, at["right_upper_arm"]] = -1.4 * ((frames - 20.0) / 8.0).clamp(0.0, 1.0)
    found = seen_by(ring(4), body.joints(state))
    found.keypoints[GAP, :, ARM] = torch.nan
    return found


def track(given, keypoints, smoothing):
    return kalman(given.rig)(keypoints=keypoints, smoothing=smoothing)


def test_smoothed_arms_that_move_while_hidden_are_nearer_than_a_straight_line(standing):
    found = track(standing, standing.keypoints, "full")
    share = (torch.arange(1, 9) / 9.0).double()[:, None, None]
    line = found.joints3d[19, ARM].lerp(found.joints3d[28, ARM], share)
    off = (line - standing.joints[GAP][:, ARM]).norm(dim=-1).mean()
    assert errors(found, standing.joints)[GAP][:, ARM].mean() < off


def test_a_leg_that_stood_stays_while_it_is_hidden(standing):
    keypoints = standing.keypoints.clone()
    keypoints[28:42, :, LEGS] = torch.nan
    found = track(standing, keypoints, "none")
    assert errors(found, standing.joints)[28:42, LEGS].mean() < 0.025


def test_jumps_count_from_the_frame_after_the_joint_was_last_seen():
    carriers = torch.tensor([[1.0, 0.0], [0.0, 1.0]])  # a column for each of two joints
    seen = torch.ones(1, 8, 2, dtype=torch.bool)
    seen[0, 2:5, 0] = False
    started = torch.zeros(1, 8, dtype=torch.bool)
    jumped = torch.zeros(1, 8, 2)
    jumped[0, 5], jumped[0, 7, 0] = torch.tensor([3.0, 5.0]), 7.0
    moved = from_last_seen(jumped, seen, started, carriers)
    expected = torch.zeros(1, 8, 2)
    expected[0, 2, 0], expected[0, 5, 1], expected[0, 7, 0] = 3.0, 5.0, 7.0
    torch.testing.assert_close(moved, expected)
    started[0, 4] = True  # what is smoothed there does not reach any further back
    assert from_last_seen(jumped, seen, started, carriers)[0, 4, 0] == 3.0


def test_smoothing_reaches_over_a_brief_absence_and_over_no_other_beginning():
    def frames(*numbers):
        return torch.isin(torch.arange(16), torch.tensor(numbers))[None]

    # first, after three frames without anybody, in the frame after that, while seen, after five
    started = frames(1, 5, 6, 8, 14)
    coasting = frames(0, 2, 3, 4, 9, 10, 11, 12, 13)
    assert beginnings(started, coasting, 4.0).nonzero()[:, 1].tolist() == [1, 8, 14]
    past_the_end = frames(1, 5), frames(4, 5, 6)  # nothing is measured there
    assert beginnings(*past_the_end, 4.0).nonzero()[:, 1].tolist() == [1, 5]


def _speeds(velocity, std=0.1):
    v = torch.tensor([[[velocity, 0.0, 0.0]]], dtype=torch.float64)
    return Speeds(v, std**2 * torch.eye(3, dtype=torch.float64).expand(1, 1, 3, 3))


@pytest.mark.parametrize(("velocity", "least", "most"), [(0.0, 0.9, 1.0), (1.0, 0.0, 0.01)])
def test_joints_that_hardly_move_are_still(velocity, least, most):
    seen = torch.ones(1, 1, dtype=torch.bool)
    still = StillJoints.none(torch.zeros(1, 1)).later(_speeds(velocity), seen, 1 / FPS)
    assert least < float(still.probability) <= most


def test_who_stood_for_long_is_expected_to_stand_for_longer():
    seen = torch.ones(1, 1, dtype=torch.bool)
    still = StillJoints.none(torch.zeros(1, 1, dtype=torch.float64))
    for _ in range(15):
        still = still.later(_speeds(0.0), seen, 1 / FPS)
    before = float(still.probability)
    torch.testing.assert_close(float(still.seconds), 0.5)
    for _ in range(15):
        still = still.later(_speeds(9.0), ~seen, 1 / FPS)
    torch.testing.assert_close(float(still.probability), before * math.exp(-1.0))
