"""Hold frames as rays, in axes that are rolled with the torso, and the state between two frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._arm_chain import ArmState
from torchpose.upper_body._body_lengths import Lengths
from torchpose.upper_body._face_points import FacePoints
from torchpose.upper_body._lean import rolled
from torchpose.upper_body._measured_joints import MeasuredJoints
from torchpose.upper_body._torso_likelihood import Torso, see_torso

__all__ = ["ArticulatedState", "RayFrame", "UprightFrame", "frames_as_rays", "with_middle"]

_NECK = UPPER_BODY.index("neck")


class ArticulatedState(NamedTuple):
    """State of `ArticulatedFilter` between two frames.

    Attributes:
        root: the belief over size, depth and turn of the torso, [B, S, Z, P].
        lengths: the belief over the lengths of the bones.
        arms: the belief over the arms; None before the first frame.
        middle: the middle of the shoulders, camera axes, [B, 3]; on the optical axis before any of the
            torso was seen.
        lean: the moments of the line between the shoulders (`seen_lean`), [B, 2].
        frame: the number of frames before.
    """

    root: Tensor
    lengths: Lengths
    arms: ArmState | None
    middle: Tensor
    lean: Tensor
    frame: int


class RayFrame(NamedTuple):
    """Measurements of one frame as rays.

    Attributes:
        rays: K^-1 [u, v, 1] of the eight joints, [B, 8, 3]. known: whether each is measured, [B, 8].
        std: the standard deviation of a pixel over the focal length, [B, 8].
        exact: whether every keypoint has full confidence, [B].
        face: the rays of nose, eyes and ears; None if there are none.
    """

    rays: Tensor
    known: Tensor
    std: Tensor
    exact: Tensor
    face: FacePoints | None

    def upright(self, lean: Float[Tensor, " B"]) -> UprightFrame:
        """Return the frame in tilted axes, of a camera that is rolled by the lean of the torso."""
        rays, face = rolled(self.rays, -lean), self.face
        if face is not None:
            face = face._replace(places=rolled(face.places, -lean))
        torso = see_torso(rays, self.known, self.std)
        return UprightFrame(rays, self.known, self.std, self.exact, face, torso)


class UprightFrame(NamedTuple):
    """One frame in axes in which the torso is upright: as `RayFrame`, and the rays of the torso."""

    rays: Tensor
    known: Tensor
    std: Tensor
    exact: Tensor
    face: FacePoints | None
    torso: Torso


def frames_as_rays(measured: MeasuredJoints, matrix: Float[Tensor, "3 3"]) -> list[RayFrame]:
    """Return the measurements of each of T frames as rays.

    Args:
        measured: the measurements, [B, T, ...]. matrix: K of the prior's camera.
    """
    focal = (matrix[0, 0] * matrix[1, 1]).sqrt()
    uv = measured.uv
    ones = torch.ones_like(uv[..., :1])
    rays = torch.cat([uv, ones], -1) @ torch.linalg.inv(matrix).mT
    variance = measured.cov.diagonal(dim1=-2, dim2=-1).mean(-1)
    std = (variance.sqrt() / focal).expand(uv.shape[:3])
    sure = measured.confidence
    exact = measured.mask.any(-1) if sure is None else (sure >= 1).all(-1)
    parts = zip(
        rays.unbind(1), measured.mask.unbind(1), std.unbind(1), exact.unbind(1), strict=True
    )
    faces = _faces_as_rays(measured, matrix)
    return [RayFrame(*part, face) for part, face in zip(parts, faces, strict=True)]


def _faces_as_rays(
    measured: MeasuredJoints, matrix: Float[Tensor, "3 3"]
) -> Sequence[FacePoints | None]:
    """Return nose, eyes and ears in each frame as rays."""
    face = measured.face
    if face is None:
        return [None] * measured.uv.shape[1]
    focal, centre = matrix.diagonal()[:2], matrix[:2, 2]
    places = (face.places - centre) / focal
    parts = zip(places.unbind(1), face.confidence.unbind(1), strict=True)
    return [FacePoints(*part, face.expected) for part in parts]


def with_middle(measured: MeasuredJoints) -> MeasuredJoints:
    """Return the joints with the middle of the shoulders, as it was measured, in place of the neck."""
    middle = measured.middle
    if middle is None:
        return measured
    uv, mask, cov = (x.clone() for x in measured[:3])
    uv[..., _NECK, :], mask[..., _NECK] = middle.uv, middle.mask & mask[..., _NECK]
    cov[..., _NECK, :, :] = middle.cov
    return measured._replace(uv=uv, mask=mask, cov=cov)
