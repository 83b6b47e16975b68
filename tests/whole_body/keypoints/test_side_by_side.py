"""Two cameras side by side are no worse than one of them, and say how unsure depths are."""

import pytest
import torch

from tests.whole_body.keypoints.scenes import FPS, NAMES, errors, kalman, moving_body, ring, seen_by
from torchpose.body import BODY_15
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.metrics import coverage
from torchpose.priors._shipped import load_body_motion
from torchpose.whole_body._keypoints.body_kalman import BodyKalmanFilter
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps
from torchpose.whole_body._keypoints.keypoint_start import start
from torchpose.whole_body._keypoints.keypoint_tracker import KeypointTracker
from torchpose.whole_body._keypoints.lifted_pose import _of_expected_size, telling

pytestmark = pytest.mark.usefixtures("undoubted_cameras")

LEGS = [i for i, name in enumerate(NAMES) if name.endswith(("knee", "ankle"))]


def stereo(baseline, focal=1000.0):
    """Level cameras at the height of the pelvis, 3 m before the origin of a world with y up."""
    half_turn = (3.141592653589793, 0.0, 0.0)
    return CameraRig([
        PinholeCamera(
            focal, focal, 959.5, 539.5, 1920, 1080, f"c{i}", rotation=half_turn,
            translation=(side * baseline / 2, 0.0, 3.0),
        )
        for i, side in enumerate((1, -1))
    ])  # fmt: skip


@pytest.fixture(scope="module")
def noisy():
    """Joints, a rig and keypoints with 4 px of noise."""
    return seen_by(stereo(0.12), moving_body(40, height=1.9))[:3]


@pytest.fixture(scope="module")
def track(noisy):
    _, rig, keypoints = noisy
    return kalman(rig)(keypoints=keypoints)


def relative(joints):
    return joints - joints[..., [BODY_15.joint("pelvis")], :]


def test_two_cameras_side_by_side_are_no_worse_than_one(noisy, track):
    joints, rig, keypoints = noisy
    alone = kalman(rig.select([0]))
    by_one = alone(keypoints=keypoints[:, :1])
    assert float(errors(track, joints).mean()) < float(errors(by_one, joints).mean())
    two, one = (
        float((relative(x.joints3d) - relative(joints)).norm(dim=-1).mean())
        for x in (track, by_one)
    )
    assert two < 1.1 * one


def test_bones_do_not_grow_with_noise_along_the_rays(noisy, track):
    joints, _, _ = noisy
    parents = [BODY_15.parents[joint] for joint in LEGS]
    true = (joints[0, LEGS] - joints[0, parents]).norm(dim=-1).sum()
    found = track.details["bone_lengths"][-1, LEGS].sum()
    assert abs(float(found / true) - 1) < 0.08


def test_ellipsoids_hold_the_joints(noisy, track):
    joints, _, _ = noisy
    inside = coverage(track.joints3d, track.covariance3d, joints).overall[1]
    assert float(inside) > 0.85


def test_ellipsoids_from_the_pelvis_hold_the_joints_and_not_the_place(noisy, track):
    joints, _, _ = noisy
    cov = track.details["covariance_from_pelvis"]
    pelvis = BODY_15.joint("pelvis")
    others = [joint for joint in range(len(NAMES)) if joint != pelvis]
    given = (relative(track.joints3d), cov, relative(joints))
    assert float(coverage(*(value[:, others] for value in given)).overall[1]) > 0.8
    assert not cov[:, pelvis].any()
    variances = (x[:, LEGS].diagonal(dim1=-2, dim2=-1).sum() for x in (cov, track.covariance3d))
    assert next(variances) < 0.25 * next(variances)


def test_live_poses_are_those_of_the_recording(noisy, track):
    _, rig, keypoints = noisy
    tracker = kalman(rig)
    stream = tracker.init()
    for t in range(4):
        stream, pose = tracker.step(stream, keypoints=keypoints[t])
        torch.testing.assert_close(pose.joints3d[0], track.joints3d[t])
        live, whole = (x.details["covariance_from_pelvis"] for x in (pose, track))
        torch.testing.assert_close(live[0], whole[t])


def test_one_of_the_two_alone_is_followed_until_the_other_is_back(noisy):
    joints, rig, keypoints = noisy
    hidden = keypoints[:30].clone()
    hidden[:20, 1] = torch.nan
    poses = kalman(rig)(keypoints=hidden)
    spread = poses.details["covariance_from_pelvis"][:, LEGS].diagonal(dim1=-2, dim2=-1).sum((1, 2))
    assert spread[0] > spread[-1]
    apart = relative(poses.joints3d) - relative(joints[poses.first_frame : 30])
    assert float(apart.norm(dim=-1).mean()) < 0.1


def test_cameras_far_apart_are_not_lifted_and_tell_what_one_does_not():
    motion = load_body_motion("whole-body")
    assert KeypointTracker(ring(2), FPS, motion).lifter is None
    assert KeypointTracker(stereo(0.12), FPS, motion).lifter is not None
    joints = moving_body(1)
    near, far = (float(telling(RigMaps.of(rig), joints)[0]) for rig in (stereo(0.12), ring(2)))
    assert 1.05 < near < 1.2 and far > 50
    assert float(telling(RigMaps.of(ring(1)), joints)[0]) == 1


def test_the_derivative_without_the_size_is_that_of_differences():
    motion, rig = load_body_motion("whole-body"), stereo(0.4)
    filter = BodyKalmanFilter(motion, rig, FPS)
    body, pixels = filter.articulation, rig(moving_body(1)).pixels
    one = torch.ones_like(pixels[..., 0])
    point = start(filter, KeypointFrame(pixels, one, 1e-4 * one, 0.9 * one)).state.mean
    share = torch.tensor([[0.6]], dtype=torch.float64)

    def apart(d):
        moved = body.moved(point, d)
        joints, jacobian = body.linearise(moved)
        return _of_expected_size(filter, moved, joints.flatten(-2), jacobian.flatten(-3, -2), share)

    zero = torch.zeros(1, body.dim, dtype=torch.float64)
    _, H = apart(zero)
    for n in range(body.columns["scales"].start, body.columns["scales"].stop):
        step = zero.clone()
        step[:, n] = 1e-6
        numeric = (apart(step)[0] - apart(-step)[0]) / 2e-6
        torch.testing.assert_close(H[..., n], numeric, atol=1e-6, rtol=0)
