"""Every benchmark runs on a tiny problem and finds that results agree; times are not tested."""

import argparse
import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks._table_file import table_file
from benchmarks.speed._timing import THREAD_VARIABLES
from tests.data import data_dir_or_skip

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = (
    "speed.mixture_kalman_filter",
    "speed.kalman_step",
    "speed.expectation_maximisation",
    "speed.batch_memory",
    "speed.gradients",
    "speed.streamed_em",
    "speed.silhouettes",
    "speed.root_uncertainty",
    "speed.gplvm",
    "speed.tree_messages",
)


def run(script: str, *options: str) -> subprocess.CompletedProcess[str]:
    paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    command = [sys.executable, "-m", f"benchmarks.{script}", "--threads", "1"]
    return subprocess.run(
        [*command, *options],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=400,  # for a machine that has other work; alone they take seconds
        check=False,
    )


@pytest.fixture
def run_here(monkeypatch, capsys):
    """Run a script in this process, which keeps its cores: what it prints."""

    def run(script: str, *options: str) -> str:
        module = importlib.import_module(f"benchmarks.{script}")
        monkeypatch.setattr(sys, "argv", [script, "--threads", "1", *options])
        monkeypatch.setattr(os, "sched_setaffinity", lambda *_: None, raising=False)
        for library in THREAD_VARIABLES:  # which the script sets; they are put back afterwards
            monkeypatch.setenv(f"{library}_NUM_THREADS", "1")
        monkeypatch.setenv("PYTHONPATH", str(ROOT))  # of processes that the script starts
        capsys.readouterr()
        module.main()
        return capsys.readouterr().out

    return run


@pytest.mark.parametrize("script", SCRIPTS)
def test_quick_run_agrees_and_is_written(script, run_here, tmp_path):
    written = tmp_path / "table.md"
    printed = run_here(script, "--quick", "--runs", "1", "--out", str(written))
    text = written.read_text()
    assert "Agreement" in text
    assert "| ---" in text
    assert text.split() == printed.split()


def test_a_table_goes_to_a_file_or_into_a_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/checkout/benchmarks/speed/gplvm.py"])
    (tmp_path / "v0.2").mkdir()
    wanted = {
        "new/table.md": "new/table.md", "folder": "folder/gplvm.md", "v0.2": "v0.2/gplvm.md",
    }  # fmt: skip
    for given, file in wanted.items():
        assert table_file(str(tmp_path / given)) == tmp_path / file
        assert (tmp_path / file).parent.is_dir() and not (tmp_path / file).exists()
    (tmp_path / "file.md").write_text("")
    (tmp_path / "folder" / "gplvm.md").mkdir()
    for given in ("file.md/table.md", "folder"):
        with pytest.raises(argparse.ArgumentTypeError, match="file or a folder that can be"):
            table_file(str(tmp_path / given))


def test_levers_run_without_the_test_persons_and_go_on_where_they_stopped(tmp_path):
    recordings = tmp_path / "kinect_utd_mhad"
    recordings.mkdir()
    for path in data_dir_or_skip("kinect_utd_mhad").glob("s0[1-6]_*.npz"):
        (recordings / path.name).symlink_to(path)
    out = tmp_path / "levers"
    arguments = ("--quick", "--data", str(recordings), "--out", str(out), "--only")
    first = run("ub_people_levers", *arguments, "single")
    assert first.returncode == 0, first.stdout + first.stderr
    assert "| single poses, learnt Q and R " in first.stdout
    assert "log-evidence" in first.stdout
    fits = {path.name for path in out.glob("*.safetensors")}
    second = run("ub_people_levers", *arguments, "single", "default")
    assert second.returncode == 0, second.stdout + second.stderr
    rows = [line.split() for line in first.stdout.splitlines() if line.startswith("| single")]
    again = [line.split() for line in second.stdout.splitlines() if line.startswith("| single")]
    assert len(rows) == 6
    assert rows == again
    assert len({path.name for path in out.glob("*.safetensors")} - fits) == 2
    assert (out / "levers.md").read_text() == second.stdout


def test_every_training_person_is_held_out_once(tmp_path):
    data = data_dir_or_skip("kinect_utd_mhad")
    done = run("ub_people_by_person", "--quick", "--data", str(data), "--out", str(tmp_path))
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [line.split("|")[1].strip() for line in done.stdout.splitlines()[2:]]
    assert rows == ["s1", "s2", "s3", "s4", "s5", "s6", "mean", "standard deviation"]
    assert len(list(tmp_path.glob("*.safetensors"))) == 6


def test_every_place_is_tracked_by_all_three(tmp_path):
    data = data_dir_or_skip("kinect_utd_mhad")
    done = run("ub_people_places", "--quick", "--data", str(data), "--out", str(tmp_path))
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [line.split("|")[1:-1] for line in done.stdout.splitlines()[2:]]
    assert len(rows) == 8
    assert all(0 < float(value) < 100 for row in rows for value in row[1:])
