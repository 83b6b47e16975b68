"""The gate of an action, or of several, as a filter over body states asks for it (AS 6)."""

from copy import deepcopy
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose.body.kinematics import Body
from torchpose.errors import InputError, SkeletonError
from torchpose.filters.base import Generators, uniform
from torchpose.priors.actions.bank import ActionBank
from torchpose.priors.actions.gate import GATE_WIDTH, check_gate_width, match_postures
from torchpose.priors.actions.part_postures import PartPostures
from torchpose.priors.actions.postures import posture_to_state
from torchpose.priors.actions.space import ActionSpace
from torchpose.whole_body.filters.redraw import Rows

__all__ = ["PostureGate"]

Actions = Int[Tensor, " R"] | None


class PostureGate(nn.Module):
    """Whether states belong to an action, and the nearest ones that do.

    The relative angles of a state are projected, a posture j of the mean performance is drawn for them
    (its match), and they are let through if they lie within two deviations of it in all dimensions
    (AS 6). Position and orientation of the root make no difference. It computes in float32.

    Args:
        body: whose states.
        action: one action, or a bank of several, whose index each state then has; the last one is none,
            which lets everything through.
        posture_body: body on which the performances of the action were put (`Body.convert`); the
            postures of states are then told on it too, so that where this person's shoulders and hips
            are makes no difference. The same body if None.
        width: of the gate, deviations to either side.

    Raises:
        SkeletonError: a body of other joints. InputError: not an action, or a width that is not positive.
    """

    action: Any  # an ActionSpace, or an ActionBank if `several`
    postures: PartPostures

    def __init__(
        self,
        body: Body,
        action: ActionSpace | ActionBank,
        posture_body: Body | None = None,
        width: float = GATE_WIDTH,
    ) -> None:
        super().__init__()
        if not isinstance(action, ActionSpace | ActionBank):
            raise InputError(
                f"action must be an ActionSpace, an ActionBank or None, got {type(action).__name__}"
            )
        check_gate_width(width)
        if posture_body is None:
            posture_body = deepcopy(body)  # that of the filter has its own place in the state
        elif posture_body.skeleton != body.skeleton:
            raise SkeletonError(
                f"expected a posture_body of skeleton {body.skeleton.name!r}, got "
                f"{posture_body.skeleton.name!r}"
            )
        else:  # a state then means the same rotations to both
            posture_body = posture_body.altered(centres=body.centres, frame=body.frame)
        self.posture_body, self.width = posture_body, width
        self.postures = PartPostures(posture_body)
        self.action = deepcopy(action).to(body.offsets.device, torch.float32)
        self.several = isinstance(action, ActionBank)

    # --- which action each particle is of

    def first_actions(self, batch: int, n: int) -> Int[Tensor, "B N"]:
        """Actions of new particles: as many of each as its probability at the start."""
        ends = self.action.start().exp().cumsum(0)
        place = (torch.arange(n, device=ends.device) + 0.5) / n
        return torch.searchsorted(ends, place.to(ends)).clamp_max(len(ends) - 1).expand(batch, n)

    def next_actions(
        self, actions: Int[Tensor, "B N"], fps: float | None, generator: Generators
    ) -> Int[Tensor, "B N"]:
        """Actions one frame later, drawn by the bank's matrix."""
        log_rows = self.action.transition(fps).log()[actions]
        drawn = uniform(len(actions), actions.shape[1:], generator, log_rows)
        return match_postures(log_rows, drawn)

    def log_evidence(
        self, states: Float[Tensor, "B N D"], actions: Int[Tensor, "B N"], fps: float | None
    ) -> Float[Tensor, "B N"]:
        """How likely every posture is under its own action, float64, to the power that a frame counts.

        The gate only says yes or no, which hardly tells actions apart that begin alike.
        """
        log = self.action.log_likelihood(self.postures(states.flatten(0, 1)))
        log = log.gather(-1, actions.flatten()[:, None]).view(actions.shape).double()
        return log * self.action.evidence_share(fps)

    # --- the gate

    def accept(
        self, relative: Float[Tensor, "r Q"], rows: Rows, actions: Actions = None
    ) -> Bool[Tensor, " r"]:
        """Whether each state passes the gate of the posture that is drawn for it.

        Args:
            relative: columns without the root, of these rows. rows: with the generator.
            actions: of all R rows, with a bank.
        """
        postures = self.postures.of_relative(relative)
        own, j = self._matched(postures, rows, actions)
        if own is not None:
            return self.action.inside(postures, own, j, self.width)
        return self.action.inside(self.action.project(postures), j, self.width)

    def clamp(
        self, states: Float[Tensor, "r D"], rows: Rows, actions: Actions = None
    ) -> Float[Tensor, "r D"]:
        """States moved to the gate of the posture that is drawn for them, with their own root."""
        postures = self.postures(states)
        own, j = self._matched(postures, rows, actions)
        chosen = (j,) if own is None else (own, j)
        clamped = self.action.clamp_postures(postures, *chosen, self.width)
        moved = posture_to_state(self.posture_body, clamped.to(states), states)
        return torch.cat([states[:, :6], moved[:, 6:]], -1)

    def _matched(
        self, postures: Tensor, rows: Rows, actions: Tensor | None
    ) -> tuple[Tensor | None, Tensor]:
        """The action of each row, with a bank, and the posture of it that is drawn."""
        drawn = rows.uniform(postures)
        if actions is None:
            z = self.action.project(postures)
            return None, match_postures(self.action.log_match(z), drawn)
        own = actions[rows.at]
        return own, self.action.match(postures, own, uniform=drawn)
