"""Jumps and wrong bones that were put in are found, and nothing else is."""

import math

import pytest
import torch

from tests.learning.curation.bodies import moving, recording
from torchpose.errors import InputError, ShapeError
from torchpose.learning._curation import (
    JUMP_SPEEDS,
    bone_lengths,
    find_jumps,
    find_wrong_joints,
    person_bones,
)
from torchpose.learning._curation.bones import PersonBones, human_size
from torchpose.learning._curation.joints import with_missing


def put(joints, frames, joint, shift):
    changed = joints.clone()
    changed[frames, joint] += torch.tensor(shift, dtype=joints.dtype)
    return changed


# --- jumps ----------------------------------------------------------------------------------------


def test_smooth_motion_has_none():
    assert not find_jumps(moving(600), 30.0).any()
    assert not find_jumps(moving(600), 12.0).any()


@pytest.mark.parametrize("length", [1, 2, 3])
@pytest.mark.parametrize("joint", [0, 3, 6])
def test_a_spike_is_found_and_nothing_else(joint, length):
    wrong = find_jumps(put(moving(), slice(50, 50 + length), joint, (0.2, 0.1, -0.2)), 30.0)
    expected = torch.zeros_like(wrong)
    expected[50 : 50 + length, joint] = True
    assert torch.equal(wrong, expected)


@pytest.mark.parametrize("length", [4, 5])
def test_a_longer_jump_that_comes_back(length):
    wrong = find_jumps(put(moving(), slice(50, 50 + length), 0, (0.7, 0.0, 0.0)), 30.0)
    expected = torch.zeros_like(wrong)
    expected[50 : 50 + length, 0] = True
    assert torch.equal(wrong, expected)


def test_a_jump_that_does_not_come_back_spoils_both_sides():
    wrong = find_jumps(put(moving(), slice(80, None), 7, (0.0, 0.9, 0.0)), 30.0)
    assert torch.nonzero(wrong).tolist() == [[79, 7], [80, 7]]


def test_spikes_beside_each_other_and_at_the_ends():
    joints = moving()
    for frame in (20, 22, 24):
        joints = put(joints, frame, 1, (0.9, 0.0, 0.0))
    joints = put(put(joints, 0, 5, (0.5, 0.0, 0.0)), 199, 2, (0.0, 0.0, 0.8))
    wrong = find_jumps(joints, 30.0)
    assert wrong[[20, 22, 24], 1].all() and wrong[0, 5] and wrong[199, 2]
    assert int(wrong.sum()) <= 9


def test_time_without_a_joint_is_time_to_move():
    joints = put(moving(), slice(100, None), 0, (0.0, 1.2, 0.0))
    joints[95:100, 0] = math.nan
    assert not find_jumps(joints, 30.0)[:, 0].any()  # 1.2 m in 6 frames is 6 m/s
    joints[98, 0] = joints[101, 0]
    assert find_jumps(put(joints, 98, 0, (0, 1.5, 0)), 30.0)[98, 0]
    assert not find_jumps(torch.full((5, 8, 3), math.nan), 30.0).any()
    assert not find_jumps(moving(1), 30.0).any()


@pytest.mark.parametrize("fps", [15.0, 30.0, 120.0])
def test_bounds_are_speeds(fps):
    at = math.ceil(0.1 * fps) + 3
    for factor, expected in ((0.8, False), (1.3, True)):
        joints = torch.zeros(40, 8, 3).double()
        joints[at:, 0, 0] = factor * JUMP_SPEEDS[0] / fps
        assert bool(find_jumps(joints, fps).any()) == expected


def test_bad_bounds():
    with pytest.raises(InputError, match="positive"):
        find_jumps(moving(), 0.0)
    with pytest.raises(InputError, match="positive"):
        find_jumps(moving(), 30.0, (0.0,) * 8)
    with pytest.raises(ShapeError):
        find_jumps(moving(), 30.0, (1.0,) * 7)


# --- bones ----------------------------------------------------------------------------------------


def usual(joints):
    [bones] = person_bones([recording(joints=joints)]).values()
    return bones


def test_bones_of_a_person_by_hand():
    bones = usual(moving(noise=0.0))
    expected = [0.2, math.hypot(0.18, 0.1), 0.28, 0.26, math.hypot(0.18, 0.1), 0.28, 0.26]
    torch.testing.assert_close(bones.length, torch.tensor(expected).double())
    assert bones.spread.abs().max() < 1e-9
    assert bone_lengths(moving(3)).shape == (3, 7)


@pytest.mark.parametrize(("joint", "shift"), [(0, 0.5), (1, 0.6), (3, 0.3), (2, 0.9), (6, 0.6)])
def test_the_joint_to_blame(joint, shift):
    joints = moving()
    bones = usual(joints)
    found = find_wrong_joints(put(joints, 60, joint, (0.0, 0.0, shift)), bones)
    assert torch.nonzero(found.joints).tolist() == [[60, joint]]
    assert not found.frames.any()
    assert not find_wrong_joints(joints, bones).joints.any()


def test_no_body():
    joints = moving()
    bones = usual(joints)
    joints[70] = joints[70, 4] + 0.02 * torch.randn(
        8, 3, generator=torch.Generator().manual_seed(0)
    )
    found = find_wrong_joints(joints, bones)
    assert torch.nonzero(found.frames).flatten().tolist() == [70]


def test_what_varies_by_itself_is_no_outlier():
    bones = usual(moving())
    loose = PersonBones(bones.length, torch.full((7,), 0.3).double())
    joints = put(moving(), 60, 0, (0.0, 0.0, 0.6))
    assert not find_wrong_joints(joints, loose).joints.any()
    missing = put(moving(), 60, 0, (math.nan, 0.0, 0.0))
    assert not find_wrong_joints(missing, bones).joints.any()


def test_human_size():
    bones = usual(moving())
    assert human_size(bones, 0.36) == ""
    assert "shoulders of 90 cm" in human_size(bones, 0.9)
    assert "an upper arm of 7 cm" in human_size(usual(moving(size=0.25)), None)


def test_missing_joints_lose_their_weight():
    one = recording(weights=torch.ones(200, 8).double())
    missing = torch.zeros(200, 8, dtype=torch.bool)
    missing[3, 0] = True
    left = with_missing(one, missing)
    assert left.joints[3, 0].isnan().all() and int(left.joints.isnan().sum()) == 3
    assert left.weights is not None and left.weights[3, 0] == 0 and left.weights.sum() == 1599
    assert one.joints.isfinite().all()
