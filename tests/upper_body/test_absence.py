"""Hands that are probably outside of the image, as evidence for the tracker of upper bodies."""

import pytest
import torch

from torchpose import PinholeCamera
from torchpose.demo import KEYPOINT_NAMES, noisy_keypoints, performer
from torchpose.errors import InputError, ShapeError
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import UpperBodyTracker
from torchpose.upper_body._absence import HANDS, absence_of, log_beyond

N = 24
HIGH = 300  # rows of an image that ends below the elbows
CAMERA = PinholeCamera(525.0, 525.0, 319.5, 239.5, 640, HIGH)
METHODS = ("window-mixture", "articulated", "multiple-model")


@pytest.fixture(scope="module")
def keypoints():
    """Head, neck and left hand; the right hand is never seen."""
    points = noisy_keypoints(performer(N, seed=0).joints, std_px=2.0)[None].clone()
    points[:, :, KEYPOINT_NAMES.index("hand_right")] = torch.nan
    return points


def absent(value):
    found = torch.full((1, N, len(KEYPOINT_NAMES)), torch.nan, dtype=torch.float64)
    found[:, :, KEYPOINT_NAMES.index("hand_right")] = value
    return found


def tracked(prior, keypoints, method, probability=None, camera=CAMERA, **options):
    tracker = UpperBodyTracker(prior, camera, method, fps=30.0, **options)
    given = None if probability is None else absent(probability)
    return tracker(keypoints, names=KEYPOINT_NAMES, absent=given)


@pytest.fixture(scope="module", params=METHODS)
def method(request):
    return request.param


@pytest.fixture(scope="module")
def plain(prior, keypoints, method):
    """The track by a method that is told of no absence."""
    return tracked(prior, keypoints, method)


def test_a_hand_that_is_surely_absent_goes_below_the_border(prior, keypoints, method, plain):
    """The hand that is measured stays."""
    sure = tracked(prior, keypoints, method, 0.99)
    rows = [float(track.joints2d[0, :, HANDS[1], 1].mean()) for track in (plain, sure)]
    assert rows[1] > max(HIGH, rows[0] + 10)
    down = [float(track.joints3d[0, :, HANDS[1], 1].mean()) for track in (plain, sure)]
    assert down[1] > down[0]
    kept = [track.joints2d[0, :, HANDS[0]] for track in (plain, sure)]
    assert float((kept[1] - kept[0]).norm(dim=-1).median()) < 2.0


def test_hands_of_which_nothing_is_known_change_nothing(prior, keypoints, method, plain):
    for probability in (0.3, torch.nan):
        found = tracked(prior, keypoints, method, probability)
        torch.testing.assert_close(found.joints3d, plain.joints3d, rtol=0, atol=1e-12)


def test_absence_of_a_hand_that_is_measured_is_ignored(prior, keypoints):
    tracker = UpperBodyTracker(prior, CAMERA, fps=30.0)
    given = torch.full_like(keypoints[..., 0], torch.nan)
    given[:, :, KEYPOINT_NAMES.index("hand_left")] = 0.999
    plain, found = (
        tracker(keypoints, names=KEYPOINT_NAMES, absent=value) for value in (None, given)
    )
    torch.testing.assert_close(found.joints3d, plain.joints3d, rtol=0, atol=1e-12)


def test_live_and_in_blocks_the_numbers_are_those_of_a_whole_recording(prior, keypoints):
    tracker, given = UpperBodyTracker(prior, CAMERA, fps=30.0), absent(0.95)
    given[:, ::3] = torch.nan
    whole = tracker(keypoints, names=KEYPOINT_NAMES, absent=given)
    state = tracker.init(1, KEYPOINT_NAMES)
    state, first = tracker.advance(state, keypoints[:, :10], absent=given[:, :10])
    live = [first.joints3d]
    for t in range(10, N):
        state, pose = tracker.step(state, keypoints[:, t], absent=given[:, t])
        live.append(pose.joints3d[:, None])
    torch.testing.assert_close(torch.cat(live, 1), whole.joints3d, rtol=1e-9, atol=1e-9)


def test_smoothers_use_it_too(prior, keypoints):
    plain, found = (
        tracked(prior, keypoints, None, p, smoothing="full").joints2d[0, :, HANDS[1], 1].mean()
        for p in (None, 0.99)
    )
    assert float(found) > max(HIGH, float(plain))


def test_it_needs_the_size_of_the_image_and_probabilities(prior, keypoints):
    unknown = PinholeCamera(525.0, 525.0, 319.5, 239.5)
    with pytest.raises(InputError, match="width and height"):
        tracked(prior, keypoints, None, 0.9, unknown)
    with pytest.raises(InputError, match="from 0 to 1"):
        tracked(prior, keypoints, None, 1.2)
    with pytest.raises(ShapeError, match="absent"):
        UpperBodyTracker(prior, CAMERA)(
            keypoints, names=KEYPOINT_NAMES, absent=torch.zeros(1, N, 2)
        )


def test_borders_are_those_of_the_image_in_pixels_of_the_prior():
    """Of a camera with twice the pixels of the prior's, and of points in space before it."""
    camera = PinholeCamera(1050.0, 1050.0, 639.5, 479.5, 1280, 960)
    matrix = PinholeCamera(525.0, 525.0, 319.5, 239.5).matrix
    found = absence_of(torch.tensor([[[0.999, 0.1]]], dtype=torch.float64), camera, matrix)
    inside, below, left, right, above = torch.tensor(
        [[300.0, 200.0], [300.0, 500.0], [-20.0, 200.0], [660.0, 200.0], [300.0, -20.0]]
    ).double()
    for place, beyond in zip((below, left, right, above), range(4), strict=True):
        distance = found.planes[:, :2] @ place + found.planes[:, 2]
        assert (distance > 0).nonzero().flatten().tolist() == [beyond]
    assert bool((found.planes[:, :2] @ inside + found.planes[:, 2] < 0).all())
    assert float(found.log_inside[0, 0, 0]) < -0.5 and float(found.log_inside[0, 0, 1]) == 0
    rays = torch.linalg.solve(
        matrix, torch.nn.functional.pad(torch.stack([inside, below]), (0, 1), value=1.0).mT
    ).mT
    logs = log_beyond(
        2.5 * rays,
        found.planes @ matrix,
        rays.new_tensor([0.0, 0.0, 1.0]),
        found.log_inside[0, 0, 0],
    )
    torch.testing.assert_close(logs[0], found.log_inside[0, 0, 0], rtol=0, atol=1e-3)
    assert abs(float(logs[1])) < 0.2


def test_hands_are_named_by_their_rows():
    assert [UPPER_BODY[row] for row in HANDS] == ["hand_left", "hand_right"]
