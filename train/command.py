"""Run `python -m train fit` and `select`: their arguments and defaults."""

import contextlib
import logging
import os
import shlex
import threading
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch import LightningDataModule, LightningModule, Trainer
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only

from torchpose._core.files import check_output_folder
from torchpose._core.terminal import show_progress, without_options
from torchpose.errors import InputError
from torchpose.learning._selection import select_n_components
from train.blocks import Key
from train.callbacks import FitPictures, FitProgress, PriorWriter, StopAtOnce
from train.checkpoints import AtomicCheckpoints, LastCheckpoint, checkpoint_file
from train.data import RecordingsDataModule
from train.processes import register_strategy

__all__ = ["how_to_go_on", "run"]

_MODEL = {"class_path": "train.mixture_em.MixtureEM"}
_DATA = {"class_path": "train.data.RecordingsDataModule"}
_DEFAULTS = {
    "max_epochs": -1,  # the recipe says how many steps there are
    "log_every_n_steps": 1,
    "enable_model_summary": False,
}
# how and where a fit runs, not what it makes
_HOW = (
    *(f"--trainer.{name}" for name in ("accelerator", "devices", "num_nodes", "strategy")),
    *(f"--trainer.{name}" for name in ("default_root_dir", "logger", "log_every", "enable_")),
    "--ckpt_path",
    "--pictures",
    "--prior.pictures",
    "--data.num_workers",
    "--data.init_args.num_workers",
)


def run(arguments: Sequence[str]) -> None:
    """Run `fit` or `select`.

    Args:
        arguments: the command and what stands after it.
    """
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    # Lightning and the versions of torch and jsonargparse that it is used with here; nothing to change
    warnings.filterwarnings("ignore", r".*LeafSpec", FutureWarning)
    warnings.filterwarnings("ignore", category=DeprecationWarning, module="lightning|jsonargparse")
    register_strategy()
    _Command.arguments, _Command.kept, _Command.resumed = list(arguments), None, False
    quiet: dict[str, Any] = {"exit_on_error": False}
    with _log_errors_said_once():
        _Command(
            LightningModule,
            LightningDataModule,
            subclass_mode_model=True,
            subclass_mode_data=True,
            trainer_class=SelectingTrainer,
            trainer_defaults=_DEFAULTS,
            seed_everything_default=0,
            auto_configure_optimizers=False,
            load_from_checkpoint_support=False,
            parser_kwargs={**quiet, "prog": "python -m train", "fit": quiet, "select": quiet},
            args=_Command.arguments,
        )


@contextlib.contextmanager
def _log_errors_said_once() -> Iterator[None]:
    """Keep the thread that writes TensorBoard's file from printing an error that the next log raises."""
    before = threading.excepthook

    def hook(failed: threading.ExceptHookArgs) -> None:
        of_logs = type(failed.thread).__module__.startswith("tensorboard")
        if not (of_logs and isinstance(failed.exc_value, OSError)):
            before(failed)

    threading.excepthook = hook
    try:
        yield
    finally:
        threading.excepthook = before


def how_to_go_on() -> str:
    """Return how to go on after a command was stopped, in words."""
    if _Command.resumed or (_Command.kept is not None and _Command.kept.written):
        return "go on with --ckpt_path last, which takes up the fit after its last step"
    return "run the same command again, as no step was finished"


class SelectingTrainer(Trainer):
    """Lightning's trainer, which can also choose the number of components."""

    def select(
        self,
        model: LightningModule,
        datamodule: LightningDataModule,
        candidates: list[int],
        rule: str = "best",
        ckpt_path: str | None = None,
    ) -> None:
        """Fit a mixture over poses for each number of components and compare held-out persons.

        Args:
            candidates: numbers of components.
            rule: best, or one-standard-error for the fewest that are not clearly worse.
            ckpt_path: not used here; it may stand in the configuration.
        """
        if not isinstance(datamodule, RecordingsDataModule):
            raise InputError(f"select needs RecordingsDataModule, got {type(datamodule).__name__}")
        datamodule.setup("fit")
        if not datamodule.watched:
            raise InputError("select compares held-out persons: name some with --data.held_out")
        task = datamodule.tasks["pose"]
        found = select_n_components(
            datamodule.sources[Key("pose")],
            datamodule.sources_by_person(),
            candidates,
            task.seed,
            rule=rule,
            max_iter=task.max_iter,
            tol=task.tol,
            progress=show_progress(),
        )
        header, rows = found.table()
        widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
        for row in (header, *rows):
            print("  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)))
        print(f"--data.recipe.n_components {found.n_components}")


class _Command(LightningCLI):
    arguments: list[str]
    kept: LastCheckpoint | None = None  # writes the checkpoints of this run
    resumed = False

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        return {
            "fit": LightningCLI.subcommands()["fit"] | {"weights_only"},
            "select": {"model", "datamodule"},
        }

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        parser.add_lightning_class_args(PriorWriter, "prior")
        parser.add_lightning_class_args(FitPictures, "pictures")
        parser.set_defaults({"model": _MODEL, "data": _DATA})

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        self.config = parser.parse_args(args)

    def _parse_ckpt_path(self) -> None:
        """Take settings from the configuration only; a checkpoint is compared with them."""

    def before_instantiate_classes(self) -> None:
        settings = self.config[self.subcommand]
        if not settings["prior"]["command"]:
            settings["prior"]["command"] = command_line(self.arguments)
        if not settings["trainer"]["default_root_dir"]:
            name = Path(settings["prior"]["out"]).stem
            settings["trainer"]["default_root_dir"] = str(Path("runs") / name)
        _follow_torchrun(settings["trainer"])
        _take_seed(settings)

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        given = self.config_init[self.subcommand]["trainer"]
        callbacks = list(given["callbacks"] or [])
        own = [
            kind() for kind in (LastCheckpoint, FitProgress) if given[_SWITCHES[kind]] is not False
        ]
        _Command.kept = next((c for c in own if isinstance(c, LastCheckpoint)), None)
        given["callbacks"] = [*callbacks, *own, StopAtOnce()]
        if given["logger"] in (None, True):
            given["logger"] = _loggers(given["default_root_dir"])
        given["plugins"] = [*(given["plugins"] or []), AtomicCheckpoints()]
        return super().instantiate_trainer(**kwargs)

    def before_fit(self) -> None:
        """See that logs can be written, and read all recordings, before other processes are started."""
        folder = self.trainer.default_root_dir
        rank_zero_only(check_output_folder)(folder, "--trainer.default_root_dir")
        self.datamodule.setup("fit")
        for line in getattr(self.datamodule, "said", ()):  # other people's data say nothing
            rank_zero_only(print)(line, flush=True)

    def after_fit(self) -> None:
        """Raise where the trainer took no step, which it calls done."""
        callbacks = self.trainer.callbacks  # type: ignore[attr-defined]
        if not any(c.ended for c in callbacks if isinstance(c, PriorWriter)):
            raise InputError(
                "the trainer took no step, so that nothing was written; leave out max_epochs, max_steps or "
                "limit_train_batches of 0"
            )

    def _prepare_subcommand_kwargs(self, subcommand: str) -> dict[str, Any]:
        given = super()._prepare_subcommand_kwargs(subcommand)
        if subcommand == "fit":
            folder = self.trainer.default_root_dir
            given["ckpt_path"] = _checkpoint(given["ckpt_path"], folder)
            _Command.resumed = given["ckpt_path"] == str(checkpoint_file(folder))
        return given


_SWITCHES = {LastCheckpoint: "enable_checkpointing", FitProgress: "enable_progress_bar"}


def command_line(arguments: Sequence[str]) -> str:
    """Return the command that makes the same prior, without how and where it was run.

    >>> command_line(["fit", "--config", "a.yaml", "--trainer.devices", "2", "--ckpt_path=last"])
    'python -m train fit --config a.yaml'
    >>> command_line(["fit", "--config=a.yaml", "--trainer.max_epochs", "3", "--trainer.logger=false"])
    'python -m train fit --config=a.yaml --trainer.max_epochs 3'
    """
    return shlex.join(["python", "-m", "train", *without_options(arguments, _HOW)])


def _take_seed(settings: Any) -> None:
    """Give the model, or the recipe of the data, the seed of everything if it has none of its own.

    Raises:
        InputError: it has another one.
    """
    everything = int(settings["seed_everything"])
    for name in ("model.init_args.seed", "data.init_args.recipe.seed"):
        own = settings.get(name)
        if own is not None and everything not in (0, own):
            if own:
                raise InputError(
                    f"seed_everything is {everything}, and {name} is {own}; leave one of them out"
                )
            settings[name] = everything


def _follow_torchrun(trainer: Any) -> None:
    """Set as many devices and nodes as torchrun has started processes for.

    Lightning would take one device and fit the same prior in every process.
    """
    if "TORCHELASTIC_RUN_ID" not in os.environ:
        return
    here, everywhere = int(os.environ["LOCAL_WORLD_SIZE"]), int(os.environ["WORLD_SIZE"])
    for name, count in (("devices", here), ("num_nodes", everywhere // here)):
        given = trainer[name]
        if given not in ("auto", 1, "1", -1, "-1") and str(given) != str(count):
            raise InputError(
                f"--trainer.{name} is {given}, but torchrun has started {here} processes on each of "
                f"{everywhere // here} nodes; leave it out"
            )
        trainer[name] = count
    if everywhere > 1 and trainer["strategy"] == "auto":
        trainer["strategy"] = "ddp"


def _loggers(folder: str | Path) -> list[Logger]:
    """Return loggers of tables and for TensorBoard, in a new folder for each run."""
    versions = [p.name.partition("_")[2] for p in Path(folder).glob("version_*")]
    version = max((int(v) for v in versions if v.isdigit()), default=-1) + 1
    return [
        CSVLogger(folder, name="", version=version, flush_logs_every_n_steps=1),
        TensorBoardLogger(folder, name="", version=version),
    ]


def _checkpoint(given: str | None, folder: str | Path) -> str | None:
    """Return the checkpoint to resume from: `last`, `auto` (the last one, if there is one) or a file.

    Raises:
        InputError: there is none.
    """
    if given is None:
        return None
    path = checkpoint_file(folder) if given in ("last", "auto") else Path(given)
    if path.is_file():
        return str(path)
    if given == "auto":
        return None
    raise InputError(f"{path}: no such checkpoint; leave out --ckpt_path to start anew")
