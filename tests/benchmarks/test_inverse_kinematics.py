"""Inverse kinematics of the mannequin's arms."""

import math

import pytest
import torch

from benchmarks._performances import hands_to_arms
from torchpose.demo._mannequin import BodyAngles, BodySize, angles_to_joints
from torchpose.errors import InputError


def joints_of(arms: torch.Tensor, size: BodySize | None = None) -> torch.Tensor:
    zero = torch.zeros(len(arms), 3, dtype=arms.dtype)
    joints, _ = angles_to_joints(BodyAngles(zero, zero, zero, arms), size)
    return joints - joints[:, 4:5]


def places(n: int, seed: int) -> torch.Tensor:
    """Random places before the body, within reach."""
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor([-0.15, -0.25, -0.45]), torch.tensor([0.40, 0.60, -0.15])
    hands = low + (high - low) * torch.rand((n, 2, 3), generator=generator, dtype=torch.float64)
    return hands * torch.tensor([[1.0, 1, 1], [-1.0, 1, 1]])


@pytest.mark.parametrize("size", [BodySize(), BodySize(upper_arm=0.31, forearm=0.22)])
def test_hands_arrive_where_they_were_sent(size):
    hands = places(400, 0)
    joints = joints_of(hands_to_arms(hands, size), size)
    reach = (hands - joints[:, [2, 5]]).norm(dim=-1)
    within = (reach > 0.2) & (reach < size.upper_arm + size.forearm + size.hand - 0.01)
    assert within.double().mean() > 0.7
    error = (joints[:, [0, 7]] - hands).norm(dim=-1)
    assert error[within].max() < 2e-3
    assert error[within].median() < 1e-5


def test_elbow_follows_the_law_of_cosines_and_hangs_low():
    hands = places(100, 1)
    arms, size = hands_to_arms(hands), BodySize()
    joints = joints_of(arms)
    reach = (joints[:, [0, 7]] - joints[:, [2, 5]]).norm(dim=-1)
    a, b = size.upper_arm, size.forearm + size.hand
    inner = torch.acos((a * a + b * b - reach.square()) / (2 * a * b))
    torch.testing.assert_close(math.pi - inner, arms[..., 3])
    middle = (joints[:, [0, 7]] + joints[:, [2, 5]]) / 2
    assert (joints[:, [1, 6]] - middle)[..., 1].min() > -0.02  # y points down


def test_a_place_out_of_reach_is_pointed_at():
    far = torch.tensor([[[0.3, 0.1, -2.0], [-0.3, 0.1, -2.0]]], dtype=torch.float64)
    joints = joints_of(hands_to_arms(far))[0]
    for hand, shoulder, target in ((0, 2, far[0, 0]), (7, 5, far[0, 1])):
        pointing = joints[hand] - joints[shoulder]
        cosine = torch.cosine_similarity(pointing, target - joints[shoulder], dim=0)
        assert cosine > 0.999
        assert pointing.norm() > 0.57


def test_both_arms_are_mirror_images_and_bad_places_are_refused():
    hands = places(20, 2)
    mirror = torch.tensor([-1.0, 1, 1], dtype=torch.float64)
    swapped = (hands * mirror).flip(1)
    torch.testing.assert_close(hands_to_arms(swapped).flip(1), hands_to_arms(hands))
    with pytest.raises(InputError, match="finite"):
        hands_to_arms(torch.full((1, 2, 3), math.nan))
