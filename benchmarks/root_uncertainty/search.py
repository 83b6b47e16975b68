"""A search for survival and diffusion that goes on where the best is at the edge of what was tried."""

from collections.abc import Callable, Sequence
from math import inf, isfinite
from pathlib import Path

from benchmarks.root_uncertainty.runs import validation_error
from benchmarks.root_uncertainty.trackees import METHODS, Budget, Walker, published, selected_among
from benchmarks.silhouette.runs import Tuning
from benchmarks.silhouette.trackees import SCALES, Setting
from torchpose.filters._resampling import LEAST_SURVIVORS

__all__ = ["search_setting", "tune"]

_SCALES = (0.1, 10.0)  # none beyond is tried
_MOST = 0.97
_FIRST_SCALE = 1.4


def tune(
    walkers: Sequence[Walker],
    method: str,
    budget: Budget,
    folder: Path,
    start: Setting | None = None,
) -> Tuning:
    """Survival and diffusion with the smallest mean error over everybody's validation clips.

    Every method has the same clips and seed to choose by.

    Args:
        walkers: at the frame rate of the choice. budget: of the filter. folder: with what was measured.
        start: of the search, such as what was chosen at another rate. Without one it starts from
            `Method.first`, and the published survival is tried as well.
    """
    known, usual = METHODS[method], published(method, walkers[0].fps).value
    return search_setting(
        lambda setting: validation_error(walkers, method, setting, budget, folder),
        start or Setting(known.first, _FIRST_SCALE),
        None if start else usual,
        known.values,
        LEAST_SURVIVORS / selected_among(method, budget),
    )


def search_setting(
    error: Callable[[Setting], float],
    start: Setting,
    usual: float | None,
    values: Sequence[float],
    least: float,
    scales: Sequence[float] = SCALES,
) -> Tuning:
    """The setting whose error is smaller than that of its neighbours.

    From the start the scale goes to better neighbours until there is none, then the survival, and both
    in turn until neither changes. Where a row ends too early it goes on by the ratio of its last two:
    what is chosen lies between others that were tried, or next to the least survival that can be.

    Args:
        error: of a setting; one that is not finite is never chosen.
        start: from where it starts. usual: a value that is tried in any case, or None.
        values: shares that survive. least: share below which none is tried. scales: of the diffusion.
    """
    tried: dict[Setting, float] = {}

    def of(setting: Setting) -> float:
        if setting not in tried:
            tried[setting] = error(setting)
        return tried[setting] if isfinite(tried[setting]) else inf

    def along_scales(value: float, scale: float) -> float:
        return _descend(lambda s: of(Setting(value, s)), ladder, scale, _SCALES)

    def along_values(value: float, scale: float) -> float:
        return _descend(lambda v: of(Setting(v, scale)), row, value, (least, _MOST))

    row, ladder = sorted({*values, start.value}), sorted({*scales, start.scale})
    value, scale = start.value, along_scales(*start)
    if usual is not None:
        row = sorted({*row, usual})
        value = min(value, usual, key=lambda v: of(Setting(v, scale)))
    settled = False
    while not settled:
        before = value, scale
        value = along_values(value, scale)
        scale = along_scales(value, scale)
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
