"""Tell recordings at different frame rates apart."""

from collections.abc import Sequence

import numpy as np

_SPREAD = 1.05  # of what time stamps say about sensors that run at one rate


def group_by_rate(rates: Sequence[float], usual: float | None = None) -> dict[float, list[int]]:
    """Return the indices of recordings by frame rate, with the median rate of each group as its key.

    Rates within 5 % of the lowest one of a group belong to it, since time stamps of sensors that run at
    one rate say slightly different ones.

    Args:
        rates: frames per second of each recording. usual: a rate that those within 5 % of it are taken for.
    """
    if usual is not None:
        rates = [usual if same_rate(rate, usual) else rate for rate in rates]
    groups: list[list[int]] = []
    for index in np.argsort(rates, kind="stable").tolist():
        if not groups or rates[index] > _SPREAD * rates[groups[-1][0]]:
            groups.append([])
        groups[-1].append(index)
    return {float(np.median([rates[i] for i in group])): sorted(group) for group in groups}


def same_rate(rate: float, other: float) -> bool:
    """Return whether two frame rates differ by 5 % at most."""
    return max(rate, other) <= _SPREAD * min(rate, other)
