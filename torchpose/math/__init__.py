"""Compute with Gaussians, mixtures and rotations; nothing here is about poses."""

from torchpose._core.facade import set_up_facade
from torchpose.math._gaussian import kalman_predict, kalman_update
from torchpose.math._mixture_em import expectation_maximisation
from torchpose.math._rotation_gaussians import (
    angle_to_edge,
    fit_gaussian,
    gaussian_rotate,
    rotate_gaussian,
    safe_centre,
)
from torchpose.math._rotations import (
    compose,
    conjugate,
    euler_to_matrix,
    mean_rotation,
    quaternion_vector_to_matrix,
)
from torchpose.math._unscented import unscented_transform, unscented_update

__all__ = [
    "angle_to_edge",
    "compose",
    "conjugate",
    "euler_to_matrix",
    "expectation_maximisation",
    "fit_gaussian",
    "gaussian_rotate",
    "kalman_predict",
    "kalman_update",
    "mean_rotation",
    "quaternion_vector_to_matrix",
    "rotate_gaussian",
    "safe_centre",
    "unscented_transform",
    "unscented_update",
]

set_up_facade(__name__)
