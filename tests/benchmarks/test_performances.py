"""Movements: humanly possible, each what its name says, the same with the same seed."""

import math

import numpy as np
import pytest
import torch

from benchmarks._performances import PERFORMANCES, crossing, performance
from torchpose.demo._mannequin import ANGLE_LIMITS, BodySize
from torchpose.errors import InputError
from torchpose.math import euler_to_matrix
from torchpose.skeleton._upper_body import LIMBS

MADE_UP = [name for name in PERFORMANCES if name != "performer"]


def on_torso(clip):
    """Hands [T, 2, 3] from the neck, in the torso's axes."""
    axes = clip.rotation @ euler_to_matrix(clip.angles.torso)
    return (clip.joints[:, [0, 7]] - clip.joints[:, 4:5]) @ axes


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("name", MADE_UP)
def test_movement_is_humanly_possible(name, seed):
    clip = performance(name, 1000, seed=seed)
    joints = clip.joints
    assert joints.shape == (1000, 8, 3) and len(clip.labels) == 1000
    low, high = torch.deg2rad(torch.tensor(list(ANGLE_LIMITS.values()))).double().unbind(-1)
    assert ((clip.angles.arms >= low) & (clip.angles.arms <= high)).all()
    speed = joints.diff(dim=0).norm(dim=-1) * clip.fps
    assert speed[:, [0, 7]].max() < 4 and speed[:, [1, 6]].max() < 3.5
    assert speed[:, [2, 3, 4, 5]].max() < 0.8
    assert joints.diff(n=2, dim=0).norm(dim=-1).max() * clip.fps**2 < 45
    a, b = torch.tensor(LIMBS).unbind(-1)
    lengths = (joints[:, a] - joints[:, b]).norm(dim=-1)
    assert lengths.std(0).max() < 1e-9
    x, y, z = on_torso(clip).unbind(-1)
    inside = (x.abs() < 0.15) & (z.abs() < 0.11) & (y > -0.02) & (y < 0.56)
    assert not inside.any()
    assert (joints[:, [0, 7]] - joints[:, 3:4]).norm(dim=-1).min() > 0.12
    assert (joints[:, 0] - joints[:, 7]).norm(dim=-1).min() > 0.045


def test_claps_meet_and_part():
    clip = performance("clapping", 1000)
    apart = (clip.joints[:, 0] - clip.joints[:, 7]).norm(dim=-1).numpy()
    minima = (apart[1:-1] < apart[:-2]) & (apart[1:-1] <= apart[2:]) & (apart[1:-1] < 0.1)
    assert minima.sum() >= 15
    assert np.quantile(apart, 0.9) > 0.2


def test_merging_hands_meet_and_swap_sides():
    for seed in (0, 1):
        clip = performance("merging hands", 1000, seed=seed)
        x = clip.joints[:, 0, 0] - clip.joints[:, 7, 0]  # left minus right
        assert (x < -0.1).double().mean() > 0.02  # swapped
        assert (x.abs() < 0.08).double().mean() > 0.1  # merged, as the camera sees them
        assert (x > 0.25).double().mean() > 0.2  # apart


def test_crossed_arms_are_folded_clasped_and_apart():
    for seed in (0, 1, 2):
        clip = performance("crossed arms", 2000, seed=seed)
        x = clip.joints[:, 0, 0] - clip.joints[:, 7, 0]  # left minus right
        assert (x < -0.15).double().mean() > 0.05  # on each other's side
        assert (x > 0.3).double().mean() > 0.1  # apart
        clasped = torch.tensor([label == "clasped" for label in clip.labels])
        assert (clip.joints[clasped, 0] - clip.joints[clasped, 7]).norm(dim=-1).min() < 0.1


def test_raised_arms_rise_above_the_head_and_are_held_out():
    for seed in (0, 1, 3):
        x, y, _ = on_torso(performance("raised arms", 3000, seed=seed)).unbind(-1)
        assert (y < -0.2).double().mean() > 0.04
        assert (x.abs() > 0.45).double().mean() > 0.05


def test_signers_keep_their_hands_busy_before_chest_and_face():
    clip = performance("signing", 1000)
    hands = on_torso(clip)
    speed = hands.diff(dim=0).norm(dim=-1).amax(-1) * 30
    assert (speed > 0.3).double().mean() > 0.5
    at_face = (clip.joints[:, [0, 7]] - clip.joints[:, 3:4])[..., :2].norm(dim=-1).amin(-1) < 0.16
    assert 0.03 < at_face.double().mean() < 0.6


@pytest.mark.parametrize("name", PERFORMANCES)
def test_seeds(name):
    once, again, other = (performance(name, 90, seed=s) for s in (0, 0, 1))
    assert torch.equal(once.joints, again.joints)
    assert (once.joints - other.joints).abs().max() > 0.005
    longer = performance(name, 120)
    torch.testing.assert_close(longer.joints[:90], once.joints)
    fast = performance(name, 180, fps=60.0)
    torch.testing.assert_close(fast.joints[::2], once.joints)


def test_another_body_makes_the_same_movement():
    size = BodySize(upper_arm=0.31, forearm=0.27, half_shoulders=0.18)
    clip = performance("clapping", 60, size=size)
    assert (clip.joints[:, 2] - clip.joints[:, 1]).norm(dim=-1).sub(0.31).abs().max() < 1e-9


def test_walkers_pass_each_other():
    near, far = crossing(540, seconds=9.0)
    assert (far.joints[:, 4, 2] - near.joints[:, 4, 2]).min() > 0.4
    gap = near.joints[:, 4, 0] - far.joints[:, 4, 0]
    assert gap[0] < -1 and gap[269] > 1 and gap[539] < -1
    speed = near.joints[:, 4].diff(dim=0).norm(dim=-1) * 30
    assert 0.2 < speed.max() < 1.2


def test_bad_input_is_named():
    with pytest.raises(InputError, match="performer, signing, clapping, merging hands"):
        performance("juggling")
    with pytest.raises(InputError, match="n_frames >= 1"):
        performance("clapping", 0)
    with pytest.raises(InputError, match="fps > 0"):
        performance("signing", 10, fps=math.nan)
    with pytest.raises(InputError, match="seconds"):
        crossing(10, seconds=0.0)
