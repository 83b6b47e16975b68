"""Sheets of small drawings, several in a row."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_COLUMNS = 4
_PAPER = 255


def sheet(views: Sequence[np.ndarray]) -> np.ndarray:
    """Return drawings of one size as a sheet, four in a row, the last row filled up with paper."""
    whole = [*views, *[np.full_like(views[0], _PAPER)] * (-len(views) % _COLUMNS)]
    rows = [np.hstack(whole[i : i + _COLUMNS]) for i in range(0, len(whole), _COLUMNS)]
    return np.vstack(rows)
