"""What trackers of hands take, and what they say of a frame."""

from typing import NamedTuple

from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.errors import check_finite, check_rgb, check_shape
from torchpose.measure.face import Image, check_faces

__all__ = ["HandMeasurements", "check_frame"]


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


def check_frame(frame: Image, faces: Float[Tensor, "N 3"], identity: Int[Tensor, " N"]) -> None:
    """Raise unless these are a frame, faces with a size, and who they are.

    Raises:
        ShapeError, InputError: see above.
    """
    check_rgb("frame", frame)
    check_finite("faces", faces, hint="leave out persons without a face")
    check_faces(faces)
    check_shape("identity", identity, [len(faces)])
