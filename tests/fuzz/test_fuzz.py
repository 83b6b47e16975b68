"""Damaged files and odd calls: each is refused in one line, or what comes of it is as it should be.

`pytest tests/fuzz --fuzz-seconds 600` tries more of them; `python -m tests.fuzz` prints the table of
docs/robustness.md.
"""

import json
import math
from pathlib import Path
from random import Random

import pytest

from tests.fuzz import engine, mutate, readers, samples, worker
from torchpose.errors import FileFormatError


def test_damaged_files_and_odd_calls(request):
    result = engine.fuzz(request.config.getoption("--fuzz-seconds"))
    shown = "\n".join(json.dumps(case) for case in result.bad[:20])
    assert not result.bad, f"{result.table()}\n{shown}"
    for kind, outcomes in result.outcomes.items():
        assert outcomes["refused"] > 0, kind
        assert outcomes["read"] > 0 or kind == "video", kind


def test_kinds_are_those_of_the_worker():
    assert engine.KINDS == worker.KINDS


def test_a_seed_gives_the_same_damage():
    content = json.dumps({"a": [1, 2, {"b": "text"}]}).encode()
    for name in ("a.json", "a.toml"):
        made = [mutate.damage_content(name, content, Random(f"{i}")) for i in range(40)]
        again = [mutate.damage_content(name, content, Random(f"{i}")) for i in range(40)]
        assert made == again and len(set(made)) > 20


def test_damage_reaches_no_later_case():
    content = json.dumps({"a": [1, 2, {"b": "text"}], "c": {"d": [0.5]}}).encode()
    first = mutate.damage_content("a.json", content, Random("7"))
    for i in range(3000):  # values that were put in are damaged too
        mutate.damage_content("a.json", content, Random(f"other/{i}"))
    assert mutate.damage_content("a.json", content, Random("7")) == first
    assert [] in mutate._ODD_VALUES and {} in mutate._ODD_VALUES


def test_a_header_that_is_cut_off_can_be_damaged_again():
    for length in range(12):
        made = mutate._claiming(b"\x93NUMPY\x01\0\x00\x00{}"[:length], Random(0))
        assert len(made) == length if length < 10 else b"shape" in made


def _raise(error):
    def read(path):
        raise error(f"{path}: x") if error is FileFormatError else error("x")

    return read


def _accept(path):
    """A reader that believes everything."""


@pytest.mark.parametrize(
    ("read", "outcome"),
    [
        (_accept, "read"),
        (_raise(FileFormatError), "refused"),
        (_raise(KeyError), "untyped"),
        (_raise(MemoryError), "memory"),
        (_raise(readers.SilentError), "silent"),
        (_raise(type("NamelessError", (FileFormatError,), {})), "message"),
    ],
)
def test_outcomes_are_told_apart(tmp_path, monkeypatch, read, outcome):
    monkeypatch.setitem(readers.READERS, "cameras", read)
    whole = {"cameras": {"cameras.toml": b"[a]\nmatrix = 3\n"}}
    cases = [worker.run_case(0, "cameras", i, tmp_path, whole) for i in range(20)]
    assert {case["outcome"] for case in cases} == {outcome}


def test_a_worker_that_dies_is_noticed_and_the_next_one_goes_on(tmp_path, monkeypatch):
    package = tmp_path / "tests" / "fuzz"
    package.mkdir(parents=True)
    for folder in (package, package.parent):
        (folder / "__init__.py").touch()
    (package / "worker.py").write_text(
        "import json, os, signal, sys\n"
        "start = int(sys.argv[4])\n"
        "for i in range(start, 5):\n"
        "    print(json.dumps({'case': ['cameras', i]}), flush=True)\n"
        "    if i == 2: os.kill(os.getpid(), signal.SIGSEGV)\n"
        "    print(json.dumps({'kind': 'cameras', 'index': i, 'outcome': 'refused'}), flush=True)\n"
    )
    monkeypatch.setattr(engine, "_ROOT", tmp_path)
    result = engine.fuzz(60, kinds=("cameras",))
    assert dict(result.outcomes["cameras"]) == {"refused": 4, "killed": 1}
    assert [(case["index"], case["outcome"]) for case in result.bad] == [(2, "killed")]
    assert "| cameras | 5 | 4 | 0 |" in result.table()


SPOILT = {
    "a variance below zero": lambda t: t.covariance3d[0, 1, 2].mul_(-1),
    "a covariance that is not symmetric": lambda t: t.covariance2d[0, 1, 2, 0, 1].add_(100),
    "half a joint": lambda t: t.joints3d[0, 1, 2, 0].fill_(math.nan),
    "an infinite joint": lambda t: t.joints2d[0, 1, 2, 0].fill_(math.inf),
    "a length beyond the end": lambda t: t.lengths.add_(1),
    "a failure that is none": lambda t: t.failed_at.fill_(2),
    "no camera": lambda t: t.matrix.zero_(),
}


@pytest.mark.parametrize("what", SPOILT)
def test_what_is_read_is_looked_at_apart_from_the_library(monkeypatch, what):
    track = samples.pose_track()
    monkeypatch.setattr(readers.PoseTrack, "load", lambda path: track)
    readers.READERS["poses"](Path("one.npz"))
    SPOILT[what](track)
    with pytest.raises(readers.SilentError):
        readers.READERS["poses"](Path("one.npz"))


def test_docs_name_the_kinds():
    page = Path(__file__).parents[2] / "docs" / "robustness.md"
    rows = [
        line.split("|")[1].strip() for line in page.read_text().splitlines() if line[:2] == "| "
    ]
    assert set(engine.KINDS) <= set(rows)
