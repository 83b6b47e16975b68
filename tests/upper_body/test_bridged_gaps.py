"""Keypoints in gaps: between both ends by NumPy, what stays missing, and smoothed poses with them."""

import numpy as np
import pytest
import torch

import torchpose
from torchpose import UpperBodyTracker
from torchpose.filters._outputs import FilterOutput
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body._absence import Absence
from torchpose.upper_body._bridged_gaps import bridged_over_gaps
from torchpose.upper_body._estimator import Estimates, SeenPoses
from torchpose.upper_body._face_points import FacePoints
from torchpose.upper_body._lifted_arms import BodyPoints
from torchpose.upper_body._lifted_ends import Ends
from torchpose.upper_body._measured_joints import MeasuredJoints, MiddlePoint
from torchpose.upper_body._multiple_models import _clues

RATE = 30.0
SHOULDER, ELBOW, HAND, HEAD = (
    UPPER_BODY.index(name) for name in ("shoulder_left", "elbow_left", "hand_left", "head")
)
CHAIN = {UPPER_BODY.index(f"{far}_{side}"): UPPER_BODY.index(f"{near}_{side}")
         for side in ("left", "right")
         for near, far in (("shoulder", "elbow"), ("elbow", "hand"))}  # fmt: skip


def seen(n_frames=30, hidden=()):
    """Return noisy walks, of which (joint, first, last) are hidden."""
    generator = torch.Generator().manual_seed(1)
    uv = (
        torch.randn(1, n_frames, 8, 2, generator=generator, dtype=torch.float64).cumsum(1) * 5 + 300
    )
    mask = torch.ones(1, n_frames, 8, dtype=torch.bool)
    for joint, first, last in hidden:
        mask[0, first : last + 1, joint] = False
    cov = (4.0 + torch.arange(n_frames).double().view(1, -1, 1, 1, 1)) * torch.eye(2).double()
    return MeasuredJoints(uv * mask[..., None], mask, cov.repeat(1, 1, 8, 1, 1)), uv


def test_keypoints_in_gaps_are_on_the_way_between_both_ends_relative_to_the_joint_before():
    hidden = [(HAND, 5, 11), (ELBOW, 8, 9), (HEAD, 20, 20), (SHOULDER, 25, 26)]
    measured, uv = seen(hidden=hidden)
    found = bridged_over_gaps(measured, None, RATE)
    assert bool(found.mask.all())
    expected, variance = measured.uv[0].numpy().copy(), np.zeros((30, 8))
    true, covs = uv[0].numpy(), measured.cov[0]
    for joint, first, last in sorted(hidden, key=lambda gap: gap[0] == HAND):
        before, after = first - 1, last + 1
        start = expected[:, CHAIN[joint]] if joint in CHAIN else np.zeros((30, 2))
        s = {HAND: 1.2, ELBOW: 0.7}.get(joint, 0.25)
        for t in range(first, last + 1):
            w = (t - before) / (after - before)
            ends = true[before, joint] - start[before], true[after, joint] - start[after]
            expected[t, joint] = start[t] + (1 - w) * ends[0] + w * ends[1]
            since, until = (t - before) / RATE, (after - t) / RATE
            variance[t, joint] = s**2 * (since * until) ** 2 / (since + until)
            of_ends = (1 - w) * covs[before, joint] + w * covs[after, joint]
            torch.testing.assert_close(found.cov[0, t, joint], 9 * of_ends)
    np.testing.assert_allclose(found.uv[0], expected, atol=1e-9)
    np.testing.assert_allclose(found.bridged[0], variance, atol=1e-12)


def test_gaps_at_the_ends_and_longer_ones_stay_and_frames_past_the_length_are_not_used():
    measured, _ = seen(90, [(HAND, 0, 3), (ELBOW, 10, 72), (HEAD, 40, 60)])
    found = bridged_over_gaps(measured, torch.tensor([50]), RATE)
    assert torch.equal(found.mask, measured.mask) and found is measured
    assert bool(bridged_over_gaps(measured, None, RATE).mask[0, 40:61, HEAD].all())
    assert not bool(bridged_over_gaps(measured, None, RATE).mask[0, 10:73, ELBOW].any())
    assert bool(bridged_over_gaps(measured, None, 60.0).mask[0, 10:73, ELBOW].all())


def test_an_elbow_without_its_shoulder_is_on_the_straight_line_in_the_image():
    measured, uv = seen(hidden=[(SHOULDER, 0, 29), (ELBOW, 10, 12)])
    found = bridged_over_gaps(measured, None, RATE).uv[0, 11, ELBOW]
    torch.testing.assert_close(found, (uv[0, 9, ELBOW] + uv[0, 13, ELBOW]) / 2)


def test_hands_that_are_rather_outside_of_the_image_stay_missing():
    measured, _ = seen(hidden=[(HAND, 10, 14), (ELBOW, 10, 14)])
    log_inside = torch.zeros(1, 30, 2).double()
    log_inside[0, 12:, 0] = -0.5
    found = bridged_over_gaps(
        measured._replace(absence=Absence(log_inside, torch.zeros(4, 3).double())), None, RATE
    )
    assert found.mask[0, 10:15, HAND].tolist() == [True, True, False, False, False]
    assert bool(found.mask[0, :, ELBOW].all()) and float(found.bridged[0, 13, HAND]) == 0.0


def test_the_middle_of_the_shoulders_the_face_and_the_keypoints_of_the_network_are_bridged_too():
    measured, uv = seen(hidden=[(HAND, 10, 10)])
    there = torch.ones(1, 30, dtype=torch.bool)
    there[0, 10] = False
    middle = MiddlePoint(uv[:, :, 3] * there[..., None], there, measured.cov[:, :, 3])
    body = BodyPoints(uv[:, :, :1] * there[..., None, None], there[..., None].double())
    face = FacePoints(*body, torch.tensor([True]))
    found = bridged_over_gaps(measured._replace(middle=middle, body=body, face=face), None, RATE)
    halfway = (uv[0, 9] + uv[0, 11]) / 2
    torch.testing.assert_close(found.middle.uv[0, 10], halfway[3])
    torch.testing.assert_close(found.middle.cov[0, 10], 9 * measured.cov[0, 10, 3])
    torch.testing.assert_close(found.body.places[0, 10, 0], halfway[0])
    assert bool(found.middle.mask.all()) and found.body.confidence[0, 9:12, 0].tolist() == [
        1,
        0.5,
        1,
    ]


NAMES = ["head", "neck", "shoulder_left", "shoulder_right", "elbow_left", "elbow_right",
         "hand_left", "hand_right"]  # fmt: skip
HIDDEN = slice(20, 30)


def of_waving():
    """Return keypoints of a hand that goes out, up and back in two seconds, and the same with it hidden."""
    still = torch.tensor([[320.0, 120], [320, 175], [365, 185], [275, 185], [385, 255], [255, 255],
                          [400, 250], [245, 320]]).double()  # fmt: skip
    keypoints = still.expand(60, 8, 2).clone()
    turn = torch.linspace(0.0, 1.0, 60).double()
    keypoints[:, 6] += torch.stack([60 * turn, -90 * turn], -1)
    hidden = keypoints.clone()
    hidden[HIDDEN, 6] = torch.nan
    return keypoints[None], hidden[None]


@pytest.mark.parametrize("method", ["articulated", "multiple-model", "window-mixture", "mkf-fixed"])
def test_a_hidden_hand_is_near_the_way_between_where_it_was_and_where_it_returns(prior, method):
    keypoints, hidden = of_waving()
    camera = torchpose.PinholeCamera(525.0, 525.0, 319.5, 239.5)
    tracker = UpperBodyTracker(prior, camera, method, fps=30.0, smoothing="full", neck="neck")
    found = tracker(hidden, names=NAMES)
    off = (found.joints2d[0, HIDDEN, 0] - keypoints[0, HIDDEN, 6]).norm(dim=-1)
    assert UPPER_BODY[0] == "hand_left" and float(off.mean()) < 12.0
    assert not bool(found.observed[0, HIDDEN, 0].any())
    within, beside = found.covariance3d[0, 25, 0], found.covariance3d[0, 35, 0]
    assert float(torch.linalg.eigvalsh(within - beside)[0]) > 0.02**2
    assert float(found.covariance2d[0, 25, 0].trace()) > float(found.covariance2d[0, 35, 0].trace())


def test_a_lag_that_reaches_the_end_bridges_gaps_and_a_shorter_one_does_not(prior):
    _, hidden = of_waving()
    camera = torchpose.PinholeCamera(525.0, 525.0, 319.5, 239.5)
    full, covering, short = (
        UpperBodyTracker(prior, camera, "articulated", fps=30.0, smoothing=lag)(hidden, names=NAMES)
        for lag in ("full", 59, 58)
    )
    torch.testing.assert_close(full.joints3d, covering.joints3d)
    assert not torch.allclose(full.joints3d[0, HIDDEN, 0], short.joints3d[0, HIDDEN, 0], atol=1e-3)


def test_keypoints_in_gaps_do_not_weigh_models():
    measured, _ = seen(hidden=[(joint, 10, 12) for joint in CHAIN])
    bridged = bridged_over_gaps(measured, None, RATE)

    ones, none = torch.ones(1, 30).double(), torch.full((1,), -1)
    arm = FilterOutput(ones[..., None], ones[..., None], ones, None, none)
    joints = torch.rand(1, 30, 8, 3, dtype=torch.float64)
    poses = SeenPoses(joints, *6 * [ones])
    found = Estimates(arm, arm, None, poses)
    vague = torch.full((1, 30, 2, 2), torch.inf, dtype=torch.float64)
    ends = Ends(vague.new_zeros(1, 30, 2, 2, 3), vague, bridged.mask[..., :2], vague)
    counted = _clues(found, found, poses, ends, bridged)[0, :, 0]
    assert counted.tolist() == [float(not 10 <= t <= 12) for t in range(30)]
