"""Choose the settings of a method: a value of its own, and a scale of its noise.

`choose_setting` tries the same grid for every method. `search_setting` goes on where the best is at the
edge of what was tried.
"""

import json
from collections.abc import Callable, Sequence
from math import inf, isfinite
from pathlib import Path
from typing import NamedTuple

from torchpose._core.reading import require_file
from torchpose.errors import FileFormatError, InputError

SCALES = (0.7, 1.0, 1.4, 2.0, 2.8)
"""Factors of the diffusion that validation chooses among; 1 is the motion of the validation clips."""

_SCALES = (0.1, 10.0)  # none beyond is tried
_MOST = 0.97


class Setting(NamedTuple):
    """What a method is run with: sharpness or survival rate, and factor of the diffusion."""

    value: float
    scale: float = 1.0


class Tuning(NamedTuple):
    """What validation chose for a method, and the errors of all settings it tried."""

    setting: Setting
    tried: tuple[Setting, ...] = ()
    errors: tuple[float, ...] = ()

    def error_of(self, setting: Setting) -> float:
        """Return the error of a setting; NaN if it was not tried."""
        return dict(zip(self.tried, self.errors, strict=True)).get(setting, float("nan"))

    @property
    def error(self) -> float:
        """Return the error of the chosen setting, NaN if none was tried."""
        return self.error_of(self.setting)

    def text(self, digits: str = "g") -> str:
        """Return all that was tried in words: value x scale, error.

        Args:
            digits: format of the values.
        """
        tried = zip(self.tried, self.errors, strict=True)
        return "; ".join(f"{s.value:{digits}} x {s.scale:g}, {e:.0f}" for s, e in tried) or "-"


def choose_setting(
    error: Callable[[Setting], float],
    first: float,
    values: Sequence[float],
    scales: Sequence[float] = SCALES,
) -> Tuning:
    """Return the setting with the smallest error: first the scale at the value `first`, then the value.

    Args:
        error: of a setting; one that is not finite is never chosen.
        first: value with which the scale is chosen. values, scales: what is tried.
    """
    tried: dict[Setting, float] = {}

    def best() -> Setting:
        return min(tried, key=lambda s: tried[s] if isfinite(tried[s]) else inf)

    for scale in scales:
        tried[Setting(first, scale)] = error(Setting(first, scale))
    scale = best().scale
    for value in values:
        if Setting(value, scale) not in tried:
            tried[Setting(value, scale)] = error(Setting(value, scale))
    return Tuning(best(), tuple(tried), tuple(tried.values()))


def search_setting(
    error: Callable[[Setting], float],
    start: Setting,
    usual: float | None,
    values: Sequence[float],
    least: float,
    scales: Sequence[float] = SCALES,
) -> Tuning:
    """Return the setting whose error is smaller than that of its neighbours.

    From the start the scale goes to better neighbours until there is none, then the value, and both
    in turn until neither changes. Where a row ends too early it goes on by the ratio of its last two:
    what is chosen lies between others that were tried, or next to the least value that can be.

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


def read_settings(
    path: str | Path, methods: Sequence[str], condition: str | None = None
) -> dict[str, Setting]:
    """Return the settings that an earlier run chose for these methods.

    Args:
        path: report.json of the run, or its folder. methods: by name.
        condition: for which it chose, where it chose for several, such as frame rates.

    Raises:
        InputError: no such file, or a method that the run, or the condition, did not have.
        FileFormatError: no report of one choice for each method.
    """
    path = require_file(Path(path) / "report.json" if Path(path).is_dir() else path)
    try:
        chosen = json.loads(path.read_text(encoding="utf-8"))["settings"]["settings"]
        if condition is not None:
            chosen = chosen.get(condition, {})
        known = {name: Setting(float(s["value"]), float(s["scale"])) for name, s in chosen.items()}
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise FileFormatError(
            f"{path}: expected the report.json of a run of this protocol with one number of particles "
            f"and one size, whose settings hold a value and a scale for each method ({error!r})"
        ) from error
    missing = [name for name in methods if name not in known]
    if missing:
        at = f" at {condition}" if condition else ""
        raise InputError(
            f"{path}: expected settings of {', '.join(methods)}{at}; there are none of "
            f"{', '.join(missing)}, only of {', '.join(known) or 'nobody'}: run without --settings, or "
            "choose with --method"
        )
    return {name: known[name] for name in methods}
