"""What fits to whole bodies share: one process, the identity of a fit, and where its file goes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

from lightning.pytorch import LightningModule
from torch.optim import Optimizer

from torchpose.errors import InputError
from torchpose.io import Recording
from train.callbacks import PriorWriter
from train.identity import check_identity

__all__ = ["BodyFit", "recording_name"]

_ENTRY = "torchpose"  # of a checkpoint: what it is of


class BodyFit(LightningModule):
    """Base of the fits that one process does with an optimiser of its own, or with none.

    A subclass calls `save_hyperparameters` in its constructor, and names its data and what it fits.

    Attributes:
        data_type: the data module that it takes, with `setup` and `identity`. what: what is fitted,
            for the refusal of several processes.
    """

    data_type: ClassVar[type]
    what: ClassVar[str]

    def __init__(self) -> None:
        super().__init__()
        self.automatic_optimization = False
        self._identity: dict[str, Any] = {}

    def setup(self, stage: str) -> None:
        """Read the recordings."""
        if self.trainer.world_size > 1:
            raise InputError(
                f"{self.what} fitted by one process, got {self.trainer.world_size}; set "
                "--trainer.devices 1"
            )
        data = self._data
        data.setup(stage)
        self._identity = {"model": type(self).__name__, "settings": self.settings}
        self._identity |= data.identity()

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that was set and matters to the result."""
        return {k: v for k, v in self._given.items() if k != "picture" and not k.startswith("_")}

    def configure_optimizers(self) -> Sequence[Optimizer]:
        """None that Lightning knows of."""
        return []

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Say what the checkpoint is of."""
        checkpoint[_ENTRY] = {"identity": self._identity, **self.progress_made()}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse a checkpoint of anything else."""
        kept = check_identity(checkpoint.get(_ENTRY), self._identity, self.trainer.ckpt_path)
        self.go_on_from(kept)

    def progress_made(self) -> dict[str, Any]:
        """What a checkpoint holds beside the module's state; nothing where the fit is done again."""
        return {}

    def go_on_from(self, kept: dict[str, Any]) -> None:
        """Take up what `progress_made` gave."""

    @property
    def written_to(self) -> Path | None:
        """Where a prior's file would be; None in other processes, or if none is wanted."""
        writers = [c for c in self.trainer.callbacks if isinstance(c, PriorWriter)]  # type: ignore[attr-defined]
        return writers[0].out if writers and self.trainer.is_global_zero else None

    @property
    def _given(self) -> Any:
        return self.hparams

    @property
    def _data(self) -> Any:
        data, wanted = getattr(self.trainer, "datamodule", None), self.data_type
        if not isinstance(data, wanted):
            raise InputError(
                f"{type(self).__name__} takes {wanted.__name__}, got {type(data).__name__}; set "
                f"data.class_path to {wanted.__module__}.{wanted.__name__}"
            )
        return data


def recording_name(recording: Recording) -> str:
    """What messages call a recording: its file without the suffix, or its person."""
    return recording.person_id if recording.path is None else recording.path.stem
