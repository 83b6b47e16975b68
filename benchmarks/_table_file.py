"""Take a file or a folder as the `--out` of a script that writes one table."""

import argparse
import os
import sys
from pathlib import Path


def table_file(text: str) -> Path:
    """Return the Markdown file that --out names: itself, or the script's own name in a folder.

    A name without a suffix is a folder, as is one that exists. Folders are made at once, so that a
    script refuses what it cannot write before its work and not after it.

    Args:
        text: as given on the command line.

    Raises:
        argparse.ArgumentTypeError: nothing can be written there.
    """
    path = Path(text)
    if path.is_dir() or not path.suffix:
        path /= f"{Path(sys.argv[0]).stem}.md"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise argparse.ArgumentTypeError(
            f"expected a file or a folder that can be written, got {text}: {error.strerror}"
        ) from error
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise argparse.ArgumentTypeError(
            f"expected a file or a folder that can be written, got {text}"
        )
    return path
