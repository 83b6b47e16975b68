"""From the state of an arm, in the image plane, to joints in metres with covariances (BL 5)."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.camera.projection import backproject, lift
from torchpose.math.rotations import RotationOrder, euler_to_matrix
from torchpose.math.unscented import unscented_transform

__all__ = ["arm_in_body_frame", "arm_in_camera_frame", "join_arms", "pixel_covariances"]

_CHUNK = 4096  # states at a time: 43 sigma points of 21 numbers each make 30 MB


def arm_in_camera_frame(
    mean: Float[Tensor, "... 21"],
    cov: Float[Tensor, "... 21 21"],
    matrix: Float[Tensor, "3 3"],
) -> tuple[Float[Tensor, "... 5 3"], Float[Tensor, "... 5 3 3"]]:
    """Return the joints of an arm in camera axes, X = lambda K^-1 [u, v, 1], by unscented transform.

    Each joint depends on its own (u, v, lambda) alone, so seven sigma points do. The covariance is
    of where the joint is in space: it includes how far away the whole body is.

    Args:
        mean, cov: of the arm's state. matrix: K of the state's pixels.

    Returns:
        Mean [..., 5, 3] in metres and covariance [..., 5, 3, 3] of hand, elbow, shoulder, head, neck.
    """
    joints = mean[..., :15].unflatten(-1, (5, 3))
    blocks = cov[..., :15, :15].unflatten(-1, (5, 3)).unflatten(-3, (5, 3))
    own = blocks.diagonal(dim1=-4, dim2=-2).movedim(-1, -3)
    return _unscented(lambda points: backproject(points, matrix), joints, own)


def arm_in_body_frame(
    mean: Float[Tensor, "... 21"],
    cov: Float[Tensor, "... 21 21"],
    matrix: Float[Tensor, "3 3"],
    rotation_order: RotationOrder,
) -> tuple[Float[Tensor, "... 5 3"], Float[Tensor, "... 5 3 3"]]:
    """Return the joints of an arm in the frame of the body, (BL 5), by unscented transform over the state.

    X = [p1 p2 p3]^-1 (lambda [u, v, 1] - p4), P = K [R | t]: the camera's rotation and translation
    are part of the state, so their uncertainty is in the covariance, and what joints and camera have
    in common (the distance of the whole body, say) cancels.

    Args:
        mean, cov: of the arm's state. matrix: K. rotation_order: of roll, pitch and yaw.

    Returns:
        As `arm_in_camera_frame`, in the frame in which the prior's poses were recorded and centred.
    """

    def to_body(points: Tensor) -> Tensor:
        joints = points[..., :15].unflatten(-1, (5, 3))
        rotation = euler_to_matrix(points[..., 15:18], rotation_order)
        return lift(joints, matrix, rotation, points[..., 18:21]).flatten(-2)

    flat_mean, flat_cov = mean.reshape(-1, 21), cov.reshape(-1, 21, 21)
    parts = [
        _joint_blocks(*_unscented(to_body, m, c))
        for m, c in zip(flat_mean.split(_CHUNK), flat_cov.split(_CHUNK), strict=True)
    ]
    joints, covs = (torch.cat(values) for values in zip(*parts, strict=True))
    return joints.view(*mean.shape[:-1], 5, 3), covs.view(*mean.shape[:-1], 5, 3, 3)


def _unscented(
    function: Callable[[Tensor], Tensor], mean: Tensor, cov: Tensor
) -> tuple[Tensor, Tensor]:
    return unscented_transform(function, mean, cov, centre=True, directions="cholesky")


def _joint_blocks(mean: Tensor, cov: Tensor) -> tuple[Tensor, Tensor]:
    blocks = cov.unflatten(-1, (5, 3)).unflatten(-3, (5, 3))
    return mean.unflatten(-1, (5, 3)), blocks.diagonal(dim1=-4, dim2=-2).movedim(-1, -3)


def join_arms(left: Float[Tensor, "B T 5 *rest"], right: Float[Tensor, "B T 5 *rest"]) -> Tensor:
    """Return the eight joints from hand, elbow, shoulder, head and neck of either arm.

    Head and neck are averaged. For covariances the average bounds that of the averaged estimate
    whatever the two errors have in common: Cov((a + b) / 2) <= (Cov a + Cov b) / 2.
    """
    shared = (left[:, :, 3:] + right[:, :, 3:]) / 2
    return torch.cat([left[:, :, :3], shared, right[:, :, :3].flip(2)], 2)


def pixel_covariances(cov: Float[Tensor, "B T 21 21"]) -> Float[Tensor, "B T 5 2 2"]:
    """Return the covariances of (u, v) of the five joints of an arm, pixels squared."""
    blocks = cov[..., :15, :15].unflatten(-1, (5, 3)).unflatten(-3, (5, 3))
    return blocks.diagonal(dim1=-4, dim2=-2).movedim(-1, -3)[..., :2, :2]
