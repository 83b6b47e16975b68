"""Expect people to be upright where it is known, at least roughly, which way is up."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose._core.checks import check_choice
from torchpose.body._articulation import Articulation, BodyPoint
from torchpose.camera._rig import CameraRig
from torchpose.whole_body._body_files import UP_AXES

# Of the upward direction in the axes of the pelvis, to the left and forward.
_MEAN, _STD = (0.0, -0.1), (0.08, 0.08)
_TILT = (0.1, 0.1)  # radians, of the roll and pitch of a camera
_ROLL, _PITCH = 0.05, 0.3  # the same of several cameras: tripods are level, lenses point down
_FREEDOM = 4.0  # degrees of freedom of a lean's t distribution, for people who bend


class Lean(NamedTuple):
    """Holds the gap [B, 2] between expected and actual lean, its variance, and its derivative [B, 2, N]."""

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

    def lean(self, articulation: Articulation, point: BodyPoint) -> Lean:
        """Return how far bodies are from the expected lean: a turn d changes R^T u by (R^T u) x d."""
        up = (point.rotations[..., 0, :, :].mT @ self.direction[:, None]).squeeze(-1)
        x, y, z = up.unbind(-1)
        o = torch.zeros_like(x)
        turned = torch.stack([torch.stack([o, -z, y], -1), torch.stack([-y, x, o], -1)], -2)
        jacobian = up.new_zeros(*up.shape[:-1], 2, articulation.dim)
        start = articulation.columns["rotations"].start
        jacobian[..., start : start + 3] = turned
        gap = self.mean - torch.stack([x, z], -1)
        far = (gap.square() / self.variance).sum(-1, keepdim=True)
        return Lean(gap, self.variance * (_FREEDOM + far) / (_FREEDOM + 2), jacobian)


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
