"""Compute the forward kinematics of the articulated body: states to rotations, joints and limbs.

A state x [..., D] is the root's position (metres, in any right-handed world axes), the root part's
orientation, then the rotation of every other part in the order of the skeleton's parts, each as a
quaternion vector (`torchpose.math._rotations`). Every function takes any leading shape.
"""

import math
from typing import TYPE_CHECKING, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose._core.checks import check_choice, check_finite, check_height, check_shape
from torchpose._core.module_state import derived, register_given
from torchpose.body._limbs import (
    Limbs,
    chained,
    check_limb_lengths,
    checked_directions,
    checked_lengths,
    checked_radii,
    checked_tips,
    level_plan,
    point_weights,
)
from torchpose.body._skeleton import BodySkeleton
from torchpose.errors import InputError, ShapeError, SkeletonError
from torchpose.math._rotations import (
    compose,
    conjugate,
    matrix_to_quaternion_vector,
    mean_rotation,
    quaternion_vector_to_matrix,
    within_unit_ball,
)

Frame = Literal["parent", "body"]
FRAMES: tuple[Frame, ...] = ("parent", "body")

_ROOT, _HEADING, _RELATIVE = slice(0, 3), slice(3, 6), slice(6, None)


class _Geometry(NamedTuple):
    """Holds tensors derived from a body's measures, see `Body`; `centred`: whether a part has a centre."""

    offsets: Tensor
    centre_rotations: Tensor
    joint_weights: Tensor
    limb_weights: Tensor
    centred: bool


class Body(nn.Module):
    """Holds a person's bone lengths and limbs, and computes joints and limbs from states (kinematics).

    With ``frame="parent"`` (MR) and ``frame="body"`` (DX) a part's rotation to world axes is

        R_part = R_parent C_part R(q_part)    and    R_part = R_root C_part R(q_part),

    where C_part is the part's centre: with it training data stay away from |q| = 1 (DX 1). The
    root part has none. Joints and limbs are linear in these rotations, p = p_root + sum R_part o, so
    all of them are one matrix product; only the levels of the part tree are taken in turn.

    Args:
        skeleton: J joints, P parts, L limbs.
        bone_lengths: [J], metres, from each joint's parent; the root's entry counts for nothing.
        radii: [L, 2] or [*B, L, 2], metres, at every limb's start and end; batched radii are the
            shapes of several candidates for one person.
        directions: [J, 3], this person's rest directions; the skeleton's by default.
        centres: [P, 3], quaternion vector of every part's centre; none by default.
        frame: ``"parent"`` or ``"body"``.
        tips: [K, 3], this person's offsets of the tips, metres; by default the skeleton's, scaled
            with the body height.
        dtype: the floating-point type of buffers; joints and rotations have that of the states.

    Attributes:
        skeleton, frame: as given. dim: D, the numbers in a state.

    Buffers: bone_lengths [J], directions [J, 3], tips [K, 3], radii, centres [P, 3]. What follows from
    them follows their changes: offsets [J, 3], centre_rotations [P, 3, 3], joint_weights [3 P, J],
    limb_weights [3 P, 2 L].

    Raises:
        InputError: a bone length that is not positive, a limb of zero length, negative radii, a
            direction without length, an unknown frame. ShapeError: wrong sizes.

    >>> from torchpose.body._skeleton import BODY_15
    >>> body = Body.of_height(BODY_15, 1.75)
    >>> body.joints(torch.zeros(2, 5, body.dim, dtype=torch.float64)).shape
    torch.Size([2, 5, 15, 3])
    """

    bone_lengths: Tensor
    directions: Tensor
    tips: Tensor
    radii: Tensor
    centres: Tensor

    def __init__(
        self,
        skeleton: BodySkeleton,
        bone_lengths: Float[Tensor, " J"],
        radii: Float[Tensor, "*B L 2"],
        *,
        directions: Float[Tensor, "J 3"] | None = None,
        centres: Float[Tensor, "P 3"] | None = None,
        frame: Frame = "parent",
        tips: Float[Tensor, "K 3"] | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        check_choice("frame", frame, FRAMES)
        self.skeleton, self.frame, self.dim = skeleton, frame, skeleton.dim
        device = bone_lengths.device
        lengths = checked_lengths(skeleton, bone_lengths.double())
        directions = checked_directions(skeleton, directions, device)
        tips = checked_tips(skeleton, lengths, tips)
        if centres is None:
            centres = torch.zeros(len(skeleton.parts), 3, dtype=torch.float64, device=device)
        check_shape("centres", centres, [len(skeleton.parts), 3])
        check_finite("centres", centres)
        centres = within_unit_ball(centres.to(device, torch.float64))
        if bool(centres[0].any()):
            raise InputError("the root part has no centre: centres[0] must be zero")
        for name, value in {
            "bone_lengths": lengths,
            "directions": directions,
            "tips": tips,
            "radii": checked_radii(skeleton, radii),
            "centres": centres,
        }.items():
            register_given(self, name, value.to(device, dtype))
        check_limb_lengths(skeleton, self.limb_weights)
        for name, index in level_plan(skeleton).items():
            self.register_buffer(name, torch.tensor(index, device=device), persistent=False)

    @property
    def offsets(self) -> Float[Tensor, "J 3"]:
        """Return the position [J, 3] of every joint relative to its parent in the rest pose, metres."""
        return self._geometry().offsets

    @property
    def centre_rotations(self) -> Float[Tensor, "P 3 3"]:
        """Return the rotation of every part's centre."""
        return self._geometry().centre_rotations

    @property
    def joint_weights(self) -> Float[Tensor, "P3 J"]:
        """Return the linear map [3 P, J] from the columns of the parts' rotations to the joints."""
        return self._geometry().joint_weights

    @property
    def limb_weights(self) -> Float[Tensor, "P3 L2"]:
        """Return the linear map [3 P, 2 L] from the columns of the parts' rotations to the limbs' ends."""
        return self._geometry().limb_weights

    def _geometry(self) -> "_Geometry":
        sources = (self.bone_lengths, self.directions, self.tips, self.centres)
        return derived(self, "geometry", sources, self._make_geometry)

    def _make_geometry(self) -> "_Geometry":
        skeleton, dtype = self.skeleton, self.bone_lengths.dtype
        offsets = self.bone_lengths.double()[:, None] * self.directions.double()
        weights = point_weights(skeleton, offsets, self.tips.double())
        at = {name: i for i, name in enumerate(skeleton.points)}
        ends = [at[e] for limb in skeleton.limbs for e in (limb.start, limb.end)]
        centred = self.centres.requires_grad or bool(self.centres.any())
        if centred:
            turns = quaternion_vector_to_matrix(self.centres.double())
        else:  # as above, in a tenth of the time: every live frame has a body of its own
            eye = torch.eye(3, dtype=torch.float64, device=offsets.device)
            turns = eye.repeat(len(skeleton.parts), 1, 1)
        return _Geometry(
            offsets.to(dtype),
            turns.to(dtype),
            weights[:, : len(skeleton.names)].contiguous().to(dtype),
            weights[:, ends].to(dtype),
            centred,
        )

    @classmethod
    def of_height(
        cls,
        skeleton: BodySkeleton,
        height: float,
        frame: Frame = "parent",
        dtype: torch.dtype = torch.float64,
    ) -> "Body":
        """Build a person of average proportions and clothes from the body height.

        Args:
            skeleton: gives the proportions. height: metres.
            frame: "parent" or "body", see `Body`.
            dtype: the floating-point type of buffers, see `Body`.

        Returns:
            `Body` with the skeleton's standard lengths and radii.

        Raises:
            InputError: a height that nobody has, or an unknown frame.
        """
        check_height(height)
        lengths, radii = skeleton.standard_lengths(height), skeleton.standard_radii(height)
        return cls(skeleton, lengths, radii, frame=frame, dtype=dtype)

    def altered(
        self,
        *,
        radii: Float[Tensor, "*B L 2"] | None = None,
        centres: Float[Tensor, "P 3"] | None = None,
        frame: Frame | None = None,
    ) -> "Body":
        """Return the same person with other radii, centres or frame.

        States of one mean nothing to another of other centres or frame: `convert` them.

        Args:
            radii: [L, 2] or [*B, L, 2], metres; None keeps this body's.
            centres: [P, 3], quaternion vector of every part's centre; None keeps this body's.
            frame: "parent" or "body"; None keeps this body's.

        Returns:
            `Body` of the same dtype and device.

        Raises:
            InputError: negative radii or an unknown frame. ShapeError: wrong sizes.
        """
        other = Body(
            self.skeleton,
            self.bone_lengths,
            self.radii if radii is None else radii,
            directions=self.directions,
            centres=self.centres if centres is None else centres,
            frame=self.frame if frame is None else frame,
            tips=self.tips,
            dtype=self.offsets.dtype,
        )
        return other.to(self.offsets.device)

    @property
    def height(self) -> float:
        """Return the body height by the bone lengths, metres."""
        return self.skeleton.height(self.bone_lengths)

    @property
    def relative_columns(self) -> tuple[int, ...]:
        """Return the columns of a state without the root's position and orientation, Q = D - 6 of them."""
        return tuple(range(6, self.dim))

    # --- states to points ---------------------------------------------------------------------

    def part_rotations(self, state: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch P 3 3"]:
        """Return the rotation of every part, from part axes to world axes.

        Args:
            state: [..., D], metres and quaternion vectors.

        Returns:
            Rotation matrices [..., P, 3, 3].

        Raises:
            ShapeError: another number of columns.
        """
        self._check(state)
        turns = quaternion_vector_to_matrix(state[..., 3:].unflatten(-1, (-1, 3)))
        geometry = self._geometry()
        if geometry.centred:  # a product with unit matrices would cost a tenth
            turns = geometry.centre_rotations.to(turns) @ turns
        if self.frame == "body":
            root, others = turns[..., :1, :, :], turns[..., 1:, :, :]
            return torch.cat([root, root @ others], -3)
        return chained(self, turns, len(self.skeleton.part_levels))

    def joints(self, state: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch J 3"]:
        """Return the positions of all joints.

        Args:
            state: [..., D], root position in metres, then a quaternion vector for each part.

        Returns:
            [..., J, 3], metres, world axes.

        Raises:
            ShapeError: another number of columns.
        """
        return self._points(state, self.part_rotations(state), self.joint_weights)

    def limbs(self, state: Float[Tensor, "*batch D"]) -> Limbs:
        """Return the tapered cylinders of all limbs.

        Args:
            state: [..., D], metres and quaternion vectors.

        Returns:
            `Limbs` with start and end [..., L, 3], metres, world axes, and the body's radii, metres.

        Raises:
            ShapeError: another number of columns.
        """
        ends = self._points(state, self.part_rotations(state), self.limb_weights)
        start, end = ends.unflatten(-2, (-1, 2)).unbind(-2)
        return Limbs(start, end, self.radii)

    def forward(self, state: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch J 3"]:
        """Return the positions of all joints, as `joints` does.

        Args:
            state: [..., D], metres and quaternion vectors.

        Returns:
            [..., J, 3], metres, world axes.
        """
        return self.joints(state)

    if TYPE_CHECKING:  # nn.Module has Any
        __call__ = forward

    def _points(self, state: Tensor, rotations: Tensor, weights: Tensor) -> Tensor:
        rows = rotations.transpose(-3, -2).flatten(-2)  # [..., 3, 3 P]
        return (rows @ weights.to(rows)).mT + state[..., None, _ROOT]

    # --- states as values ---------------------------------------------------------------------

    def perturb(
        self, state: Float[Tensor, "*#batch D"], step: Float[Tensor, "*#batch D"]
    ) -> Float[Tensor, "*batch D"]:
        """Move states by steps: position and parts' vectors add, the root's orientation turns.

        q_root <- q_root q_step, about the body's own axes, so that a heading may turn all the way
        round; the vectors of the other parts are kept inside the unit ball.

        Args:
            state: [..., D]. step: [..., D], metres and quaternion vectors.

        Returns:
            States [..., D].

        Raises:
            ShapeError: another number of columns.
        """
        self._check(state, step)
        position = state[..., _ROOT] + step[..., _ROOT]
        heading = compose(state[..., _HEADING], step[..., _HEADING])
        parts = state[..., _RELATIVE] + step[..., _RELATIVE]
        parts = within_unit_ball(parts.unflatten(-1, (-1, 3))).flatten(-2)
        return torch.cat([position, heading, parts], -1)

    def difference(
        self, a: Float[Tensor, "*#batch D"], b: Float[Tensor, "*#batch D"]
    ) -> Float[Tensor, "*batch D"]:
        """Return the step that leads from b to a: ``perturb(b, difference(a, b))`` is a.

        Args:
            a, b: states [..., D], metres and quaternion vectors; they broadcast.

        Returns:
            Step [..., D]: metres for the root, quaternion vectors for the rotations.

        Raises:
            ShapeError: another number of columns.
        """
        self._check(a, b)
        turn = compose(conjugate(b[..., _HEADING]), a[..., _HEADING])
        plain = a - b
        return torch.cat([plain[..., _ROOT], turn, plain[..., _RELATIVE]], -1)

    def mean(
        self, states: Float[Tensor, "*batch N D"], log_weights: Float[Tensor, "*#batch N"]
    ) -> Float[Tensor, "*batch D"]:
        """Return the weighted mean of particles; the root's orientation by the mean of quaternions.

        Args:
            states: [..., N, D]. log_weights: [..., N], of any common factor.

        Returns:
            State [..., D], metres and quaternion vectors.

        Raises:
            InputError: all weights of a batch element are zero. ShapeError: other sizes.
        """
        self._check(states)
        check_shape("log_weights", log_weights, ["...", states.shape[-2]])
        highest = log_weights.amax(-1)
        if not bool((highest > -math.inf).all()):
            raise InputError("the mean needs a particle with a weight above zero, got none")
        weights = log_weights.softmax(-1).to(states)
        plain = (weights[..., None, :] @ states).squeeze(-2)
        heading = mean_rotation(states[..., _HEADING], weights)
        heading = heading.expand(*plain.shape[:-1], 3)
        return torch.cat([plain[..., _ROOT], heading, plain[..., _RELATIVE]], -1)

    def relative(self, state: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch Q"]:
        """Return the columns of a state without the root's position and orientation.

        Args:
            state: [..., D].

        Returns:
            [..., Q] with Q = D - 6: quaternion vectors of all parts but the root.

        Raises:
            ShapeError: another number of columns.
        """
        self._check(state)
        return state[..., _RELATIVE]

    def with_relative(
        self, state: Float[Tensor, "*#batch D"], relative: Float[Tensor, "*#batch Q"]
    ) -> Float[Tensor, "*batch D"]:
        """Return states with the root of `state` and other relative columns, scaled back into the unit ball.

        Args:
            state: [..., D], gives root position and orientation.
            relative: [..., Q] with Q = D - 6, quaternion vectors of all parts but the root.

        Returns:
            States [..., D]; the leading dimensions broadcast.

        Raises:
            ShapeError: other sizes.
        """
        self._check(state)
        check_shape("relative", relative, ["...", self.dim - 6])
        # not torch.broadcast_shapes, whose first call imports a computer algebra system
        lead = torch.broadcast_tensors(state[..., 0], relative[..., 0])[0].shape
        parts = within_unit_ball(relative.unflatten(-1, (-1, 3))).flatten(-2)
        root = state[..., :6].expand(*lead, 6)
        return torch.cat([root, parts.expand(*lead, parts.shape[-1])], -1)

    def state_of(
        self,
        position: Float[Tensor, "*batch 3"],
        rotations: Float[Tensor, "*batch P 3 3"],
    ) -> Float[Tensor, "*batch D"]:
        """Return the state of given world rotations of the parts; the inverse of `part_rotations`.

        Args:
            position: [..., 3], of the root, metres.
            rotations: [..., P, 3, 3], from part axes to world axes.

        Returns:
            State [..., D], metres and quaternion vectors.

        Raises:
            ShapeError: other sizes.
        """
        check_shape("position", position, ["...", 3])
        check_shape("rotations", rotations, ["...", len(self.skeleton.parts), 3, 3])
        if self.frame == "body":
            above = rotations[..., :1, :, :]
        else:
            above = rotations[..., list(self.skeleton.part_parents[1:]), :, :]
        turns = self.centre_rotations[1:].mT.to(rotations) @ (above.mT @ rotations[..., 1:, :, :])
        vectors = matrix_to_quaternion_vector(torch.cat([rotations[..., :1, :, :], turns], -3))
        return torch.cat([position, vectors.flatten(-2)], -1)

    def convert(self, state: Float[Tensor, "*batch D"], other: "Body") -> Float[Tensor, "*batch D"]:
        """Return the same rotations as a state of another body: other centres, frame or person.

        Args:
            state: [..., D], of this body: metres and quaternion vectors.
            other: of the same skeleton.

        Returns:
            State [..., D] of the other body, with the same root position, metres, and part rotations.

        Raises:
            SkeletonError: the other body has another skeleton.
        """
        if other.skeleton != self.skeleton:
            raise SkeletonError(
                f"expected a body of skeleton {self.skeleton.name!r}, got "
                f"{other.skeleton.name!r}; states cannot be converted"
            )
        return other.state_of(state[..., _ROOT], self.part_rotations(state))

    def _check(self, *states: Tensor) -> None:
        for state in states:
            if state.ndim < 1 or state.shape[-1] != self.dim:
                raise ShapeError(
                    f"states must have shape [..., {self.dim}] (3 for the root and 3 for each of "
                    f"{len(self.skeleton.parts)} parts), got {list(state.shape)}"
                )

    def extra_repr(self) -> str:
        return f"{self.skeleton.name!r}, height={self.height:.2f} m, frame={self.frame!r}"


def centres_of(body: Body, states: Float[Tensor, "*batch D"]) -> Float[Tensor, "P 3"]:
    """Learn centres of the parts from recorded states, for `Body.altered` and `Body.convert`.

    Each is the mean of the part's rotations, so that the vectors of the training data lie about
    zero and away from |q| = 1 where they would jump. (DX 1) takes that recorded q_i which maximises
    the mean scalar part of q_i^-1 q_j; the mean maximises the mean of its square over all rotations.

    Args:
        body: the states' own; its centres are undone.
        states: [..., D], recorded.

    Returns:
        [P, 3]; the root part's is zero.

    Raises:
        InputError: no state, or NaN or infinite ones.

    Reference: Daubney & Xie, equation (1).
    """
    states = states.reshape(-1, body.dim)
    if states.shape[0] == 0:
        raise InputError("centres need at least one recorded state, got none")
    check_finite("states", states)
    vectors = states[:, 3:].unflatten(-1, (-1, 3)).transpose(0, 1)
    centres = compose(body.centres, mean_rotation(vectors))
    return torch.cat([torch.zeros_like(centres[:1]), centres[1:]])
