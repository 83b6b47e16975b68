"""What calls of modules return, as `mypy` sees it, to which `nn.Module` would say Any."""

from typing import assert_type

import torch
from torch import Tensor, nn

import torchpose
from torchpose.filters import FilterOutput, MixtureKalmanFilter
from torchpose.priors import GaussianMixture


class Recogniser(nn.Module):
    """A model of a program that has a tracker as a layer."""

    def __init__(self, tracker: torchpose.UpperBodyTracker) -> None:
        super().__init__()
        self.tracker = tracker

    def forward(self, keypoints: Tensor) -> Tensor:
        track = assert_type(self.tracker(keypoints, names=["head", "neck"]), torchpose.PoseTrack)
        return assert_type(track.joints3d, Tensor)


def test_a_tracker_in_a_model() -> None:
    prior = torchpose.load_prior("kinect-upper-body-small")
    tracker = torchpose.UpperBodyTracker(prior, prior.camera, "mkf-fixed")
    assert Recogniser(tracker)(torch.full((1, 2, 2, 2), 240.0)).shape == (1, 2, 8, 3)


def test_mixture_filter_and_camera() -> None:
    one = torch.ones(1)
    mixture = GaussianMixture(one, one[None], one[None, None])
    density = assert_type(mixture(torch.zeros(2, 1)), Tensor)
    output = assert_type(
        MixtureKalmanFilter(mixture, one, one, [0])(torch.zeros(1, 2, 1)), FilterOutput
    )
    pixels = assert_type(torchpose.PinholeCamera(525, 525, 320, 240)(torch.ones(1, 3)), Tensor)
    assert (density.shape, output.mean.shape, pixels.shape) == ((2,), (1, 2, 1), (1, 3))
