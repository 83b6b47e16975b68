"""`python -m train select`: how many components, by the likelihood of persons who are held out.

It is a command and no option of `fit`, so that the number stands in the configuration: the prior is
then made again from it without another search, and a fit that is resumed knows what it fits.
"""

from lightning.pytorch import LightningDataModule, LightningModule, Trainer

from torchpose._core.terminal import show_progress
from torchpose.errors import InputError
from torchpose.learning._selection import select_n_components
from train.blocks import Key
from train.data import RecordingsDataModule

__all__ = ["SelectingTrainer"]


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
