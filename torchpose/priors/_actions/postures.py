"""Convert states to and from postures: relative angles of twelve limbs, 36 numbers without the root.

A limb's posture is the direction u of its bone in the axes of its parent limb, given by the
angles between the bone and the three planes of those axes (x left, y up, z forward),

    a = arcsin(u),   each within 90 degrees,   sin^2 a_x + sin^2 a_y + sin^2 a_z = 1,

which change smoothly with the direction wherever it points and never jump. The axes of the root are
those of hips and torso: x along the hips to the person's left, y along the spine, at right angles to
x, z forward. So bending over tilts the root and flexes the thighs. Every limb carries the axes on to
the limbs that hang on it by the smallest rotation from its straight direction to where it points;
straight are a torso and a head that stand up, arms held out sideways, legs that hang down, so that
opposite directions, where the smallest rotation would jump, are out of reach. Postures depend on
joint positions alone: not on the twist of a limb, nor on bone lengths.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_finite, check_shape
from torchpose.body._fitting import joints_without_gaps, swing_parts
from torchpose.body._kinematics import Body
from torchpose.body._skeleton import BODY_15
from torchpose.errors import InputError, ShapeError, SkeletonError
from torchpose.math._rotations import minimal_rotation, quaternion_vector_to_matrix
from torchpose.math._tree_messages import tree_levels
from torchpose.priors._actions.polar_limbs import (
    LIMB_PARENTS,
    LIMBS_12,
    POSTURE_DIM,
)

_TINY = 1e-6  # metres or sines: nothing shorter has a direction


# --- joints to postures ---------------------------------------------------------------------------


def posture_angles(joints: Float[Tensor, "*batch 15 3"]) -> Float[Tensor, "*batch 36"]:
    """Return the relative angles of the twelve limbs, degrees.

    Args:
        joints: [..., 15, 3], metres, in the order of `BODY_15` (`body_joints`), any right-handed
            axes. A joint that is NaN in all frames is one that the set lacks: the limbs that need
            it are at rest (arm hanging, head up, elbow and knee straight).

    Returns:
        [..., 36], three for each of `LIMBS_12` in turn, each from -90 to 90.

    Raises:
        ShapeError: not fifteen joints. InputError: a joint is missing in some frames only; hips,
            neck or pelvis are missing or lie in one point.

    >>> body = Body.of_height(BODY_15, 1.75)
    >>> joints = body.joints(torch.zeros(body.dim, dtype=torch.float64))
    >>> left = posture_angles(joints)[6:12]  # clavicle and upper arm of somebody standing
    >>> (left[3:] - torch.tensor([0.0, -90.0, 0.0])).abs().max() < 13
    tensor(True)
    """
    known = _known(joints)
    frame = posture_root(joints)
    ends = joints[..., _ENDS, :] - joints[..., _STARTS, :]
    short = (ends.norm(dim=-1) < _TINY) & known
    if bool(short.any()):
        limb = LIMBS_12[int(torch.nonzero(short)[0, -1])]
        raise InputError(f"limb {limb.name!r} has no length in some frames; cut them out")
    rest = _axes("rest", joints)
    seen = torch.nn.functional.normalize(torch.where(known[:, None], ends, rest), dim=-1)
    local = torch.empty_like(seen)
    axes = frame[..., None, :, :]
    for level in _LEVELS:
        axes = axes[..., level.above, :, :]
        u = (seen[..., level.limbs, None, :] @ axes).squeeze(-2)
        u = torch.where(known[level.limbs, None], u, rest[level.limbs])
        local[..., level.limbs, :] = u
        axes = _carry(axes, u, level)
    return angles_of_directions(local)


def posture_root(joints: Float[Tensor, "*batch 15 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation from the root's axes to the world's: x along the hips, y up the spine, z forward.

    Args:
        joints: [..., 15, 3], metres, in the order of `BODY_15`.

    Raises:
        InputError: hips, neck or pelvis are missing, lie in one point or in one line.
    """
    check_shape("joints", joints, ["...", len(BODY_15.names), 3])
    left, right, neck, pelvis = (joints[..., BODY_15.joint(name), :] for name in _ROOT_JOINTS)
    check_finite("hips, neck and pelvis", torch.stack([left, right, neck, pelvis], -2))
    x = torch.nn.functional.normalize(left - right, dim=-1)
    spine = torch.nn.functional.normalize(neck - pelvis, dim=-1)
    z = torch.linalg.cross(x, spine)
    if bool((z.norm(dim=-1) < _TINY).any()):
        raise InputError(
            "the root's axes need hips apart and a spine across them; in some frames they lie in "
            "one point or in one line; cut those frames out"
        )
    z = torch.nn.functional.normalize(z, dim=-1)
    return torch.stack([x, torch.linalg.cross(z, x), z], -1)


def state_postures(body: Body, state: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch 36"]:
    """Return the relative angles, degrees, of the states of a body.

    Args:
        body: a body with the joints of `BODY_15`.
        state: [..., D], metres and quaternion vectors.

    Returns:
        Postures [..., 36], degrees.

    Raises:
        SkeletonError: a body of other joints than those of `BODY_15`.
    """
    check_body(body)
    return posture_angles(body.joints(state))


# --- postures to states ---------------------------------------------------------------------------


def normalise_postures(postures: Float[Tensor, "*batch 36"]) -> Float[Tensor, "*batch 36"]:
    """Return the angles of the directions nearest in sines: a = arcsin(u), u = sin a / |sin a|.

    Three angles of a limb belong to a direction only if their squared sines sum to 1, which
    interpolated or projected ones do not.

    Args:
        postures: [..., 36], degrees.
    """
    return angles_of_directions(_local_directions(postures))


def posture_directions(
    postures: Float[Tensor, "*batch 36"], root: Float[Tensor, "*batch 3 3"]
) -> Float[Tensor, "*batch 12 3"]:
    """Return world directions of the twelve limbs, u = sin a / |sin a|, carried on from the root.

    Args:
        postures: [..., 36], degrees. root: [..., 3, 3], of `posture_root`.

    Raises:
        ShapeError: other sizes. InputError: not finite.
    """
    check_shape("postures", postures, ["...", POSTURE_DIM])
    check_shape("root", root, [*postures.shape[:-1], 3, 3])
    check_finite("postures", postures)
    local = _local_directions(postures)
    world = torch.empty_like(local)
    axes = root[..., None, :, :]
    for level in _LEVELS:
        axes = axes[..., level.above, :, :]
        u = local[..., level.limbs, :]
        world[..., level.limbs, :] = (axes @ u[..., None]).squeeze(-1)
        axes = _carry(axes, u, level)
    return world


def posture_to_state(
    body: Body, postures: Float[Tensor, "*batch 36"], root_state: Float[Tensor, "*#batch D"]
) -> Float[Tensor, "*batch D"]:
    """Return the states of given postures, in closed form, with the root of other states.

    Kept of `root_state` are the root's position, the pelvis and the plane in which the torso leans
    forward: all that `posture_root` is made of. The torso points where the posture says and turns
    about itself to where the clavicles point; the other parts swing to their directions without
    twist. The inverse of `state_postures` up to twists, which joints do not show: the joints of a
    state come back. A body's shoulders are fixed in its torso, so that of the clavicles of any other
    posture only their common turn about the spine is taken over.

    Args:
        body: whose joints are those of `BODY_15`. postures: [..., 36], degrees.
        root_state: [..., D].

    Returns:
        [..., D], of the body.

    Raises:
        SkeletonError: a body of other joints. ShapeError: other sizes. InputError: not finite.
    """
    check_body(body)
    check_shape("postures", postures, ["...", POSTURE_DIM])
    # not by torch.broadcast_shapes, whose first call imports sympy: a second in the middle of a track
    lead = torch.broadcast_tensors(postures[..., 0], root_state[..., 0])[0].shape
    states = root_state.expand(*lead, root_state.shape[-1]).reshape(-1, root_state.shape[-1])
    angles = postures.expand(*lead, POSTURE_DIM).reshape(-1, POSTURE_DIM).to(states)
    rotations = body.part_rotations(states)
    directions = posture_directions(angles, posture_root(body.joints(states)))
    bones = _joint_bones(body, directions)
    torso = body.skeleton.part("torso")
    rest = rotations[:, 0] @ body.centre_rotations[torso]
    rotations[:, torso] = _torso_rotation(body, rest, bones)
    known = torch.ones(len(body.skeleton.names), dtype=torch.bool, device=states.device)
    rotations = swing_parts(body, rotations, bones, known)
    return body.state_of(states[:, :3], rotations).reshape(*lead, body.dim)


def check_body(body: Body) -> None:
    """Raise `SkeletonError` unless a body has the joints and parts of `BODY_15`."""
    if body.skeleton.names != BODY_15.names or body.skeleton.parts != BODY_15.parts:
        raise SkeletonError(
            f"postures are of the joints of {BODY_15.name!r}, got a body of "
            f"{body.skeleton.name!r} with {', '.join(body.skeleton.names)}"
        )


def _local_directions(postures: Tensor) -> Tensor:
    """Return unit directions u [..., 12, 3] in the parents' axes; at rest where all angles are zero."""
    check_shape("postures", postures, ["...", POSTURE_DIM])
    sines = torch.deg2rad(postures.clamp(-90, 90)).sin().unflatten(-1, (-1, 3))
    none = sines.norm(dim=-1, keepdim=True) < _TINY
    return torch.nn.functional.normalize(torch.where(none, _axes("rest", sines), sines), dim=-1)


def angles_of_directions(directions: Tensor) -> Tensor:
    """Return the angles [..., 36] of unit directions [..., 12, 3] to the planes of their axes, degrees.

    An angle of 90 degrees falls on every side, so that its gradient is 0: that of arcsin is infinite.
    """
    sines = directions.clamp(-1, 1)
    if torch.is_grad_enabled():
        sines = torch.where(sines.abs() < 1, sines, sines.detach())
    return torch.rad2deg(sines.arcsin()).flatten(-2)


def _torso_rotation(body: Body, rest: Tensor, bones: Tensor) -> Tensor:
    """Return rotations [N, 3, 3] that point the neck's offset along its bone and then turn about it.

    The turn brings the shoulders nearest to their bones: tan of it = sum t . (a x s) / sum a . s
    over both, a the shoulder's offset and s its bone, both across t.
    """
    spine, shoulders = BODY_15.joint("neck"), _joints("left_shoulder", "right_shoulder")
    up = torch.nn.functional.normalize(bones[:, spine], dim=-1)
    start = (rest @ body.offsets[spine, :, None]).squeeze(-1)
    swung = quaternion_vector_to_matrix(minimal_rotation(start, up)) @ rest
    arms = body.offsets[shoulders] @ swung.mT  # a, [N, 2, 3]
    seen, axis = bones[:, shoulders], up[:, None]
    seen = seen - (seen * axis).sum(-1, keepdim=True) * axis
    sine = (torch.linalg.cross(arms, seen) * axis).sum((-1, -2))
    angle = torch.atan2(sine, (arms * seen).sum((-1, -2)))
    return quaternion_vector_to_matrix((angle / 2).sin()[:, None] * up) @ swung


def _joint_bones(body: Body, directions: Tensor) -> Tensor:
    """Return vectors [N, J, 3] from each joint's parent to it; hips and root are left zero."""
    bones = directions.new_zeros(len(directions), len(body.skeleton.names), 3)
    bones[:, _ENDS] = directions * body.bone_lengths[_ENDS, None]
    return bones


def _carry(axes: Tensor, local: Tensor, level: "_Level") -> Tensor:
    """Return the axes of a level's limbs that carry others, turned from straight to where they point.

    The smallest rotation from a to b is I - (a + b)(a + b)^T / (1 + a . b) + 2 b a^T.
    """
    if not level.carriers:
        return axes
    a = _axes("straight", local)[level.limbs][level.carriers]
    b = local[..., level.carriers, :]
    share = 1 + (a * b).sum(-1)
    middle = a + b
    turn = 2 * b[..., :, None] * a[:, None, :] + torch.eye(3).to(local)
    turn = turn - middle[..., :, None] * (middle / share.clamp_min(_TINY)[..., None])[..., None, :]
    if bool((share < _TINY).any()):  # opposite directions, of which the formula makes a reflection
        swing = quaternion_vector_to_matrix(minimal_rotation(a, b))
        turn = torch.where(share[..., None, None] < _TINY, swing, turn)
    return axes[..., level.carriers, :, :] @ turn


# --- limbs and joints -----------------------------------------------------------------------------

_ROOT_JOINTS = ("left_hip", "right_hip", "neck", "pelvis")


class _Level(NamedTuple):
    """Describes the limbs of one depth.

    above: place of each one's parent among the carriers of the level before.
    carriers: places of those in the level that others hang on."""

    limbs: list[int]
    above: list[int]
    carriers: list[int]


def _level(limbs: Sequence[int], carriers: Sequence[int]) -> _Level:
    """Return a level, by the carriers of the level before (-1: the root)."""
    above = [carriers.index(LIMB_PARENTS[limb]) for limb in limbs]
    return _Level(list(limbs), above, [i for i, limb in enumerate(limbs) if limb in LIMB_PARENTS])


def _levels() -> list[_Level]:
    found: list[_Level] = []
    for limbs in tree_levels(LIMB_PARENTS, [limb.name for limb in LIMBS_12]):
        before = [found[-1].limbs[i] for i in found[-1].carriers] if found else [-1]
        found.append(_level(limbs, before))
    return found


_LEVELS = _levels()


def _joints(*names: str) -> list[int]:
    return [BODY_15.joint(name) for name in names]


_STARTS = _joints(*(limb.start for limb in LIMBS_12))
_ENDS = _joints(*(limb.end for limb in LIMBS_12))


def _axes(kind: str, like: Tensor) -> Tensor:
    """Return directions [12, 3], straight or at rest, on a tensor's device."""
    return like.new_tensor([getattr(limb, kind) for limb in LIMBS_12])


def _known(joints: Tensor) -> Tensor:
    """Return [12], True for limbs both of whose joints are known."""
    if joints.ndim < 2 or joints.shape[-2:] != (len(BODY_15.names), 3):
        raise ShapeError(
            f"joints must have shape [..., 15, 3] in the order of BODY_15, got "
            f"{list(joints.shape)}; body_joints picks them out of a joint set"
        )
    there = joints_without_gaps(BODY_15.names, joints.reshape(-1, *joints.shape[-2:]))
    return there[_STARTS] & there[_ENDS]
