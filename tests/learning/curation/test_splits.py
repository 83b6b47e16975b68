"""Persons stay on one side, and copies are found under any name."""

from dataclasses import replace

import pytest
import torch

from tests.learning.curation.bodies import kinect_v1, moving, recording
from torchpose.errors import InputError, OverlapError
from torchpose.learning._curation import (
    find_duplicates,
    leave_one_person_out,
    persons_of,
    refuse_leaks,
    split_persons,
)
from torchpose.learning._curation.splits import same_names

PERSONS = ("ann", "bob", "cyd")


def everybody():
    return [
        recording(person, name, moving(60, seed=10 * p + n))
        for p, person in enumerate(PERSONS)
        for n, name in enumerate("ab")
    ]


def test_leave_one_person_out():
    recordings = everybody()
    splits = list(leave_one_person_out(recordings))
    assert [s.persons for s in splits] == [(f"{p}#",) for p in PERSONS]
    for split in splits:
        assert len(split.train) == 4 and len(split.test) == 2
        assert {r.person_id for r in split.test} == set(split.persons)
        assert not {r.person_id for r in split.train} & set(split.persons)
        assert {id(r) for r in split.train + split.test} == {id(r) for r in recordings}


def test_split_persons():
    split = split_persons(everybody(), ["cyd", "ann#"])
    assert persons_of(split.train) == ["bob#"] and persons_of(split.test) == ["ann#", "cyd#"]
    for wanted, word in ((["dan#"], "'dan#' is nobody's name.*ann#"), ([], "both sides"),
                         ([f"{p}#" for p in PERSONS], "both sides")):  # fmt: skip
        with pytest.raises(InputError, match=word):
            split_persons(everybody(), wanted)
    with pytest.raises(InputError, match="two or more"):
        leave_one_person_out(everybody()[:2])


def test_one_name_in_several_folders_is_doubtful():
    """Without a source, each folder's person counts apart; nobody is left out, but it is said."""
    days = [
        replace(recording(day, name, moving(60, seed=10 * d + n)), person=name)
        for d, day in enumerate(("monday", "tuesday"))
        for n, name in enumerate(("ann", "bob"))
    ]
    with pytest.warns(UserWarning, match="monday#(ann|bob), tuesday#.* count as 2 persons") as all_:
        assert len(list(leave_one_person_out(days))) == 4
    assert len(all_) == 2
    with pytest.warns(UserWarning, match="monday#ann, tuesday#ann count as 2 persons") as told:
        split_persons(days, ["monday#ann"])
    assert len(told) == 1
    split_persons(days, ["monday#ann", "tuesday#ann"])  # on one side
    leave_one_person_out([replace(r, source=f"{r.person}/set@0") for r in days])
    leave_one_person_out([replace(r, person="") for r in days])


def test_names_that_differ_in_case_are_doubtful():
    both = [recording(person, "a", moving(120)) for person in ("ann", "Ann")]
    [note] = same_names(both)
    assert note.startswith("Ann#, ann# count as 2 persons, since their names differ in case")
    assert same_names(everybody()) == []


def test_companions_of_a_test_person_are_on_neither_side():
    friend = recording("ann", "a", moving(60, seed=77), companion=1)
    other = recording("bob", "a", moving(60, seed=78), companion=1)
    split = split_persons([*everybody(), friend, other], ["ann#"])
    assert not any(r is friend for r in split.train + split.test)
    assert any(r is other for r in split.train)
    assert persons_of([*everybody(), friend]) == [f"{p}#" for p in PERSONS]


def test_leaks_are_refused():
    ann, bob = recording("ann"), recording("bob", joints=moving(seed=5))
    refuse_leaks([ann], [bob])
    with pytest.raises(OverlapError, match="ann# would be in training and test"):
        refuse_leaks([ann, bob], [recording("ann", "z", moving(seed=9))])
    with pytest.raises(OverlapError, match=r"ann/a\.csv would be"):
        refuse_leaks([ann], [recording("ann", "a", moving(seed=9), companion=1)])
    copy = recording("cyd", "copy", ann.joints)
    with pytest.raises(OverlapError, match=r"100 % .*cyd/copy.*cyd#.*ann/a.*ann#.*test"):
        refuse_leaks([ann, bob], [copy])
    with pytest.raises(OverlapError, match=r"cyd/copy"):
        list(leave_one_person_out([ann, bob, copy]))


@pytest.mark.parametrize(
    "change",
    [
        lambda j: j,
        lambda j: j.float().double(),
        lambda j: (j * 1000).round() / 1000,
        lambda j: j - j[:, 4:5],
        lambda j: j + torch.tensor([0.3, 0.0, -1.0]),
        lambda j: j[40:],
        lambda j: j[:120],
        lambda j: torch.where(torch.arange(len(j))[:, None, None] == 7, torch.nan, j),
    ],
)
def test_copies_are_found(change):
    original = moving(200, seed=3)
    others = [recording("bob", str(i), moving(150, seed=50 + i)) for i in range(4)]
    everyone = [others[0], recording("ann", joints=original), *others[1:]]
    everyone.append(recording("cyd", joints=change(original)))
    [found] = find_duplicates(everyone)
    assert (found.first, found.second) == (1, 5)
    assert found.shared > 0.7


def test_copies_in_another_joint_set_are_found():
    joints, names = kinect_v1(moving(100))
    both = [recording(joints=moving(100)), recording("bob", joints=joints, names=names)]
    assert len(find_duplicates(both)) == 1


def test_what_is_no_copy():
    assert find_duplicates([]) == []
    assert find_duplicates([recording(), recording("b", joints=moving(seed=8))]) == []
    part = torch.cat([moving(200, seed=3)[:30], moving(300, seed=8)])
    assert (
        find_duplicates([recording(joints=moving(200, seed=3)), recording("b", joints=part)]) == []
    )
    assert find_duplicates([recording(joints=torch.full((4, 8, 3), torch.nan))]) == []
    still = moving(1).repeat(50, 1, 1)  # a still recording is no copy of itself
    assert find_duplicates([recording(joints=still)]) == []
