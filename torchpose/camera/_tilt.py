"""Turn the axes of a camera that looks up or down, or is rolled, into those of a level one.

With u the direction that points up, in camera axes, a level camera in the same place with the same heading
has the axes z = e_z - (e_z . u) u of length one, y = -u and x = y × z.
"""

import math
from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.camera._projection import homogeneous_pixels, pixel_rays, turn_homography
from torchpose.errors import CameraError

LARGEST_PITCH = math.radians(60.0)
"""Radians, beyond which a camera sees persons from above or below as no prior does."""

_LEVEL = 1e-9  # by which a direction may be off the one that points up in a level camera
# Between a ray and the optical axis of the level camera; beyond it has no pixel.
_LEAST_COSINE = 0.1


def up_of_angles(pitch: float, roll: float = 0.0) -> tuple[float, float, float]:
    """Return the direction that points up, in camera axes.

    u = (-sin r cos p, -cos r cos p, sin p)

    Args:
        pitch: the angle by which the camera looks up, radians.
        roll: the angle by which it is rolled clockwise, as one who stands behind it sees it, radians.
    """
    return (
        -math.sin(roll) * math.cos(pitch),
        -math.cos(roll) * math.cos(pitch),
        math.sin(pitch),
    )


def angles_of_up(up: Float[Tensor, "3"]) -> tuple[float, float]:
    """Return pitch and roll of a camera, radians; the inverse of `up_of_angles`.

    Args:
        up: the unit vector that points up, in camera axes.
    """
    x, y, z = up.double().tolist()
    return math.asin(max(-1.0, min(1.0, z))), math.atan2(-x, -y)


def unit_up(name: str, up: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Return a direction that points up with length one, and exactly level where it is level.

    Args:
        name: what it is of, for the message. up: the direction, of any length.

    Raises:
        CameraError: no direction, or a camera that looks up or down by more than 60 degrees.
    """
    length = up.norm()
    if not float(length) > 0:
        raise CameraError(f"{name} must be a direction, got {up.tolist()}")
    up = up / length
    pitch, _ = angles_of_up(up)
    if abs(pitch) > LARGEST_PITCH + 1e-9:
        way = "up" if pitch > 0 else "down"
        raise CameraError(
            f"{name} means that the camera looks {way} by {math.degrees(abs(pitch)):.0f} degrees; at most "
            f"{math.degrees(LARGEST_PITCH):.0f} are possible"
        )
    level = up.new_tensor([0.0, -1.0, 0.0])
    return level if float((up - level).norm()) < _LEVEL else up


def level_rotation(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Return the rotation from camera axes to those of the level camera with the same heading.

    Args:
        up: the unit vector that points up, in camera axes.
    """
    forward = torch.zeros_like(up)
    forward[2] = 1.0
    z = torch.nn.functional.normalize(forward - up[2] * up, dim=0)
    return torch.stack([torch.linalg.cross(-up, z), -up, z])


class Turn(NamedTuple):
    """Turn of pixels about the centre of a camera, as an image that is turned with it would have them.

    Attributes:
        rotation: R, from the axes of the camera to those of the turned one, [3, 3].
        homography: K R K^-1, [3, 3].
    """

    rotation: Tensor
    homography: Tensor

    @classmethod
    def to_level(cls, up: Float[Tensor, "3"], matrix: Float[Tensor, "3 3"]) -> Self:
        """Return the turn of a camera into a level one.

        Args:
            up: the unit vector that points up, in camera axes. matrix: K of both.
        """
        rotation = level_rotation(up.to(matrix))
        return cls(rotation, turn_homography(rotation, matrix))

    def back(self, matrix: Float[Tensor, "3 3"]) -> Self:
        """Return the inverse.

        Args:
            matrix: K of both.
        """
        return type(self)(self.rotation.mT, turn_homography(self.rotation.mT, matrix))

    def points(self, uv: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Return turned pixels; those beyond `visible` are far outside of the image."""
        seen = homogeneous_pixels(uv) @ self.homography.to(uv).mT
        return seen[..., :2] / _in_front(seen[..., 2:])

    def covariances(
        self, covariance: Float[Tensor, "*#batch 2 2"], uv: Float[Tensor, "*batch 2"]
    ) -> Float[Tensor, "*batch 2 2"]:
        """Return the covariances of turned pixels, J C J^T with the Jacobian J at these pixels.

        Args:
            covariance: C, pixels squared. uv: the pixels before the turn.
        """
        homography = self.homography.to(uv)
        seen = (homogeneous_pixels(uv) @ homography.mT)[..., None]
        depth = _in_front(seen[..., 2:, :])
        slopes = (homography[:2, :2] - seen[..., :2, :] / depth * homography[2, :2]) / depth
        return slopes @ covariance.to(uv) @ slopes.mT

    def lines(self, lines: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
        """Return half-planes of pixels, a (u, v) + b > 0, in turned pixels.

        Args:
            lines: (a, b).
        """
        return torch.linalg.solve(self.homography.to(lines).mT, lines.mT).mT

    def visible(
        self, uv: Float[Tensor, "*batch 2"], matrix: Float[Tensor, "3 3"]
    ) -> Bool[Tensor, "*batch"]:
        """Return whether pixels are seen by the turned camera, up to 84 degrees beside its axis.

        Args:
            uv: the pixels before the turn. matrix: K of both.
        """
        turned = pixel_rays(uv, matrix.to(uv)) @ self.rotation.to(uv).mT
        return turned[..., 2] > _LEAST_COSINE * turned.norm(dim=-1)


def _in_front(depth: Tensor) -> Tensor:
    return depth.clamp_min(1e-3)
