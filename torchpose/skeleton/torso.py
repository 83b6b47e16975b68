"""Poses in the axes of their own torso: what is left of a body when head, neck and shoulders are laid
on a fixed set of them by fixed-scale Procrustes.

It is what the 3D error compares (BL section 6), and what a person does apart from how they stand
towards the camera, so that estimates from different views and postures may be averaged in it.
"""

from jaxtyping import Float
from torch import Tensor

from torchpose.math.procrustes import procrustes

__all__ = ["ALIGN_JOINTS", "TORSO", "in_torso_axes", "onto_torso"]

ALIGN_JOINTS = (3, 4, 2, 5)
"""Head, neck and both shoulders of the 8-joint upper body: what the paper aligns (BL section 6)."""

TORSO = ((0.0, -0.20, 0.0), (0.0, -0.01, 0.0), (0.16, 0.10, 0.0), (-0.16, 0.10, 0.0))
"""Head, neck, left and right shoulder, metres: x to the person's left, y down, about their middle."""


def in_torso_axes(joints: Float[Tensor, "*batch 8 3"]) -> Float[Tensor, "*batch 8 3"]:
    """Return the eight joints, moved so that head, neck and shoulders lie on `TORSO` as well as they can.

    Args:
        joints: any axes, metres.
    """
    chosen = list(ALIGN_JOINTS)
    torso = joints.new_tensor(TORSO).expand(*joints.shape[:-2], -1, -1)
    motion = procrustes(joints[..., chosen, :], torso)
    return joints @ motion.rotation.mT + motion.translation[..., None, :]


def onto_torso(
    pose: Float[Tensor, "*batch 8 3"],
    covs: Float[Tensor, "*batch 8 3 3"],
    joints: Float[Tensor, "*batch 8 3"],
) -> tuple[Float[Tensor, "*batch 8 3"], Float[Tensor, "*batch 8 3 3"]]:
    """Return a pose with covariances, moved to where the head, neck and shoulders of another one are.

    Args:
        pose, covs: in the axes of the torso. joints: of which only head, neck and shoulders count.
    """
    chosen = list(ALIGN_JOINTS)
    motion = procrustes(pose[..., chosen, :], joints[..., chosen, :])
    moved = pose @ motion.rotation.mT + motion.translation[..., None, :]
    turn = motion.rotation[..., None, :, :]
    return moved, turn @ covs @ turn.mT
