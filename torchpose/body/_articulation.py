"""Compute joints of an articulated body and how they move with every number of its state.

The state of the Kalman filter is a point on a manifold, `BodyPoint`; errors and covariances live in its
tangent space. In the order of the tangent's columns, N of them:

    position     3         root, metres, world axes
    rotations    R         radians about the axes of every part, each in the part's own axes
    velocities   3 + R     of these, per second
    scales       G         logarithms of bone lengths over the standard ones, left and right together
    shifts       3 S       of the joints that rigid parts carry (neck, shoulders, hips), metres, part axes

Pelvis and torso have three axes. Limbs and head have the two across their bone: nothing measures their twist,
which is zero about the part's centre (`Body`).
"""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose.body._kinematics import Body
from torchpose.body._limbs import chained, level_plan
from torchpose.body._skeleton import BODY_15, BodySkeleton, other_side
from torchpose.math._rotations import (
    cross_matrix,
    exponential,
    matrix_to_rotvec,
    minimal_rotation,
    quaternion_vector_to_matrix,
)

# Where the bone of a limb points at its centre, in the axes of the part above: opposite to where no
# bone can point, since a swing by half a turn has no single axis. x left, y up, z forward.
_CENTRES = {
    "head": (0.0, 1.0, 0.0),
    "left_upper_arm": (0.5, -0.5, 0.7),
    "right_upper_arm": (-0.5, -0.5, 0.7),
    "left_forearm": (0.0, -0.5, 0.8),
    "right_forearm": (0.0, -0.5, 0.8),
    "left_thigh": (0.2, -1.0, 0.6),
    "right_thigh": (-0.2, -1.0, 0.6),
    "left_shank": (0.0, -1.0, -0.8),
    "right_shank": (0.0, -1.0, -0.8),
}

_HEIGHT = 1.75  # metres, of the standard body whose lengths the scales are relative to


class BodyPoint(NamedTuple):
    """Holds points on the manifold of body states.

    Attributes:
        position: [..., 3], metres. rotations: [..., P, 3, 3], the root's to world axes, the others' relative
            to their centre and the part above. velocity: [..., 3 + R]. scales: [..., G]. shifts: [..., S, 3].
    """

    position: Tensor
    rotations: Tensor
    velocity: Tensor
    scales: Tensor
    shifts: Tensor

    def map(self, change: Callable[[Tensor], Tensor]) -> "BodyPoint":
        """Return the point with a function applied to every tensor."""
        return BodyPoint(*(change(value) for value in self))


class JointJacobian(NamedTuple):
    """Holds joints [..., J, 3], metres, world axes, and their derivative [..., J, 3, N] by the tangent."""

    joints: Tensor
    jacobian: Tensor


class Articulation(nn.Module):
    """Computes joints and their derivatives for bodies of `BODY_15`, whose lengths are part of the state."""

    offsets: Tensor
    path: Tensor
    group: Tensor
    part_of: Tensor
    axis_part: Tensor
    axis: Tensor
    generators: Tensor
    pivot: Tensor
    moves: Tensor
    centres: Tensor
    carriers: Tensor
    in_group: Tensor
    axis_row: Tensor
    shifted_index: Tensor
    path_of_shifts: Tensor
    path_by_group: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.skeleton = skeleton = BODY_15
        standard = Body.of_height(skeleton, _HEIGHT)
        names = [name.removeprefix("left_").removeprefix("right_") for name in skeleton.names]
        groups = list(dict.fromkeys(names[1:]))
        self.groups = tuple(groups)
        parts, parents = torch.tensor(skeleton.part_of), skeleton.part_parents
        limbs = [skeleton.part_of.count(p) == 1 for p in range(len(skeleton.parts))]
        self.shifted = tuple(j for j, p in enumerate(skeleton.part_of) if j and not limbs[p])
        axes = [(p, a) for p, limb in enumerate(limbs) for a in ((0, 2) if limb else (0, 1, 2))]
        self.n_rotations, self.n_pose = len(axes), 3 + len(axes)
        self.n_root = sum(part == 0 for part, _ in axes)
        self.limb_parts = tuple(p for p, limb in enumerate(limbs) if limb)
        self.dim = 2 * self.n_pose + len(groups) + 3 * len(self.shifted)
        path = _paths(skeleton.parents)
        above = _paths(parents)
        moved = above[:, parts]  # [P, J], whether the rotation of a part moves a joint
        buffers = {
            "offsets": standard.offsets,
            "path": path.double(),
            "group": torch.tensor([0] + [groups.index(n) for n in names[1:]]),
            "part_of": parts,
            "axis_part": torch.tensor([p for p, _ in axes]),
            "axis": torch.tensor([a for _, a in axes]),
            "generators": _generators(axes, len(skeleton.parts)),
            "pivot": torch.tensor([_pivot(skeleton, p) for p, _ in axes]),
            "moves": moved[[p for p, _ in axes]].double(),
            "centres": _centre_rotations(skeleton),
            "axis_row": torch.tensor([3 * p + a for p, a in axes]),
            "shifted_index": torch.tensor(self.shifted),
            "path_of_shifts": path[list(self.shifted)].mT[:, None, :, None].double(),
        }
        plan = {**level_plan(skeleton), **self._limb_plan()}
        buffers |= {name: torch.tensor(index, dtype=torch.long) for name, index in plan.items()}
        for name, value in buffers.items():
            value = value.double() if value.is_floating_point() else value
            self.register_buffer(name, value, persistent=False)
        self.register_buffer("carriers", self._carriers().double(), persistent=False)
        in_group = torch.nn.functional.one_hot(self.group, len(groups)).double()
        in_group[0] = 0
        self.register_buffer("in_group", in_group, persistent=False)
        by_group = torch.einsum("bn,bg->ngb", self.path, in_group).flatten(0, 1)
        self.register_buffer("path_by_group", by_group, persistent=False)

    @cached_property
    def columns(self) -> dict[str, slice]:
        """Return which columns of the tangent hold what."""
        sizes = {
            "position": 3,
            "rotations": self.n_rotations,
            "velocity": self.n_pose,
            "scales": len(self.groups),
            "shifts": 3 * len(self.shifted),
        }
        slices, start = {}, 0
        for name, size in sizes.items():
            slices[name] = slice(start, start + size)
            start += size
        return slices

    @property
    def relative_columns(self) -> slice:
        """Return the columns of the angles of all parts but the root."""
        rotations = self.columns["rotations"]
        return slice(rotations.start + self.n_root, rotations.stop)

    def relative_angles(self, point: BodyPoint) -> Float[Tensor, "*batch Q"]:
        """Return rotation vectors of all parts but the root about their centres, on their axes, radians."""
        turns = matrix_to_rotvec(point.rotations)
        return turns[..., self.axis_part[self.n_root :], self.axis[self.n_root :]]

    def scales_of(self, lengths: Float[Tensor, "*batch J"]) -> Float[Tensor, "*batch G"]:
        """Return the logarithms of bone lengths over the standard ones, both sides averaged."""
        logs = (lengths[..., 1:] / self.offsets[1:].norm(dim=-1)).log()
        members = self.in_group[1:]
        return (logs @ members) / members.sum(0)

    def _limb_plan(self) -> dict[str, list[int]]:
        """Return per level its limbs, their places in the level, and both joints of their bones."""
        plan, skeleton = {}, self.skeleton
        for depth, level in enumerate(skeleton.part_levels):
            limbs = [part for part in level if part in self.limb_parts]
            ends = [skeleton.part_of.index(part) for part in limbs]
            plan[f"_limbs_{depth}"] = limbs
            plan[f"_in_level_{depth}"] = [level.index(part) for part in limbs]
            plan[f"_ends_{depth}"] = ends
            plan[f"_starts_{depth}"] = [skeleton.parents[end] for end in ends]
        return plan

    def _carriers(self) -> Float[Tensor, "J N"]:
        """Return which columns directly move a joint: angles and shift of its bone, and their velocity."""
        n, at = len(self.skeleton.names), self.columns
        carriers = torch.zeros(n, self.dim)
        turned = (self.part_of[:, None] == self.axis_part).float()
        carriers[:, at["rotations"]] = turned
        carriers[:, at["velocity"]][:, 3:] = turned
        carriers[0, :3] = carriers[0, at["velocity"]][:3] = 1
        for k, j in enumerate(self.shifted):
            carriers[j, at["shifts"].start + 3 * k : at["shifts"].start + 3 * k + 3] = 1
        return carriers

    # --- the manifold -----------------------------------------------------------------------------

    def moved(self, point: BodyPoint, step: Float[Tensor, "*batch N"]) -> BodyPoint:
        """Return the point that a step in the tangent space leads to."""
        sizes = [columns.stop - columns.start for columns in self.columns.values()]
        position, rotations, velocity, scales, shifts = step.split(sizes, -1)
        return BodyPoint(
            point.position + position,
            point.rotations @ self._turns(rotations),
            point.velocity + velocity,
            point.scales + scales,
            point.shifts + shifts.unflatten(-1, (-1, 3)),
        )

    def difference(self, a: BodyPoint, b: BodyPoint) -> Float[Tensor, "*batch N"]:
        """Return the step that leads from b to a, to first order where both axes of a limb turn."""
        turns = matrix_to_rotvec(b.rotations.mT @ a.rotations)
        return torch.cat(
            [
                a.position - b.position,
                turns[..., self.axis_part, self.axis],
                a.velocity - b.velocity,
                a.scales - b.scales,
                (a.shifts - b.shifts).flatten(-2),
            ],
            -1,
        )

    def swung(
        self,
        point: BodyPoint,
        joints: Float[Tensor, "B J 3"],
        known: Bool[Tensor, "B J"] | None = None,
    ) -> BodyPoint:
        """Return points with limbs swung to bones that are known, without twist about their centres.

        Args:
            point: [B]. joints: metres, world axes.
            known: whether a joint is known; a limb from a joint that is not begins where the point has it,
                and one to such a joint stays as it is. None: all are.
        """
        if known is not None:
            joints = torch.where(known[..., None], joints, self.joints(point))
        rotations = point.rotations
        world = self.centres[:1] @ rotations[:, :1]
        for depth in range(1, len(self.skeleton.part_levels)):
            parts, above = self._level(depth, "parts"), self._level(depth, "above")
            frames = world.index_select(1, above) @ self.centres.index_select(0, parts)
            turns = rotations.index_select(1, parts)
            limbs, places, ends, starts = (
                self._level(depth, name) for name in ("limbs", "in_level", "ends", "starts")
            )
            if len(limbs):
                bones = joints.index_select(1, ends) - joints.index_select(1, starts)
                seen = (frames.index_select(1, places).mT @ bones[..., None]).squeeze(-1)
                swing = quaternion_vector_to_matrix(
                    minimal_rotation(self.offsets.index_select(0, ends).expand_as(seen), seen)
                )
                if known is not None:
                    before = turns.index_select(1, places)
                    swing = torch.where(known[:, ends, None, None], swing, before)
                turns = turns.index_copy(1, places, swing)
                rotations = rotations.index_copy(1, limbs, swing)
            world = frames @ turns
        return point._replace(rotations=rotations)

    def _level(self, depth: int, name: str) -> Int[Tensor, " N"]:
        """Return indices of a level of parts; see `level_plan` and `_limb_plan`."""
        return self.get_buffer(f"_{name}_{depth}")

    def _turns(self, angles: Tensor) -> Tensor:
        """Return rotation matrices [..., P, 3, 3] of the parts' turns by angles [..., R]."""
        skew = angles @ self.generators
        return exponential(skew.unflatten(-1, (-1, 3, 3)))

    # --- joints -----------------------------------------------------------------------------------

    def world_rotations(self, point: BodyPoint) -> Float[Tensor, "*batch P 3 3"]:
        """Return the rotation of every part, from part axes to world axes."""
        turns = self.centres @ point.rotations
        return chained(self, turns, len(self.skeleton.part_levels))

    def bones(self, point: BodyPoint) -> Float[Tensor, "*batch J 3"]:
        """Return the bones from each joint's parent to it in the axes of the part that carries it."""
        shifts = point.shifts.new_zeros(*point.shifts.shape[:-2], len(self.offsets), 3)
        return self._scaled(point) + shifts.index_copy(-2, self.shifted_index, point.shifts)

    def _scaled(self, point: BodyPoint) -> Float[Tensor, "*batch J 3"]:
        """Return the bones of a person's lengths, without shifts."""
        return self.offsets * point.scales.index_select(-1, self.group).exp()[..., None]

    def joints(self, point: BodyPoint) -> Float[Tensor, "*batch J 3"]:
        """Return the positions of all joints, metres, world axes."""
        rotations = self.world_rotations(point).index_select(-3, self.part_of)
        bones = (rotations @ self.bones(point)[..., None]).squeeze(-1)
        return point.position[..., None, :] + self.path.mT @ bones

    def linearise(self, point: BodyPoint) -> JointJacobian:
        """Return joints and their derivative by the tangent.

        A turn of a part by a small angle about its own axis a moves the joints beyond its pivot by
        (R a) x (p - p_pivot); a bone's scale and shift move its joint and all beyond it.
        """
        rotations = self.world_rotations(point)
        carried = rotations.index_select(-3, self.part_of)
        bones = (carried @ self.bones(point)[..., None]).squeeze(-1)
        joints = point.position[..., None, :] + self.path.mT @ bones
        axes = rotations.mT.flatten(-3, -2).index_select(-2, self.axis_row)
        levers = joints[..., None, :, :] - joints.index_select(-2, self.pivot)[..., None, :]
        turned = torch.linalg.cross(axes[..., None, :].expand_as(levers), levers)
        turned = turned * self.moves[..., None]  # [..., R, J, 3]
        scaled = (carried @ self._scaled(point)[..., None]).squeeze(-1)
        n_scales = len(self.groups)
        by_scale = (self.path_by_group @ scaled).unflatten(-2, (-1, n_scales)).mT
        turned_shifts = carried.index_select(-3, self.shifted_index).transpose(-3, -2)
        by_shift = self.path_of_shifts * turned_shifts[..., None, :, :, :]
        lead = joints.shape[:-2]
        n = joints.shape[-2]
        eye = torch.eye(3, dtype=joints.dtype, device=joints.device).expand(*lead, n, 3, 3)
        none = joints.new_zeros(*lead, n, 3, self.n_pose)
        jacobian = torch.cat(
            [eye, turned.movedim(-3, -1), none, by_scale, by_shift.flatten(-2)], -1
        )
        return JointJacobian(joints, jacobian)


def covariances_of(
    jacobian: Float[Tensor, "*batch J 3 N"], cov: Float[Tensor, "*batch N N"]
) -> Float[Tensor, "*batch J 3 3"]:
    """Return the covariances H_j P H_j^T of joints.

    Args:
        jacobian: H, of the joints by the tangent. cov: P, of the tangent.
    """
    moved = (jacobian.flatten(-3, -2) @ cov).unflatten(-2, (-1, 3))
    return moved @ jacobian.mT


class Mirror(NamedTuple):
    """Holds which column [R] of rotations the mirror image has in place of each, and its sign [R]."""

    columns: Tensor
    sign: Tensor


def mirror_of(articulation: Articulation) -> Mirror:
    """Return what mirroring left and right does to the angles of an articulation.

    In a mirror across x, rotation vectors (x, y, z) become (x, -y, -z), of the part on the other side.
    """
    parts = articulation.skeleton.parts
    places = list(zip(articulation.axis_part.tolist(), articulation.axis.tolist(), strict=True))
    other = [(parts.index(other_side(parts[p])), a) for p, a in places]
    sign = [1.0 if a == 0 else -1.0 for _, a in places]
    columns = torch.tensor([places.index(place) for place in other])
    return Mirror(columns, torch.tensor(sign, dtype=torch.float64))


def _paths(parents: Sequence[int]) -> Tensor:
    """Return [K, K] bool: whether the row's node is the column's or above it."""
    n = len(parents)
    path = torch.zeros(n, n, dtype=torch.bool)
    for node in range(n):
        above = node
        while above >= 0:
            path[above, node] = True
            above = parents[above]
    return path


def _generators(axes: Sequence[tuple[int, int]], n_parts: int) -> Float[Tensor, "R P9"]:
    """Return the cross matrices of all parts, for a unit turn of a part about an axis of its own each."""
    generators = torch.zeros(len(axes), n_parts, 3, 3, dtype=torch.float64)
    for row, (part, axis) in enumerate(axes):
        generators[row, part] = cross_matrix(torch.eye(3, dtype=torch.float64)[axis])
    return generators.flatten(1)


def _pivot(skeleton: BodySkeleton, part: int) -> int:
    """Return the joint about which a part turns."""
    if part == 0:
        return 0
    return skeleton.parents[skeleton.part_of.index(part)]


def _centre_rotations(skeleton: BodySkeleton) -> Tensor:
    """Return the rotations [P, 3, 3] of the parts' centres relative to the part above."""
    rest = torch.tensor(skeleton.directions, dtype=torch.float64)
    vectors = torch.zeros(len(skeleton.parts), 3, dtype=torch.float64)
    for name, direction in _CENTRES.items():
        part = skeleton.parts.index(name)
        bone = rest[skeleton.part_of.index(part)]
        vectors[part] = minimal_rotation(bone, torch.tensor(direction, dtype=torch.float64))
    return quaternion_vector_to_matrix(vectors)
