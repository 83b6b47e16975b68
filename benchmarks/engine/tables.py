"""Tables of a report, and CSV files, made of the rows of an experiment."""

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from benchmarks.engine.experiment import Axis, Results, Row
from benchmarks.engine.statistics import Cell
from torchpose.evaluation._report import RESULTS, Report, Table
from torchpose.io._results import replace_own

Thing = TypeVar("Thing")
Label = Callable[[str], str]


def pivot(
    report: Report,
    key: str,
    title: str,
    results: Results,
    rows: Sequence[Axis],
    cells: Mapping[str, Cell],
    *,
    columns: Axis | None = None,
    more: Mapping[str, Cell] | None = None,
    total: str = "",
    label: Label = str,
    digits: int | tuple[int, ...] = 1,
    note: str = "",
) -> Table:
    """Add a table with a row for each value of one or several axes.

    Args:
        report: gets the table. key: its name in the report. title: above it.
        results: all runs. rows: axes whose values make the rows.
        cells: what each row says, by the names of the columns.
        columns: axis each of whose values has all cells; the names of the columns are formatted with
            it, such as "± {}".
        more: cells of all runs of a row, after these.
        total: name of further rows, over all values of the first axis of `rows`.
        label: what a method is called. digits, note: of the table.
    """
    values: list[Any] = [None] if columns is None else results.names(columns)
    texts = [_text(columns, value, label) for value in values]
    names = [name.format(text) for text in texts for name in cells]
    table = report.table(key, title, [*names, *(more or {})], digits=digits, note=note)

    def add(name: str, group: Results) -> None:
        parts = [group if columns is None else group.where(**{columns: v}) for v in values]
        found = [cell(part) for part in parts for cell in cells.values()]
        table.add(name, [*found, *(cell(group) for cell in (more or {}).values())])

    for place, group in results.by(*rows).items():
        add(_row_name(rows, place, label), group)
    if total:
        for place, group in results.by(*rows[1:]).items():
            add(", ".join(filter(None, (total, _row_name(rows[1:], place, label)))), group)
    return table


def _row_name(axes: Sequence[Axis], place: Sequence[Any], label: Label) -> str:
    return ", ".join(_text(axis, v, label) for axis, v in zip(axes, place, strict=True))


def _text(axis: Axis | None, value: Any, label: Label) -> str:
    return label(value) if axis == "method" else str(value)


def describe(
    report: Report,
    key: str,
    title: str,
    things: Mapping[str, Thing],
    columns: Mapping[str, Callable[[Thing], Any]],
    *,
    digits: int | tuple[int, ...] = 1,
    note: str = "",
) -> Table:
    """Add a table with a row for each thing, such as a subject, and a column for each question.

    Args:
        report: gets the table. key: its name in the report. title: above it.
        things: by the names of their rows. columns: thing -> cell. digits, note: of the table.
    """
    table = report.table(key, title, list(columns), digits=digits, note=note)
    for name, thing in things.items():
        table.add(name, [cell(thing) for cell in columns.values()])
    return table


def write_csv(path: Path, results: Results, columns: Mapping[str, Callable[[Row], Any]]) -> None:
    """Write one line for every run, all those of a method together.

    Args:
        path: of the file. results: all runs. columns: row -> what is written, by name.
    """
    with (
        replace_own(path, RESULTS) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as out,
    ):
        writer = csv.writer(out)
        writer.writerow(columns)
        for group in results.by("condition", "method").values():
            writer.writerows([cell(row) for cell in columns.values()] for row in group.rows)
