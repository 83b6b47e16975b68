"""The standard deviations of angles that the page on keypoints shows are those of drawn joints."""

from pathlib import Path

import pytest
import torch

SNIPPET = Path(__file__).parents[2] / "docs" / "snippets" / "joint_angles.py"
ARM = torch.tensor([[0.0, 0.0, 0.0], [0.05, 0.27, -0.04], [0.18, 0.15, -0.17]]).double()
COVS = (
    1e-6
    * torch.tensor(
        [
            [[4.0, 0.5, -1.0], [0.5, 3.0, 0.0], [-1.0, 0.0, 20.0]],
            [[5.0, 0.0, 2.0], [0.0, 4.0, -3.0], [2.0, -3.0, 40.0]],
            [[6.0, 1.0, 0.0], [1.0, 6.0, 5.0], [0.0, 5.0, 50.0]],
        ]
    ).double()
)  # square metres; depth, the last axis, is the least sure


@pytest.fixture(scope="module")
def defined():
    """What the snippet defines before it tracks anybody."""
    found = {}
    exec(SNIPPET.read_text().partition("\ncamera = ")[0], found)
    return found


@pytest.mark.parametrize("shared", [0.0, 0.5, 0.9])
def test_standard_deviation_is_that_of_drawn_joints(defined, shared):
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(2, 40_000, 3, 3, generator=generator, dtype=torch.float64)
    own, common = drawn[0], drawn[1, :, :1]
    left, singular, _ = torch.linalg.svd(COVS)
    roots = left * singular.sqrt()[:, None] @ left.mT
    off = (roots @ ((1 - shared) ** 0.5 * own + shared**0.5 * common)[..., None]).squeeze(-1)
    mean, std = defined["angle_with_std"](ARM, COVS, shared)
    spread = (defined["angle"](ARM + off) - mean).square().mean().sqrt()
    torch.testing.assert_close(std, spread, rtol=0.02, atol=0)


def test_errors_that_joints_share_count_less(defined):
    apart, together = (defined["angle_with_std"](ARM, COVS, shared)[1] for shared in (0.0, 0.9))
    assert together < 0.6 * apart


def test_frames_without_a_pose_stay_nan(defined):
    joints, covs = torch.stack([ARM, ARM]), torch.stack([COVS, COVS])
    joints[1], covs[1] = torch.nan, torch.nan
    mean, std = defined["angle_with_std"](joints, covs, 0.5)
    assert mean.isfinite().tolist() == std.isfinite().tolist() == [True, False]
