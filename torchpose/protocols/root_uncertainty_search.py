"""A search for survival and diffusion that goes on where the best is at the edge of what was tried."""

from collections.abc import Callable, Sequence
from math import inf, isfinite

from torchpose.protocols.silhouette_runs import Tuning
from torchpose.protocols.silhouette_trackees import SCALES, Setting

__all__ = ["search_setting"]

_SCALES = (0.1, 10.0)  # none beyond is tried
_MOST = 0.97


def search_setting(
    error: Callable[[Setting], float],
    first: float,
    values: Sequence[float],
    least: float,
    scales: Sequence[float] = SCALES,
) -> Tuning:
    """The setting whose error is smaller than that of all its neighbours.

    First the scale at the value `first`, then the value at that scale, then both in turn among their
    neighbours until neither changes. Where the best of a row is its end, the row goes on by the
    ratio of its last two, as long as there are such settings: what is chosen lies between others that
    were tried, or at the least survival.

    Args:
        error: of a setting; one that is not finite is never chosen.
        first: value with which the scale is chosen. values: shares that survive, ascending.
        least: share below which none is tried. scales: of the diffusion, ascending.
    """
    tried: dict[Setting, float] = {}

    def of(setting: Setting) -> float:
        if setting not in tried:
            tried[setting] = error(setting)
        return tried[setting] if isfinite(tried[setting]) else inf

    row = [value for value in values if value >= least]
    ladder = list(scales)
    scale = min(ladder, key=lambda s: of(Setting(first, s)))
    scale = _descend(lambda s: of(Setting(first, s)), ladder, scale, _SCALES)
    value = min(row, key=lambda v: of(Setting(v, scale)))
    settled = False
    while not settled:
        before = value, scale
        value = _descend(lambda v: of(Setting(v, scale)), row, value, (least, _MOST))  # noqa: B023
        scale = _descend(lambda s: of(Setting(value, s)), ladder, scale, _SCALES)  # noqa: B023
        settled = before == (value, scale)
    return Tuning(Setting(value, scale), tuple(tried), tuple(tried.values()))


def _descend(
    error: Callable[[float], float], row: list[float], at: float, within: tuple[float, float]
) -> float:
    """Go to better neighbours until there is none; the row is made longer where it ends too early."""
    while True:
        for end, inner in ((row[0], row[1]), (row[-1], row[-2])):
            further = float(f"{end * end / inner:.2g}")
            if at == end and within[0] <= further <= within[1]:
                row.append(further)
        row.sort()
        place = row.index(at)
        best = min(row[max(0, place - 1) : place + 2], key=error)
        if error(best) >= error(at):
            return at
        at = best
