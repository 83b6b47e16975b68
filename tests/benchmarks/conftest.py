"""Scripts run in the process of their test, and a few recordings of every person of UTD-MHAD."""

import importlib
import os
import sys
from pathlib import Path

import pytest

from benchmarks._command import execute
from benchmarks.speed._timing import THREAD_VARIABLES
from tests.data import few_recordings

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def run_here(monkeypatch, capsys, undoubted_cameras):
    """Run a script in this process, which keeps its cores: what it prints."""

    def run(script: str, *options: str) -> str:
        module = importlib.import_module(f"benchmarks.{script}")
        monkeypatch.setattr(sys, "argv", [f"{script.replace('.', '/')}.py"])  # names its table
        monkeypatch.setattr(os, "sched_setaffinity", lambda *_: None, raising=False)
        for library in THREAD_VARIABLES:  # which the script sets; they are put back afterwards
            monkeypatch.setenv(f"{library}_NUM_THREADS", "1")
        monkeypatch.setenv("PYTHONPATH", str(ROOT))  # of processes that the script starts
        capsys.readouterr()
        code = execute(module.main, ["--threads", "1", *options])
        captured = capsys.readouterr()
        assert code == 0, captured.err
        return captured.out

    return run


@pytest.fixture(scope="session")
def few_people(tmp_path_factory) -> Path:
    """A folder kinect_utd_mhad with two recordings of each person."""
    return few_recordings("kinect_utd_mhad", tmp_path_factory.mktemp("few-people"), 2)
