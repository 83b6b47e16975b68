"""Drawing again what was not accepted, for many particles at once and a bounded number of times."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.filters.base import Generators

__all__ = ["Redrawn", "Rows", "all_accepted", "redraw_until_accepted"]


class Rows(NamedTuple):
    """Some rows of a batch of particles laid out one after the other.

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
        """Every row of [B, N]."""
        index = torch.arange(batch * n, device=device)
        return cls(index, torch.div(index, max(n, 1), rounding_mode="floor"), batch, generator)

    def keep(self, kept: Bool[Tensor, " r"]) -> "Rows":
        """The rows that are True."""
        return self._replace(at=self.at[kept], element=self.element[kept])

    def repeated(self, times: int) -> "Rows":
        """Every row so many times in turn."""
        if times == 1:
            return self
        at, element = (x.repeat_interleave(times) for x in (self.at, self.element))
        return self._replace(at=at, element=element)

    def normal(self, dim: int, like: Tensor) -> Float[Tensor, "r dim"]:
        """Standard normal numbers; with a list of generators, each element draws from its own."""
        return self.drawn(lambda n, g: torch.randn(
            n, dim, generator=g, dtype=like.dtype, device=like.device
        ))  # fmt: skip

    def uniform(self, like: Tensor) -> Float[Tensor, " r"]:
        """Uniform numbers in [0, 1), as `normal`."""
        return self.drawn(
            lambda n, g: torch.rand(n, generator=g, dtype=like.dtype, device=like.device)
        )

    def drawn(self, draw: Callable[[int, torch.Generator | None], Tensor]) -> Tensor:
        """Numbers for every row, from draw(number, generator)."""
        if not isinstance(self.generator, Sequence):
            return draw(len(self.at), self.generator)
        counts = torch.bincount(self.element, minlength=self.batch).tolist()
        pairs = zip(counts, self.generator, strict=True)
        return torch.cat([draw(count, g) for count, g in pairs])


class Redrawn(NamedTuple):
    """What was drawn for each of R rows.

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
        draws[index] += torch.where(waiting, _place(block.total, 1), 0)
        until[index] += _place(before[:, None] + block.total, wanted)
        count[index] = before + block.total[:, -1]
        done += times
    share = torch.full(first.shape, torch.nan, dtype=torch.float64, device=first.device)
    if estimate_share:
        share = torch.where(count >= 2, 1 / (until - 1).clamp_min(1), count / until).double()
    return Redrawn(states, count > 0, first, draws, share)


def all_accepted(states: Float[Tensor, "R D"]) -> Redrawn:
    """What `redraw_until_accepted` returns where there is nothing to accept."""
    yes = torch.ones(len(states), dtype=torch.bool, device=states.device)
    return Redrawn(states, yes, yes, yes.long(), yes.double())


class _Block(NamedTuple):
    """The first accepted of several draws for each row (else the last one), and how many were so far."""

    states: Tensor
    total: Tensor


def _block(
    draw: Callable[[Rows], Tensor], accept: Callable[[Tensor, Rows], Tensor], rows: Rows, times: int
) -> _Block:
    several = rows.repeated(times)
    drawn = draw(several)
    total = accept(drawn, several).view(-1, times).long().cumsum(1)
    chosen = torch.arange(len(total), device=total.device) * times + _place(total, 1) - 1
    return _Block(drawn[chosen], total)


def _place(total: Tensor, wanted: int) -> Tensor:
    """Number of draws until so many were accepted, or all of them [r]."""
    return (total < wanted).sum(1).add_(1).clamp_max_(total.shape[1])
