"""Benchmarks read their options from the signature of a function, and none has a parser of its own."""

import ast
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import pytest

from benchmarks._command import OneOf, execute
from torchpose.errors import InputError

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
OWN_PARSERS = {
    "mediapipe_landmarks.py",  # runs where torchpose is not installed
}


class Size(NamedTuple):
    """How much is done.

    Attributes:
        runs: of each. quick: little of it.
    """

    runs: int = 3
    quick: bool = False


@pytest.fixture
def called():
    return []


@pytest.fixture
def benchmark(called):
    def main(
        size: Size = Size(runs=7),  # noqa: B008
        *,
        data: Path,
        only: Annotated[Sequence[str], OneOf(("a", "b"))] | None = None,
        factors: Sequence[float] = (0.5, 2.0),
        axes: Literal["body", "camera"] = "body",
        windows: bool = True,
    ) -> None:
        """Do it.

        Args:
            size: see `Size`. data: folder of recordings. only: these rows. factors: of the noise.
            axes: of the targets. windows: fit them.
        """
        called.append((size, data, only, factors, axes, windows))

    return main


def test_options_have_the_defaults_of_the_signature(benchmark, called):
    assert execute(benchmark, ["--data", "d"]) == 0
    assert called == [(Size(7, False), Path("d"), None, [0.5, 2.0], "body", True)]


def test_options_are_read_as_their_types_have_them(benchmark, called):
    line = "--quick --runs 2 --data d --only b a --factors 1 3.5 --axes camera --windows false"
    assert execute(benchmark, line.split()) == 0
    assert called == [(Size(2, True), Path("d"), ["b", "a"], [1.0, 3.5], "camera", False)]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("--runs 2", "data"),
        ("--data d --only c", "--only: expected one of a, b, got 'c'"),
        ("--data d --axes sideways", "--axes"),
        ("--data d --factors much", "factors"),
        ("--data d --unknown 1", "--unknown"),
    ],
)
def test_what_is_refused_is_said_in_one_line(benchmark, called, capsys, line, said):
    assert execute(benchmark, line.split()) == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert said in error and not called


def test_help_has_the_texts_of_the_docstring(benchmark, capsys):
    assert execute(benchmark, ["--help"]) == 0
    text = capsys.readouterr().out
    assert "--only a|b" in text and "folder of recordings" in text
    assert re.search(r"--runs N\s+of each \(default 7\)", text)


def test_a_run_that_finds_a_difference_fails(capsys):
    def disagreeing() -> None:
        sys.exit("results differ")

    def refusing() -> None:
        raise InputError("no recordings")

    assert execute(disagreeing, []) == 1
    assert capsys.readouterr().err == "results differ\n"
    assert execute(refusing, []) == 2


def test_no_benchmark_has_a_parser_of_its_own():
    found = {
        path.relative_to(BENCHMARKS).as_posix()
        for path in BENCHMARKS.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Import | ast.ImportFrom)
        and {"argparse", "jsonargparse"}
        & {getattr(node, "module", None), *(alias.name for alias in node.names)}
    }
    assert found <= OWN_PARSERS
