"""Gradients of the public modules against finite differences, and outputs that they leave as they are."""

import pytest
import torch

from tests.gradients import assert_differentiable, assert_without_gradient
from torchpose.priors import load_prior
from torchpose.upper_body import UpperBodyTracker

NAMES = ("head", "hand_left", "hand_right")


def keypoints(batch=1, frames=9, seed=0):
    """Head and hands that wander about, pixels."""
    generator = torch.Generator().manual_seed(seed)
    place = torch.tensor([[320.0, 120.0], [400.0, 240.0], [240.0, 240.0]], dtype=torch.float64)
    steps = torch.randn(batch, frames, 3, 2, generator=generator, dtype=torch.float64)
    return place + 4 * steps.cumsum(1)


def poses(tracker, **arguments):
    """A function of the keypoints, with numbers that are the same in every call."""

    def track(uv):
        generator = torch.Generator().manual_seed(0)
        found = tracker(uv, names=NAMES, generator=generator, **arguments)
        joints = found.joints2d, found.joints3d
        return *joints, found.covariance2d, found.covariance3d, found.log_evidence

    return track


def make_tracker(**options):
    prior = load_prior("kinect-upper-body")
    return UpperBodyTracker(prior, camera=prior.camera, **options)


@pytest.mark.parametrize(
    "options",
    [
        {"method": "window-mixture"},
        {"method": "window-mixture", "smoothing": 20},
        {"method": "window-mixture", "smoothing": "full"},
        {"steady": False},
        {"steady": False, "smoothing": "full"},
        {"method": "mkf-fixed"},
        {"method": "mkf-fixed", "smoothing": 2},
        {"method": "mkf-fixed", "smoothing": "full"},
    ],
)
def test_poses_of_the_tracker(options):
    assert_differentiable(poses(make_tracker(**options)), keypoints(), step=1e-4)


@pytest.mark.parametrize("method", ["window-mixture", "mkf-fixed"])
def test_poses_of_keypoints_with_gaps_and_noise_of_their_own(method):
    """Batches of other lengths, missing keypoints, confidences and covariances of every keypoint."""
    uv, confidence = keypoints(batch=2), torch.full((2, 9, 3), 0.7)
    uv[0, 3:6, 1] = float("nan")
    confidence[1, 2:4] = 0.0
    confidence[0, 7] = 0.2
    lengths = torch.tensor([9, 6])
    track = poses(make_tracker(method=method), confidence=confidence, lengths=lengths)
    assert_differentiable(track, uv, step=1e-4)
    own = (1 + torch.arange(9.0).double())[:, None, None, None] * torch.eye(2).double()
    own = own.expand(2, 9, 3, 2, 2)
    track = poses(make_tracker(method=method, frame="body"), covariance=own, lengths=lengths)
    assert_differentiable(track, uv, step=1e-4)


@pytest.mark.parametrize("method", ["window-mixture", "mkf-fixed"])
def test_poses_of_streams(method):
    tracker = make_tracker(method=method)

    def track(uv):
        state = tracker.init(len(uv), NAMES)
        state, some = tracker.advance(state, uv[:, :5])
        state, live = tracker.step(state, uv[:, 5])
        return some.joints3d, some.covariance3d, live.joints2d, live.joints3d, live.covariance3d

    assert_differentiable(track, keypoints(frames=6), step=1e-4)


def test_poses_of_shoulders_whose_neck_is_placed():
    names = ("head", "shoulder_left", "shoulder_right", "hand_left", "hand_right")
    place = [[320.0, 120.0], [370.0, 170.0], [270.0, 170.0], [400.0, 240.0], [240.0, 240.0]]
    uv = torch.tensor(place, dtype=torch.float64) + keypoints(frames=5)[:, :, :1] - 320.0
    tracker = make_tracker(method="window-mixture")
    assert_differentiable(lambda x: [tracker(x, names=names).joints3d], uv, step=1e-4)


@pytest.mark.parametrize("method", ["articulated", "multiple-model"])
@pytest.mark.parametrize("frames", [1, 2])
def test_poses_of_bones(method, frames):
    """Exponentials of their density are float32, so that differences are to a hundredth.

    Where other hypotheses are chosen poses jump, by less the more there are: small steps and few frames
    have no such place.
    """
    function = poses(make_tracker(method=method))
    assert_differentiable(function, keypoints(frames=frames), step=1e-4, tolerance=1e-2)


@pytest.mark.parametrize("method", ["mkf-sampled", "mkf-split"])
def test_poses_of_tracks_that_are_drawn_or_selected(method):
    tracker = make_tracker(method=method, n_tracks=12)
    # small steps: where another track is kept than before, split tracks jump
    assert_differentiable(poses(tracker), keypoints(frames=5), step=2e-5)


@pytest.mark.parametrize("method", ["pf-mixture", "pf-walk", "pf-walk-unscaled"])
def test_poses_of_particles_have_no_gradient(method):
    assert_without_gradient(poses(make_tracker(method=method, n_particles=200)), keypoints())


@pytest.mark.parametrize("method", ["window-mixture", "mkf-fixed"])
def test_what_inference_mode_left_behind_serves_gradients(method):
    tracker, uv = make_tracker(method=method), keypoints(frames=3)
    with torch.inference_mode():
        plain = tracker(uv, names=NAMES).joints3d
    leaf = uv.clone().requires_grad_()
    found = tracker(leaf, names=NAMES).joints3d
    found.sum().backward()
    torch.testing.assert_close(found.detach(), plain.clone(), rtol=1e-10, atol=1e-10)
    assert float(leaf.grad.norm()) > 0
