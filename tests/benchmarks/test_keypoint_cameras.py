"""Disturbed cameras are off by what is said, peers find what they can, and measures have known values."""

import math

import pytest
import torch

from benchmarks.keypoint_bodies.clips import CLEAN, see
from benchmarks.keypoint_cameras.disturbed import DEGREES, DELAYS, METRES, disturb, in_step
from benchmarks.keypoint_cameras.peers import bundle_adjusted, correlated_delays
from benchmarks.keypoint_cameras.ways import Found, measure
from torchpose.demo._rendering.walk import walk, walk_clip


@pytest.fixture(scope="module")
def clip():
    return see(walk_clip(walk(seconds=2.0)), faults=CLEAN)


def test_cameras_begin_too_early_by_their_delays(clip):
    late = disturb(clip, late=True, turned=False)
    assert late.delays.tolist() == list(DELAYS)
    moved = in_step(late.keypoints, late.delays)
    true = clip.rig(late.joints).pixels
    torch.testing.assert_close(moved[4:-4], true[4:-4])
    torch.testing.assert_close(late.said.rotation, clip.rig.rotation)


def test_all_cameras_but_one_are_turned_and_shifted(clip):
    turned = disturb(clip, late=False, turned=True)
    trace = (turned.said.rotation * turned.rig.rotation).sum((-2, -1))
    angles = torch.rad2deg(((trace - 1) / 2).clamp(-1, 1).arccos())
    assert sorted(round(float(a), 3) for a in angles) == [0.0, DEGREES, DEGREES, DEGREES]
    places = [-(r.rotation.mT @ r.translation[..., None]) for r in (turned.said, turned.rig)]
    off = (places[0] - places[1]).squeeze(-1).norm(dim=-1)
    assert sorted(round(float(x), 5) for x in off) == [0.0, METRES, METRES, METRES]


def test_a_jump_tells_delays_by_its_speed(clip):
    t = torch.arange(90, dtype=torch.float64)
    jump = 200 * torch.exp(-(((t - 45) / 4) ** 2))
    pixels = torch.zeros(90, 2, 15, 2, dtype=torch.float64)
    pixels[:, 0, :, 1] = jump[:, None]
    pixels[:, 1, :, 1] = 0.5 * jump.roll(6)[:, None]
    assert correlated_delays(pixels, torch.ones_like(pixels[..., 0]), 60.0) == [0, 6]


def test_bundle_adjustment_finds_relative_rotations(clip):
    turned = disturb(clip, late=False, turned=True)
    rotation, _ = bundle_adjusted(turned.said, turned.keypoints, turned.confidence)
    relative = [torch.as_tensor(R) @ torch.as_tensor(R)[0].T
                for R in (rotation, turned.rig.rotation)]  # fmt: skip
    trace = (relative[0] * relative[1]).sum((-2, -1))[1:]
    assert float(torch.rad2deg(((trace - 1) / 2).clamp(-1, 1).arccos()).max()) < 0.1


def test_measures_have_known_values(clip):
    late = disturb(clip, late=True, turned=False)
    off = torch.tensor([0.03, 0.0, 0.04], dtype=torch.float64)
    found = measure(Found(late.joints + off, late.delays + 0.5, late.rig), late)
    assert found.room == pytest.approx(50.0) and found.moved == pytest.approx(0.0, abs=1e-6)
    assert found.delay == pytest.approx(0.5) and found.angle == pytest.approx(0.0, abs=1e-4)
    turned = disturb(clip, late=False, turned=True)
    wrong = measure(Found(turned.joints, turned.delays, turned.said), turned)
    assert 0.5 < wrong.angle < 2 * DEGREES + 0.01
    assert math.isfinite(wrong.moved)
