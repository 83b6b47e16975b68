"""Write the results of a run to a folder all at once, and keep files that the user put there."""

import contextlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Self

from torchpose._core.digests import digest_of_files
from torchpose._core.files import (
    as_output_error,
    atomic_path,
    check_output_folder,
    hold,
    hold_folder,
)
from torchpose._core.reading import npz_keys
from torchpose._core.wording import first_of
from torchpose.errors import OutputError, TorchposeError

_LISTED = 5


class ResultsFolder:
    """Stages the files of a run in a folder, and puts them in their places together.

    A list in the folder, `.torchpose-KIND.json`, says which files a run has put there, by name, size
    and SHA-256. Only these, as long as nobody has changed them, are replaced or deleted by the next
    run. Anything else in the place of a result is refused before any work; what appears there while
    the run is at work is moved to a folder `earlier-1` (or 2, ...), which `notes` says. So are the
    results of a version of torchpose that had no such list, if `earlier` knows them.

    The private folder, `.torchpose-KIND`, is locked: a second run of the same kind is refused, and
    what a killed run left in it is cleared by the next one. Where there are no locks, two runs do not
    see each other, and each replaces what the other has put there.

    Args:
        folder: of the results; made if need be.
        kind: of the results; those of one kind in a folder belong together.
        own: pattern of the names that such a run may write. Files that an earlier one has written
            and this one does not are deleted.
        expected: names that this run is going to write.
        inputs: files that it reads, which are never written over.
        earlier: whether a folder without a list holds results of an earlier version.

    Raises:
        OutputError: a folder without a name; when entered: one that cannot be written to, an output that is
            an input, a file of somebody else's in the place of an expected one, or another run at work.

    Example:
        >>> folder = tempfile.mkdtemp()
        >>> with ResultsFolder(folder, "notes", r"note.txt", ["note.txt"]) as results:
        ...     note = results.stage / "note.txt"
        ...     _ = note.write_text("all or nothing")
        ...     [path.name for path in results.commit([note])]
        ['note.txt']
    """

    def __init__(
        self,
        folder: str | Path,
        kind: str,
        own: str,
        expected: Sequence[str],
        inputs: Iterable[str | Path] = (),
        earlier: Callable[[Path], bool] = lambda folder: False,
    ) -> None:
        if not str(folder).strip():
            raise OutputError(
                "expected a folder for the results, got an empty name; give --out DIR"
            )
        self.folder, self.notes = Path(folder), list[str]()
        self._kind, self._own, self._expected = kind, re.compile(own), list(expected)
        self._inputs, self._earlier = [Path(path) for path in inputs], earlier
        self._done: set[str] = set()
        self._before: list[str] = []  # results of a version without a list
        self._lock: int | None = None

    def __enter__(self) -> Self:
        check_output_folder(self.folder)
        self._refuse_inputs()
        self._refuse_strangers()
        with as_output_error(self.folder):
            self.stage = self._take_stage()
        return self

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self.stage, ignore_errors=True)
        if self._lock is not None:
            os.close(self._lock)

    def commit(self, written: Sequence[Path]) -> list[Path]:
        """Put files from the stage in their places, and delete those of an earlier run.

        It may be called again for more: the files of one run stay together. Until the new files are
        there, the old ones are not: no state between holds files of two runs.

        Args:
            written: paths of files in the stage.

        Returns:
            Where they are now.

        Raises:
            OutputError: a file cannot be moved; then everything is as it was.
        """
        with as_output_error(self.folder):
            self._commit([path.name for path in written])
        return [self.folder / path.name for path in written]

    # --- before any work

    def _refuse_inputs(self) -> None:
        for path in self._present():
            for given in self._inputs:
                if _same_file(path, given):
                    raise OutputError(
                        f"{path}: is an input of this run, which would write over it; choose another "
                        "--out"
                    )

    def _refuse_strangers(self) -> None:
        listed = _read_list(self.folder, self._kind) or {}
        if not any((self.folder / name).exists() for name in listed) and self._earlier(self.folder):
            self._before = [path.name for path in self._present()]
            return
        for name in self._expected:
            _refuse_stranger(self.folder / name, listed)

    def _present(self) -> list[Path]:
        """Return the existing files of the folder under names that a run of this kind may write."""
        return [path for path in self.folder.iterdir() if self._own.fullmatch(path.name)]

    def _take_stage(self) -> Path:
        """Make a private folder that is empty and locked."""
        stage = self.folder / f".torchpose-{self._kind}"
        while True:
            stage.mkdir(exist_ok=True)
            lock, held = hold_folder(stage)
            if held is False:
                raise OutputError(
                    f"{self.folder}: another run is writing into this folder; wait until it ends, or "
                    "choose another --out"
                )
            if lock is None:  # there are no locks
                stage.rmdir()
                return Path(tempfile.mkdtemp(dir=self.folder, prefix=f"{stage.name}-"))
            if _same_folder(lock, stage):  # not one that its owner has just removed
                break
            os.close(lock)
        self._lock = lock
        for path in stage.iterdir():
            _remove(path)
        return stage

    # --- the results

    def _commit(self, written: Sequence[str]) -> None:
        listed = _read_list(self.folder, self._kind) or {}
        new = {name: _facts(self.stage / name) for name in written}
        self._done |= new.keys()
        stale = [name for name in listed if name not in self._done and self._own.fullmatch(name)]
        in_the_way = [n for n in (*new, *stale) if os.path.lexists(self.folder / n)]
        ours = [name for name in in_the_way if _is_listed(self.folder / name, listed)]
        strangers = [name for name in in_the_way if name not in ours and name in new]
        strangers += [n for n in self._before if n not in (*in_the_way, *self._done)]
        self._before = []
        moves: list[tuple[Path, Path]] = []
        if strangers:
            aside = _free_folder(self.folder, strangers)
            moves = [(self.folder / name, aside / name) for name in strangers]
        trash = self.stage / ".old"
        trash.mkdir(exist_ok=True)
        moves += [(self.folder / name, trash / name) for name in ours]
        file = _list_path(self.folder, self._kind)
        moves += [(file, trash / file.name)] if file.exists() else []
        kept = {name: facts for name, facts in listed.items() if name not in stale} | new
        with _renamed(moves):  # nothing of the earlier run is there when the first file appears
            _write_list(self.folder, self._kind, kept)
            with _renamed([(self.stage / name, self.folder / name) for name in new]):
                pass
        shutil.rmtree(trash, ignore_errors=True)
        if strangers:
            self.notes.append(
                "files in the place of results that are not known to be of this command were moved to "
                f"{aside}: {first_of(strangers, _LISTED)}"
            )


@contextlib.contextmanager
def replace_own(path: str | Path, kind: str) -> Iterator[Path]:
    """Yield a temporary file that becomes `path` when the block succeeds, as `atomic_path` does.

    What stands at `path` and was not written in this way before, with the same `kind`, or was changed
    since, is moved to a folder `earlier-1` (or 2, ...) beside it.

    Yields:
        Path of the temporary file.

    Raises:
        OutputError: the file cannot be written.
    """
    path = Path(path)
    with atomic_path(path) as temporary:
        yield temporary
        with as_output_error(path), _locked_folder(path.parent):
            listed = _read_list(path.parent, kind) or {}
            if os.path.lexists(path) and not _is_listed(path, listed):
                set_aside(path)
            _write_list(path.parent, kind, listed | {path.name: _facts(temporary)})


def set_aside(path: Path) -> Path:
    """Move a file to a folder `earlier-1` (or 2, ...) beside it; return where it is then.

    Raises:
        OutputError: it cannot be moved.
    """
    with as_output_error(path):
        return path.rename(_free_folder(path.parent, [path.name]) / path.name)


def refuse_stranger(path: str | Path, kind: str, earlier: bool = False) -> None:
    """See that there is nothing in the place of a result but what a run has written.

    Args:
        path: of the result. kind: of the results in its folder.
        earlier: whether it may be of an earlier version, which kept no list.

    Raises:
        OutputError: there is something else, or it was changed since.
    """
    path = Path(path)
    listed = _read_list(path.parent, kind)
    if listed is not None or not earlier:
        _refuse_stranger(path, listed or {})


def holds_arrays(path: str | Path, names: Iterable[str]) -> bool:
    """Return whether a file is an .npz with arrays of these names."""
    try:
        return set(names) <= set(npz_keys(path))
    except TorchposeError:
        return False


# --- the list of what was written -----------------------------------------------------------------


def _read_list(folder: Path, kind: str) -> dict[str, Any] | None:
    """Return size and digest of the files that runs of a kind have put in a folder, None without a list."""
    try:
        found = json.loads(_list_path(folder, kind).read_text(encoding="utf-8"))["files"]
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError):
        return {}  # damaged: nothing is known to be written by us
    if not isinstance(found, dict):
        return {}
    return {name: facts for name, facts in found.items() if Path(name).name == name}


def _write_list(folder: Path, kind: str, listed: dict[str, Any]) -> None:
    text = json.dumps({"format": 1, "files": dict(sorted(listed.items()))}, indent=1)
    with atomic_path(_list_path(folder, kind)) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def _list_path(folder: Path, kind: str) -> Path:
    return folder / f".torchpose-{kind}.json"


def _facts(path: Path) -> dict[str, Any]:
    return {"size": path.stat().st_size, "sha256": digest_of_files([path])}


def _is_listed(path: Path, listed: dict[str, Any]) -> bool:
    """Return whether a file is still what a run has written."""
    facts = listed.get(path.name)
    if not isinstance(facts, dict) or path.is_symlink() or not path.is_file():
        return False
    return path.stat().st_size == facts.get("size") and _facts(path) == facts


def _refuse_stranger(path: Path, listed: dict[str, Any]) -> None:
    if not os.path.lexists(path) or _is_listed(path, listed):
        return
    if path.name in listed:
        what = "was changed since torchpose wrote it"
    else:
        what = "is there, and is not known to be written by this command"
    raise OutputError(f"{path}: {what}; move it away or choose another --out")


# --- files and folders ----------------------------------------------------------------------------


@contextlib.contextmanager
def _renamed(moves: Sequence[tuple[Path, Path]]) -> Iterator[None]:
    """Rename files, and back again if one cannot be renamed or the block fails."""
    done: list[tuple[Path, Path]] = []
    try:
        for source, target in moves:
            source.rename(target)
            done.append((source, target))
        yield
    except BaseException:
        for source, target in reversed(done):
            target.rename(source)
        raise


def _free_folder(folder: Path, names: Sequence[str]) -> Path:
    """Return the first folder `earlier-N` in which none of these names is taken."""
    number = 1
    while any(os.path.lexists(folder / f"earlier-{number}" / name) for name in names):
        number += 1
    free = folder / f"earlier-{number}"
    free.mkdir(exist_ok=True)
    return free


def _same_file(path: Path, other: Path) -> bool:
    try:
        return os.path.samefile(path, other)
    except OSError:
        return False


@contextlib.contextmanager
def _locked_folder(folder: Path) -> Iterator[None]:
    """Wait for the lock of a folder; go on without where there are none."""
    handle = None
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        hold(handle, wait=True)
    try:
        yield
    finally:
        if handle is not None:
            os.close(handle)


def _same_folder(handle: int, folder: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), folder.stat())
    except FileNotFoundError:
        return False


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()
