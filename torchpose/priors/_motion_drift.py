"""How bodies accelerate on average by their pose and velocity: a linear function of both.

Who walks swings a leg back that is ahead, and goes on. With the angles x of all parts but the root, and the
velocities v, those of the position in the root's own axes, the mean acceleration beside -decay v is

    u = D (1, x, v),

so that a Kalman filter stays one of a linear process.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body._articulation import Articulation, BodyPoint
from torchpose.math._rotations import cross_matrix


class Drift(NamedTuple):
    """Holds mean accelerations [*batch, V], world axes, and their derivative [*batch, V, N]."""

    acceleration: Tensor
    jacobian: Tensor


def moving(
    articulation: Articulation, point: BodyPoint, velocity: Float[Tensor, "*batch V"]
) -> Float[Tensor, "*batch D"]:
    """Return (1, x, v), what mean accelerations are a linear function of.

    Args:
        articulation: of the bodies. point: poses. velocity: of position, in world axes, and angles.
    """
    own = (point.rotations[..., 0, :, :].mT @ velocity[..., :3, None]).squeeze(-1)
    one = torch.ones_like(velocity[..., :1])
    return torch.cat([one, articulation.relative_angles(point), own, velocity[..., 3:]], -1)


def drift_at(articulation: Articulation, drift: Float[Tensor, "V D"], point: BodyPoint) -> Drift:
    """Return the mean accelerations of bodies beside the decay of their velocities.

    A small turn d of the root changes v by [v]_x d, and accelerations R u by -R [u]_x d. Angles are taken to
    turn as their rotation vectors change.

    Args:
        articulation: of the bodies. drift: D. point: the bodies.
    """
    at, root = articulation.columns, point.rotations[..., 0, :, :]
    state = moving(articulation, point, point.velocity)
    n = state.shape[-1] - articulation.n_pose
    own = state @ drift.mT
    jacobian = own.new_zeros(*own.shape, articulation.dim)
    jacobian[..., articulation.relative_columns] = drift[:, 1:n]
    jacobian[..., at["velocity"]] = drift[:, n:]
    first = at["velocity"].start
    jacobian[..., first : first + 3] = drift[:, n : n + 3] @ root.mT
    turns = slice(at["rotations"].start, at["rotations"].start + 3)
    jacobian[..., turns] = drift[:, n : n + 3] @ cross_matrix(state[..., n : n + 3])
    jacobian[..., :3, turns] -= cross_matrix(own[..., :3])
    jacobian[..., :3, :] = root @ jacobian[..., :3, :]
    position = (root @ own[..., :3, None]).squeeze(-1)
    return Drift(torch.cat([position, own[..., 3:]], -1), jacobian)
