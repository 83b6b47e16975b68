"""What is changed in Lightning: several processes without gradients, checkpoints that are whole."""

from datetime import timedelta
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

from lightning.pytorch.plugins.io import TorchCheckpointIO
from lightning.pytorch.strategies import DDPStrategy, StrategyRegistry

from torchpose._core.files import atomic_path
from torchpose.errors import FileFormatError

__all__ = ["AtomicCheckpoints", "Processes", "register"]


class Processes(DDPStrategy):
    """Lightning's DDP, which also takes modules that have nothing to learn by gradients.

    `DistributedDataParallel` refuses a module without trainable parameters, and would send all
    buffers around in every step. Such a module is left unwrapped and does its own exchange with
    `reduce`; any other one is wrapped as usual.
    """

    def configure_ddp(self) -> None:
        """Wrap the module, if there are gradients to average."""
        module = self.lightning_module
        if module is not None and any(p.requires_grad for p in module.parameters()):
            super().configure_ddp()


def register() -> None:
    """Take `Processes` wherever Lightning would take DDP: by name, or for several devices."""
    StrategyRegistry.register(
        "ddp",
        Processes,
        description="DDP; modules without trainable parameters are not wrapped",
        override=True,
        start_method="popen",
        # others wait while one still holds out its persons; one that is dead is noticed at once
        timeout=timedelta(hours=3),
    )


class AtomicCheckpoints(TorchCheckpointIO):
    """Checkpoints that appear whole or not at all, however the process ends."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None
    ) -> None:
        """Write beside `path`, then rename."""
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as temporary:
            super().save_checkpoint(checkpoint, temporary, storage_options)

    def load_checkpoint(self, path: Any, *args: Any, **options: Any) -> dict[str, Any]:
        """Read one.

        Raises:
            FileFormatError: it is truncated, or something else.
        """
        try:
            found = super().load_checkpoint(path, *args, **options)
        except (RuntimeError, EOFError, ValueError, UnpicklingError) as error:
            raise FileFormatError(
                f"{path}: expected a checkpoint; the file is truncated or of another kind"
            ) from error
        if not isinstance(found, dict) or "pytorch-lightning_version" not in found:
            raise FileFormatError(f"{path}: expected a checkpoint, got something that is none")
        return found
