"""Process noise Q of the filters over single poses: what a prior brings for each method."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.priors.arm_state import STATE_DIM
from torchpose.priors.upper_body import UpperBodyPrior, released_process_cov
from torchpose.skeleton.upper_body import ARM_JOINTS
from torchpose.upper_body.measurements import pixel_indices

__all__ = ["ProcessNoise", "default_process_cov", "default_walk_cov"]

_WALK_RATE = 0.9  # of a component's covariance, per second; chosen as the methods' factors were


class ProcessNoise(NamedTuple):
    """Q of a method, in terms of the recorded steps that a prior brings.

    With S the second moment of the recorded steps (`increment_covs`) and k the factor, Q = k S for a
    walk, which has to step where the prior has bodies, and Q = k diag(S) for the others, whose
    transition brings them back there.

    Attributes:
        factor: k; that of a method has the least error on training persons that were held out
            (`benchmarks/process_noise.py`).
        walks: whether the method walks at random.
        tuned: whether a Q that the prior states comes first, as fine-tuning states it.
    """

    factor: float = 10.0
    walks: bool = False
    tuned: bool = True

    def cov(
        self, prior: UpperBodyPrior, side: str
    ) -> Float[Tensor, "21 21"] | Float[Tensor, " 21"]:
        """Return Q per frame at the prior's own rate.

        A prior without S has the Q that it states, else `default_process_cov`; walks then have
        `default_walk_cov`.

        Args:
            prior: whose noise is taken. side: "left" or "right".
        """
        noise = prior.noise
        stated = noise.get(f"process_cov_{side}", noise.get("process_cov"))
        increments = noise.get(f"increment_cov_{side}")
        if self.walks:
            return default_walk_cov(prior, side) if increments is None else self.factor * increments
        if stated is not None and (increments is None or self.tuned):
            return stated
        if increments is None:
            return default_process_cov(prior)
        return self.factor * increments.diagonal()


def default_process_cov(prior: UpperBodyPrior) -> Float[Tensor, " 21"]:
    """Return the diagonal of Q per frame where a prior brings none: that of the released tracker.

    Its authors set it by hand for f = 1550 pixels, a person 4.5 m away and 25 frames per second; the
    same movement in metres is f / depth times as many pixels elsewhere.

    Args:
        prior: whose camera, mean depth and frame rate are used.
    """
    depth = prior.left.moments()[0][2:15:3].mean().clamp_min(0.1)
    pixels = math.sqrt(prior.info.fx * prior.info.fy) / depth / (1550 / 4.5)
    released = released_process_cov().to(pixels)
    in_pixels = torch.zeros(STATE_DIM, dtype=torch.bool, device=released.device)
    in_pixels[pixel_indices(ARM_JOINTS)] = True
    scaled = torch.where(in_pixels, released * pixels.square(), released)
    return scaled * (25.0 / (prior.info.fps or 30.0))


def default_walk_cov(prior: UpperBodyPrior, side: str) -> Float[Tensor, "21 21"]:
    """Return Q per frame for particles that walk at random, where a prior brings no recorded steps.

    Q = r / fps sum_i pi_i Sigma_i, r = 0.9 / s: a step in the directions in which a component is wide.
    The released Q lets every number wander by itself, up to a metre of depth in a frame, which leaves
    hardly any particle where the prior has bodies.

    Args:
        prior: whose mixture and frame rate are used. side: "left" or "right".
    """
    mixture = getattr(prior, side)
    within = torch.einsum("k,kij->ij", mixture.weights, mixture.covariances)
    return _WALK_RATE / (prior.info.fps or 30.0) * within
