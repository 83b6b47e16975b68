"""Decide from edges whether left and right hand are swapped (Burke & Lasenby, section 5.3)."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose._core.images import Image
from torchpose._core.module_state import CpuModule
from torchpose.errors import InputError
from torchpose.measure._edges import ARM_LIMBS, Segments, limb_votes, segments_of_arms
from torchpose.measure._persons import match_states
from torchpose.skeleton._joint_sets import UPPER_BODY

_HANDS = UPPER_BODY.index("hand_left"), UPPER_BODY.index("hand_right")


class AssociationState(NamedTuple):
    """Holds the edge votes for the association of N persons' hands.

    Attributes:
        votes: for the hands as measured and for the hands swapped, per length of the limbs, decayed
            over time [N, 2].
        swapped: whether the hands are swapped [N]. identity: number of each person [N].
    """

    votes: Float[Tensor, "N 2"]
    swapped: Bool[Tensor, " N"]
    identity: Int[Tensor, " N"]


class HandAssociation(CpuModule):
    """Decides from the edges of the arms whether left and right hand are swapped.

    For the hands as measured (h = 0) and swapped (h = 1) a pose tracker has inferred elbows and
    shoulders. The edge segments that support the four limbs of each hypothesis are counted (BL 50),
    n_h, divided by the length of the limbs, and averaged over time:

        v_h <- d v_h + n_h / sum_limbs |limb|;

    Without the division longer arms would have more votes. The hands become swapped when
    v_1 > (1 + m) v_0 + l, and become unswapped when v_0 > (1 + m) v_1 + l.

    Args:
        decay: d, per frame. margin: m. least: l.
        apart: least distance of the hands, in sizes of the face; a frame in which they are nearer
            leaves the votes as they were.
        position_std: in sizes of the face. angle_std: radians. threshold, along: see `limb_votes`.

    Raises:
        InputError: settings out of range.

    Reference:
        Burke & Lasenby, section 5.3.
    """

    def __init__(
        self,
        decay: float = 0.8,
        margin: float = 0.5,
        least: float = 0.5,
        apart: float = 1.0,
        position_std: float = 0.4,
        angle_std: float = 0.4,
        threshold: float = 0.3,
        along: bool = True,
    ) -> None:
        super().__init__()
        if not (0 <= decay < 1 and min(margin, least, apart) >= 0):
            raise InputError(
                "decay must be in [0, 1), margin, least and apart not negative, got "
                f"{decay}, {margin}, {least} and {apart}"
            )
        self.decay, self.margin, self.least, self.apart = decay, margin, least, apart
        self.position_std, self.angle_std = position_std, angle_std
        self.threshold, self.along = threshold, along
        self.register_buffer("limbs", torch.tensor(ARM_LIMBS))

    limbs: Tensor

    def init(self) -> AssociationState:
        """Return the state without persons."""
        return _unknown(0)

    def step(
        self,
        state: AssociationState,
        grey: Image,
        joints: Float[Tensor, "N 2 8 2"],
        size: Float[Tensor, " N"],
        identity: Int[Tensor, " N"],
    ) -> AssociationState:
        """Return the votes after the next frame.

        Args:
            state: from `init` or the step before. grey: [H, W], uint8.
            joints: inferred with the hands as given and with the hands swapped, order of
                `UPPER_BODY`, each with its own sides, pixels; NaN where not known.
            size: of the faces, pixels. identity: number of each person.

        Raises:
            ShapeError: wrong shapes.
        """
        check_shape("joints", joints, ["N", 2, 8, 2])
        check_shape("size", size, [len(joints)])
        check_shape("identity", identity, [len(joints)])
        state = match_states(state, _unknown(1), identity)
        if not len(joints):
            return state
        between = (joints[:, 0, _HANDS[0]] - joints[:, 0, _HANDS[1]]).norm(dim=1)
        tells = between >= self.apart * size.to(between)
        if not bool(tells.any()):
            return state
        segments = segments_of_arms(grey, joints[tells], float(size[tells].median()))
        votes = self.decay * state.votes + self.votes(segments, joints, size).to(state.votes)
        votes = torch.where(tells[:, None], votes, state.votes)
        given, other = votes.unbind(1)
        factor = 1 + self.margin
        swapped = torch.where(
            state.swapped,
            ~(given > factor * other + self.least),
            other > factor * given + self.least,
        )
        return AssociationState(votes, swapped, state.identity)

    def votes(
        self, segments: Segments, joints: Float[Tensor, "N 2 8 2"], size: Float[Tensor, " N"]
    ) -> Float[Tensor, "N 2"]:
        """Return the number of supporting segments of each hypothesis per length of its limbs."""
        limbs = joints[:, :, self.limbs]  # [N, 2, limb, end, 2]
        spread = (self.position_std * size.to(joints))[:, None, None].expand(limbs.shape[:3])
        starts, ends = limbs[..., 0, :], limbs[..., 1, :]
        found = limb_votes(
            segments, starts, ends, spread, self.angle_std, self.threshold, self.along
        )
        length = (ends - starts).norm(dim=-1).nan_to_num(0.0).sum(-1) / size.to(joints)[:, None]
        return found.sum(-1) / length.clamp_min(1.0)


def _unknown(persons: int) -> AssociationState:
    """Return the state of persons without votes."""
    number = torch.zeros(persons, dtype=torch.long)
    return AssociationState(torch.zeros(persons, 2, dtype=torch.float32), number > 0, number)
