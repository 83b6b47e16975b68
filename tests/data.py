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
