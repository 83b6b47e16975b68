"""Show the progress of a fit, draw pictures of it, write the prior's file, and stop at a signal."""

import signal
import threading
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from tqdm.auto import tqdm

from torchpose._core.terminal import show_progress
from torchpose.learning._fit_files import check_fit_file, fit_results, write_prior_files
from torchpose.priors import UpperBodyPrior
from train.blocks import Sweep
from train.body_fit import BodyFit
from train.mixture_em import MixtureEM
from train.stopping import terminate

__all__ = ["FitPictures", "FitProgress", "PriorWriter", "StopAtOnce"]


class FitProgress(ProgressBar):
    """Progress bars over the steps of EM, with mean log-likelihoods, and over the blocks of a step."""

    def __init__(self) -> None:
        super().__init__()
        self._shown = show_progress()
        self._steps: Any = None
        self._blocks: Any = None

    def disable(self) -> None:
        """Show nothing."""
        self._shown = False

    def enable(self) -> None:
        """Show the bars."""
        self._shown = True

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Open the bars."""
        off = not self._shown
        self._steps = tqdm(desc="EM", unit="step", initial=trainer.current_epoch, disable=off)
        self._blocks = tqdm(desc="step", unit="block", leave=False, disable=off)

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Count the blocks of this step."""
        if isinstance(batch, Sweep):
            self._blocks.reset(total=len(batch))
            batch.watchers.append(self._blocks.update)

    def on_train_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Show the log-likelihoods after a step."""
        shown = {
            kind.replace("_", " "): f"{float(trainer.callback_metrics[kind]):.4f}"
            for kind in ("log_likelihood", "held_out")
            if kind in trainer.callback_metrics
        }
        self._steps.set_postfix(shown, refresh=False)
        self._steps.update()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Close the bars."""
        for bar in (self._blocks, self._steps):
            if bar is not None:
                bar.close()


class FitPictures(Callback):
    """Pictures of components, samples and likelihoods, as files and in TensorBoard.

    Args:
        every: steps between two sets of pictures; 0 draws none but at the end.
        at_end: draw them at the end. n_shown: components at most.
    """

    def __init__(self, every: int = 10, at_end: bool = True, n_shown: int = 30) -> None:
        self._every, self._at_end, self._n_shown = every, at_end, n_shown
        self._drawn_at = -1

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw the pictures if they are due."""
        if self._every and (trainer.current_epoch + 1) % self._every == 0:
            self._draw(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw the pictures of the finished fit."""
        if self._at_end:
            self._draw(trainer, pl_module)

    def _draw(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not isinstance(pl_module, MixtureEM):
            return
        folder = trainer.log_dir  # all processes have to ask for it
        step = max(len(history) for history in pl_module.histories.values())
        if not trainer.is_global_zero or folder is None or step == self._drawn_at:
            return
        self._drawn_at = step
        pictures = Path(folder) / "pictures"
        pictures.mkdir(parents=True, exist_ok=True)
        prior = pl_module.assembled(name=Path(trainer.default_root_dir).name)
        for name, draw in _pictures(pl_module, prior, self._n_shown).items():
            _keep(draw(), pictures / f"{name}.png", trainer, step)


def _pictures(
    module: MixtureEM, prior: UpperBodyPrior, n_shown: int
) -> dict[str, Callable[[], Any]]:
    from torchpose.viz._prior_pictures import (
        plot_log_likelihood,
        plot_prior_components,
        plot_prior_samples,
    )

    found: dict[str, Callable[[], Any]] = {
        "likelihood": lambda: plot_log_likelihood(module.histories, module.held_out_history),
        "samples": lambda: plot_prior_samples(prior),
    }
    for mixture in ("pose", *prior.windows):

        def draw(mixture: str = mixture) -> Any:
            return plot_prior_components(prior, mixture, n_shown)

        found[f"components-{mixture}"] = draw
    return found


def _keep(figure: Any, path: Path, trainer: Trainer, step: int) -> None:
    """Save a picture as a file and in TensorBoard."""
    import numpy as np

    from torchpose.viz import save_figure

    save_figure(figure, path, dpi=100)
    for logger in trainer.loggers:
        if isinstance(logger, TensorBoardLogger):
            figure.set_dpi(100)
            figure.canvas.draw()
            pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3]
            logger.experiment.add_image(path.stem, pixels, step, dataformats="HWC")


class PriorWriter(Callback):
    """Calibration at the end of a fit, and the files of the prior, its card and its picture.

    Args:
        out: the prior, NAME.safetensors. name: in its metadata, that of the file by default.
        licence: of the recordings. command: that makes it. pictures: draw its mean poses, the
            latent space of a manifold, or the performances of actions.

    Attributes:
        ended: whether the fit came to its end.

    Raises:
        OutputError: a name that is none of a prior, a folder that cannot be written to.
    """

    def __init__(
        self,
        out: str,
        name: str = "",
        licence: str = "",
        command: str = "",
        pictures: bool = True,
    ) -> None:
        self.out = check_fit_file(out)
        self._facts = {"name": name or self.out.stem, "licence": licence, "command": command}
        self._pictures, self.ended = pictures, False
        self._open = ExitStack()

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Check before any work that the prior can be written and that nothing else is in its place."""
        if trainer.is_global_zero and stage == "fit":
            given = [value for value in pl_module.hparams.values() if isinstance(value, str)]
            self.results = fit_results(self.out, given, self._pictures)
            self._open.enter_context(self.results)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write everything, from the first process; a trial of one step is no prior, and writes nothing."""
        self.ended = True
        if trainer.fast_dev_run:  # type: ignore[attr-defined]
            if trainer.is_global_zero:
                print(f"a trial (fast_dev_run): {self.out} is not written", flush=True)
            return
        done = self._written(pl_module)
        if done is not None:
            print(done, flush=True)

    def _written(self, module: LightningModule) -> str | None:
        """Write what was fitted, and return what to say of it; None where another process writes."""
        if isinstance(module, BodyFit):
            here = module.trainer.is_global_zero
            if not here:
                return None
            return module.write(self.results, self.out.name, self._pictures, **self._facts)
        finish = getattr(module, "finished_prior", None)
        prior = finish(**self._facts) if finish else None
        if prior is None:
            return None
        return write_prior_files(prior, self.results, self.out.name, self._pictures)

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Remove temporary files."""
        self._open.close()

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        """Remove temporary files."""
        self._open.close()


class StopAtOnce(Callback):
    """A callback that keeps SIGTERM from Lightning, which would end the epoch first and exit with code 0.

    The signal is passed on to the other processes that Lightning has started on this machine.
    """

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Set the handler of the signal again, after Lightning has set its own."""
        launcher = trainer.strategy.launcher

        def pass_on() -> None:
            if launcher is not None:
                launcher.kill(signal.SIGTERM)

        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, partial(terminate, first=pass_on))
