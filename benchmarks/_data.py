"""Find the folders and files of the data sets, and say by name which of them are missing."""

from pathlib import Path

from torchpose.errors import InputError


def data_folder(data: str | Path, name: str) -> Path:
    """Return `data` itself, or the folder `name` in it.

    Raises:
        InputError: no such folder.
    """
    data = Path(data)
    folder = data / name if (data / name).is_dir() else data
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the one that holds {name} with --data")
    return folder


def data_files(folder: Path, *patterns: str) -> list[Path]:
    """Return the files of a data set, pattern by pattern and sorted by name.

    Args:
        folder: of the data set. patterns: of the names, each of which some file has to match.

    Raises:
        InputError: no file matches one of them.
    """
    found = []
    for pattern in patterns:
        files = sorted(folder.glob(pattern))
        if not files:
            raise InputError(
                f"{folder}: expected files {pattern}, found none; give the folder that holds the data "
                f"sets with --data"
            )
        found += files
    return found
