"""Gate postures by an action, or by several, and draw again those that are rejected (AS 6).

All rejected particles are drawn again together, a bounded number of times.
"""

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose.body._kinematics import Body
from torchpose.errors import InputError, SkeletonError
from torchpose.filters._recursive_filter import Generators, uniform
from torchpose.priors._actions.bank import ActionBank
from torchpose.priors._actions.gate import GATE_WIDTH, check_gate_width, match_postures
from torchpose.priors._actions.part_postures import PartPostures
from torchpose.priors._actions.postures import posture_to_state
from torchpose.priors._actions.space import ActionSpace

Actions = Int[Tensor, " R"] | None


class Rows(NamedTuple):
    """Holds some rows of a batch of particles laid out one after the other.

    Attributes:
        at: [r], row of the R = B N particles, rising. element: [r], which of the B each belongs to.
        batch: B. generator: as handed to the filter.
    """

    at: Int[Tensor, " r"]
    element: Int[Tensor, " r"]
    batch: int
    generator: Generators

    @classmethod
    def all(cls, batch: int, n: int, generator: Generators, device: torch.device) -> "Rows":
        """Return every row of [B, N]."""
        index = torch.arange(batch * n, device=device)
        return cls(index, torch.div(index, max(n, 1), rounding_mode="floor"), batch, generator)

    def keep(self, kept: Bool[Tensor, " r"]) -> "Rows":
        """Return the rows that are True."""
        return self._replace(at=self.at[kept], element=self.element[kept])

    def repeated(self, times: int) -> "Rows":
        """Return every row `times` times in turn."""
        if times == 1:
            return self
        at, element = (x.repeat_interleave(times) for x in (self.at, self.element))
        return self._replace(at=at, element=element)

    def normal(self, dim: int, like: Tensor) -> Float[Tensor, "r dim"]:
        """Draw standard normal numbers; with a list of generators, each element draws from its own."""
        return self.drawn(lambda n, g: torch.randn(
            n, dim, generator=g, dtype=like.dtype, device=like.device
        ))  # fmt: skip

    def uniform(self, like: Tensor) -> Float[Tensor, " r"]:
        """Draw uniform numbers in [0, 1), as `normal`."""
        return self.drawn(
            lambda n, g: torch.rand(n, generator=g, dtype=like.dtype, device=like.device)
        )

    def drawn(self, draw: Callable[[int, torch.Generator | None], Tensor]) -> Tensor:
        """Return numbers for every row, from draw(number, generator)."""
        if not isinstance(self.generator, Sequence):
            return draw(len(self.at), self.generator)
        counts = torch.bincount(self.element, minlength=self.batch).tolist()
        pairs = zip(counts, self.generator, strict=True)
        return torch.cat([draw(count, g) for count, g in pairs])


class Redrawn(NamedTuple):
    """Holds the states that were drawn for each of R rows.

    Attributes:
        states: [R, D], the first accepted draw, or the last one where none was.
        accepted: [R], False where none was. first: [R], whether the first draw was.
        draws: [R], how many were drawn until one was accepted, or in all.
        share: [R], an unbiased estimate of the probability that a draw is accepted.
    """

    states: Float[Tensor, "R D"]
    accepted: Bool[Tensor, " R"]
    first: Bool[Tensor, " R"]
    draws: Int[Tensor, " R"]
    share: Float[Tensor, " R"]


def redraw_until_accepted(
    draw: Callable[[Rows], Tensor],
    accept: Callable[[Tensor, Rows], Tensor],
    rows: Rows,
    max_redraws: int,
    *,
    estimate_share: bool = False,
) -> Redrawn:
    """Draw for every row until a draw is accepted, at most 1 + `max_redraws` times.

    In every round only the rows that still wait are computed, closed up to a dense tensor, and a round
    draws half as many for each of them as all rounds before it: few rounds, and little that is drawn in
    vain. The first one that is accepted counts, as if they were drawn one by one.

    With `estimate_share` a row is drawn for until a second draw is accepted (which is not used): the
    probability Z of acceptance is then estimated without bias, where k is the draw of the second one, by

        Z^ = 1 / (k - 1),   with one or none in all m draws  1 / m or 0,

    the probability that the first draw was accepted, given how many were in all. The first alone would
    give only 1{k = 1}. Accepted states are independent of Z^, so that weights Z^ are exact on average.

    Args:
        draw: rows -> states [r, D]. accept: (states, rows) -> [r]. rows: all of them.
        max_redraws: bound, 0 or more. estimate_share: whether Z^ is wanted; else it is NaN.

    Reference: Girshick, Mosteller & Savage, Unbiased estimates for certain binomial sampling problems,
    Annals of Mathematical Statistics 17 (1946), theorem 3.
    """
    wanted = 2 if estimate_share else 1
    states = draw(rows)
    first = accept(states, rows)
    count = first.long()
    draws = torch.ones_like(count)  # until the first
    until = torch.ones_like(count)  # until the last that is wanted
    done = 1
    while done <= max_redraws:
        rows = rows.keep(count[rows.at] < wanted)
        if len(rows.at) == 0:
            break
        times = min(max(done // 2, 1), max_redraws + 1 - done)
        block = _block(draw, accept, rows, times)
        index, before = rows.at, count[rows.at]
        waiting = before == 0
        states[index[waiting]] = block.states[waiting]
        draws[index] += torch.where(waiting, _draws_until(block.total, 1), 0)
        until[index] += _draws_until(before[:, None] + block.total, wanted)
        count[index] = before + block.total[:, -1]
        done += times
    share = torch.full(first.shape, torch.nan, dtype=torch.float64, device=first.device)
    if estimate_share:
        share = torch.where(count >= 2, 1 / (until - 1).clamp_min(1), count / until).double()
    return Redrawn(states, count > 0, first, draws, share)


def all_accepted(states: Float[Tensor, "R D"]) -> Redrawn:
    """Return the result of `redraw_until_accepted` for states without a gate: all accepted at first."""
    yes = torch.ones(len(states), dtype=torch.bool, device=states.device)
    return Redrawn(states, yes, yes, yes.long(), yes.double())


class _Block(NamedTuple):
    """Holds the first accepted draw of each row (else the last one), and the number of draws so far."""

    states: Tensor
    total: Tensor


def _block(
    draw: Callable[[Rows], Tensor], accept: Callable[[Tensor, Rows], Tensor], rows: Rows, times: int
) -> _Block:
    several = rows.repeated(times)
    drawn = draw(several)
    total = accept(drawn, several).view(-1, times).long().cumsum(1)
    chosen = torch.arange(len(total), device=total.device) * times + _draws_until(total, 1) - 1
    return _Block(drawn[chosen], total)


def _draws_until(total: Tensor, wanted: int) -> Tensor:
    """Return the number of draws [r] until `wanted` were accepted, or all draws."""
    return (total < wanted).sum(1).add_(1).clamp_max_(total.shape[1])


class PostureGate(nn.Module):
    """Accepts states of an action, and finds the nearest accepted ones of others.

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
        width: the width of the gate, deviations to either side.

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
        """Return actions of new particles: as many of each as its probability at the start."""
        ends = self.action.start().exp().cumsum(0)
        place = (torch.arange(n, device=ends.device) + 0.5) / n
        return torch.searchsorted(ends, place.to(ends)).clamp_max(len(ends) - 1).expand(batch, n)

    def next_actions(
        self, actions: Int[Tensor, "B N"], fps: float | None, generator: Generators
    ) -> Int[Tensor, "B N"]:
        """Draw actions one frame later, by the bank's matrix."""
        log_rows = self.action.transition(fps).log()[actions]
        drawn = uniform(len(actions), actions.shape[1:], generator, log_rows)
        return match_postures(log_rows, drawn)

    def log_evidence(
        self, states: Float[Tensor, "B N D"], actions: Int[Tensor, "B N"], fps: float | None
    ) -> Float[Tensor, "B N"]:
        """Return the log-likelihood of postures under their own actions, times the share of a frame, float64.

        The gate only says yes or no, which hardly tells actions apart that begin alike.
        """
        log = self.action.log_likelihood(self.postures(states.flatten(0, 1)))
        log = log.gather(-1, actions.flatten()[:, None]).view(actions.shape).double()
        return log * self.action.evidence_share(fps)

    # --- the gate

    def accept(
        self, relative: Float[Tensor, "r Q"], rows: Rows, actions: Actions = None
    ) -> Bool[Tensor, " r"]:
        """Tell whether each state passes the gate of the posture that is drawn for it.

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
        """Return states moved to the gate of the posture that is drawn for them, with their own root."""
        postures = self.postures(states)
        own, j = self._matched(postures, rows, actions)
        chosen = (j,) if own is None else (own, j)
        clamped = self.action.clamp_postures(postures, *chosen, self.width)
        moved = posture_to_state(self.posture_body, clamped.to(states), states)
        return torch.cat([states[:, :6], moved[:, 6:]], -1)

    def _matched(
        self, postures: Tensor, rows: Rows, actions: Tensor | None
    ) -> tuple[Tensor | None, Tensor]:
        """Return the action of each row, with a bank, and the posture of it that is drawn."""
        drawn = rows.uniform(postures)
        if actions is None:
            z = self.action.project(postures)
            return None, match_postures(self.action.log_match(z), drawn)
        own = actions[rows.at]
        return own, self.action.match(postures, own, uniform=drawn)
