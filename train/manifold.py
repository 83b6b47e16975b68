"""Fit a manifold of poses with Lightning, in epochs of one step.

A step is ten iterations of the optimiser over all poses at once. The fit itself is
`torchpose.learning._recipes.manifold`.
"""

from typing import Any

from torch import nn

from torchpose.io._results import ResultsFolder
from torchpose.learning._fit_files import write_manifold_files
from torchpose.learning._recipes import ManifoldFitting, ManifoldPoses, ManifoldRecipe
from torchpose.learning._recipes.manifold import check_gathering
from train.body_fit import BodyData, BodyFit
from train.data import check_double_precision

__all__ = ["ManifoldData", "ManifoldFit"]


class ManifoldData(BodyData):
    """Poses of one motion of one person or several, and held-out poses of other recordings.

    Args:
        paths: folders (with their subfolders) or files; `$NAME` stands for a variable of the
            environment.
        persons, held_out, validation, actions, without, fps, frames, axes: see `ManifoldPoses.gather`.

    Raises:
        InputError: see `ManifoldPoses.gather`.
    """

    source = ManifoldPoses

    def __init__(
        self,
        paths: list[str],
        persons: list[str] | None = None,
        held_out: list[str] | None = None,
        validation: int = 2,
        actions: list[str] | None = None,
        without: list[str] | None = None,
        fps: float = 60.0,
        frames: int = 350,
        axes: str | None = None,
    ) -> None:
        check_gathering(validation, frames, fps)
        super().__init__(
            paths=paths, persons=persons, held_out=held_out, validation=validation,
            actions=actions, without=without, fps=fps, frames=frames, axes=axes,
        )  # fmt: skip


class ManifoldFit(BodyFit):
    """Fits a back-constrained GPLVM to the poses of `ManifoldData`.

    Logged in each step: what `ManifoldFitting.step` gives.

    Args:
        latent_dim, gamma_x, optimiser, learning_rate, steps, patience, start, smoothness, standardise,
            seed: see `ManifoldRecipe`.

    Raises:
        InputError: a setting that is not positive.
    """

    data_type, what = ManifoldData, "a manifold is"

    def __init__(
        self,
        latent_dim: int = 2,
        gamma_x: float | None = None,
        optimiser: str = "lbfgs",
        learning_rate: float | None = None,
        steps: int = 40,
        patience: int = 3,
        start: int = 0,
        smoothness: float = 0.0,
        standardise: bool = False,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.save_hyperparameters()
        self._recipe = ManifoldRecipe(**self.settings)
        self.fitting: Any = nn.Identity()
        self._stopped = False

    def setup(self, stage: str) -> None:
        """Set up the fit at its start; a checkpoint's state comes later."""
        check_double_precision(self.trainer)
        super().setup(stage)
        self.fitting = ManifoldFitting(self.gathered, self._recipe)

    def on_train_start(self) -> None:
        """Stop if the fit was resumed after its last step."""
        if self._stopped or self.fitting.finished:
            self.trainer.should_stop = True

    def training_step(self, batch: int, batch_idx: int) -> None:
        """Take one step, and log the error on the held-out poses."""
        self.log_all(self.fitting.step())
        if self.fitting.finished:
            self.trainer.should_stop = True

    def progress_made(self) -> dict[str, Any]:
        """Return whether the fit had come to its end."""
        return {"stopped": self.trainer.should_stop}

    def go_on_from(self, kept: dict[str, Any]) -> None:
        """Stop at once if the fit had come to its end."""
        self._stopped = bool(kept["stopped"])

    def write(self, results: ResultsFolder, file: str, pictures: bool, **facts: str) -> str:
        """Write the manifold, and a picture of its latent space."""
        return write_manifold_files(self.fitting, results, file, pictures, **facts)
