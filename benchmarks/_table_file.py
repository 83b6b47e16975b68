"""Take a file or a folder as the `--out` of a script that writes one table, and write it."""

import os
import sys
from pathlib import Path
from typing import Annotated

from torchpose._core.files import atomic_path
from torchpose.errors import InputError
from torchpose.evaluation import Report


def table_file(given: str | Path) -> Path:
    """Return the Markdown file that --out names: itself, or the script's own name in a folder.

    A name without a suffix is a folder, as is one that exists. Folders are made at once, so that a
    script refuses what it cannot write before its work and not after it.

    Args:
        given: on the command line.

    Raises:
        InputError: nothing can be written there.
    """
    path = Path(given)
    if path.is_dir() or not path.suffix:
        path /= f"{_script_name()}.md"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"expected a file or a folder that can be written, got {given}: {error.strerror}"
        ) from error
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise InputError(f"expected a file or a folder that can be written, got {given}")
    return path


def save_text(path: Path | None, text: str) -> None:
    """Write a text to a file, the whole of it or none; where there is no file, nothing is written."""
    if path is not None:
        with atomic_path(path) as temporary:
            temporary.write_text(text, encoding="utf-8")


def print_tables(report: Report, out: Path | None) -> None:
    """Print the tables of a report, and write the same to a file, if there is one."""
    text = "\n\n".join(table.to_markdown() for table in report.values())
    print(text)
    save_text(out, f"{text}\n")


TableFile = Annotated[Path, table_file]
"""The file of a table as the type of an option."""


def _script_name() -> str:
    """Return the name of the script or the package that runs."""
    script = Path(sys.argv[0])
    return script.parent.name if script.stem == "__main__" else script.stem
