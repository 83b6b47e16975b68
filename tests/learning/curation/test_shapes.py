"""Turning, scaling and mirroring bodies does what it says and nothing else."""

import math

import pytest
import torch

from tests.learning.curation.bodies import kinect_v1, moving, recording
from torchpose.errors import InputError
from torchpose.learning._curation import (
    bone_lengths,
    face_camera,
    harmonise_bones,
    mirrored,
    torso_rotation,
)
from torchpose.math import euler_to_matrix
from torchpose.skeleton import SKELETONS
from torchpose.skeleton._upper_body import scale_bones


def turn(joints, roll=0.0, pitch=0.0, yaw=0.0):
    R = euler_to_matrix(torch.tensor([roll, pitch, yaw]).double(), "zxy")
    neck = joints[:, 4:5]
    return (joints - neck) @ R.mT + neck


# --- towards the camera ---------------------------------------------------------------------------


def test_torso_rotation_is_a_rotation():
    g = torch.Generator().manual_seed(0)
    across, up = torch.randn(2, 50, 3, generator=g, dtype=torch.float64)
    R = torso_rotation(across, up)
    torch.testing.assert_close(R @ R.mT, torch.eye(3).double().expand(50, 3, 3))
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(50).double())
    turned_across, turned_up = (R @ across[..., None])[..., 0], (R @ up[..., None])[..., 0]
    torch.testing.assert_close(turned_across[:, 0], across.norm(dim=-1))
    assert bool((turned_up[:, 1] < 0).all()) and turned_up[:, 2].abs().max() < 1e-12


@pytest.mark.parametrize("yaw", [0.7, -2.5])
def test_someone_who_stands_sideways_is_turned_back(yaw):
    straight = moving(noise=0.0)
    for of in ("recording", "pose"):
        one = face_camera(recording(joints=turn(straight, yaw=yaw)), of)
        torch.testing.assert_close(one.joints, straight, atol=1e-9, rtol=0)
        assert f"each {of}" in one.notes[-1]


def test_with_hips_leaning_is_taken_out_too():
    joints, names = kinect_v1(moving(noise=0.0))
    for hip, x in (("left_hip", 0.1), ("right_hip", -0.1), ("hip_center", 0.0)):
        joints[:, names.index(hip)] = joints[:, names.index("shoulder_center")] + torch.tensor(
            [x, 0.5, 0.0]
        )
    neck = joints[:, names.index("shoulder_center")][:, None]
    R = euler_to_matrix(torch.tensor([0.2, -0.3, 0.8]).double(), "zxy")
    leaning = (joints - neck) @ R.mT + neck
    one = face_camera(recording(joints=leaning, names=names))
    torch.testing.assert_close(one.joints, joints, atol=1e-9, rtol=0)


def test_missing_shoulders_take_the_mean_and_nobody_is_refused():
    joints = turn(moving(noise=0.0), yaw=0.5)
    joints[4, 2] = math.nan
    one = face_camera(recording(joints=joints), "pose")
    torch.testing.assert_close(one.joints[4, 7], moving(noise=0.0)[4, 7], atol=1e-9, rtol=0)
    assert int(one.joints.isnan().sum()) == 3
    with pytest.raises(InputError, match=r"ann/a\.csv, person ann#.*shoulders"):
        face_camera(recording(joints=torch.where(torch.arange(8)[:, None] == 2, math.nan, joints)))
    with pytest.raises(InputError, match="recording or pose"):
        face_camera(recording(), "frame")


# --- bones ----------------------------------------------------------------------------------------


def test_scaled_bones_keep_their_directions():
    joints, factors = moving(), torch.linspace(0.7, 1.3, 7).double()
    scaled = scale_bones(joints, factors)
    torch.testing.assert_close(bone_lengths(scaled), bone_lengths(joints) * factors)
    for near, far in ((4, 3), (4, 2), (2, 1), (1, 0), (5, 6), (6, 7)):
        before, after = (j[:, far] - j[:, near] for j in (joints, scaled))
        cosine = torch.nn.functional.cosine_similarity(before, after, dim=-1)
        torch.testing.assert_close(cosine, torch.ones_like(cosine))
    torch.testing.assert_close(scaled[:, 4], joints[:, 4])


def test_everybody_has_the_mean_persons_bones():
    small, large = moving(seed=1, size=0.8, noise=0.0), moving(seed=2, size=1.2, noise=0.0)
    people = [recording("ann", joints=small), recording("bob", joints=large),
              recording("bob", "b", large + 0.1)]  # fmt: skip
    same = harmonise_bones(people)
    mean = (bone_lengths(small[0]) + bone_lengths(large[0])) / 2  # persons count, not recordings
    for one in same:
        torch.testing.assert_close(bone_lengths(one.joints)[::40], mean.expand(5, 7))
    assert "mean person" in same[0].notes[-1]
    gap = small.clone()
    gap[3, 1] = math.nan  # without an elbow nobody knows where the hand would be
    out = harmonise_bones([recording(joints=gap)])[0].joints
    assert out[3, :2].isnan().all() and int(out.isnan().sum()) == 6
    with pytest.raises(InputError, match="at least one"):
        harmonise_bones([])


# --- mirror ---------------------------------------------------------------------------------------


def test_mirrored_twice_is_the_same():
    weights = torch.rand(200, 8, generator=torch.Generator().manual_seed(0)).double()
    one = recording(weights=weights)
    once = mirrored(one)
    torch.testing.assert_close(mirrored(once).joints, one.joints)
    torch.testing.assert_close(once.joints[:, 0], one.joints[:, 7] * torch.tensor([-1, 1, 1]))
    torch.testing.assert_close(once.weights, weights.flip(1)[:, [0, 1, 2, 4, 3, 5, 6, 7]])
    assert once.person_id == one.person_id


@pytest.mark.parametrize("name", ["kinect-v2-25", "azure-32", "cmu-31"])
def test_every_joint_set_can_be_mirrored(name):
    names = SKELETONS[name].joints
    joints = torch.randn(3, len(names), 3, generator=torch.Generator().manual_seed(0)).double()
    one = recording(joints=joints, names=names)
    torch.testing.assert_close(mirrored(mirrored(one)).joints, joints)
    unpaired = recording(joints=joints[:, :2], names=("left_hand", "head"))
    assert mirrored(unpaired).joints[:, 0].isnan().all()
