"""The smallest tracker: one Kalman filter, with the prior's moments in place of its components."""

from typing import NamedTuple

import torch
from torch import Tensor

import torchpose
from torchpose.filters import RecursiveFilter, StepOutput, make_transition
from torchpose.math import kalman_predict, kalman_update
from torchpose.priors import GaussianMixture
from torchpose.upper_body import PoseFilter, register_method


class OneGaussianState(NamedTuple):
    mean: Tensor  # [B, D]
    cov: Tensor  # [B, D, D]


class OneGaussianFilter(RecursiveFilter):
    def __init__(self, prior, process_cov, measurement_cov, observed):
        super().__init__(measurement_cov, observed, prior.dim, torch.float64)
        mean, cov = (m.double() for m in prior.moments())
        self.register_buffer("prior_mean", mean)
        self.register_buffer("prior_cov", cov)
        matrix, offset, noise = make_transition(
            "stationary", mean[None], cov[None], torch.diag(process_cov).double()
        )
        self.register_buffer("matrix", matrix[0])
        self.register_buffer("offset", offset[0])
        self.register_buffer("noise", noise[0])

    def init(self, batch_size, *, generator=None):
        dim = self.dim
        return OneGaussianState(
            self.prior_mean.expand(batch_size, dim), self.prior_cov.expand(batch_size, dim, dim)
        )

    def filter_frame(self, state, frame, generator, return_cov):
        predicted = kalman_predict(*state, self.matrix, self.offset, self.noise)
        mean, cov, log_evidence = kalman_update(
            *predicted, frame.z, frame.cov, self.observed, frame.mask
        )
        log_weights = mean.new_zeros(len(mean), 1)  # one track, of weight one
        estimate = StepOutput(mean, log_weights, log_evidence, cov if return_cov else None)
        return OneGaussianState(mean, cov), estimate


mixture = GaussianMixture(torch.ones(1), torch.zeros(1, 2), torch.eye(2)[None])
one = OneGaussianFilter(mixture, torch.ones(2), torch.ones(1), observed=[0])
out = one(torch.randn(4, 20, 1), lengths=torch.tensor([20, 5, 9, 1]))
print(out.mean.shape)
# > torch.Size([4, 20, 2])

register_method("one-gaussian", PoseFilter(OneGaussianFilter))  # the one line

prior = torchpose.load_prior("kinect-upper-body-small")
tracker = torchpose.UpperBodyTracker(prior, prior.camera, method="one-gaussian")
keypoints = torch.full((1, 10, 3, 2), 240.0)
keypoints[..., 0] = torch.tensor([320.0, 420.0, 220.0])
track = tracker(keypoints, names=["head", "hand_left", "hand_right"])
print(track.method, track.joints3d.shape)
# > one-gaussian torch.Size([1, 10, 8, 3])
