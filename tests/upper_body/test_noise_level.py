"""Keypoints that shake more than usual have a larger R, and the poses of them wider ellipsoids."""

import pytest
import torch

from tests.upper_body.lifters import UNSURE
from torchpose.demo import demo_camera, performer
from torchpose.metrics import coverage
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import UpperBodyTracker
from torchpose.upper_body._noise_level import NoiseLevel, follow_noise

ALL = torch.ones(1, 8, dtype=torch.bool)
USUAL = torch.full((1, 8), 9.0, dtype=torch.float64)
SCALE = torch.tensor([200.0], dtype=torch.float64)


def still(n_frames, std, seed=0):
    """Pixels of a body that stands still, with noise."""
    generator = torch.Generator().manual_seed(seed)
    return std * torch.randn(n_frames, 1, 8, 2, generator=generator, dtype=torch.float64) + 300


def followed(uv, fps=30.0, known=None):
    level = NoiseLevel.usual(1, 1 / fps, USUAL)
    for t, frame in enumerate(uv):
        there = ALL if known is None else known[t]
        level = follow_noise(level, frame, there, USUAL, SCALE, 1 / fps)
    return level


@pytest.mark.parametrize(("std", "expected"), [(0.5, 1.0), (3.0, 1.0), (6.0, 4.0), (12.0, 16.0)])
def test_factor_is_that_of_the_noise_and_at_least_one(std, expected):
    assert float(followed(still(240, std)).factor) == expected


@pytest.mark.parametrize("seed", range(5))
def test_usual_noise_never_enlarges_r(seed):
    level = NoiseLevel.usual(1, 1 / 30, USUAL)
    for frame in still(150, 3.0, seed):
        level = follow_noise(level, frame, ALL, USUAL, SCALE, 1 / 30)
        assert float(level.factor) == 1


def test_glitches_and_gaps_are_no_noise():
    uv = still(150, 3.0)
    uv[70, :, UPPER_BODY.index("head")] += 200
    known = ALL.repeat(150, 1, 1)
    known[40:50] = False
    uv[40:50] = 0.0
    uv[50:] += 40  # where the body is seen again
    assert float(followed(uv, known=known).factor) == 1


def test_a_body_that_jumps_is_no_noise():
    seconds = torch.arange(90, dtype=torch.float64) / 30
    up = 0.15 * 200 * (2 * torch.pi * 1.5 * seconds).cos()  # as in jumping jacks
    uv = still(90, 3.0)
    uv[..., 1] += up[:, None, None]
    assert float(followed(uv).factor) == 1
    assert float(followed(uv[::3], 10.0).factor) <= 2


@pytest.fixture(scope="module")
def joints():
    return performer(60, seed=1).joints.double()


def tracked(prior, joints, std, **options):
    uv = demo_camera()(joints)[..., :2]
    generator = torch.Generator().manual_seed(0)
    noise = std * torch.randn(uv.shape, generator=generator, dtype=torch.float64)
    tracker = UpperBodyTracker(prior, demo_camera(), "articulated", **options)
    return tracker((uv + noise)[None])


def test_usual_noise_changes_no_bit(prior, joints):
    found, plain = (tracked(prior, joints, 3.0, outliers=own) for own in (True, False))
    assert torch.equal(found.joints3d, plain.joints3d)
    assert torch.equal(found.covariance3d, plain.covariance3d)


def test_ellipsoids_of_noisy_keypoints_hold_more(prior, joints):
    neck = UPPER_BODY.index("neck")
    inside = []
    for outliers in (True, False):
        track = tracked(prior, joints, 10.0, outliers=outliers, lifter=UNSURE)
        found, true = (x - x[:, [neck]] for x in (track.joints3d[0], joints))
        inside.append(float(coverage(found, track.covariance3d[0], true).overall[1]))
    adapted, plain = inside
    assert adapted > plain + 0.1
