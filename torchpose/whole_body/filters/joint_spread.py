"""How far the joints of particles spread about those of an estimate."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body.kinematics import Body
from torchpose.errors import InputError, check_shape
from torchpose.math.gaussian import symmetrise
from torchpose.math.quaternion_vectors import quaternion_vector_to_matrix, within_unit_ball
from torchpose.math.unscented import sigma_points
from torchpose.whole_body.filters.body_particles import BodyFilterState

__all__ = ["joint_covariance", "joint_covariance_with_parts"]

_ROOT = 6  # columns of a state: position and orientation of the root


def joint_covariance(
    body: Body, state: BodyFilterState, mean: Float[Tensor, "B D"]
) -> Float[Tensor, "B J 3 3"]:
    """Second moment of the particles' joints about those of an estimate, metres squared."""
    away = body.joints(state.particles) - body.joints(mean)[:, None]
    weights = state.log_weights.exp().to(away)
    return torch.einsum("bn,bnji,bnjk->bjik", weights, away, away)


def joint_covariance_with_parts(
    body: Body,
    state: BodyFilterState,
    covariances: Float[Tensor, "B N V 3 3"],
    mean: Float[Tensor, "B D"],
) -> Float[Tensor, "B J 3 3"]:
    """The same where each particle has a Gaussian N(x_i; mu_i, Sigma_i) for each of its parts.

    With ``frame="body"`` a joint is a sum over the parts, p_j = p_r + sum_i R_r C_i R(x_i) o_ij, and
    the parts of a particle are independent of each other, so that with p^ of the estimate

        E[(p_j - p^_j)(p_j - p^_j)^T] = sum_n w_n (sum_i Cov[R_r C_i R(x_i) o_ij] + d_nj d_nj^T),
        d_nj = E[p_j | n] - p^_j.

    Mean and covariance of the rotations R(x_i) come from six sigma points each (`sigma_points`).

    Args:
        body: with ``frame="body"``. state: its particles [B, N, D] and their weights.
        covariances: Sigma of the V = P - 1 parts that are not the root, [B, N, V, 3, 3].
        mean: the estimate [B, D].

    Returns:
        [B, J, 3, 3], metres squared, symmetric.

    Raises:
        InputError: a body of another frame. ShapeError: another number of parts.
    """
    if body.frame != "body":
        raise InputError(
            "parts add up to joints only in rotations against the root; expected a body with "
            f"frame='body', got {body.frame!r}"
        )
    n_parts = len(body.skeleton.parts) - 1
    check_shape("covariances", covariances, ["B", "N", n_parts, 3, 3])
    particles = state.particles
    points = sigma_points(particles[..., _ROOT:].unflatten(-1, (-1, 3)), covariances)
    turns = quaternion_vector_to_matrix(within_unit_ball(points))  # [B, N, V, S, 3, 3]
    root = quaternion_vector_to_matrix(particles[..., None, 3:_ROOT])
    turns = (root @ body.centre_rotations[1:])[..., None, :, :] @ turns
    middle = turns.mean(3)
    expected = _joints(body, particles, torch.cat([root, middle], 2))
    away = expected - body.joints(mean)[:, None]
    weights = state.log_weights.exp().to(away)
    between = torch.einsum("bn,bnji,bnjk->bjik", weights, away, away)
    share = (weights / points.shape[-2]).sqrt()[..., None, None, None, None]
    spread = (share * (turns - middle[..., None, :, :])).transpose(1, 2).flatten(2, 3)
    rows = spread.flatten(-2)  # [B, V, N S, 9]
    of_parts = (rows.mT @ rows).unflatten(-1, (3, 3)).unflatten(2, (3, 3))
    offsets = body.joint_weights[3:].unflatten(0, (n_parts, 3))
    within = torch.einsum("bvxcyd,vcj,vdj->bjxy", of_parts, offsets, offsets)
    return symmetrise(between + within)


def _joints(
    body: Body, state: Float[Tensor, "*batch D"], rotations: Float[Tensor, "*batch P 3 3"]
) -> Float[Tensor, "*batch J 3"]:
    """Joints for matrices of the parts, which need be no rotations: joints are linear in them."""
    rows = rotations.transpose(-3, -2).flatten(-2)
    return (rows @ body.joint_weights).mT + state[..., None, :3]
