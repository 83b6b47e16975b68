"""Mathematics without words of the domain: Gaussians, rotations, unscented transforms, EM."""

from torchpose._core.facade import set_up_facade
from torchpose.math.gaussian import (
    kalman_predict,
    kalman_update,
    log_prob,
    mixture_moments,
)
from torchpose.math.mixture_em import expectation_maximisation
from torchpose.math.quaternion_vectors import (
    compose,
    conjugate,
    matrix_to_quaternion_vector,
    mean_rotation,
    quaternion_vector_to_matrix,
)
from torchpose.math.rotation_gaussians import (
    angle_to_edge,
    fit_gaussian,
    gaussian_rotate,
    rotate_gaussian,
    safe_centre,
    turn_gaussian,
)
from torchpose.math.rotations import (
    euler_to_matrix,
    matrix_to_euler,
    rotvec_to_matrix,
)
from torchpose.math.unscented import (
    sigma_points,
    unscented_transform,
    unscented_update,
)

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
    "log_prob",
    "matrix_to_euler",
    "matrix_to_quaternion_vector",
    "mean_rotation",
    "mixture_moments",
    "quaternion_vector_to_matrix",
    "rotate_gaussian",
    "rotvec_to_matrix",
    "safe_centre",
    "sigma_points",
    "turn_gaussian",
    "unscented_transform",
    "unscented_update",
]

set_up_facade(__name__)
