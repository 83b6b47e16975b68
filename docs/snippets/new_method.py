"""A method of the tracker that is no filter: every frame alone, by the linear Gaussian posterior."""

from typing import NamedTuple

import torch

from torchpose import PoseTrack
from torchpose.cli import main
from torchpose.filters import FilterOutput
from torchpose.math import kalman_update
from torchpose.skeleton import LEFT_ARM, RIGHT_ARM
from torchpose.upper_body import (
    Estimates,
    Estimator,
    arm_measurements,
    pixel_indices,
    register_method,
)


class Alone(NamedTuple):
    joints: dict[str, tuple[str, ...]]  # there is nothing to remember of the frames before


class FrameByFrame(Estimator):
    """Estimates every frame by itself.

    Args:
        widening: factor on the covariances of the prior.
    """

    def __init__(self, model, *, widening: float = 1.0):  # an option, here and of the command
        self.prior, self.widening = model.prior, widening

    def init(self, batch_size, joints, arm_generators):
        return Alone(joints)

    def advance(self, state, measured, progress=False):
        left = self.arm(self.prior.left, LEFT_ARM, state.joints["left"], measured)
        right = self.arm(self.prior.right, RIGHT_ARM, state.joints["right"], measured)
        return state, Estimates(left, right)

    def arm(self, mixture, rows, joints, measured):
        z, mask, noise = arm_measurements(rows, joints, measured)
        mean, cov = mixture.moments()
        prior = mean.expand(*z.shape[:2], -1), self.widening * cov.expand(*z.shape[:2], -1, -1)
        mean, cov, log_evidence = kalman_update(
            *prior, z, noise, torch.tensor(pixel_indices(joints)), mask
        )
        none = torch.full((len(z),), -1)  # no sequence failed
        return FilterOutput(mean, mean.new_zeros(*z.shape[:2], 1), log_evidence, cov, none)


register_method("frame-by-frame", FrameByFrame)

# torchpose track keypoints.npz --method frame-by-frame --widening 2 --out result
line = ["track", "keypoints.npz", "--method", "frame-by-frame", "--widening", "2"]
main([*line, "--out", "result"])
track = PoseTrack.load("result/poses.npz")
if track.method != "frame-by-frame" or not track.joints3d.isfinite().all():
    raise SystemExit(f"unexpected poses of {track.method}")
