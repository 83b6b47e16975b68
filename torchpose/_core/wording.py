"""Word lists in messages."""

from collections.abc import Sequence


def first_of(names: Sequence[object], most: int, between: str = ", ") -> str:
    """Return the first names, and how many more there are.

    >>> first_of(["a.csv", "b.csv", "c.csv"], 2)
    'a.csv, b.csv and 1 more'
    """
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return between.join(map(str, names[:most])) + more
