"""Arms that are measured are seldom in or behind the torso that would hide them."""

import math

import pytest
import torch

import torchpose
from benchmarks._performances import performance
from torchpose.demo import demo_camera
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body._torso_occlusion import log_in_view

HIDDEN = math.log(0.1)
SHOULDERS = 0.34  # metres apart
FAR = 2.5


def weight_of(*place, middle=(0.0, 0.0, FAR)):
    """Return the weight of a joint at a place relative to the middle of the shoulders, upright axes."""
    middle = torch.tensor(middle, dtype=torch.float64)
    shoulder = middle + torch.tensor([SHOULDERS / 2, 0.0, 0.0])
    return float(log_in_view((middle + torch.tensor(place))[None], shoulder, middle))


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ((0.0, 0.25, 0.0), HIDDEN),  # inside
        ((0.0, 0.25, 0.3), HIDDEN),  # behind the back
        ((0.0, 0.25, -0.3), 0.0),  # before the chest
        ((0.3, 0.25, 0.0), 0.0),  # beside
        ((0.0, -0.2, 0.1), 0.0),  # at the head
        ((0.0, 0.8, 0.1), 0.0),  # below the hips
    ],
)
def test_from_the_front_what_is_in_or_behind_a_torso_is_hidden(place, expected):
    assert weight_of(*place) == pytest.approx(expected, abs=0.1)


def test_from_behind_arms_before_the_chest_are_still_measured():
    """Upright axes turn with the torso: its front is towards -z, and the camera is behind."""
    behind = (0.0, 0.0, -FAR)
    assert weight_of(0.0, 0.25, -0.3, middle=behind) == pytest.approx(0.0, abs=0.05)
    assert weight_of(0.0, 0.25, 0.0, middle=behind) == pytest.approx(HIDDEN, abs=0.05)


def test_gradients_are_finite_everywhere():
    places = torch.tensor([[0.0, 0.25, 0.0], [0.2, 0.25, 0.0], [0.153, 0.3, 0.0]]).double()
    places = (places + torch.tensor([0.0, 0.0, FAR])).requires_grad_(True)
    middle = torch.tensor([0.0, 0.0, FAR], dtype=torch.float64)
    log_in_view(places, middle + torch.tensor([0.17, 0.0, 0.0]), middle).sum().backward()
    assert places.grad is not None and bool(places.grad.isfinite().all())


def test_a_torso_whose_shoulders_are_on_one_ray_has_a_width():
    middle = torch.tensor([0.0, 0.0, FAR], dtype=torch.float64)
    places = middle + torch.tensor([[0.0, 0.25, 0.0], [0.0, 0.0, 0.0], [0.3, 0.25, 0.1]])
    shoulder = middle.clone().requires_grad_()
    found = log_in_view(places, shoulder, middle)
    found.sum().backward()
    assert bool(found.isfinite().all()) and bool((found <= 0).all())
    assert shoulder.grad is not None and bool(shoulder.grad.isfinite().all())


def standing(n_frames):
    """Return the keypoints of two bodies that stand still, [2, T, 8, 2]."""
    left = torch.tensor([[100.0, 70.0], [80.0, 10.0], [50.0, -60.0]])
    right = (left * torch.tensor([-1.0, 1.0])).flip(0)
    spine = torch.tensor([[0.0, -140.0], [0.0, -80.0]])
    return (300.0 + torch.cat([left, spine, right])).double().repeat(2, n_frames, 1, 1)


def tracker_of(method, **options):
    prior = torchpose.load_prior("kinect-upper-body-small")
    return torchpose.UpperBodyTracker(prior, demo_camera(), method, **options)


@pytest.mark.parametrize("method", ["articulated", "multiple-model"])
def test_joints_on_one_pixel_are_tracked(method):
    """All joints of one body, and both shoulders of the other."""
    keypoints = standing(4)
    keypoints[0] = 300.0
    keypoints[1, :, UPPER_BODY.index("shoulder_left")] = keypoints[
        1, :, UPPER_BODY.index("shoulder_right")
    ]
    track = tracker_of(method)(keypoints)
    for name in ("joints2d", "joints3d", "covariance3d", "log_evidence", "bone_lengths"):
        assert bool(getattr(track, name).isfinite().all()), name
    assert track.failed_at.tolist() == [-1, -1]


@pytest.mark.filterwarnings("ignore::torchpose.errors.DegenerateFilterWarning")
@pytest.mark.parametrize("method", ["articulated", "multiple-model"])
def test_a_body_that_is_lost_says_so_and_stays_alone(method):
    tracker, keypoints = tracker_of(method, outliers=False), standing(6)
    alone = tracker(keypoints[:1])
    keypoints[1, 4, UPPER_BODY.index("shoulder_left")] = 1e160  # its square is infinite
    track = tracker(keypoints)
    assert track.failed_at.tolist() == [-1, 4]
    finite = track.joints3d[1].flatten(1).isfinite()
    assert bool(finite[:4].all()) and not bool(finite[4:].any())
    torch.testing.assert_close(track.joints3d[0], alone.joints3d[0], rtol=0, atol=1e-12)


def test_hands_before_the_chest_are_found_there():
    """Forearms that point at the camera look the same as ones that point away, through the chest."""
    truth = performance("merging hands", 120, 30.0, 0, 1.6)[0][::3].double()
    camera = demo_camera()
    seen = (truth @ camera.matrix.T)[..., :2] / truth[..., 2:]
    tracker = tracker_of("articulated", fps=10.0)
    found = tracker(seen[None], names=list(UPPER_BODY)).joints3d[0]
    neck, *hands = (UPPER_BODY.index(name) for name in ("neck", "hand_left", "hand_right"))
    off = (found - found[:, [neck]]) - (truth - truth[:, [neck]])
    assert float(off[:, hands].norm(dim=-1).mean()) < 0.095  # 0.11 where nothing is hidden
