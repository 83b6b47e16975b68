"""Experiments: run a grid of subjects, methods, conditions and seeds, one row for each run."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Literal, NamedTuple, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks.engine.kept import kept_runs, source_hash
from torchpose.errors import InputError

Subject = TypeVar("Subject")
Method = TypeVar("Method")

Axis = Literal["condition", "subject", "method", "seed"]
AXES: tuple[Axis, ...] = ("condition", "subject", "method", "seed")

Measure = Callable[[Any], Tensor | float]
"""A number of one run, such as its mean error."""


class Grid(NamedTuple, Generic[Subject, Method]):
    """Subjects and methods of one condition, by the names that they have in tables."""

    subjects: Mapping[str, Subject]
    methods: Mapping[str, Method]


class Row(NamedTuple):
    """One run: its place in the grid, and what was found, a NamedTuple of tensors."""

    condition: str
    subject: str
    method: str
    seed: int
    run: Any


@dataclass(frozen=True)
class Results:
    """All runs of an experiment, one row each, in the order of the grid."""

    rows: tuple[Row, ...]

    def __add__(self, other: "Results") -> "Results":
        return Results(self.rows + other.rows)

    def names(self, axis: Axis) -> list[Any]:
        """Return the values of an axis in the order in which they appear."""
        return list(dict.fromkeys(getattr(row, axis) for row in self.rows))

    def where(self, **equal: Any) -> "Results":
        """Return the rows that have these values.

        Args:
            equal: values by axis, such as ``method="sir", seed=0``.

        Raises:
            InputError: there are none.
        """
        rows = tuple(
            row for row in self.rows if all(getattr(row, axis) == v for axis, v in equal.items())
        )
        if not rows:
            wanted = ", ".join(f"{axis} {value!r}" for axis, value in equal.items())
            raise InputError(f"expected runs of {wanted}, there are none of {len(self.rows)} runs")
        return Results(rows)

    def by(self, *axes: Axis) -> dict[tuple[Any, ...], "Results"]:
        """Return the rows by their values on some axes, in the order in which these appear."""
        groups: dict[tuple[Any, ...], list[Row]] = {}
        for row in self.rows:
            groups.setdefault(tuple(getattr(row, axis) for axis in axes), []).append(row)
        return {key: Results(tuple(rows)) for key, rows in groups.items()}

    @property
    def runs(self) -> list[Any]:
        """Return the runs of all rows."""
        return [row.run for row in self.rows]

    def values(self, measure: Measure) -> Float[Tensor, "Q S"]:
        """Return a number of every cell of the grid (Q) and seed (S).

        Args:
            measure: of one run.
        """
        return torch.stack(
            [
                torch.stack([torch.as_tensor(measure(run)).double() for run in cell.runs])
                for cell in self.by("condition", "method", "subject").values()
            ]
        )


def _one(subject: Any, method: Any) -> int:
    return 1


@dataclass(frozen=True)
class Experiment(Generic[Subject, Method]):
    """How runs of one kind are made, and what they depend on.

    Args:
        kind: of a run, a NamedTuple of tensors. Its name and fields tell files of different kinds apart.
        make: (subject, method, seeds) -> one run for each seed. Each has random numbers of its own, so
            that it does not depend on which others are made with it.
        facts: (subject, method) -> everything beside the seed that a run depends on; tensors count
            with all their numbers.
        sources: files and folders of the checkout whose code makes runs (`source_hash`).
        work: (subject, method) -> how much one run is to the progress bar. unit: of this.
    """

    kind: Any
    make: Callable[[Subject, Method, Sequence[int]], Sequence[Any]]
    facts: Callable[[Subject, Method], Sequence[Any]]
    sources: tuple[str, ...]
    work: Callable[[Subject, Method], int] = _one
    unit: str = "run"

    def run(
        self,
        conditions: Mapping[str, Grid[Subject, Method]],
        seeds: Sequence[int],
        folder: Path,
        *,
        progress: bool = False,
        title: str = "runs",
    ) -> Results:
        """Make all runs that are not in the folder yet, and return these and the others.

        Args:
            conditions: grids by the name of what sets them apart. seeds: runs of every cell.
            folder: where runs are kept, one file each. progress: whether to show a bar, called `title`.
        """
        cells = [
            (condition, *subject, *method)
            for condition, grid in conditions.items()
            for subject in grid.subjects.items()
            for method in grid.methods.items()
        ]
        source = source_hash(*self.sources)
        total = len(seeds) * sum(self.work(cell[2], cell[4]) for cell in cells)
        rows: list[Row] = []
        with tqdm(total=total, disable=not progress, unit=self.unit, desc=title) as bar:
            for condition, subject, who, method, how in cells:
                bar.set_postfix_str(" ".join(filter(None, (condition, subject, method))))
                facts = [source, *self.facts(who, how)]
                make = lambda missing, w=who, h=how: self.make(w, h, missing)  # noqa: E731
                found = kept_runs(folder, self.kind, facts, seeds, make)
                rows += [
                    Row(condition, subject, method, seed, run)
                    for seed, run in zip(seeds, found, strict=True)
                ]
                bar.update(len(seeds) * self.work(who, how))
        return Results(tuple(rows))
