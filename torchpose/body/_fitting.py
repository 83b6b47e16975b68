"""Fit bodies and states to recorded joint positions, batched over frames.

Joint positions leave some quantities undetermined. The fit takes for:

- the twist of a part about its only bone (head, arms, legs): none; the part swings from its centre
  to the bone's direction by the smallest angle;
- the tilt of the pelvis about the line of the hips: the torso's, where the pelvis joint lies within
  4 cm of that line (pose2sim: 0, Berkeley MHAD: 2 cm, whose own tilt is off by up to 100 degrees).
  Where it lies farther away (CMU: 10 cm), the hips determine the tilt;
- a joint that the set lacks: its part stays at rest.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.checks import check_height, check_shape, check_tensors
from torchpose._core.facade import set_up_facade
from torchpose._core.rows import where_rows
from torchpose.body._kinematics import Body, Frame
from torchpose.body._skeleton import BODY_15, BodySkeleton
from torchpose.errors import InputError, SkeletonError
from torchpose.math._rotations import cross_matrix, minimal_rotation, quaternion_vector_to_matrix

_TILT = 0.5  # radians, standard deviation between the tilts of pelvis and torso
_LEVER = 0.04  # metres, least distance of the pelvis joint from the hips that tells the tilt
_TORSO_TILT = 1e-2  # square metres, weight of the torso's tilt where the hips do not tell
_LEAST_TILT = 1e-9  # and where they do
_DAMPING = 1e-6  # square metres, of Gauss-Newton: keeps the twist where it is, at least
_MOST_DAMPING = 1e3  # frames that no step makes better stay where they are
_MOST_SCALE = 3.0  # of bones beside those of the body; beyond, units differ, feet included
_ROUNDS = 4  # of rigid shapes and rotations in turn; the change is below 0.1 mm after three
_CHUNK = 2048  # frames per Gauss-Newton step, 30 MB of Jacobians


def fit_body(
    joints: Float[Tensor, "T J 3"],
    radii: Float[Tensor, "L 2"] | None = None,
    *,
    skeleton: BodySkeleton = BODY_15,
    centres: Float[Tensor, "P 3"] | None = None,
    frame: Frame = "parent",
    head_top: float | None = None,
) -> Body:
    """Fit the body of one person: constant bone lengths and directions from recorded joints.

    Arms and legs get the median length of their bones. The joints of the rigid parts (pelvis and
    torso) get their mean position in the part's axes, with rotations and mean positions in turn;
    the head its mean direction in the torso's axes. Tips that hang on the neck are placed by the
    middle of the shoulders, since joint sets differ in their neck. Default radii and tips follow
    from the body height, and that from the legs.

    Args:
        joints: [T, J, 3], metres, in the skeleton's order (`body_joints`); NaN in all frames where
            the set lacks a joint, whose bone then has the skeleton's proportion.
        radii: [L, 2], metres; a clothed adult's by default.
        skeleton: the skeleton of the body.
        centres, frame: of the states, see `Body`.
        head_top: metres from the head joint to the top of the head, which tells where the tip
            "crown" goes: 0.11 where the joint is the head's centre (Kinect), 0 where it is its top
            (pose2sim). By default the top lies a fifth of the height above the shoulders.

    Returns:
        `Body` in float64, on the device of `joints`, with the person's bone lengths, directions and tips.

    Raises:
        InputError: a joint is missing in some frames only, a bone has no length, no joint of the
            pelvis or torso, or joints in other units than metres. ShapeError: another number of joints.
    """
    check_tensors(joints=joints)
    joints = joints.double()
    roles, known = _roles(skeleton), _known_joints(skeleton, joints)
    bones = _bones(skeleton, joints)
    lengths = bones.norm(dim=-1).median(0).values
    height = check_height(skeleton.height(lengths), "the height of the body of these joints")
    lengths = torch.where(known, lengths, skeleton.standard_lengths(height).to(lengths))
    radii = skeleton.standard_radii(height) if radii is None else radii
    body = Body(skeleton, lengths, radii.to(lengths), frame=frame)
    rigid, learnt = (torch.tensor(m, device=known.device) for m in (roles.rigid, roles.learnt))
    learnt = learnt & known
    for _ in range(_ROUNDS):
        axes = _rigid_rotations(body, joints, _tilt_of(body, joints))[:, roles.axes]
        mean = (axes.mT @ bones[..., None]).squeeze(-1).mean(0)
        offsets = torch.where(learnt[:, None], mean, body.offsets)
        lengths = torch.where(rigid, offsets.norm(dim=-1), lengths)
        body = Body(skeleton, lengths, body.radii, directions=offsets, frame=frame)
    return Body(
        skeleton, lengths, body.radii, directions=body.offsets, centres=centres, frame=frame,
        tips=_placed_tips(body, head_top),
    )  # fmt: skip


def _placed_tips(body: Body, head_top: float | None) -> Tensor:
    """Return tips [K, 3] at the height of the person, those on the neck by the middle of the shoulders."""
    if head_top is not None and not math.isfinite(head_top):
        raise InputError(f"head_top must be finite, metres, got {head_top}")
    skeleton = body.skeleton
    standard = body.height * torch.tensor(skeleton.directions, dtype=torch.float64)
    standard = standard * torch.tensor(skeleton.proportions, dtype=torch.float64)[:, None]
    sides = [skeleton.joint(f"{side}_shoulder") for side in ("left", "right")]
    lower = body.offsets[sides].mean(0) - standard[sides].mean(0).to(body.offsets)
    on_neck = torch.tensor([tip.joint == "neck" for tip in skeleton.tips]).to(lower)
    shift = on_neck[:, None] * lower * torch.tensor([0.0, 1.0, 0.0]).to(lower)
    tips = body.tips + shift
    if head_top is not None:
        head, crown = skeleton.joint("head"), [tip.name for tip in skeleton.tips].index("crown")
        limb = next(i for i, limb in enumerate(skeleton.limbs) if limb.end == "crown")
        top = body.offsets[head, 1] + head_top - body.radii[limb, 1]
        above = torch.tensor([tip.part == "head" for tip in skeleton.tips]).to(tips)
        tips[:, 1] += above * (top - tips[crown, 1])
    return tips


def fit_state(body: Body, joints: Float[Tensor, "T J 3"], steps: int = 4) -> Float[Tensor, "T D"]:
    """Find the states whose joints are nearest to recorded ones, for all frames at once.

    Closed form first: rotations of pelvis and torso by the singular value decomposition, and of
    the other parts by the swing to their bone's direction. Then damped Gauss-Newton steps over the
    root's position and the rotations of all parts share out what constant bone lengths leave.

    Args:
        body: the body of this person.
        joints: [T, J, 3], metres, in the order of the body's joints; NaN in all frames for a joint
            that the set lacks: its part and those beyond it stay at rest.
        steps: the number of steps of Gauss-Newton; 0 for the closed form.

    Returns:
        [T, D], in the body's dtype.

    Raises:
        InputError: a joint is missing in some frames only, or wholly where pelvis and torso need
            it, or joints in other units than the body. ShapeError: another number of joints.
    """
    if steps < 0:
        raise InputError(f"steps must not be negative, got {steps}")
    check_tensors(joints=joints)
    joints = joints.to(body.offsets)
    known = _known_joints(body.skeleton, joints)
    _check_units(body, joints, known)
    tilt, chunks = _tilt_of(body, joints), joints.split(_CHUNK)
    tilts = [tilt._replace(seen=seen) for seen in tilt.seen.split(_CHUNK)]
    fits = zip(chunks, tilts, strict=True)
    return torch.cat([_fit_chunk(body, chunk, known, own, steps) for chunk, own in fits])


def fit_errors(
    body: Body, state: Float[Tensor, "*batch D"], joints: Float[Tensor, "*batch J 3"]
) -> Float[Tensor, "*batch J"]:
    """Return the distance of every joint from where it was recorded, millimetres, NaN where it was not."""
    return 1000 * (body.joints(state) - joints.to(state)).norm(dim=-1)


# --- closed form ----------------------------------------------------------------------------------


class _Fit(NamedTuple):
    """Holds the root position [T, 3], world rotations of the parts [T, P, 3, 3]."""

    position: Tensor
    rotations: Tensor


class _Tilt(NamedTuple):
    """Holds the evidence of the tilt of the root part about the line of the hips.

    axis, spine: [3], the line and the rest direction of the spine across it, in the part's axes.
    seen: [T, 3], the recorded direction of the spine across the line of the hips, world axes.
    weight: square metres, of the squared sine of the angle between them.
    """

    axis: Tensor
    spine: Tensor
    seen: Tensor
    weight: Tensor


def _tilt_of(body: Body, joints: Tensor) -> _Tilt:
    roles = _roles(body.skeleton)
    carried = [j for j, part in enumerate(body.skeleton.part_of) if part == 0 and j > 0]
    arms, hips = body.offsets[carried], joints[:, carried] - joints[:, :1]
    spine = _unit(body.offsets[roles.spine])
    across = arms - (arms @ spine)[:, None] * spine
    axis = torch.linalg.svd(across)[2][0]  # the direction in which they lie apart most
    line = _unit(torch.einsum("n,tni->ti", arms @ axis, hips))
    direction = joints[:, roles.spine] - joints[:, 0]
    seen = _unit(direction - (direction * line).sum(-1, keepdim=True) * line)
    lever = (arms - (arms @ axis)[:, None] * axis).square().sum(-1).mean().sqrt()
    off = (hips.norm(dim=-1) - arms.norm(dim=-1)).square().mean()  # they should not move at all
    told = (off / _TILT**2).clamp_min(_LEAST_TILT)
    return _Tilt(axis, spine, seen, torch.where(lever > _LEVER, told, _TORSO_TILT))


def _fit_chunk(body: Body, joints: Tensor, known: Tensor, tilt: _Tilt, steps: int) -> Tensor:
    rotations = _rigid_rotations(body, joints, tilt)
    rotations = swing_parts(body, rotations, _bones(body.skeleton, joints), known)
    fit = _Fit(joints[:, 0], rotations)
    if steps:
        fit = _gauss_newton(body, fit, joints, known, tilt, steps)
        axes = fit.rotations[:, list(body.skeleton.part_of)]
        bones = (axes @ body.offsets[..., None]).squeeze(-1)
        rotations = swing_parts(body, fit.rotations, bones, known)  # steps may have left a twist
        fit = fit._replace(rotations=rotations)
    return body.state_of(fit.position, fit.rotations)


def _rigid_rotations(body: Body, joints: Tensor, tilt: _Tilt) -> Tensor:
    """Return world rotations [T, P, 3, 3] of the parts that carry several joints; others are NaN.

    R = argmin sum_n |R w_n - (p_n - p_pivot)|^2 over the part's joints, by the singular value
    decomposition of sum_n (p_n - p_pivot) w_n^T. The root part also gets the direction of the
    spine, with the weight of the tilt.
    """
    skeleton, roles = body.skeleton, _roles(body.skeleton)
    part_of, every = list(skeleton.part_of), list(range(len(skeleton.names)))
    arms = body.joint_weights.unflatten(0, (-1, 3))[part_of, :, every]  # w, [J, 3]
    seen = joints - joints[:, roles.pivots]
    outer = seen[..., :, None] * arms[:, None, :]
    index = torch.tensor(part_of, device=joints.device)
    sums = outer.new_zeros(len(joints), len(skeleton.parts), 3, 3).index_add(1, index, outer)
    sums[:, 0] += tilt.weight * tilt.seen[:, :, None] * tilt.spine
    u, _, vt = torch.linalg.svd(sums[:, roles.rigid_parts])
    sign = torch.ones_like(u[..., 0])
    sign[..., 2] = torch.linalg.det(u @ vt)
    rotations = torch.full_like(sums, math.nan)
    rotations[:, roles.rigid_parts] = (u * sign[..., None, :]) @ vt
    return rotations


def swing_parts(
    body: Body,
    rotations: Float[Tensor, "T P 3 3"],
    bones: Float[Tensor, "T J 3"],
    known: Bool[Tensor, " J"],
) -> Float[Tensor, "T P 3 3"]:
    """Return rotations of the parts with one bone, from their centre to its direction, without twist.

    Args:
        rotations: [T, P, 3, 3], of the rigid parts (pelvis and torso); what it holds for the others
            counts for nothing. bones: [T, J, 3], from each joint's parent to it, world axes, of any
            length. known: [J]; parts of other joints stay at rest.
    """
    skeleton, roles = body.skeleton, _roles(body.skeleton)
    done = rotations.clone()
    for level in skeleton.part_levels[1:]:
        parts = [part for part in level if part not in roles.rigid_parts]
        joints = [skeleton.part_of.index(part) for part in parts]
        above = [0 if body.frame == "body" else skeleton.part_parents[part] for part in parts]
        rest = done[:, above] @ body.centre_rotations[parts]
        offsets = body.offsets[joints]
        seen = (rest.mT @ bones[:, joints, :, None]).squeeze(-1)
        seen = torch.where(known[joints, None], seen, offsets)
        turn = quaternion_vector_to_matrix(minimal_rotation(offsets.expand_as(seen), seen))
        done[:, parts] = rest @ turn
    return done


# --- Gauss-Newton ---------------------------------------------------------------------------------


def _gauss_newton(
    body: Body, fit: _Fit, joints: Tensor, known: Tensor, tilt: _Tilt, steps: int
) -> _Fit:
    """Take steps (J^T J + mu I)^-1 J^T r, with the damping mu of each frame after Levenberg-Marquardt.

    A frame that a step makes worse stays where it is and gets more damping.
    """

    def linearise(fit: _Fit) -> tuple[Tensor, Tensor]:
        residual, jacobian = _linearise(body, fit, joints, known)
        angle, moves = _tilt_residual(fit, tilt)
        return torch.cat([residual, angle], 1), torch.cat([jacobian, moves], 1)

    residual, jacobian = linearise(fit)
    damping = torch.full_like(residual[:, 0], _DAMPING)
    for _ in range(steps):
        moved = _moved(fit, residual, jacobian, damping)
        new_residual, new_jacobian = linearise(moved)
        better = new_residual.square().sum(-1) < residual.square().sum(-1)
        fit = where_rows(better, moved, fit)
        residual = where_rows(better, new_residual, residual)
        jacobian = where_rows(better, new_jacobian, jacobian)
        damping = damping * torch.where(better, 0.1, 100.0).to(damping)
        damping = damping.clamp(_DAMPING, _MOST_DAMPING)
    return fit


def _moved(fit: _Fit, residual: Tensor, jacobian: Tensor, damping: Tensor) -> _Fit:
    normal = jacobian.mT @ jacobian
    normal = normal + damping[:, None, None] * torch.eye(normal.shape[-1]).to(normal)
    slope = jacobian.mT @ residual[..., None]
    step = torch.cholesky_solve(slope, torch.linalg.cholesky(normal)).squeeze(-1)
    turns = quaternion_vector_to_matrix(step[:, 3:].unflatten(-1, (-1, 3)) / 2)
    return _Fit(fit.position + step[:, :3], turns @ fit.rotations)


def _linearise(body: Body, fit: _Fit, joints: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Return residuals [T, R] of known joints and how root and parts move them, [T, R, 3 + 3 P].

    p_n = p_root + sum_p R_p w_pn, so that a small turn omega of part p about the world's axes moves
    it by omega x R_p w_pn.
    """
    arms = body.joint_weights.unflatten(0, (-1, 3))  # w, [P, 3, J]
    turned = torch.einsum("tpij,pjn->tnpi", fit.rotations, arms)
    residual = joints - fit.position[:, None] - turned.sum(2)
    moves = -cross_matrix(turned).transpose(2, 3).flatten(3)  # [T, J, 3, 3 P]
    still = torch.eye(3).to(moves).expand(*moves.shape[:2], 3, 3)
    jacobian = torch.cat([still, moves], -1)
    return residual[:, known].flatten(1), jacobian[:, known].flatten(1, 2)


def _tilt_residual(fit: _Fit, tilt: _Tilt) -> tuple[Tensor, Tensor]:
    """Return the weighted sine [T, 1] of the angle that the root part lacks, and what moves it, [T, 1, D]."""
    root = fit.rotations[:, 0]
    axis, spine = root @ tilt.axis, root @ tilt.spine
    sine = (torch.linalg.cross(axis, spine) * tilt.seen).sum(-1, keepdim=True)
    moves = axis.new_zeros(len(axis), 1, 3 + 3 * fit.rotations.shape[1])
    moves[:, 0, 3:6] = axis
    return tilt.weight.sqrt() * sine, tilt.weight.sqrt() * moves


# --- joints and parts -----------------------------------------------------------------------------


class _Roles(NamedTuple):
    """Roles of a skeleton's joints and parts in the fit.

    rigid_parts: those that carry several joints, the root part and the torso. rigid: [J], joints
    carried by them. learnt: [J], joints whose offset is learnt: those, and of the parts with one
    joint those in the middle of the body (the head). axes: [J], the part in whose axes it is learnt.
    pivots: [J], the joint about which each joint's part turns. spine: the torso's first joint.
    """

    rigid_parts: list[int]
    rigid: list[bool]
    learnt: list[bool]
    axes: list[int]
    pivots: list[int]
    spine: int


@lru_cache(maxsize=32)
def _roles(skeleton: BodySkeleton) -> _Roles:
    n_joints = len(skeleton.names)
    parts = [p for p in range(len(skeleton.parts)) if skeleton.single_joint(p) is None]
    spine = next((j for j in range(1, n_joints) if skeleton.part_of[j] in parts[1:]), -1)
    if 0 not in parts or spine < 0 or skeleton.parents[spine] != 0:
        raise SkeletonError(
            f"a fit needs a root part and a torso that carry several joints each, the torso's first "
            f"one next to the root joint; {skeleton.name!r} has none"
        )
    rigid = [j > 0 and skeleton.part_of[j] in parts for j in range(n_joints)]
    central = [not part.startswith(("left_", "right_")) for part in skeleton.parts]
    learnt = [rigid[j] or (j > 0 and central[skeleton.part_of[j]]) for j in range(n_joints)]
    axes = [p if p in parts else skeleton.part_parents[p] for p in skeleton.part_of]
    pivots = [0] * n_joints
    for level in skeleton.joint_levels[1:]:
        for j in level:
            above = skeleton.parents[j]
            same = above > 0 and skeleton.part_of[above] == skeleton.part_of[j]
            pivots[j] = pivots[above] if same else above
    return _Roles(parts, rigid, learnt, axes, pivots, spine)


def _check_units(body: Body, joints: Tensor, known: Bool[Tensor, " J"]) -> None:
    """Raise `InputError` where the lengths of bones say that joints are in other units than the body."""
    own = body.offsets.detach().norm(dim=-1)
    lengths = _bones(body.skeleton, joints.detach()).norm(dim=-1).median(0).values
    times = float((lengths / own)[known & (own > 0)].median())
    if not 1 / _MOST_SCALE < times < _MOST_SCALE:
        raise InputError(
            f"joints must be in metres, as the body is, got bones of {times:.4g} times the lengths of its "
            "own; divide millimetres by 1000 and centimetres by 100"
        )


def _bones(skeleton: BodySkeleton, joints: Tensor) -> Tensor:
    """Return the bones [T, J, 3], from each joint's parent to it; zero for the root."""
    return joints - joints[:, [max(parent, 0) for parent in skeleton.parents]]


def _known_joints(skeleton: BodySkeleton, joints: Tensor) -> Bool[Tensor, " J"]:
    """Return which joints [J] are known in all frames, with all joints between them and the root."""
    check_shape("joints", joints, ["T", len(skeleton.names), 3])
    if joints.shape[0] == 0:
        raise InputError("a fit needs at least one frame, got none")
    known = joints_without_gaps(skeleton.names, joints)
    needed = [j for j, rigid in enumerate(_roles(skeleton).rigid) if (rigid or j == 0)]
    missing = [skeleton.names[j] for j in needed if not bool(known[j])]
    if missing:
        raise InputError(f"pelvis and torso need their joints; missing are {', '.join(missing)}")
    for level in skeleton.joint_levels[1:]:
        above = [skeleton.parents[j] for j in level]
        known[list(level)] &= known[above]
    return known


def joints_without_gaps(names: Sequence[str], joints: Float[Tensor, "T J 3"]) -> Bool[Tensor, " J"]:
    """Return which joints are there in all frames.

    Raises:
        InputError: one is missing in some frames only.
    """
    there = torch.isfinite(joints).all(-1)
    gap = there.any(0) & ~there
    if bool(gap.any()):
        frame, joint = (int(i) for i in torch.nonzero(gap)[0])
        raise InputError(
            f"joint {names[joint]!r} is missing in frame {frame} ({int(gap.sum())} such "
            "gaps); fill or cut them out: only a joint that is missing in all frames may be NaN"
        )
    return there.all(0)


def _unit(vector: Tensor) -> Tensor:
    return torch.nn.functional.normalize(vector, dim=-1)


set_up_facade(__name__)
