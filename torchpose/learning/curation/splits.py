"""Splits into training and test by persons, without leaks."""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from torchpose.errors import InputError, OverlapError
from torchpose.io.recordings import Recording
from torchpose.learning.curation.duplicates import (
    refuse_shared_between_persons,
    refuse_shared_recordings,
)
from torchpose.learning.curation.upper import label

__all__ = [
    "PersonSplit",
    "leave_one_person_out",
    "persons_of",
    "pick_persons",
    "refuse_leaks",
    "split_persons",
]


class PersonSplit(NamedTuple):
    """Recordings to train on, recordings of other persons to test on, and who those are."""

    train: list[Recording]
    test: list[Recording]
    persons: tuple[str, ...]


def persons_of(recordings: Iterable[Recording]) -> list[str]:
    """The persons (`Recording.person_id`) in order, each once; companions are none of them."""
    return sorted({r.person_id for r in recordings if not r.companion})


def pick_persons(names: Iterable[str], known: Sequence[str]) -> set[str]:
    """Ids of the persons that are meant by names, which may leave out their origin.

    Where a folder stands for a person, its name is the person's.

    Args:
        names: ids (`Recording.person_id`), or what stands on one side of their ``#``.
        known: ids of everybody.

    Raises:
        InputError: nobody, or several persons, of that name.

    >>> sorted(pick_persons(["s1", "b#s2", "bob"], ["a#s1", "a#s2", "b#s2", "bob#"]))
    ['a#s1', 'b#s2', 'bob#']
    """
    found = set()
    for name in names:
        fitting = [p for p in known if name in (p, p.partition("#")[2], p.removesuffix("#"))]
        if len(fitting) != 1:
            which = f"could be {' or '.join(fitting)}" if fitting else "is nobody's name"
            raise InputError(
                f"{name!r} {which}; the recordings are of {', '.join(known) or 'nobody'}"
            )
        found.add(fitting[0])
    return found


def split_persons(recordings: Sequence[Recording], test_persons: Iterable[str]) -> PersonSplit:
    """Recordings of some persons to test on, those of all others to train on.

    Other people in a file of a test person are on neither side, because nobody says who they are.

    Args:
        recordings: all of them.
        test_persons: ids (`Recording.person_id`).

    Raises:
        InputError: a person without a recording, or nobody left on one side. OverlapError: one
            recording, or part of it, on both sides under different persons.
    """
    split = _split(recordings, sorted(set(test_persons)))
    refuse_leaks(split.train, split.test)
    return split


def _split(recordings: Sequence[Recording], wanted: list[str]) -> PersonSplit:
    known = persons_of(recordings)
    strangers = [person for person in wanted if person not in known]
    if strangers:
        raise InputError(
            f"no recording of {', '.join(strangers)}; there are recordings of {', '.join(known)}"
        )
    test = [r for r in recordings if r.person_id in wanted]
    files = {r.path for r in test if r.path is not None}
    train = [r for r in recordings if r.person_id not in wanted and r.path not in files]
    if not test or not train:
        raise InputError(
            f"a split needs persons on both sides, got {len(wanted)} to test of {len(known)} in all"
        )
    return PersonSplit(train, test, tuple(wanted))


def leave_one_person_out(recordings: Sequence[Recording]) -> Iterator[PersonSplit]:
    """One split per person, in the order of their ids: that person to test, all others to train.

    Raises:
        InputError: fewer than two persons. OverlapError: as `split_persons`.
    """
    persons = persons_of(recordings)
    if len(persons) < 2:
        raise InputError(
            f"leaving one person out needs recordings of two or more, got {', '.join(persons) or 'none'}"
            "; a folder stands for a person where files do not name one"
        )
    refuse_shared_between_persons(recordings)
    return (_split(recordings, [person]) for person in persons)


def refuse_leaks(train: Sequence[Recording], test: Sequence[Recording]) -> None:
    """Raise if a person, a file or a recording is on both sides.

    Raises:
        OverlapError: it is named.
    """
    shared = sorted({r.person_id for r in train} & {r.person_id for r in test})
    if shared:
        raise OverlapError(
            f"{', '.join(shared)} would be in training and test; take each person for one of them"
        )
    files = {r.path for r in train if r.path is not None}
    for recording in test:
        if recording.path in files:
            raise OverlapError(
                f"{label(recording)} would be in training and test, with different people in it"
            )
    refuse_shared_recordings(train, test)
