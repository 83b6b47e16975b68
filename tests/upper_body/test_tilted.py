"""Cameras that look up or down: the poses of a level camera there, in the axes of the tilted one."""

import math

import pytest
import torch

from tests.upper_body.lifters import UNSURE
from torchpose import PinholeCamera
from torchpose.camera import project
from torchpose.camera._tilt import Turn
from torchpose.demo import KEYPOINT_NAMES, noisy_keypoints, performer
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import METHODS, PoseTrack, UpperBodyTracker
from torchpose.upper_body._measured_joints import kept_turn

N = 12
LEVEL = PinholeCamera(525.0, 525.0, 319.5, 239.5, 640, 480, up=(0, -1, 0))
TILTED = {"looks down": LEVEL.tilted(-0.35, 0.05), "on its side": LEVEL.tilted(0.1, math.pi / 2)}
OF_RAYS = ("articulated", "multiple-model", "window-mixture")
NAMES = list(KEYPOINT_NAMES)
MORE = ("head", "neck", "shoulder_left", "shoulder_right", "hand_left", "hand_right", "nose",
        "ear_left", "ear_right")  # fmt: skip


@pytest.fixture(scope="module")
def keypoints():
    """Two performers in the level camera, with a gap."""
    frames = torch.stack([noisy_keypoints(performer(N, seed=s).joints, std_px=3.0) for s in (0, 1)])
    frames[1, 4:7, 2] = torch.nan
    return frames


def tilt(camera, uv, std=3.0):
    """Return pixels of the level camera as a tilted one has them, and the covariances of both."""
    turn = Turn.to_level(camera.up, camera.matrix).back(camera.matrix)
    level = std**2 * torch.eye(2, dtype=torch.float64).expand(*uv.shape, 2)
    return turn.points(uv), turn.covariances(level, uv), level


def both(prior, camera, uv, names=NAMES, method=None, smoothing=None, **options):
    """Return the poses of the tilted and of the level camera, told the same."""
    tilted_uv, tilted_cov, cov = tilt(camera, uv)
    options |= {"method": method, "smoothing": smoothing, "outliers": False}
    tracks = []
    for own, pixels, noise in ((camera, tilted_uv, tilted_cov), (LEVEL, uv, cov)):
        tracker = UpperBodyTracker(prior, own, **options)
        generator = torch.Generator().manual_seed(0)
        tracks.append(tracker(pixels, None, names, generator=generator, covariance=noise))
    return tracks


def check_same(camera, tilted, level):
    """Check that poses are the same but for the axes and the pixels."""
    rotation = camera.level_rotation
    near = {"rtol": 1e-5, "atol": 1e-6}
    torch.testing.assert_close(tilted.joints3d @ rotation.mT, level.joints3d, **near)
    turned = rotation @ tilted.covariance3d @ rotation.mT
    torch.testing.assert_close(turned, level.covariance3d, **near)
    turn = Turn.to_level(camera.up, camera.matrix)
    torch.testing.assert_close(turn.points(tilted.joints2d), level.joints2d, rtol=1e-5, atol=1e-4)
    cov = turn.covariances(tilted.covariance2d, tilted.joints2d)
    torch.testing.assert_close(cov, level.covariance2d, rtol=1e-2, atol=1e-2)
    assert torch.equal(tilted.observed, level.observed)


def from_neck(joints):
    return joints - joints[:, [UPPER_BODY.index("neck")]]


@pytest.mark.parametrize("how", TILTED)
@pytest.mark.parametrize("method", OF_RAYS)
def test_a_known_tilt_is_undone(prior, keypoints, how, method):
    camera = TILTED[how]
    check_same(camera, *both(prior, camera, keypoints, method=method))


@pytest.mark.parametrize("method", sorted(set(METHODS) - set(OF_RAYS)))
def test_a_known_roll_is_undone(prior, keypoints, method):
    """Single poses keep their pitch, which is part of the state."""
    options = {"n_particles": 50} if method.startswith("pf") else {}
    camera = LEVEL.tilted(0.0, math.pi / 2)
    check_same(camera, *both(prior, camera, keypoints, method=method, **options))


@pytest.mark.parametrize("method", ["articulated", "multiple-model"])
def test_faces_and_necks_between_shoulders_are_turned_too(prior, method):
    body = performer(N, seed=0).joints
    rows = [UPPER_BODY.index(name) for name in MORE[:6]]
    head = body[:, [UPPER_BODY.index("head")]]
    off = body.new_tensor([[0.0, 0.05, -0.1], [0.07, 0.03, 0.0], [-0.07, 0.03, 0.0]])
    points = torch.cat([body[:, rows], head + off], 1)
    points[:, 1] = (points[:, 2] + points[:, 3]) / 2
    eye, still = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    uv = project(points, LEVEL.matrix, eye, still)[None, ..., :2]
    camera = TILTED["looks down"]
    check_same(camera, *both(prior, camera, uv, MORE, method, "full", neck="mid-shoulder"))


def test_a_camera_that_is_known_to_be_level_changes_no_number_of_bones(prior, keypoints):
    """It does change what is lifted from single frames, which is told from how far above a body is seen."""
    unknown = PinholeCamera(525.0, 525.0, 319.5, 239.5, 640, 480)
    assert kept_turn(LEVEL, prior) is None and kept_turn(unknown, prior) is None
    for lifter in (UNSURE, None):
        options = {"method": "articulated", "lifter": lifter}
        trackers = (UpperBodyTracker(prior, camera, **options) for camera in (LEVEL, unknown))
        known, other = (tracker(keypoints, names=NAMES).joints3d for tracker in trackers)
        assert torch.equal(known, other) == (lifter is UNSURE)


@pytest.mark.parametrize("method", ["articulated", "window-mixture", "mkf-fixed"])
def test_streams_of_a_tilted_camera_are_its_recordings(prior, keypoints, method):
    camera = TILTED["looks down"]
    uv, _, _ = tilt(camera, keypoints)
    tracker = UpperBodyTracker(prior, camera, method)
    whole, state = tracker(uv, names=NAMES), tracker.init(len(uv), NAMES)
    for t in range(N):
        state, pose = tracker.step(state, uv[:, t])
        torch.testing.assert_close(pose.joints3d, whole.joints3d[:, t], rtol=0, atol=1e-8)
        torch.testing.assert_close(pose.joints2d, whole.joints2d[:, t], rtol=0, atol=1e-5)


def test_what_was_seen_stays_where_it_was_seen(prior, keypoints):
    """The noise that the prior learnt is that of pixels of the camera, wherever it looks."""
    camera = TILTED["looks down"]
    uv, _, _ = tilt(camera, keypoints)
    track = UpperBodyTracker(prior, camera, "mkf-fixed")(uv, names=NAMES)
    rows = [UPPER_BODY.index(name) for name in NAMES]
    off = (track.joints2d[:, :, rows] - uv).norm(dim=-1)
    assert float(off.nanmean()) < 5


def test_files_of_poses_keep_where_up_is(prior, keypoints, tmp_path):
    camera = TILTED["looks down"]
    uv, _, _ = tilt(camera, keypoints)
    for sequences in (uv, uv[:1]):
        track = UpperBodyTracker(prior, camera, "mkf-fixed")(sequences, names=NAMES)
        track.save(tmp_path / "poses.npz")
        torch.testing.assert_close(PoseTrack.load(tmp_path / "poses.npz").up, camera.up)
    assert PoseTrack.load(tmp_path / "poses.npz").joints3d.shape == (1, N, 8, 3)
    track = UpperBodyTracker(prior, prior.camera, "mkf-fixed")(uv, names=NAMES)
    track.save(tmp_path / "poses.npz")
    assert track.up is None and PoseTrack.load(tmp_path / "poses.npz").up is None


def test_poses_in_the_frame_of_the_body_know_no_camera(prior, keypoints):
    camera = TILTED["looks down"]
    tilted, level = both(prior, camera, keypoints, method="window-mixture", frame="body")
    torch.testing.assert_close(tilted.joints3d, level.joints3d, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("method", ["window-mixture", "mkf-fixed", "pf-mixture"])
def test_poses_of_a_camera_that_looks_up_are_better_if_told(prior, method):
    joints = performer(40, seed=0).joints
    centre = joints - from_neck(joints)
    camera = PinholeCamera(525.0, 525.0, 319.5, 239.5, 640, 480)
    up = camera.tilted(math.radians(25))
    turned = from_neck(joints) @ up.level_rotation + centre
    uv = noisy_keypoints(turned, std_px=3.0)[None]
    options = {"n_particles": 200} if method.startswith("pf") else {}
    errors = []
    for own in (up, camera):
        generator = torch.Generator().manual_seed(0)
        track = UpperBodyTracker(prior, own, method, **options)(
            uv, names=NAMES, generator=generator
        )
        errors.append(float((from_neck(track.joints3d[0]) - from_neck(turned)).norm(dim=-1).mean()))
    assert errors[0] < 0.8 * errors[1]
