"""Poses in the axes of the torso: what they do not depend on, and the way back."""

import torch

from tests.priors.poses import poses
from torchpose.math._rotations import rotvec_to_matrix
from torchpose.metrics import joint_errors_3d
from torchpose.metrics._pose_errors import ALIGN_JOINTS
from torchpose.skeleton._torso import TORSO, in_torso_axes, onto_torso

TURN = rotvec_to_matrix(torch.tensor([0.3, -0.5, 0.2], dtype=torch.float64))


def bodies(n=6):
    return poses(n, seed=2).double()


def test_where_a_body_stands_and_how_it_is_turned_does_not_count():
    body = bodies()
    moved = body @ TURN.mT + torch.tensor([0.4, -0.2, 2.0])
    torch.testing.assert_close(in_torso_axes(moved), in_torso_axes(body))


def test_the_body_keeps_its_shape_and_lies_on_the_torso():
    body = bodies()
    found = in_torso_axes(body)
    assert float(joint_errors_3d(found, body).max()) < 1e-9
    torso = torch.tensor(TORSO, dtype=torch.float64)
    assert float((found[:, list(ALIGN_JOINTS)] - torso).norm(dim=-1).max()) < 0.1


def test_a_mirrored_body_is_the_mirror_image():
    body, flip = bodies(), torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    order = [7, 6, 5, 3, 4, 2, 1, 0]
    torch.testing.assert_close(
        in_torso_axes(body[:, order] * flip), in_torso_axes(body)[:, order] * flip
    )


def test_a_pose_goes_back_to_where_it_was_with_its_covariances():
    body = bodies()
    pose = in_torso_axes(body)
    factor = torch.randn(6, 8, 3, 3, generator=torch.Generator().manual_seed(0)).double()
    covs = factor @ factor.mT
    moved, turned = onto_torso(pose, covs, body)
    torch.testing.assert_close(moved, body)
    apart = (body[:, 0] - body[:, 4])[..., None]
    before = (pose[:, 0] - pose[:, 4])[..., None]
    torch.testing.assert_close(apart.mT @ turned[:, 0] @ apart, before.mT @ covs[:, 0] @ before)
