"""What trackers of hands say of a frame."""

from typing import NamedTuple

from jaxtyping import Bool, Float
from torch import Tensor

__all__ = ["HandMeasurements"]


class HandMeasurements(NamedTuple):
    """Hands of N persons: left, right (the person's own), in pixels of the frame.

    Attributes:
        points: centres of the hands (x, y); NaN where there is nothing to say.
        covariance: of the points, pixels squared.
        mass: probability that the hand is there.
        seen: False where a hand is lost, to be taken as missing.
    """

    points: Float[Tensor, "N 2 2"]
    covariance: Float[Tensor, "N 2 2 2"]
    mass: Float[Tensor, "N 2"]
    seen: Bool[Tensor, "N 2"]
