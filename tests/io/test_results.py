"""Folders of results: all files of a run or none, and never a file of the user's lost."""

import os
import signal
import sys
import warnings
from pathlib import Path

import pytest

from torchpose._core.files import atomic_path, check_output_folder
from torchpose.errors import OutputError
from torchpose.io._results import ResultsFolder, refuse_stranger, replace_own

NAMES = ("a.txt", "b.txt", "c.txt")
LIST = ".torchpose-notes.json"


def folder_of(out, expected=("a.txt",), **options):
    return ResultsFolder(out, "notes", r"[abc]\d?\.txt", expected, **options)


def write(out, text, names=NAMES, **options):
    """A run that writes the same text under some names; returns what it has to say."""
    with folder_of(out, names, **options) as results:
        for name in names:
            (results.stage / name).write_text(text)
        results.commit([results.stage / name for name in names])
    return results.notes


def content(folder):
    """Every file that is seen, by name."""
    return {p.name: p.read_text() for p in folder.iterdir() if p.is_file() and p.name[0] != "."}


def test_nothing_is_there_before_the_commit_and_everything_after_it(tmp_path):
    with folder_of(tmp_path / "new") as results:
        written = [results.stage / name for name in NAMES]
        for path in written:
            path.write_text("one")
        assert content(tmp_path / "new") == {}
        assert results.commit(written) == [tmp_path / "new" / name for name in NAMES]
    assert content(tmp_path / "new") == dict.fromkeys(NAMES, "one")
    assert {p.name for p in (tmp_path / "new").iterdir()} == {*NAMES, LIST}


def test_the_next_run_replaces_and_deletes_what_the_last_one_wrote_and_nothing_else(tmp_path):
    write(tmp_path, "one")
    (tmp_path / "a2.txt").write_text("mine")
    (tmp_path / "notes.txt").write_text("mine")
    write(tmp_path, "two", ("a.txt", "b.txt"))
    assert content(tmp_path) == {
        "a.txt": "two", "b.txt": "two", "a2.txt": "mine", "notes.txt": "mine"
    }  # fmt: skip


def test_a_second_commit_of_a_run_adds_to_the_first(tmp_path):
    write(tmp_path, "one")
    with folder_of(tmp_path) as results:
        for name in ("a.txt", "b.txt"):
            (results.stage / name).write_text("two")
            results.commit([results.stage / name])
            assert content(tmp_path) == {n: "two" for n in ("a.txt", "b.txt") if n <= name}


def test_what_was_edited_is_refused_or_left_where_it_is(tmp_path):
    write(tmp_path, "one")
    (tmp_path / "b.txt").write_text("two")  # as many letters
    with pytest.raises(OutputError, match=r"b\.txt: was changed since torchpose wrote it"):
        write(tmp_path, "new")
    write(tmp_path, "new", ("a.txt",))
    assert content(tmp_path) == {"a.txt": "new", "b.txt": "two"}


@pytest.mark.parametrize("kind", ["file", "link", "lost link", "folder"])
def test_somebody_elses_file_is_refused(tmp_path, kind):
    (tmp_path / "other").write_text("mine")
    place = tmp_path / "a.txt"
    if kind == "file":
        place.write_text("mine")
    elif kind == "folder":
        place.mkdir()
    else:
        place.symlink_to(tmp_path / ("other" if kind == "link" else "nowhere"))
    before = os.lstat(place)
    with pytest.raises(OutputError, match=r"a\.txt: is there, and is not known"):
        write(tmp_path, "one")
    assert os.lstat(place) == before and (tmp_path / "other").read_text() == "mine"


def test_a_file_that_appears_during_the_run_is_moved_aside(tmp_path):
    for number in (1, 2):
        with folder_of(tmp_path) as results:
            (tmp_path / "b.txt").write_text(f"mine {number}")
            (results.stage / "b.txt").write_text("one")
            results.commit([results.stage / "b.txt"])
        assert (tmp_path / f"earlier-{number}" / "b.txt").read_text() == f"mine {number}"
        assert content(tmp_path) == {"b.txt": "one"}
        assert f"earlier-{number}: b.txt" in results.notes[0]


def test_results_of_a_version_without_a_list_are_moved_aside(tmp_path):
    for name in ("a.txt", "b.txt", "a2.txt", "d.txt"):
        (tmp_path / name).write_text("old")
    notes = write(tmp_path, "new", ("a.txt", "b.txt"), earlier=lambda out: out == tmp_path)
    assert content(tmp_path) == {"a.txt": "new", "b.txt": "new", "d.txt": "old"}
    assert content(tmp_path / "earlier-1") == dict.fromkeys(("a.txt", "b.txt", "a2.txt"), "old")
    assert len(notes) == 1
    assert write(tmp_path, "newer", ("a.txt", "b.txt"), earlier=lambda out: True) == []


@pytest.mark.parametrize("text", ["", "[]", '{"files": 3}', '{"files": {"../x": {}, "a.txt": 1}}'])
def test_a_damaged_list_makes_everything_somebody_elses(tmp_path, text):
    write(tmp_path, "one")
    (tmp_path / LIST).write_text(text)
    with pytest.raises(OutputError, match="move it away or choose another"):
        write(tmp_path, "two")
    assert content(tmp_path) == dict.fromkeys(NAMES, "one")


def test_an_input_is_no_output_through_links_too(tmp_path):
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    elsewhere.mkdir()
    write(out, "one")
    (elsewhere / "soft").symlink_to(out / "a.txt")
    os.link(out / "b.txt", elsewhere / "hard")
    (out / "a3.txt").symlink_to(elsewhere / "data.txt")
    (elsewhere / "data.txt").write_text("data")
    around = out / ".." / "out" / "c.txt"
    for given in (
        out / "a.txt",
        elsewhere / "soft",
        elsewhere / "hard",
        elsewhere / "data.txt",
        around,
    ):
        with pytest.raises(OutputError, match="is an input of this run"):
            write(out, "two", inputs=[tmp_path / "none", given])
    assert content(out) == {**dict.fromkeys(NAMES, "one"), "a3.txt": "data"}


def test_a_second_run_at_once_is_refused(tmp_path):
    with folder_of(tmp_path) as results:
        (results.stage / "a.txt").write_text("one")
        with pytest.raises(OutputError, match="another run is writing into this folder"):
            write(tmp_path, "two")
        with ResultsFolder(tmp_path, "others", r"z", ["z"]):
            pass
        results.commit([results.stage / "a.txt"])
    assert content(tmp_path) == {"a.txt": "one"}
    write(tmp_path, "two")


def test_without_locks_the_last_one_wins(tmp_path, monkeypatch):
    monkeypatch.setattr("torchpose._core.files.fcntl", None)
    with folder_of(tmp_path) as one:
        (one.stage / "a.txt").write_text("one")
        write(tmp_path, "two")
        one.commit([one.stage / "a.txt"])
    assert content(tmp_path) == {"a.txt": "one"}
    assert {p.name for p in tmp_path.iterdir()} == {"a.txt", LIST}


def test_a_file_that_cannot_be_moved_leaves_everything_as_it_was(tmp_path, monkeypatch):
    write(tmp_path, "one")
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    rename = Path.rename

    def full(self, target):
        if self.name == "c.txt" and self.parent.name == ".torchpose-notes":
            raise OSError(28, "No space left on device")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", full)
    with pytest.raises(OutputError, match="No space left"):
        write(tmp_path, "two")
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="a folder that root cannot write to")
def test_a_folder_that_is_read_only_is_refused():
    with pytest.raises(OutputError, match="results cannot be written to this folder"):
        write(Path("/proc/self"), "one")


def forked(work):
    """How a process ends that does this and is this process otherwise."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # threads, which do nothing here
        child = os.fork()
    if not child:
        try:
            work()
        finally:
            os._exit(0)
    return os.waitpid(child, 0)[1]


@pytest.mark.skipif(sys.platform == "win32", reason="fork and SIGKILL")
def test_a_run_killed_at_any_rename_leaves_files_of_one_run(tmp_path):
    rename = Path.rename

    def killed_at(number, out):
        left = [number]

        def counted(self, target):
            left[0] -= 1
            if left[0] < 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return rename(self, target)

        Path.rename = counted
        write(out, "two")

    ends = []
    for number in range(12):
        out = tmp_path / str(number)
        write(out, "one")
        ends.append(forked(lambda n=number, out=out: killed_at(n, out)))
        assert len(set(content(out).values())) <= 1, content(out)
        write(out, "three")
        assert content(out) == dict.fromkeys(NAMES, "three")
        assert {p.name for p in out.iterdir()} == {*NAMES, LIST}
    assert ends[0] == ends[5] == signal.SIGKILL and ends[-1] == 0


@pytest.mark.skipif(sys.platform == "win32", reason="fork and SIGKILL")
def test_what_a_killed_run_left_is_cleared_and_what_a_live_one_needs_is_not(tmp_path):
    def killed():
        with folder_of(tmp_path) as results, atomic_path(tmp_path / "x.txt"):
            (results.stage / ".poses-1").mkdir()
            with atomic_path(results.stage / "a.txt"):
                os.kill(os.getpid(), signal.SIGKILL)

    assert forked(killed) == signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 2
    with atomic_path(tmp_path / "y.txt") as alive:
        alive.write_text("alive")
        with folder_of(tmp_path) as results:
            assert list(results.stage.iterdir()) == []
            assert {p.name for p in tmp_path.iterdir()} == {alive.name, results.stage.name}
            check_output_folder(tmp_path)
    assert content(tmp_path) == {"y.txt": "alive"}


def test_own_files_are_replaced_one_by_one_and_others_moved_aside(tmp_path):
    for text in ("one", "two"):
        with replace_own(tmp_path / "report.md", "pages") as temporary:
            temporary.write_text(text)
        assert content(tmp_path) == {"report.md": text}
    refuse_stranger(tmp_path / "report.md", "pages")
    (tmp_path / "report.md").write_text("edited")
    (tmp_path / "plot.md").write_text("mine")
    for name in ("report.md", "plot.md", "report.md"):
        with replace_own(tmp_path / name, "pages") as temporary:
            temporary.write_text("three")
    assert content(tmp_path) == {"report.md": "three", "plot.md": "three"}
    assert content(tmp_path / "earlier-1") == {"report.md": "edited", "plot.md": "mine"}
    with pytest.raises(OutputError, match="move it away"):
        refuse_stranger(tmp_path / "report.md", "others")
    refuse_stranger(tmp_path / "report.md", "others", earlier=True)
    (tmp_path / "report.md").write_text("edited again")
    with pytest.raises(ZeroDivisionError), replace_own(tmp_path / "report.md", "pages"):
        raise ZeroDivisionError
    assert (tmp_path / "report.md").read_text() == "edited again"
    with replace_own(tmp_path / "report.md", "pages"):
        pass
    assert (tmp_path / "earlier-2" / "report.md").read_text() == "edited again"
