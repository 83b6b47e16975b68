"""Expect people to be upright where it is known, at least roughly, which way is up."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_choice
from torchpose.body._articulation import Articulation, BodyPoint
from torchpose.body._skeleton import BODY_15
from torchpose.camera._rig import CameraRig
from torchpose.whole_body._body_files import UP_AXES

# Of the upward direction in the axes of the pelvis, to the left and forward. Trunks, from the middle of the
# hips to that of the shoulders, have the same deviations about no lean.
_MEAN, _STD = (0.0, -0.1), (0.08, 0.08)
_TILT = (0.1, 0.1)  # radians, of the roll and pitch of a camera
_ROLL, _PITCH = 0.05, 0.3  # the same of several cameras: tripods are level, lenses point down
_FREEDOM = 4.0  # degrees of freedom of a lean's t distribution, for people who bend

_SHOULDERS = [BODY_15.joint("left_shoulder"), BODY_15.joint("right_shoulder")]
_HIPS = [BODY_15.joint("left_hip"), BODY_15.joint("right_hip")]
LEGS = [BODY_15.joint(f"{side}_{n}") for n in ("knee", "ankle") for side in ("left", "right")]
"""Joints of `Upright.legs`."""
# From the middle of the hips to the left, up and ahead, in lengths of a leg. Means of positions, which are
# nearer than where a straight leg ends.
_USUAL = ((0.11, -0.43, 0.11), (-0.11, -0.43, 0.11), (0.11, -0.90, 0.0), (-0.11, -0.90, 0.0))
_USUAL_STD = ((0.07, 0.08, 0.15),) * 2 + ((0.10, 0.10, 0.25),) * 2


class Expected(NamedTuple):
    """Holds gaps [B, K] between expected and actual values, their variances, and derivatives [B, K, N]."""

    gap: Tensor
    variance: Tensor
    jacobian: Tensor


class Upright(NamedTuple):
    """Holds the direction that is up [3], world axes, and mean and squared scale [2] of a pelvis' lean.

    The lean is the upward direction in the axes of the pelvis, to its left and forward, R^T u. It has a t
    distribution, so that somebody who bends is expected upright with less force:

        variance = s^2 (f + sum_i gap_i^2 / s_i^2) / (f + 2).
    """

    direction: Tensor
    mean: Tensor
    variance: Tensor

    def lean(self, articulation: Articulation, point: BodyPoint) -> Expected:
        """Return how far bodies are from the expected lean: a turn d changes R^T u by (R^T u) x d."""
        up = (point.rotations[..., 0, :, :].mT @ self.direction[:, None]).squeeze(-1)
        x, y, z = up.unbind(-1)
        o = torch.zeros_like(x)
        turned = torch.stack([torch.stack([o, -z, y], -1), torch.stack([-y, x, o], -1)], -2)
        jacobian = up.new_zeros(*up.shape[:-1], 2, articulation.dim)
        start = articulation.columns["rotations"].start
        jacobian[..., start : start + 3] = turned
        gap = self.mean - torch.stack([x, z], -1)
        return Expected(gap, _variance_of(gap, self.variance), jacobian)

    def trunk_lean(self, articulation: Articulation, point: BodyPoint) -> Expected:
        """Return how far trunks, from the middle of the hips to that of the shoulders, are from upright.

        The derivative is that of turns: lengths of trunks, and axes of shoulders, are taken as they are.
        """
        joints, moved = articulation.linearise(point)
        axes = axes_of(joints, self.direction)[..., [0, 2], :]
        trunk = (joints[..., _SHOULDERS, :] - joints[..., _HIPS, :]).mean(-2)
        length = trunk.norm(dim=-1)[..., None]
        turned = (moved[..., _SHOULDERS, :, :] - moved[..., _HIPS, :, :]).mean(-3)
        gap = -(axes @ trunk[..., None]).squeeze(-1) / length
        return Expected(gap, _variance_of(gap, self.variance), axes @ turned / length[..., None])

    def legs(self, articulation: Articulation, point: BodyPoint) -> Expected:
        """Return how far knees and ankles are from where they are on average, [B, 12]; see `LEGS`."""
        joints, moved = articulation.linearise(point)
        axes = axes_of(joints, self.direction)
        hips = joints[..., _HIPS, :].mean(-2, keepdim=True)
        below = (joints[..., LEGS, :] - hips) @ axes.mT
        turned = moved[..., LEGS, :, :] - moved[..., _HIPS, :, :].mean(-3, keepdim=True)
        length = articulation.bones(point).norm(dim=-1)[..., LEGS].sum(-1)[..., None, None] / 2
        mean, std = (length * torch.tensor(values).to(length) for values in (_USUAL, _USUAL_STD))
        jacobian = axes[..., None, :, :] @ turned
        return Expected(
            (mean - below).flatten(-2), std.square().flatten(-2), jacobian.flatten(-3, -2)
        )


def axes_of(
    joints: Float[Tensor, "*batch J 3"], up: Float[Tensor, "3"]
) -> Float[Tensor, "*batch 3 3"]:
    """Return the directions to the left of the shoulders, up, and ahead, world axes."""
    across = joints[..., _SHOULDERS[0], :] - joints[..., _SHOULDERS[1], :]
    left = torch.nn.functional.normalize(across - (across @ up)[..., None] * up, dim=-1)
    up = up.expand_as(left)
    return torch.stack([left, up, torch.linalg.cross(left, up)], -2)


def _variance_of(gap: Float[Tensor, "*batch 2"], variance: Tensor) -> Float[Tensor, "*batch 2"]:
    """Return the variance with which a gap counts, that of a t distribution; see `Upright`."""
    far = (gap.square() / variance).sum(-1, keepdim=True)
    return variance * (_FREEDOM + far) / (_FREEDOM + 2)


def upright_of(rig: CameraRig, up: str | None) -> Upright | None:
    """Return what is expected of leans, None of several cameras where no axis is known to point up.

    Raises:
        InputError: an axis other than "y" and "z".
    """
    if up is not None:
        return known_up(rig, up)
    return camera_up(rig) if len(rig) == 1 else None


def camera_up(rig: CameraRig) -> Upright:
    """Return what is expected where the first camera is about level, which is all that is known."""
    direction = -rig.rotation[0, 1]
    std, tilt = (torch.tensor(values).to(direction) for values in (_STD, _TILT))
    return Upright(direction, torch.tensor(_MEAN).to(direction), std.square() + tilt.square())


def level_cameras_up(rig: CameraRig) -> Upright:
    """Return what is expected where several cameras are level, and roll less than they point up or down.

    The direction u has the least sum of (x_c . u)^2 / roll^2 + (z_c . u)^2 / pitch^2, with the axes of
    cameras to the right and ahead: cameras that look at a person from one side all point down to the other.
    """
    axes = torch.cat([rig.rotation[:, 0] / _ROLL, rig.rotation[:, 2] / _PITCH])
    direction = torch.linalg.eigh(axes.mT @ axes).eigenvectors[:, 0]
    above = -(rig.rotation[:, 1] @ direction).mean()
    return camera_up(rig)._replace(direction=torch.where(above < 0, -direction, direction))


def known_up(rig: CameraRig, up: str) -> Upright:
    """Return what is expected where an axis of the world is known to point up.

    Raises:
        InputError: an axis other than "y" and "z".
    """
    check_choice("up", up, UP_AXES)
    direction = torch.eye(3).to(rig.translation)["xyz".index(up)]
    mean, std = (torch.tensor(values).to(direction) for values in (_MEAN, _STD))
    return Upright(direction, mean, std.square())
