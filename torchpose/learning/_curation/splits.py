"""Split persons into training and test without leaks: duplicates, shared recordings, kinds of joints."""

import warnings
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose._core.wording import alike_once, first_of
from torchpose.errors import InputError, OverlapError
from torchpose.io._recordings import Recording
from torchpose.learning._curation.joints import label, measured
from torchpose.learning._training import one_kind

_GRID = 0.02  # metres: coarse, so that copies in whole millimetres mostly agree on it
_SHARED = 0.5  # of the shorter recording's frames
_MOST_COPIES = 64  # of one frame that are compared
_NECK = 4
_MISSING = -(2**40)


class Duplicate(NamedTuple):
    """Holds the indices of two recordings with the same frames, and the share of the shorter one's frames."""

    first: int
    second: int
    shared: float


def find_duplicates(recordings: Sequence[Recording]) -> list[Duplicate]:
    """Find pairs of recordings that share at least half of the shorter one's frames.

    A frame is its eight joints relative to the neck, rounded to 2 cm, as a hash of 64 bits; so copies
    are found that were moved, cut, renamed, or written in whole millimetres. A copy that was turned,
    scaled or mirrored is not. Equal frames within one recording count once.
    """
    keys = [torch.unique(_frame_keys(r.upper_body().joints)) for r in recordings]
    sizes = torch.tensor([len(k) for k in keys], dtype=torch.long)
    which = torch.arange(len(keys)).repeat_interleave(sizes)
    flat, order = torch.sort(torch.cat(keys) if keys else sizes, stable=True)
    which = which[order]
    pairs = []
    for apart in range(1, _MOST_COPIES):
        same = flat[apart:] == flat[:-apart]
        if not bool(same.any()):
            break
        pairs.append(torch.stack([which[:-apart][same], which[apart:][same]], 1))
    if not pairs:
        return []
    found, counts = torch.unique(torch.cat(pairs), dim=0, return_counts=True)
    share = counts / torch.minimum(sizes[found[:, 0]], sizes[found[:, 1]])
    return [
        Duplicate(first, second, part)
        for (first, second), part in zip(found.tolist(), share.tolist(), strict=True)
        if part >= _SHARED
    ]


def refuse_shared_recordings(train: Sequence[Recording], test: Sequence[Recording]) -> None:
    """Raise if a recording, or part of it, is on both sides.

    Raises:
        OverlapError: both files and persons are named.
    """
    both = [*train, *test]
    for found in find_duplicates(both):
        if found.first < len(train) <= found.second:
            raise OverlapError(
                f"{describe_duplicate(found, both)}; the first would be in the test and the second "
                "in training: remove one"
            )


def refuse_shared_between_persons(recordings: Sequence[Recording]) -> list[Duplicate]:
    """Raise if a recording, or part of it, is there under two persons.

    Returns:
        The duplicates of one person.

    Raises:
        OverlapError: both files and persons are named.
    """
    duplicates = find_duplicates(recordings)
    for found in duplicates:
        if recordings[found.first].person_id != recordings[found.second].person_id:
            raise OverlapError(
                f"{describe_duplicate(found, recordings)}; a recording under two persons would leak "
                "from training into a test: remove one, or put both into the folder of one person"
            )
    return duplicates


def describe_duplicate(found: Duplicate, recordings: Sequence[Recording]) -> str:
    """Return a sentence on which recording is contained in which other one."""
    first, second = recordings[found.first], recordings[found.second]
    return (
        f"{100 * found.shared:.0f} % of the frames of {label(second)} (person {second.person_id}) "
        f"are also in {label(first)} (person {first.person_id})"
    )


def _frame_keys(joints: Float[Tensor, "T 8 3"]) -> Int[Tensor, " N"]:
    """Return a hash of each frame that has a joint."""
    joints = joints[measured(joints).any(1)].double()
    neck = joints[:, _NECK : _NECK + 1]
    joints = joints - torch.where(torch.isfinite(neck), neck, 0.0)
    grid = torch.where(torch.isfinite(joints), (joints / _GRID).round(), _MISSING).long()
    generator = torch.Generator().manual_seed(0)
    factors = torch.randint(-(2**62), 2**62, (grid[0].numel() if len(grid) else 24,),
                            generator=generator) | 1  # fmt: skip
    return (grid.flatten(1) * factors).sum(1)  # in the ring of 64-bit numbers


class PersonSplit(NamedTuple):
    """Holds the recordings to train on, recordings of other persons to test on, and the test persons."""

    train: list[Recording]
    test: list[Recording]
    persons: tuple[str, ...]


def persons_of(recordings: Iterable[Recording]) -> list[str]:
    """Return the persons (`Recording.person_id`) in order, each once, without companions."""
    return sorted({r.person_id for r in recordings if not r.companion})


def same_names(recordings: Iterable[Recording]) -> list[str]:
    """Return notes on names that files in several folders give: each folder's person counts apart.

    Files that state their source are passed over, since it tells what they belong to. Names that differ in
    case alone are told too.
    """
    ids: dict[str, set[str]] = {}
    spellings: dict[str, set[str]] = {}
    for recording in recordings:
        if not recording.companion:
            spellings.setdefault(recording.person_id.casefold(), set()).add(recording.person_id)
        if recording.person and not recording.source and not recording.companion:
            ids.setdefault(recording.person, set()).add(recording.person_id)
    notes = [
        f"{', '.join(sorted(found))} count as {len(found)} persons, since their names differ in case; if "
        "they are one person, who may then be in training and test, spell the name in one way"
        for found in spellings.values()
        if len(found) > 1
    ]
    return notes + [
        f"{', '.join(sorted(found))} count as {len(found)} persons, since no file states a source; if "
        f"they are one person, {name} may be in training and test: put the files into one folder, or "
        "give them the same source"
        for name, found in ids.items()
        if len(found) > 1
    ]


def notes_of_reading(recordings: Iterable[Recording]) -> list[str]:
    """Return what reading noted on single recordings, alike notes once, with how many recordings have them.

    Pieces of one recording count as one.
    """
    whole = {(r.path or id(r), r.companion): r for r in recordings}
    return alike_once(note for r in whole.values() for note in r.notes)


def unstated_rates(recordings: Iterable[Recording]) -> list[str]:
    """Return a note on recordings that do not state their frame rate, if there are any."""
    unknown = [label(recording) for recording in recordings if not recording.fps]
    if not unknown:
        return []
    return [
        f"no frame rate is stated by {first_of(unknown, 2)}; that of most other recordings is "
        "assumed, without any 30 frames per second: state it (key `fps` in the .npz, a column `time` or "
        "`# fps = 30` above the header of a table)"
    ]


def pick_persons(names: Iterable[str], known: Sequence[str]) -> set[str]:
    """Return the ids of the named persons; a name may leave out its origin.

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


def pick_sides(
    known: Sequence[str], persons: Iterable[str] | None, held_out: Iterable[str]
) -> tuple[set[str], set[str]]:
    """Return the ids of those to fit to, and of those who are held out.

    Args:
        known: ids of everybody. persons, held_out: names, as of `pick_persons`; without `persons` everybody
            is fitted to who is not held out.

    Raises:
        InputError: as `pick_persons`. OverlapError: a person on both sides.
    """
    out = pick_persons(held_out, known)
    fitted = set(known) - out if persons is None else pick_persons(persons, known)
    both = sorted(fitted & out)
    if both:
        raise OverlapError(
            f"{', '.join(both)}: held out, but to be fitted to as well; name each person on one side"
        )
    return fitted, out


def split_persons(recordings: Sequence[Recording], test_persons: Iterable[str]) -> PersonSplit:
    """Split recordings into those of some persons for the test and those of all others for training.

    Other people in a file of a test person are on neither side, because nobody says who they are.
    A warning tells of files on both sides that give one name, in different folders.

    Args:
        recordings: all of them.
        test_persons: ids (`Recording.person_id`), or what stands on one side of their ``#``.

    Returns:
        `PersonSplit` with the recordings to train on and to test on.

    Raises:
        InputError: a person without a recording, or nobody left on one side. OverlapError: one
            recording, or part of it, on both sides under different persons.
    """
    split = _split(recordings, sorted(pick_persons(test_persons, persons_of(recordings))))
    refuse_leaks(split.train, split.test)
    apart = {*same_names(split.train), *same_names(split.test)}
    _warn([note for note in same_names([*split.train, *split.test]) if note not in apart])
    return split


def _split(recordings: Sequence[Recording], wanted: list[str]) -> PersonSplit:
    test = [r for r in recordings if r.person_id in wanted]
    files = {r.path for r in test if r.path is not None}
    train = [r for r in recordings if r.person_id not in wanted and r.path not in files]
    if not test or not train:
        raise InputError(
            f"a split needs persons on both sides, got {len(wanted)} to test of "
            f"{len(persons_of(recordings))} in all"
        )
    return PersonSplit(train, test, tuple(wanted))


def leave_one_person_out(recordings: Sequence[Recording]) -> Iterator[PersonSplit]:
    """Return one split per person, in the order of their ids, with that person as the test.

    A warning tells of files that give one name, in different folders.

    Args:
        recordings: the recordings of two persons or more.

    Returns:
        Iterator over `PersonSplit`, as many as there are persons.

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
    _warn(same_names(recordings))
    return (_split(recordings, [person]) for person in persons)


def _warn(notes: Iterable[str]) -> None:
    for note in notes:
        warnings.warn(note, stacklevel=3)  # who called the public function


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


def check_kinds(recordings: Sequence[Recording]) -> None:
    """Raise unless all recordings have the same kind of hand and of head, as `collect_poses` needs.

    Necks are no matter: they are converted there.

    Raises:
        InputError: no recordings. PriorError: kinds are mixed; files of each kind are named.
    """
    if not recordings:
        raise InputError("expected at least one recording, got none")
    bodies = [recording.upper_body() for recording in recordings]
    files = [label(recording) for recording in recordings]
    one_kind("hand", [body.hand for body in bodies], files)
    one_kind("head", [body.head for body in bodies], files)


def skeleton_counts(recordings: Sequence[Recording]) -> dict[str, int]:
    """Count the recordings of each joint set; those of no known set under ``other``."""
    names = sorted(r.skeleton or "other" for r in recordings)
    return {name: names.count(name) for name in dict.fromkeys(names)}
