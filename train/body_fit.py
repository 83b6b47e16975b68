"""Run a fit to whole bodies as a module of Lightning: one process, its identity, and its files.

The fits themselves are in `torchpose.learning._recipes`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from lightning.pytorch import LightningDataModule, LightningModule
from torch.optim import Optimizer

from torchpose.errors import InputError
from torchpose.io._results import ResultsFolder
from train.checkpoints import ENTRY, check_identity
from train.data import data_of

__all__ = ["BodyData", "BodyFit"]


class BodyData(LightningDataModule):
    """Base of the data of a fit, which are gathered once, in `setup`.

    Attributes:
        source: class of the library whose `gather` reads the recordings.
        gathered: what it returned, None before `setup`.

    Args:
        arguments: of `source.gather`.
    """

    source: ClassVar[Any]

    def __init__(self, **arguments: Any) -> None:
        super().__init__()
        self.gathered: Any = None
        self._arguments = arguments

    def setup(self, stage: str) -> None:
        """Gather the recordings; the second call does nothing."""
        if self.gathered is None:
            self.gathered = self.source.gather(**self._arguments)

    @property
    def said(self) -> list[str]:
        """Return notes on the recordings, a line each."""
        return [f"note: {note}" for note in self.gathered.notes]

    def train_dataloader(self) -> range:
        """Return one step an epoch."""
        return range(1)

    def identity(self) -> dict[str, Any]:
        """Return settings and digests of the recordings, equal for equal fits."""
        found: dict[str, Any] = self.gathered.identity()
        return found


class BodyFit(LightningModule):
    """Base of the fits that one process does with an optimiser of its own, or with none.

    A subclass calls `save_hyperparameters` in its constructor, names its data and what it fits, fits
    (`fit_at_once`, or in steps of its own), and writes its model (`write`).

    Attributes:
        data_type: the data module that it takes. what: what is fitted, for the refusal of several
            processes.
    """

    data_type: ClassVar[type[BodyData]]
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
        data = self.data_module
        data.setup(stage)
        self._identity = {"model": type(self).__name__, "settings": self.settings}
        self._identity |= data.identity()

    @property
    def settings(self) -> dict[str, Any]:
        """Return all settings that matter to the result."""
        given: Any = self.hparams
        return {k: v for k, v in given.items() if not k.startswith("_")}

    def configure_optimizers(self) -> Sequence[Optimizer]:
        """Return no optimiser that Lightning would step."""
        return []

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Store the identity and the progress of the fit."""
        checkpoint[ENTRY] = {"identity": self._identity, **self.progress_made()}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse a checkpoint of another fit, and restore the progress."""
        kept = check_identity(checkpoint.get(ENTRY), self._identity, self.trainer.ckpt_path)
        self.go_on_from(kept)

    def progress_made(self) -> dict[str, Any]:
        """Return what a checkpoint holds beside the module's state; nothing where the fit is repeated."""
        return {}

    def go_on_from(self, kept: dict[str, Any]) -> None:
        """Restore what `progress_made` returned."""

    def training_step(self, batch: int, batch_idx: int) -> None:
        """Fit at once; a subclass whose fit takes several steps has a step of its own."""
        self.log_all(self.fit_at_once())
        self.trainer.should_stop = True

    def fit_at_once(self) -> dict[str, float]:
        """Fit, and return the numbers that are logged; a subclass does, unless it has its own step."""
        raise NotImplementedError

    def log_all(self, found: Mapping[str, float]) -> None:
        """Log numbers of this step in double precision."""
        self.log_dict({k: torch.tensor(float(v)).double() for k, v in found.items()}, on_step=True)

    def write(self, results: ResultsFolder, file: str, pictures: bool, **facts: str) -> str:
        """Write the model's file and its card, and return what to say of it; a subclass does.

        Args:
            results, file: where a prior's file would be. pictures: draw them, where there are any.
            facts: name, licence, command.
        """
        raise NotImplementedError

    @property
    def data_module(self) -> BodyData:
        """Return the data, if they are of the right kind."""
        return data_of(self, self.data_type)

    @property
    def gathered(self) -> Any:
        """Return what is fitted to."""
        return self.data_module.gathered
