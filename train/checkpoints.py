"""Write checkpoints of fits that are complete, and refuse those of another fit."""

import os
from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO

from torchpose._core.files import atomic_path, check_output_folder, hold_folder
from torchpose.errors import FileFormatError, InputError, OutputError
from torchpose.io._results import set_aside

__all__ = [
    "ENTRY",
    "AtomicCheckpoints",
    "LastCheckpoint",
    "check_identity",
    "checkpoint_file",
    "differences",
]

ENTRY = "torchpose"
"""Key of a checkpoint under which a fit keeps its identity and its progress."""

_ADVICE = (
    "resume with the settings and recordings it was made with, or start anew without --ckpt_path"
)


def checkpoint_file(folder: str | Path) -> Path:
    """Return the last checkpoint of the fit whose logs are in a folder."""
    return Path(folder) / "checkpoints" / "last.ckpt"


class LastCheckpoint(Checkpoint):
    """A checkpoint of the whole fit after every step, in `checkpoints/last.ckpt`.

    That of an earlier fit, which this one does not take up, is moved to `earlier-1` (or 2, ...) beside it.

    Attributes:
        written: whether this run has written one; there may be one of an earlier run.

    Raises:
        OutputError: when set up: another fit writes its checkpoints there, or the folder cannot be made.
    """

    def __init__(self) -> None:
        self.written = False
        self._lock: int | None = None

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Keep other fits out of the folder, and remove temporary files of a killed one."""
        if not trainer.is_global_zero:
            return
        folder = check_output_folder(
            checkpoint_file(trainer.default_root_dir).parent, "--trainer.default_root_dir"
        )
        self._lock, held = hold_folder(folder)
        if held is False:
            raise OutputError(
                f"{folder}: another fit is writing its checkpoints there; wait until it ends, or give one of "
                "them another --trainer.default_root_dir"
            )

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Let other fits in."""
        self._release()

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        """Let other fits in."""
        self._release()

    def _release(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the checkpoint; a trial of one step is no fit, and writes none."""
        if trainer.fast_dev_run:  # type: ignore[attr-defined]
            return
        file = checkpoint_file(trainer.default_root_dir)
        if trainer.is_global_zero and not self.written and not _taken_up(trainer, file):
            _set_earlier_aside(file)
        trainer.save_checkpoint(file)
        self.written = True


def _taken_up(trainer: Trainer, file: Path) -> bool:
    """Return whether a fit goes on from a file."""
    given = trainer.ckpt_path
    return given is not None and Path(given).exists() and file.samefile(given)


def _set_earlier_aside(file: Path) -> None:
    if file.exists():
        print(
            f"note     the checkpoint of an earlier fit was moved to {set_aside(file)}", flush=True
        )


class AtomicCheckpoints(TorchCheckpointIO):
    """Checkpoints that appear whole or not at all, however the process ends."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None
    ) -> None:
        """Write a file beside `path`, then rename it."""
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as temporary:
            super().save_checkpoint(checkpoint, temporary, storage_options)

    def load_checkpoint(self, path: Any, *args: Any, **options: Any) -> dict[str, Any]:
        """Read a checkpoint.

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


def check_identity(kept: Any, wanted: Mapping[str, Any], path: Any) -> dict[str, Any]:
    """Return what a checkpoint says about itself, if it is of this fit.

    Args:
        kept: the entry of the checkpoint. wanted: the identity of this fit. path: of the file.

    Raises:
        FileFormatError: not a checkpoint of a fit like this one at all.
        InputError: of another one; every difference is named.
    """
    if not isinstance(kept, Mapping) or "identity" not in kept:
        raise FileFormatError(
            f"{path}: expected a checkpoint of {wanted.get('model', 'this model')}, got one of "
            "something else"
        )
    found = differences(kept["identity"], wanted)
    if found:
        raise InputError(f"{path}: the checkpoint is of another fit: {'; '.join(found)}; {_ADVICE}")
    return dict(kept)


def differences(kept: Any, wanted: Any, name: str = "") -> list[str]:
    """Return sentences about what differs between two nested mappings.

    >>> differences({"recipe": {"seed": 0, "views": [1, 2]}}, {"recipe": {"seed": 3, "views": [1, 2]}})
    ['recipe seed was 0, is 3']
    """
    if isinstance(kept, Mapping) and isinstance(wanted, Mapping):
        inside = f"{name} " if name else ""
        return [
            sentence
            for key in dict.fromkeys([*kept, *wanted])
            for sentence in differences(kept.get(key), wanted.get(key), f"{inside}{key}")
        ]
    return [] if kept == wanted else [f"{name} was {_short(kept)}, is {_short(wanted)}"]


def _short(value: Any) -> str:
    text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
