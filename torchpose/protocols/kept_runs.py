"""Results kept in a folder, one file each, so that a killed run goes on where it stopped."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from torchpose.errors import TorchposeError
from torchpose.io.files import read_npz, write_npz

__all__ = ["keep", "kept", "read_kept"]


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
