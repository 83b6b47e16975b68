"""The learnt neck against least squares by numpy, under rotation, and on recordings."""

import numpy as np
import pytest
import torch

from tests.data import data_dir_or_skip
from tests.priors.poses import lowered_neck, poses
from torchpose.errors import PriorError
from torchpose.io import read_recording
from torchpose.math import euler_to_matrix
from torchpose.skeleton._torso import (
    KINECT_NECK,
    NeckOffset,
    learn_neck_fraction,
    learn_neck_offset,
    place_neck,
)


def test_offset_that_was_put_in_comes_out():
    offset = NeckOffset(0.35, -0.1, 0.0, 300)
    learnt = learn_neck_offset(place_neck(poses(), offset))
    assert learnt.up == pytest.approx(0.35) and learnt.forward == pytest.approx(-0.1)
    assert learnt.residual < 1e-12 and learnt.frames == 300


def test_offset_is_the_least_squares_solution():
    joints = poses()
    learnt = learn_neck_offset(joints)
    rows, target = [], []
    for left, head, neck, right in joints[:, [2, 3, 4, 5]].numpy():
        middle = (left + right) / 2
        up = head - middle
        front = np.cross(left - right, up)
        rows.append(np.stack([up, front / np.linalg.norm(front) * np.linalg.norm(up)], 1))
        target.append(neck - middle)
    solution, *_ = np.linalg.lstsq(np.concatenate(rows), np.concatenate(target), rcond=None)
    np.testing.assert_allclose([learnt.up, learnt.forward], solution, rtol=1e-10)


def test_forward_is_towards_the_camera_and_turns_with_the_body():
    joints = lowered_neck(poses(1))
    moved = place_neck(joints, NeckOffset(0.0, 0.5, 0.0, 1))
    assert float((moved - joints)[0, 4, 2]) < -0.05
    rotation = euler_to_matrix(torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64))
    turned = place_neck(joints @ rotation.T, NeckOffset(0.0, 0.5, 0.0, 1))
    torch.testing.assert_close(turned, moved @ rotation.T)


def test_only_the_neck_moves_and_missing_shoulders_show():
    joints = poses(3)
    joints[1, 2] = torch.nan
    placed = place_neck(joints, NeckOffset(0.3, 0.0, 0.0, 1))
    others = [0, 1, 2, 3, 5, 6, 7]
    torch.testing.assert_close(placed[:, others], joints[:, others], equal_nan=True)
    assert bool(torch.isnan(placed[1, 4]).all()) and bool(torch.isfinite(placed[[0, 2]]).all())


def test_too_few_necks_are_refused():
    joints = poses(20)
    joints[5:, 4] = torch.nan
    with pytest.raises(PriorError, match="got 5 such frames"):
        learn_neck_offset(joints)


@pytest.mark.data
def test_neck_of_an_unseen_person_is_found():
    folder = data_dir_or_skip("kinect_utd_mhad")
    upper = [
        read_recording(folder / f"{name}_a01_swipe_left_t1.npz")[0].upper_body().joints
        for name in ("s01", "s02", "s07")
    ]
    offset = learn_neck_offset(torch.cat(upper[:2]))
    placed = place_neck(lowered_neck(upper[2]), offset)
    error = (placed - upper[2])[:, 4].norm(dim=-1).mean()
    before = (lowered_neck(upper[2]) - upper[2])[:, 4].norm(dim=-1).mean()
    assert float(before) > 0.09 and float(error) < 0.04


def test_the_fraction_of_the_way_to_the_head_is_the_least_squares_solution():
    joints = poses()
    learnt = learn_neck_fraction(joints)
    middle = (joints[:, 2] + joints[:, 5])[:, :2] / 2
    height, offset = ((joints[:, i, :2] - middle).flatten().numpy() for i in (3, 4))
    solution, residual, *_ = np.linalg.lstsq(height[:, None], offset, rcond=None)
    assert learnt.fraction == pytest.approx(solution[0])
    assert learnt.spread == pytest.approx(np.sqrt(residual[0] / len(offset)))
    assert learnt.frames == len(joints)
    with pytest.raises(PriorError, match="got 5 such frames"):
        learn_neck_fraction(joints[:5])


def test_the_constant_of_kinect_is_what_the_recordings_say():
    folder = data_dir_or_skip("kinect_utd_mhad")
    files = [f for p in range(1, 7) for f in sorted(folder.glob(f"s{p:02d}_*.npz"))[::20]]
    learnt = learn_neck_fraction(
        torch.cat([read_recording(f)[0].upper_body().joints for f in files])
    )
    assert learnt.fraction == pytest.approx(KINECT_NECK.fraction, abs=0.01)
    assert learnt.spread == pytest.approx(KINECT_NECK.spread, abs=0.002)
