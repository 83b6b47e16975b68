"""Read recordings for training, split them by person, and list the mixtures to fit to them."""

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any, NamedTuple, TypeVar

from lightning.pytorch import LightningDataModule, LightningModule, Trainer

from torchpose.errors import InputError
from torchpose.io import Recording, read_recordings
from torchpose.io._recordings import find_recordings, notes_on_unread_files
from torchpose.learning._curation import (
    CurationReport,
    CurationSettings,
    curate,
    refuse_leaks,
)
from torchpose.learning._curation.curate import notes_on_recordings
from torchpose.learning._curation.splits import pick_sides
from torchpose.learning._recipes import VERSION, MixtureTask, UpperBodyRecipe
from torchpose.learning._recipes.choosing import expand_path, fingerprint
from torchpose.learning._samplers import SampleSource, cached
from train.blocks import Key, SweepLoader

__all__ = ["RecordingsDataModule", "check_double_precision", "data_of", "read_sides", "split"]

D = TypeVar("D", bound=LightningDataModule)

_RECIPE, _CURATION = UpperBodyRecipe(), CurationSettings()
_HELD_OUT_SHARE = 5  # training states for each held-out state
_SHOWN_DROPS = 5


class RecordingsDataModule(LightningDataModule):
    """Recordings of 3D joints, split by person, and the blocks of states drawn from them.

    Args:
        paths: folders (with their subfolders) or files; `$NAME` stands for a variable of the
            environment.
        recipe: what is fitted.
        curation: what is left out of the recordings; None takes them as they are.
        axes: of all recordings: camera, kinect, y-up, z-up; by default what each file says.
        persons: whom to fit to, as `origin#person` or just the person; everybody not held out if
            None.
        held_out: whose likelihood is watched; they are never fitted to.
        num_workers: processes that draw states ahead; 0 draws them in the process that uses them.

    Raises:
        InputError: a variable of the environment that is not set, unknown persons, nobody left.
        OverlapError: a person, or a recording, is both fitted to and held out.
    """

    def __init__(
        self,
        paths: list[str],
        recipe: UpperBodyRecipe = _RECIPE,
        curation: CurationSettings | None = _CURATION,
        axes: str | None = None,
        persons: list[str] | None = None,
        held_out: list[str] | None = None,
        num_workers: int = 0,
    ) -> None:
        super().__init__()
        self.recipe = recipe
        self.said: list[str] = []
        self._report: CurationReport | None = None
        self.train: list[Recording] = []
        self.watched: list[Recording] = []
        self.tasks: dict[str, MixtureTask] = {}
        self._curation = curation
        self._paths, self._axes, self._num_workers = paths, axes, num_workers
        self._persons, self._held_out = persons, held_out or []
        self.sources: dict[Key, SampleSource] = {}

    def setup(self, stage: str) -> None:
        """Read and split recordings, and list the mixtures; the second call does nothing."""
        if self.tasks:
            return
        sides = read_sides(self._paths, self._axes, self._persons, self._held_out, self._curation)
        self.train, self.watched, self._report, self.said = sides
        self.tasks = self.recipe.tasks(self.train)
        self.sources = {Key(name): cached(task.source) for name, task in self.tasks.items()}
        if self.watched:
            for name, task in self._watched_recipe().tasks(self.watched, self.train).items():
                if name in self.tasks:
                    self.sources[Key(name, held_out=True)] = cached(task.source)

    def train_dataloader(self) -> SweepLoader:
        """Return this process' share of all blocks, one sweep each epoch."""
        trainer: Any = self.trainer
        if trainer is None:
            return SweepLoader(self.sources, num_workers=self._num_workers)
        return SweepLoader(
            self.sources,
            trainer.global_rank,
            trainer.world_size,
            trainer.lightning_module.epoch_of,
            self._num_workers,
        )

    def identity(self) -> dict[str, Any]:
        """Return the recipe and digests of the recordings, equal for equal fits."""
        return {
            "recipe": json.loads(json.dumps({"version": VERSION} | asdict(self.recipe))),
            "recordings": fingerprint(self.train),
            "held-out recordings": fingerprint(self.watched),
        }

    def facts(self) -> dict[str, Any]:
        """Return what a prior's file says about the curation, as that of `torchpose fit` does."""
        return {} if self._report is None else self._report.for_prior()

    def sources_by_person(self) -> list[SampleSource]:
        """Return states over poses of each held-out person."""
        recipe, people = self._watched_recipe(), sorted({r.person_id for r in self.watched})
        each = ([r for r in self.watched if r.person_id == person] for person in people)
        return [cached(recipe.tasks(own, self.train)["pose"].source) for own in each]

    def _watched_recipe(self) -> UpperBodyRecipe:
        """Return the recipe with fewer states, and with the kind of neck that is fitted to."""
        recipe, n_samples = self.recipe, self.tasks["pose"].source.n_samples
        windows = [task.source.n_samples for name, task in self.tasks.items() if "." in name]
        return replace(
            recipe,
            neck=self.recipe.poses(self.train).facts["neck"],
            n_samples=-(-n_samples // _HELD_OUT_SHARE),
            window_samples=-(-max(windows, default=0) // _HELD_OUT_SHARE),
        )


class Sides(NamedTuple):
    """Holds recordings to fit to and those of held-out persons.

    Attributes:
        report: on what was left out of the former; None if they are as they were read.
        said: lines on what was left out, and notes on what was read and on files that were not.
    """

    train: list[Recording]
    watched: list[Recording]
    report: CurationReport | None
    said: list[str]


def read_sides(
    paths: Sequence[str],
    axes: str | None,
    persons: Sequence[str] | None,
    held_out: Sequence[str],
    curation: CurationSettings | None,
) -> Sides:
    """Read recordings to fit to and those of held-out persons.

    Both sides are curated apart, so that nothing of the held-out persons gets into what is fitted.

    Args:
        paths: folders or files, see `expand_path`. axes: of all recordings, or None.
        persons, held_out: see `split`. curation: None takes recordings as they are.
    """
    given = [expand_path(path) for path in paths]
    files = find_recordings(given)
    unread = [f"note     {note}" for note in notes_on_unread_files(given, files)]
    train, watched = split(read_recordings(files, axes), persons, held_out)
    if curation is None:
        notes = [f"note     {note}" for note in notes_on_recordings(train)]
        return Sides(train, watched, None, [*notes, *unread])
    kept, report = curate(train, curation)
    watched = curate(watched, curation).recordings if watched else []
    return Sides(kept, watched, report, [report.text(_SHOWN_DROPS), *unread])


def split(
    recordings: Sequence[Recording], persons: Sequence[str] | None, held_out: Sequence[str]
) -> tuple[list[Recording], list[Recording]]:
    """Split recordings into those to fit to and those of held-out persons.

    Other people in the file of a held-out person are on neither side, because nobody says who they are.

    Args:
        recordings: of everybody. persons: to fit to; all others than those held out if None.
        held_out: persons that are not fitted to.

    Raises:
        InputError: unknown persons, or nobody is left. OverlapError: a leak between both sides.
    """
    known = sorted({r.person_id for r in recordings})
    fitted, out = pick_sides(known, persons, held_out)
    if not fitted:
        raise InputError(
            f"nobody is left to fit to: all of {', '.join(known)} are held out; hold fewer out"
        )
    watched = [r for r in recordings if r.person_id in out]
    files = {r.path for r in watched if r.path is not None}
    train = [
        r for r in recordings if r.person_id in fitted and not (r.companion and r.path in files)
    ]
    refuse_leaks(train, watched)
    return train, watched


def data_of(module: LightningModule, wanted: type[D]) -> D:
    """Return the data of a fit.

    Raises:
        InputError: data of another kind than `wanted`.
    """
    data = getattr(module.trainer, "datamodule", None)
    if not isinstance(data, wanted):
        raise InputError(
            f"{type(module).__name__} takes {wanted.__name__}, got {type(data).__name__}; set "
            f"data.class_path to {wanted.__module__}.{wanted.__name__}"
        )
    return data


def check_double_precision(trainer: Trainer) -> None:
    """Raise `InputError` unless the trainer leaves double precision alone, on a device that has it."""
    if trainer.strategy.root_device.type == "mps":
        raise InputError(
            "a fit needs double precision, which MPS does not have; add --trainer.accelerator cpu"
        )
    if trainer.precision not in ("32-true", "64-true"):
        raise InputError(
            f"a fit runs in double precision, got --trainer.precision {trainer.precision}; leave it "
            "out"
        )
