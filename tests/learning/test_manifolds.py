"""Noise of a motion about its manifold: against sums written out, and empty sequences."""

import math

import pytest
import torch

from torchpose.errors import InputError
from torchpose.learning._manifolds import check_unseen, motion_noise
from torchpose.priors._manifold.gplvm import no_noise


def test_root_mean_squares_never_cross_the_end_of_a_sequence() -> None:
    poses = torch.tensor([[0.0, 5.0], [1.0, 5.0], [3.0, 5.0], [90.0, 5.0], [94.0, 5.0]]).double()
    latents, returned = 2 * poses[:, :1], poses - torch.tensor([0.5, 0.0])
    noise = motion_noise(poses, latents, returned, [3, 2])
    step = math.sqrt((1 + 4 + 16) / 3)
    assert noise.std_latent.tolist() == pytest.approx([2 * step])
    # the second column stands still and always comes back: a twentieth of the mean over both
    assert noise.std_step.tolist() == pytest.approx([step, 0.05 * step / math.sqrt(2)])
    assert noise.std_pose.tolist() == pytest.approx([0.5, 0.05 * 0.5 / math.sqrt(2)])
    with pytest.raises(InputError, match="two frames of one sequence"):
        motion_noise(poses, latents, returned, [1] * 5)


def test_poses_that_were_fitted_to_are_noticed_beside_empty_sequences() -> None:
    fitted = torch.arange(12.0).reshape(4, 3)
    other = fitted + 0.5
    check_unseen(other, [2, 0, 2, 0], fitted)
    other[2] = fitted[3]
    check_unseen(other, [4], fitted)  # only the start of each sequence is compared
    with pytest.raises(InputError, match="poses that were not fitted to"):
        check_unseen(other, [2, 0, 2, 0], fitted)


def test_before_there_are_validation_poses_nothing_is_known() -> None:
    noise = no_noise(2, 5, torch.zeros(1))
    assert [len(std) for std in noise] == [2, 5, 5]
    assert all(bool(std.isnan().all()) for std in noise)
