"""Write and read fitted networks: weights in half precision, ready for use when read."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Self

from torch import nn

from torchpose._core.module_state import outside_inference
from torchpose._core.reading import reading
from torchpose._core.tensor_file import FileKind, read_tensors, write_tensors


class FittedNetwork(nn.Module):
    """Adds `save` and `load` to a network that is made from facts about its fit alone.

    Args:
        info: facts about the fit, of `_kind.info`.
    """

    _kind: ClassVar[FileKind[Any]]
    _words: ClassVar[str]  # what a file holds

    def __init__(self, info: Any = None) -> None:
        super().__init__()
        self.info = info or self._kind.info()

    def save(self, path: str | Path) -> None:
        """Write the network as safetensors, in half precision; the file appears whole or not at all.

        Numbers such as how many batches a layer has seen are left out.

        Raises:
            OutputError: the file cannot be written.
        """
        state = self.state_dict().items()
        tensors = {name: value.detach().cpu().half() for name, value in state if value.ndim}
        write_tensors(path, self._kind, self.info, tensors)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a network that `save` wrote, in single precision, for evaluation.

        Raises:
            InputError: no such file. FileFormatError: truncated, foreign, damaged, or newer.
        """
        info, tensors = read_tensors(path, cls._kind)
        with reading(path, cls._words), outside_inference():
            network = cls(info)
            numbers = {
                name: value for name, value in network.state_dict().items() if not value.ndim
            }
            given = {name: value.float() for name, value in tensors.items()}
            network.load_state_dict(given | numbers)
        return network.float().eval().requires_grad_(False)
