"""Exchange the legs of particles, for persons whose legs have been taken for each other."""

from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.body._kinematics import Body
from torchpose.body._skeleton import BodySkeleton
from torchpose.errors import InputError, SkeletonError
from torchpose.filters._recursive_filter import Generators, uniform
from torchpose.math._rotations import compose, conjugate

_LEG_PARTS = ("thigh", "shank")
_ROOT_COLUMNS = 3  # the position; the vectors of all parts follow


def leg_permutation(skeleton: BodySkeleton) -> Int[Tensor, " P"]:
    """Return the indices of the parts with those of the left and the right leg exchanged.

    Args:
        skeleton: with the parts left_thigh, left_shank, right_thigh and right_shank.

    Raises:
        SkeletonError: it lacks one of them.

    >>> from torchpose.body._skeleton import BODY_15
    >>> leg_permutation(BODY_15).tolist()
    [0, 1, 2, 3, 4, 9, 10, 7, 8, 5, 6]
    """
    order = torch.arange(len(skeleton.parts))
    for part in _LEG_PARTS:
        left, right = skeleton.part(f"left_{part}"), skeleton.part(f"right_{part}")
        order[left], order[right] = right, left
    return order


def leg_angle(body: Body, states: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch"]:
    """Return the angle between the upper legs, theta_legs, radians from 0 to pi.

    Args:
        states: of `body`, [..., D].
    """
    thighs = [body.skeleton.part(f"{side}_thigh") for side in ("left", "right")]
    bones = [_bone(body, thigh) for thigh in thighs]
    rotations = body.part_rotations(states)[..., thighs, :, :]
    left, right = (rotations @ torch.stack(bones).unsqueeze(-1)).squeeze(-1).unbind(-2)
    across = torch.linalg.cross(left, right).norm(dim=-1)
    return torch.atan2(across, (left * right).sum(-1))  # an arccos would be NaN beyond 1


def exchange_legs(body: Body, states: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch D"]:
    """Return states whose left leg is turned as the right one was, and the other way round.

    C_l R(q_l') = C_r R(q_r),   C_r R(q_r') = C_l R(q_l)

    Doing so twice changes nothing.
    """
    order = leg_permutation(body.skeleton).to(states.device)
    centres = body.centres.to(states)
    vectors = states[..., _ROOT_COLUMNS:].unflatten(-1, (-1, 3))
    moved = order != torch.arange(len(order), device=order.device)
    shift = compose(conjugate(centres[moved]), centres[order[moved]])
    exchanged = vectors.clone()
    exchanged[..., moved, :] = compose(shift, vectors[..., order[moved], :])
    return torch.cat([states[..., :_ROOT_COLUMNS], exchanged.flatten(-2)], -1)


def extra_copies(ancestors: Int[Tensor, "B N"]) -> Bool[Tensor, "B N"]:
    """Return which particles are further copies of an ancestor, after the first one.

    Args:
        ancestors: of the resampled particles, in any order.

    >>> extra_copies(torch.tensor([[2, 0, 2, 2, 3]])).tolist()
    [[False, False, True, True, False]]
    """
    ordered, place = ancestors.sort(dim=-1, stable=True)
    again = torch.zeros_like(ordered, dtype=torch.bool)
    again[..., 1:] = ordered[..., 1:] == ordered[..., :-1]
    return torch.zeros_like(again).scatter(-1, place, again)


def swap_legs(
    body: Any,
    particles: Float[Tensor, "B N D"],
    copies: Bool[Tensor, "B N"],
    rate: float,
    generator: Generators = None,
) -> tuple[Float[Tensor, "B N D"], Bool[Tensor, "B N"]]:
    """Exchange the legs of some extra copies of particles, the more often the wider they are apart.

    p(swap) = rate theta_legs / pi,   theta_legs the angle between the upper legs

    The first copy of every particle keeps its legs, and so does everything that was not resampled.

    Args:
        particles: [B, N, D], resampled. copies: those that may be swapped, see `extra_copies`.
        rate: probability for legs in opposite directions, 0 to 1.
        generator: as for `standard_normal`; nothing is drawn at a rate of 0.

    Returns:
        The particles, and which of them were swapped.

    Raises:
        InputError, SkeletonError: as `check_leg_swap`.

    Reference: Daubney & Xie, section 8: an extra copy of a particle is occasionally kept with the
    legs swapped, and the number of particles stays the same.
    """
    check_leg_swap(body, rate)
    if rate == 0:
        return particles, torch.zeros_like(copies)
    batch, n = particles.shape[:2]
    drawn = uniform(batch, (n,), generator, particles)
    swapped = copies & (drawn < rate * leg_angle(body, particles) / torch.pi)
    return torch.where(swapped[..., None], exchange_legs(body, particles), particles), swapped


def check_leg_swap(body: Any, rate: float) -> None:
    """Raise unless the legs of a body can be swapped at this rate.

    Raises:
        InputError: a rate that is not from 0 to 1. SkeletonError: a body without upper and lower legs.
    """
    if not 0 <= rate <= 1:
        raise InputError(f"leg_swap must be a probability, from 0 to 1, got {rate}")
    if rate == 0:
        return
    if not isinstance(body, Body):
        raise SkeletonError(
            f"leg_swap needs a torchpose.body.Body with two legs, got {type(body).__name__}; set "
            "leg_swap=0"
        )
    leg_permutation(body.skeleton)


def _bone(body: Body, part: int) -> Float[Tensor, "3"]:
    """Return the offset of the first joint that a part carries."""
    carried = [j for j, p in enumerate(body.skeleton.part_of) if p == part]
    if not carried:
        name = body.skeleton.parts[part]
        raise SkeletonError(f"part {name!r} carries no joint, so that it has no direction")
    return body.offsets[carried[0]]
