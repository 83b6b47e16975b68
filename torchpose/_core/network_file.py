"""Write and read fitted networks: weights in half precision, ready for use when read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from torch import nn

from torchpose._core.module_state import outside_inference
from torchpose._core.reading import reading
from torchpose._core.tensor_file import FileKind, read_tensors, write_tensors

__all__ = ["read_network", "write_network"]

Network = TypeVar("Network", bound=nn.Module)


def write_network(path: str | Path, kind: FileKind[Any], info: Any, network: nn.Module) -> None:
    """Write a network as safetensors, in half precision; the file appears whole or not at all.

    Numbers such as how many batches a layer has seen are left out.

    Args:
        path: the file. kind: of the file. info: of `kind.info`. network: whose tensors are written.

    Raises:
        OutputError: the file cannot be written.
    """
    state = network.state_dict().items()
    tensors = {name: value.detach().cpu().half() for name, value in state if value.ndim}
    write_tensors(path, kind, info, tensors)


def read_network(
    path: str | Path, kind: FileKind[Any], make: Callable[[Any], Network], words: str
) -> Network:
    """Read a network that `write_network` wrote, in single precision, for evaluation.

    Args:
        path: the file. kind: of the file. make: makes the network from its facts. words: what it is.

    Raises:
        InputError: no such file. FileFormatError: truncated, foreign, damaged, or newer.
    """
    info, tensors = read_tensors(path, kind)
    with reading(path, words), outside_inference():
        network = make(info)
        numbers = {name: value for name, value in network.state_dict().items() if not value.ndim}
        given = {name: value.float() for name, value in tensors.items()}
        network.load_state_dict(given | numbers)
    return network.float().eval().requires_grad_(False)
