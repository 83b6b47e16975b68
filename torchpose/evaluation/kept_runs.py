"""Results kept in a folder, one file each, so that a killed run goes on where it stopped."""

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import torch

from torchpose._core.files import write_npz
from torchpose._core.reading import read_npz
from torchpose.errors import TorchposeError

__all__ = ["keep", "kept", "read_kept", "source_hash"]

_CHECKOUT = Path(__file__).parents[2]


@cache
def source_hash(*names: str, root: Path = _CHECKOUT) -> str:
    """Sixteen letters that change with the source of these modules and packages.

    A result that is kept under them is made anew once a constant, a default or a formula of what it
    was made with has changed. The files are read once in a process.

    Args:
        names: of files and folders in `root`, such as "torchpose/filters" and "benchmarks/bend/runs.py".
    """
    digest = hashlib.sha256()
    for name in names:
        at = root / name
        for path in sorted(at.rglob("*.py")) if at.is_dir() else [at]:
            digest.update(path.relative_to(root).as_posix().encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def read_kept(path: Path, kind: Callable[..., Any], fields: tuple[str, ...]) -> Any:
    """A tuple of tensors that `keep` wrote, or None where there is none; damaged files are deleted.

    Args:
        path: of the file. kind: what is made of the tensors. fields: their names, in its order.
    """
    if not path.is_file():
        return None
    try:
        arrays = read_npz(path, fields)
    except TorchposeError:
        path.unlink()  # damaged: made again
        return None
    return kind(*(torch.from_numpy(arrays[key]) for key in fields))


def keep(path: Path, value: Any) -> None:
    """Write a NamedTuple of tensors, whole or not at all."""
    write_npz(path, {key: tensor.numpy() for key, tensor in value._asdict().items()})


def kept(path: Path, make: Callable[[], float]) -> float:
    """An error that is read from its file, or made and written there."""
    found = read_kept(path, float, ("error",))
    if found is None:
        found = float(make())
        write_npz(path, {"error": torch.tensor(found, dtype=torch.float64).numpy()})
    number: float = found
    return number
