"""Make and mirror states of one arm (D = 21): five projected joints, then their camera.

0:15 are (u, v, lambda) of hand, elbow, shoulder, head and neck, 15:18 roll, pitch and yaw, 18:21
tx, ty and tz: pixels, pixels, metres, radians, metres.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_finite, check_shape
from torchpose.camera._projection import lift, project
from torchpose.camera._viewpoints import Viewpoints
from torchpose.errors import InputError, PriorError
from torchpose.math._rotations import ROTATION_ORDERS, RotationOrder, euler_to_matrix
from torchpose.priors._gaussian_mixture import GaussianMixture
from torchpose.skeleton._upper_body import LEFT_ARM, RIGHT_ARM

STATE_DIM = 21
ANGLES = slice(15, 18)
_PIXELS_U = (0, 3, 6, 9, 12)
_NEGATED = (*_PIXELS_U, 15, 17, 18)  # u, roll, yaw, tx


def arm_state(
    points: Float[Tensor, "N 5 3"],
    views: Viewpoints,
    matrix: Float[Tensor, "3 3"],
    order: str = "zxy",
) -> Float[Tensor, "N 21"]:
    """Return states of one arm seen from random viewpoints (BL 3).

    Args:
        points: hand, elbow, shoulder, head, neck in body axes, metres.
        views: a camera pose for each.
        matrix: K, pixels.
        order: rotation order, "zxy" (paper) or "zyx" (released priors).

    Returns:
        States, in the dtype of the points.

    Raises:
        PriorError: unknown rotation order.
        InputError: a joint is behind the camera.
    """
    known_order = check_rotation_order(order)
    check_shape("points", points, (None, 5, 3))
    check_shape("views.angles", views.angles, (len(points), 3))
    own = Viewpoints(views.angles.to(points), views.translation.to(points))
    return turned_arm_state(points, own, euler_to_matrix(own.angles, known_order), matrix)


def turned_arm_state(
    points: Float[Tensor, "N 5 3"],
    views: Viewpoints,
    rotation: Float[Tensor, "N 3 3"],
    matrix: Float[Tensor, "3 3"],
) -> Float[Tensor, "N 21"]:
    """Return states as `arm_state` does, where the rotations of the angles are known.

    Args:
        points: as of `arm_state`. views: of the same dtype. rotation: of their angles. matrix: K, pixels.

    Raises:
        InputError: a joint is behind the camera.
    """
    uvl = project(points, matrix.to(points), rotation, views.translation)
    nearest = uvl[..., 2].min() if len(points) else points.new_ones(())
    if bool(nearest <= 0):
        raise InputError(
            f"all joints must be in front of the camera, got one at depth {float(nearest):.3g} m; "
            "choose views with a larger tz"
        )
    return torch.cat([uvl.flatten(1), *views], -1)


def arm_states(
    joints: Float[Tensor, "N 8 3"],
    views: Viewpoints,
    matrix: Float[Tensor, "3 3"],
    order: str = "zxy",
) -> tuple[Float[Tensor, "N 21"], Float[Tensor, "N 21"]]:
    """Return states of the left and the right arm of poses, both seen from the same viewpoints (BL 3).

    Args:
        joints: poses in the order of `UPPER_BODY`, body axes, metres.
        views: a camera pose for each.
        matrix: K, pixels.
        order: rotation order, "zxy" (paper) or "zyx" (released priors).

    Returns:
        Left and right states.

    Raises:
        ShapeError, InputError: not [N, 8, 3], joints that are missing or behind the camera.
        PriorError: unknown rotation order.
    """
    check_shape("joints", joints, (None, 8, 3))
    check_finite("joints", joints, hint="drop poses with missing joints")
    left, right = joints[:, list(LEFT_ARM)], joints[:, list(RIGHT_ARM)]
    return arm_state(left, views, matrix, order), arm_state(right, views, matrix, order)


def arm_in_body_axes(
    state: Float[Tensor, "*batch D"], matrix: Float[Tensor, "3 3"], order: RotationOrder
) -> Float[Tensor, "*batch 5 3"]:
    """Return the joints of an arm in the axes of the body (BL 5)."""
    rotation = euler_to_matrix(state[..., 15:18], order)
    joints = state[..., :15].unflatten(-1, (5, 3))
    return lift(joints, matrix.to(state), rotation, state[..., 18:21])


def mirror_arm_state(state: Float[Tensor, "*batch 21"], cx: float) -> Float[Tensor, "*batch 21"]:
    """Return the other arm's state in the mirror image: u -> 2 cx - u, roll, yaw and tx change sign.

    With M = diag(-1, 1, 1) a mirrored body M X is seen by the rotation M R M, which has the
    opposite roll and yaw in either rotation order. The map is its own inverse.

    Args:
        state: arm states.
        cx: principal point, pixels; the camera must have no skew.

    >>> mirror_arm_state(torch.arange(21.0), cx=10.0)[:4]
    tensor([20.,  1.,  2., 17.])
    """
    check_shape("state", state, ("...", STATE_DIM))
    sign, shift = _mirror_map(state, cx)
    return state * sign + shift


def mirror_mixture(mixture: GaussianMixture, cx: float) -> GaussianMixture:
    """Return the mixture over the states of the other arm; gradients flow through it.

    Args:
        mixture: over states of one arm.
        cx: principal point, pixels.
    """
    means, covariances = mirror_arm_state(mixture.means, cx), mirror_covariance(mixture.covariances)
    return GaussianMixture(mixture.weights, means, covariances)


def mirror_covariance(cov: Float[Tensor, "*batch 21 21"]) -> Float[Tensor, "*batch 21 21"]:
    """Return the covariance of the mirrored state (`mirror_arm_state`), M C M with M = diag(+-1)."""
    sign, _ = _mirror_map(cov, 0.0)
    return cov * sign * sign[:, None]


def check_rotation_order(order: str) -> RotationOrder:
    """Return the rotation order, or raise `PriorError` if it is not known."""
    for known in ROTATION_ORDERS:
        if order == known:
            return known
    raise PriorError(f"rotation order must be one of {', '.join(ROTATION_ORDERS)}, got {order!r}")


def _mirror_map(like: Tensor, cx: float) -> tuple[Tensor, Tensor]:
    sign, shift = like.new_ones(STATE_DIM), like.new_zeros(STATE_DIM)
    sign[list(_NEGATED)] = -1.0
    shift[list(_PIXELS_U)] = 2.0 * cx
    return sign, shift
