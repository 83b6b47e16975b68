"""Where the recordings lie that tests read if they are there."""

import os
from pathlib import Path

import pytest

DEFAULT = Path(__file__).resolve().parents[2] / "shared" / "data"


def data_dir_or_skip(name: str) -> Path:
    """The folder of a data set, or a skip that says which one is missing and how to point to it."""
    folder = Path(os.environ.get("TORCHPOSE_DATA", DEFAULT)) / name
    if not folder.is_dir():
        pytest.skip(
            f"data set {name!r} is not at {folder}; set TORCHPOSE_DATA to its parent folder"
        )
    return folder


def data_with(*names: str) -> Path:
    """The folder of all data sets, or a skip if one of these is missing."""
    *_, last = map(data_dir_or_skip, names)
    return last.parent


def few_recordings(name: str, into: Path, per_person: int, chosen: tuple[str, ...] = ()) -> Path:
    """A folder with links to evenly spread recordings of each person: to read all takes seconds.

    Args:
        name: of a data set whose files begin with their person, such as s01_. into: where the folder is
            made, under its own name. per_person: recordings, at most. chosen: persons; all if there are none.
    """
    whole = data_dir_or_skip(name)
    folder = into / name
    folder.mkdir(parents=True)
    persons: dict[str, list[Path]] = {}
    for path in sorted(whole.glob("s[0-9][0-9]_*.npz")):
        if not chosen or path.name[:3] in chosen:
            persons.setdefault(path.name[:3], []).append(path)
    for paths in persons.values():
        for path in paths[:: -(-len(paths) // per_person)]:
            (folder / path.name).symlink_to(path)
    return folder
