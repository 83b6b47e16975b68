"""Adapt the noise of accelerations to how briskly a person moves.

Corrections of a filter are uncorrelated over time if the ratio of the noise of motion to that of measurements
is right, whatever both are. They go on in one direction where the filter is too slow, and turn back where it
follows the noise. With the correction d_t = G y_t of all joints, y_t the pull of the keypoints on them,

    log f_t+1 = log f_t + s rho dt / tau,   rho = y_t^T d_t-1 / ((y_t^T d_t + y_t-1^T d_t-1) / 2),

is the factor f of the variances of accelerations, with the share s of joints that are measured.

Reference:
    R. K. Mehra, "On the identification of variances and adaptive Kalman filtering", IEEE Transactions on
    Automatic Control 15(2), 1970: uncorrelated innovations. The step is this package's own.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

_TIME = 0.12  # tau, seconds
_FACTORS = (0.1, 10.0)  # least and largest f


class AdaptedNoise(NamedTuple):
    """Holds by what factor the accelerations of bodies vary, and what the last correction was.

    Attributes:
        factor: f, [B]. moved: d, of all joints [B, K], metres. size: y^T d, [B].
    """

    factor: Tensor
    moved: Tensor
    size: Tensor

    @staticmethod
    def usual(like: Float[Tensor, "B K"]) -> "AdaptedNoise":
        """Return the noise of motion on average, before any correction."""
        return AdaptedNoise(
            torch.ones_like(like[:, 0]), torch.zeros_like(like), torch.zeros_like(like[:, 0])
        )

    def after(
        self,
        pulled: Float[Tensor, "B K"],
        moved: Float[Tensor, "B K"],
        size: Float[Tensor, " B"],
        measured: Float[Tensor, " B"],
        dt: float,
    ) -> "AdaptedNoise":
        """Return the noise of motion after one more correction.

        Args:
            pulled: y. moved: d. size: y^T d. measured: share of the joints with a keypoint.
            dt: seconds of a frame.
        """
        mean = 0.5 * (size + self.size)
        rho = ((pulled * self.moved).sum(-1) / mean.clamp_min(1e-9)).clamp(-1.0, 1.0)
        factor = self.factor * torch.exp(rho * measured * (dt / _TIME))
        return AdaptedNoise(factor.clamp(*_FACTORS), moved, size)
