"""What a protocol found: tables, sentences computed from them, pictures; as text, Markdown and JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from torchpose.errors import InputError
from torchpose.io._results import replace_own

RESULTS = "evaluate"
"""Kind of the files in the folder of a protocol, for `torchpose.io._results.replace_own`."""

Cell = float | int | str | None


@dataclass
class Table:
    """Holds numbers by method (row) and quantity (column).

    Args:
        title: one line above the table, with the unit.
        columns: names of the columns.
        digits: decimals of numbers that are not whole; one number, or one for each column.
        note: remarks below the table.
    """

    title: str
    columns: tuple[str, ...]
    digits: int | tuple[int, ...] = 1
    note: str = ""
    rows: dict[str, tuple[Cell, ...]] = field(default_factory=dict)

    def add(self, name: str, values: Sequence[Cell] | Tensor) -> None:
        """Append a row.

        Raises:
            InputError: another number of values than columns.
        """
        cells = values.tolist() if isinstance(values, Tensor) else list(values)
        if len(cells) != len(self.columns):
            raise InputError(
                f"table {self.title!r} has {len(self.columns)} columns, got {len(cells)} values"
            )
        self.rows[name] = tuple(cells)

    def __getitem__(self, key: tuple[str, str]) -> Any:
        """Return the cell of (row, column)."""
        row, column = key
        return self.rows[row][self.columns.index(column)]

    def cells(self) -> list[list[str]]:
        """Return all cells as text, the header first."""
        digits = self.digits
        if isinstance(digits, int):
            digits = (digits,) * len(self.columns)
        body = [
            [name, *(_text(v, d) for v, d in zip(row, digits, strict=True))]
            for name, row in self.rows.items()
        ]
        return [["", *self.columns], *body]

    def to_text(self) -> str:
        """Return columns aligned with blanks."""
        cells = self.cells()
        widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
        lines = []
        for row in cells:
            first = row[0].ljust(widths[0])
            rest = (c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))
            lines.append("  ".join([first, *rest]).rstrip())
        lines.insert(1, "-" * max(map(len, lines)))
        return "\n".join([self.title, *lines, *([self.note] if self.note else [])])

    def to_markdown(self) -> str:
        """Return a Markdown table under its title."""
        header, *body = [[c.replace("|", "/") for c in row] for row in self.cells()]
        rule = ["---", *["---:"] * len(self.columns)]
        lines = [f"| {' | '.join(row)} |" for row in (header, rule, *body)]
        return "\n".join([f"**{self.title}**", "", *lines, *(["", self.note] if self.note else [])])


@dataclass
class Report(Mapping[str, Table]):
    """Tables by name, with settings, findings and pictures.

    Args:
        name: the name of the protocol. settings: everything that the numbers depend on.
        tables: the tables by name; `report["errors"]` is one of them.
        findings: sentences computed from the numbers. pictures: files in the output folder.
    """

    name: str
    settings: dict[str, Any] = field(default_factory=dict)
    tables: dict[str, Table] = field(default_factory=dict)
    findings: list[str] = field(default_factory=list)
    pictures: list[str] = field(default_factory=list)

    def __getitem__(self, key: str) -> Table:
        return self.tables[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self.tables)

    def __len__(self) -> int:
        return len(self.tables)

    def table(self, key: str, title: str, columns: Sequence[str], **options: Any) -> Table:
        """Add an empty table to the report, and return it.

        Args:
            key: of the table in ``report.json``. title: above the table. columns: names of the columns.
            **options: other fields of `Table`.

        Returns:
            The `Table`, to be filled with rows.
        """
        self.tables[key] = Table(title, tuple(columns), **options)
        return self.tables[key]

    def summary(self) -> str:
        """Return all tables and findings as plain text."""
        parts = [self.name, *(t.to_text() for t in self.tables.values())]
        if self.findings:
            parts.append("\n".join(f"- {line}" for line in self.findings))
        return "\n\n".join(parts)

    def to_markdown(self) -> str:
        """Return all tables, findings, pictures and settings as Markdown."""
        parts = [f"# {self.name}", *(t.to_markdown() for t in self.tables.values())]
        if self.findings:
            parts.append("## Findings\n\n" + "\n".join(f"- {line}" for line in self.findings))
        parts += [f"![{Path(p).stem.replace('-', ' ')}]({p})" for p in self.pictures]
        settings = json.dumps(_plain(self.settings), indent=2, ensure_ascii=False)
        parts.append(f"## Settings\n\n```json\n{settings}\n```")
        return "\n\n".join(parts) + "\n"

    def to_json(self) -> str:
        """Return the report as JSON; numbers that are not finite are null."""
        tables = {
            key: {
                "title": t.title,
                "note": t.note,
                "rows": {
                    name: dict(zip(t.columns, row, strict=True)) for name, row in t.rows.items()
                },
            }
            for key, t in self.tables.items()
        }
        whole = {
            "name": self.name,
            "settings": self.settings,
            "tables": tables,
            "findings": self.findings,
            "pictures": self.pictures,
        }
        return json.dumps(_plain(whole), indent=2, ensure_ascii=False, allow_nan=False) + "\n"

    def save(self, out: Path) -> None:
        """Write ``report.json`` and ``report.md``, each whole or not at all.

        Files of these names that are of something else are moved to a folder ``earlier-1``.

        Args:
            out: folder, which is made if it is missing.

        Raises:
            OutputError: a file cannot be written.
        """
        for name, text in (("report.json", self.to_json()), ("report.md", self.to_markdown())):
            with replace_own(Path(out) / name, RESULTS) as temporary:
                temporary.write_text(text, encoding="utf-8")


def _text(value: Cell, digits: int) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if isinstance(value, str):
        return value
    return f"{value:,}" if isinstance(value, int) else f"{value:,.{digits}f}"


def _plain(value: Any) -> Any:
    """Return a value converted to types that JSON has."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, Tensor):
        return _plain(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, int | str | bool) or value is None else str(value)
