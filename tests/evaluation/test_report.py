"""Reports as text, Markdown and JSON."""

import json
import math

import pytest

from torchpose.errors import InputError, OutputError
from torchpose.evaluation import Report


@pytest.fixture
def report():
    made = Report("example", {"seed": 0, "path": None})
    table = made.table("errors", "Errors (cm)", ["mean", "n"], digits=2, note="pooled")
    table.add("a | b", [1.2345, 3])
    table.add("lost", [math.nan, 0])
    made.findings.append("a is better")
    made.pictures.append("errors-3d.png")
    return made


def test_rows_can_be_looked_up_and_must_fit(report):
    assert report["errors"]["a | b", "mean"] == 1.2345
    assert list(report) == ["errors"] and len(report) == 1
    with pytest.raises(InputError, match="2 columns, got 1"):
        report["errors"].add("short", [1.0])


def test_text_is_aligned_and_missing_numbers_are_dashes(report):
    header, rule, *rows = report["errors"].to_text().splitlines()[1:5]
    assert set(rule) == {"-"}
    assert {len(line) for line in (header, *rows)} == {len(rule)}
    assert "1.23" in rows[0] and rows[1].split() == ["lost", "-", "0"]
    assert "- a is better" in report.summary()


def test_markdown_keeps_its_columns(report):
    rows = [line for line in report.to_markdown().splitlines() if line.startswith("|")]
    assert {line.count("|") for line in rows} == {4}
    assert "![errors 3d](errors-3d.png)" in report.to_markdown()


def test_files_are_written_and_read_back(report, tmp_path):
    report.save(tmp_path)
    read = json.loads((tmp_path / "report.json").read_text())
    assert read["tables"]["errors"]["rows"]["a | b"] == {"mean": 1.2345, "n": 3}
    assert read["tables"]["errors"]["rows"]["lost"]["mean"] is None
    assert (tmp_path / "report.md").read_text().startswith("# example")
    with pytest.raises(OutputError):
        report.save(tmp_path / "missing")
