"""Find recordings of 2D keypoints, name their results and count their frames."""

import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from torchpose._core.digests import digest_of_files
from torchpose.errors import InputError, TorchposeError
from torchpose.io._formats.keypoint_files import is_keypoint_header
from torchpose.io._formats.openpose import holds_openpose, openpose_files
from torchpose.io._formats.table_rows import split_row
from train.predict_summary import COLUMNS

__all__ = ["Found", "KeypointRecording", "content_of", "find_keypoints", "share"]

_SUFFIXES = (".npz", ".csv")
_POINTS = ("keypoints.npy", "joints2d.npy")
_RESULTS = ({"joints3d.npy", "covariance3d.npy"}, {"state.npy", "body_frame.npy"})
_OPENPOSE = "OpenPose's JSON files"
_FIRST = "frame"  # column of a table
_LONGEST = 60  # characters of what a file holds


class KeypointRecording(NamedTuple):
    """A file or folder of keypoints, the name of its result (without suffix), and its length."""

    name: str
    path: Path
    n_frames: int


class Found(NamedTuple):
    """Holds recordings, the longest first, and why other files in the folders are none, by their paths."""

    recordings: list[KeypointRecording]
    others: dict[str, str]


def find_keypoints(paths: Sequence[str | Path], leave_out: str | Path | None = None) -> Found:
    """Find recordings of keypoints among files and folders.

    Folders are searched with their subfolders. Files there of other content are told, but not poses that
    were tracked before nor files with other suffixes. Those that cannot be opened are recordings, so that
    reading them says what is wrong. A folder of OpenPose's JSON files is one recording.

    Args:
        paths: files and folders. leave_out: a folder that is not searched: that of the results.

    Raises:
        InputError: no such path, that of the results, a file of another kind, no recordings, or two whose
            results would have one name.
    """
    found: dict[str, Path] = {}
    others: dict[str, str] = {}
    skipped = None if leave_out is None else Path(leave_out).resolve()
    inside = [path for path in paths if skipped == Path(path).resolve()]
    if inside:
        raise InputError(
            f"{inside[0]}: is the folder of the results, which is not searched for recordings; choose "
            "another --out"
        )
    for given in map(Path, paths):
        for name, path, fault in _candidates_in(given, skipped):
            if fault:
                others[str(path)] = fault
            elif found.setdefault(name, path).resolve() != path.resolve():
                raise InputError(
                    f"{found[name]} and {path}: both results would be called {name}.npz; rename one"
                    + ", or give the folder above both" * (found[name].parent != path.parent)
                )
    if not found:
        raise InputError(
            f"expected recordings of 2D keypoints ({', '.join(_SUFFIXES)} or folders of {_OPENPOSE}), "
            f"found none in {', '.join(map(str, paths)) or 'no paths at all'}"
            + "".join(f"; {path}: {others[path]}" for path in list(others)[:1])
        )
    recordings = [KeypointRecording(name, path, _length(path)) for name, path in found.items()]
    return Found(sorted(recordings, key=lambda r: (-r.n_frames, r.name)), others)


def share(
    recordings: Sequence[KeypointRecording], rank: int, world: int
) -> list[KeypointRecording]:
    """Return the recordings of one process, rank, rank + world, ..., and then those of the others.

    Args:
        recordings: the longest first. rank, world: which process of how many.
    """
    own = list(recordings[rank::world])
    mine = {recording.name for recording in own}
    return own + [recording for recording in recordings if recording.name not in mine]


def content_of(path: Path) -> str:
    """Return SHA-256 of a file, or of the names and contents of the files in a folder of OpenPose's."""
    if not path.is_dir():
        return digest_of_files([path])
    files = openpose_files(path)
    named = ((f"{file.name}\0{file.stat().st_size}\0", file) for file in files)
    return digest_of_files(part for pair in named for part in pair)


def _candidates_in(given: Path, leave_out: Path | None) -> Iterable[tuple[str, Path, str]]:
    """Find the names of recordings, their paths, and why they are none, which is empty for those that are."""
    if given.is_file():
        if given.suffix.lower() not in _SUFFIXES:
            raise InputError(
                f"{given}: expected keypoints as {', '.join(_SUFFIXES)} or a folder of {_OPENPOSE}; "
                "`torchpose track` takes videos"
            )
        yield given.stem, given, ""
        return
    if not given.is_dir():
        raise InputError(f"{given}: no such file or folder")
    if _is_openpose(given):
        yield given.resolve().name, given, ""
        return
    for path in sorted(given.rglob("*")):
        if path.name.startswith(".") or (leave_out and leave_out in path.resolve().parents):
            continue
        relative = path.relative_to(given)
        if path.is_dir() and _is_openpose(path):
            yield relative.as_posix(), path, ""
        elif path.is_file() and path.suffix.lower() in _SUFFIXES:
            holds = _holds(path)
            if not _is_result(holds):
                yield relative.with_suffix("").as_posix(), path, _fault(path, holds)


def _is_openpose(folder: Path) -> bool:
    try:
        return holds_openpose(folder)
    except TorchposeError:
        return True  # reading it gives the error


def _holds(path: Path) -> tuple[str, ...]:
    """Return the names of the arrays or columns of a file; those of keypoints if it cannot be opened."""
    is_npz = path.suffix.lower() == ".npz"
    try:
        if is_npz:
            with zipfile.ZipFile(path) as archive:
                return tuple(archive.namelist())
        with path.open("rb") as stream:
            lines = stream.read(4096).decode("utf-8-sig", "replace").splitlines()
    except (zipfile.BadZipFile, OSError):
        return _POINTS if is_npz else (_FIRST,)  # reading it gives the error
    header = next((line for line in lines if line.strip() and not line.startswith("#")), _FIRST)
    return tuple(split_row(header))


def _is_result(holds: tuple[str, ...]) -> bool:
    return holds == COLUMNS or any(result <= set(holds) for result in _RESULTS)


def _fault(path: Path, holds: tuple[str, ...]) -> str:
    """Return why a file that holds these arrays or columns has no keypoints; empty if it may have some."""
    if path.suffix.lower() == ".npz":
        expected, there = "an array keypoints or joints2d", not set(holds).isdisjoint(_POINTS)
    else:
        expected, there = f"a column {_FIRST}", is_keypoint_header(holds)
    names = ", ".join(name.removesuffix(".npy") for name in holds)
    return "" if there else f"expected {expected}, got {names[:_LONGEST] or 'none'}"


def _length(path: Path) -> int:
    """Return the number of frames, or about that; 0 if it cannot be told."""
    if path.is_dir():
        return len(openpose_files(path))
    try:
        if path.suffix.lower() != ".npz":
            with path.open("rb") as stream:
                return sum(1 for _ in stream)
        with zipfile.ZipFile(path) as archive:
            member = next(m for m in archive.namelist() if m in _POINTS)
            with archive.open(member) as stream:
                return _rows(stream)
    except Exception:  # it only serves the order; reading the file will say what is wrong with it
        return 0


def _rows(stream: IO[bytes]) -> int:
    """Return the first number of the shape in the header of an .npy."""
    version = np.lib.format.read_magic(stream)
    first = version == (1, 0)
    read = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
    return int(read(stream)[0][0])
