"""Word lists and counts in messages."""

import re
from collections.abc import Iterable, Sequence

_NUMBERS = re.compile(r"\d[\d.]*(?:(?:, |-)\d[\d.]*)*(?: and \d+ more places)?")


def first_of(names: Sequence[object], most: int, between: str = ", ") -> str:
    """Return the first names, and how many more there are.

    >>> first_of(["a.csv", "b.csv", "c.csv"], 2)
    'a.csv, b.csv and 1 more'
    """
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return between.join(map(str, names[:most])) + more


def numbered_frames(frames: Sequence[int], most: int = 8) -> str:
    """Return "frame" or "frames" with the first numbers, and how many more there are.

    >>> numbered_frames([12]), numbered_frames([12, 30, 31], 2)
    ('frame 12', 'frames 12, 30 and 1 more')
    """
    return f"{'frame' if len(frames) == 1 else 'frames'} {first_of(frames, most)}"


def counted(count: int, one: str, several: str = "") -> str:
    """Return a number of things, `one` of them or `several`, which is `one` with an s by default.

    >>> counted(1, "camera"), counted(2, "camera"), counted(1, "frame is", "frames are")
    ('1 camera', '2 cameras', '1 frame is')
    """
    return f"{count} {one if count == 1 else several or f'{one}s'}"


def alike_once(notes: Iterable[str]) -> list[str]:
    """Return notes on recordings, those that differ in numbers once, with how many recordings have them.

    >>> alike_once(["25 fps assumed", "no camera", "30 fps assumed"])
    ['25 fps assumed (2 recordings, numbers of the first)', 'no camera (1 recording)']
    """
    alike: dict[str, list[str]] = {}
    for note in notes:
        alike.setdefault(_NUMBERS.sub("#", note), []).append(note)
    first = ", numbers of the first"
    return [
        f"{same[0]} ({counted(len(same), 'recording')}{first * (len(set(same)) > 1)})"
        for same in sorted(alike.values(), key=len, reverse=True)
    ]
