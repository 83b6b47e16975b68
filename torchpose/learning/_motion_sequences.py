"""Recorded motion of bodies, by sets of recordings, as what moves is fitted to it."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchpose._core.checks import check_rate
from torchpose.body._articulation import Articulation, BodyPoint
from torchpose.body._kinematics import Body
from torchpose.math._rotations import quaternion_vector_to_matrix

_GLITCHES = 0.005  # share of frames whose changes count no more than those of the others


class MotionSequence(NamedTuple):
    """Holds the motion of one person in one recording without gaps.

    Attributes:
        origin: the set that the recording is of. person: its id. fps: frames per second.
        point: [T], on the manifold of the articulation. residual: [T, S, 3], metres, of recorded joints of
            the trunk from where parts of the standard shape and the person's lengths have them, part axes.
            lengths: [J], metres, of the person's bones. known: [J], whether the set has the joint.
    """

    origin: str
    person: str
    fps: float
    point: BodyPoint
    residual: Tensor
    lengths: Tensor
    known: Tensor


def motion_sequence(
    articulation: Articulation,
    body: Body,
    states: Float[Tensor, "T D"],
    joints: Float[Tensor, "T J 3"],
    fps: float,
    person: str,
    origin: str | None = None,
) -> MotionSequence:
    """Return a recording as motion of an articulation.

    Args:
        articulation: whose centres the body has. body: of the person. states: fitted to the joints.
        joints: [T, J, 3], metres; NaN in all frames where the set lacks a joint. fps: of both.
        person: id, `origin#name`. origin: of the set that the recording is of; by default that in the id.
    """
    check_rate("fps", fps)
    n, shifted = len(states), list(articulation.shifted)
    point = BodyPoint(
        states[:, :3],
        quaternion_vector_to_matrix(states[:, 3:].unflatten(-1, (-1, 3))),
        states.new_zeros(n, articulation.n_pose),
        states.new_zeros(n, len(articulation.groups)),
        states.new_zeros(n, len(shifted), 3),
    )
    parents = [articulation.skeleton.parents[j] for j in shifted]
    carried = articulation.world_rotations(point)[:, articulation.part_of[shifted]]
    bones = (joints[:, shifted] - joints[:, parents]).to(states)
    standard = nn.functional.normalize(articulation.offsets[shifted], dim=-1)
    rigid = body.bone_lengths[shifted, None] * standard
    residual = (carried.mT @ bones[..., None]).squeeze(-1) - rigid
    known = joints.isfinite().all(-1).all(0)
    origin = person.partition("#")[0] if origin is None else origin
    return MotionSequence(origin, person, fps, point, residual, body.bone_lengths, known)


MotionSets = Mapping[str, list[MotionSequence]]


def by_origin(sequences: Sequence[MotionSequence]) -> dict[str, list[MotionSequence]]:
    sets: dict[str, list[MotionSequence]] = {}
    for sequence in sequences:
        sets.setdefault(sequence.origin, []).append(sequence)
    return sets


def known_joints(sequences: Sequence[MotionSequence]) -> Bool[Tensor, " J"]:
    return torch.stack([s.known for s in sequences]).all(0)


def known_columns(
    articulation: Articulation, sequences: Sequence[MotionSequence]
) -> Bool[Tensor, " V"]:
    """Return whether position and angles of a set are recorded: those of a part if its joints are."""
    unknown = articulation.part_of[~known_joints(sequences)]
    told = ~torch.isin(articulation.axis_part, unknown)
    return torch.cat([torch.ones(3, dtype=torch.bool), told])


def clipped(values: Sequence[Float[Tensor, "T V"]]) -> list[Tensor]:
    """Return values with the largest of every column no larger than nearly all others."""
    size = torch.cat(list(values)).abs()
    rank = max(1, math.ceil((1 - _GLITCHES) * len(size)))
    most = size.kthvalue(rank, 0).values
    return [value.clamp(-most, most) for value in values]
