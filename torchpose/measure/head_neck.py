"""Head and neck, measured by where the face is (Burke & Lasenby, section 5)."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose.errors import InputError, check_shape

__all__ = ["FACE_OFFSETS", "FaceOffsets", "HeadNeck"]


class FaceOffsets(NamedTuple):
    """Head and neck below the centre of the face, in sizes B of the face's box.

    head = centre + B (0, a) + N(0, B^2 s_a^2),   neck = centre + B (0, b) + N(0, B^2 s_b^2)

    Attributes:
        head, neck: a and b. head_std, neck_std: (across, down), s_a and s_b.
    """

    head: float
    neck: float
    head_std: tuple[float, float]
    neck_std: tuple[float, float]


# Silhouettes of eight persons beside their Kinect skeletons put the head joint 0.47 of the way from
# the crown to the narrowest part of the neck, and the neck joint 0.89 of it further down; faces of
# three persons put crown and neck at -0.71 and 0.55 B. That gives a = -0.12 and b = 1.01. A webcam
# close by, which looks up, shortens the neck beside the arms: elbows of such persons come out best at
# (-0.4, 1.1). The values are between the two; benchmarks/face_offsets.py prints what they cost.
FACE_OFFSETS = FaceOffsets(-0.2, 1.1, (0.05, 0.08), (0.07, 0.12))


class HeadNeck(nn.Module):
    """Head and neck from the face, with covariances.

    Args:
        offsets: of the prior's head and neck from the centre of the box that the detector draws.

    Raises:
        InputError: standard deviations that are not positive.

    Reference:
        Burke & Lasenby, section 5.1: the face gives the head. Their sign-language tracker puts the
        neck 45 pixels below it.

    Example:
        >>> import torch
        >>> points, covariance = HeadNeck()(torch.tensor([[320.0, 100.0, 80.0]]))
        >>> points[0].tolist()
        [[320.0, 84.0], [320.0, 188.0]]
    """

    def __init__(self, offsets: FaceOffsets = FACE_OFFSETS) -> None:
        super().__init__()
        stds = (offsets.head_std, offsets.neck_std)
        if not all(std > 0 for pair in stds for std in pair):
            raise InputError(f"standard deviations of the offsets must be positive, got {stds}")
        down = torch.tensor([[0.0, offsets.head], [0.0, offsets.neck]], dtype=torch.float64)
        self.register_buffer("offset", down)
        self.register_buffer("std", torch.tensor(stds, dtype=torch.float64))

    offset: Tensor
    std: Tensor

    def forward(
        self, faces: Float[Tensor, "N 3"], face_cov: Float[Tensor, "N 3 3"] | None = None
    ) -> tuple[Float[Tensor, "N 2 2"], Float[Tensor, "N 2 2 2"]]:
        """Return the head and neck, in this order, and their covariances, pixels.

        Args:
            faces: centre (x, y) and size B, pixels. face_cov: how well these are known.
        """
        check_shape("faces", faces, ["N", 3])
        faces = faces.to(self.offset)
        centre, size = faces[:, None, :2], faces[:, None, 2:]
        cov = torch.diag_embed((size * self.std).square())
        if face_cov is not None:
            slope = torch.eye(2, 3).to(faces).repeat(2, 1, 1)
            slope[:, :, 2] = self.offset
            cov = cov + slope @ face_cov.to(faces)[:, None] @ slope.mT
        return centre + size * self.offset, cov
