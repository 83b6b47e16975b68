"""The table of wrong focal lengths, on a few sequences; as the command in a process of its own."""

import os
import subprocess
import sys

import pytest

from tests.benchmarks.conftest import ROOT

SMALL = "kinect-upper-body-small"  # a quarter of the time


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
        timeout=400,  # for a machine that has other work; alone it takes seconds
        check=False,
    )


@pytest.mark.slow
def test_the_true_focal_length_is_no_worse_than_a_wrong_one(few_people, tmp_path):
    written = tmp_path / "table.md"
    options = ("--data", str(few_people), "--out", str(written), "--prior", SMALL)
    done = run("focal_length", "--quick", *options)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [line.split("|")[1:-1] for line in written.read_text().splitlines() if "as it" in line]
    errors = {float(row[1]): float(row[2]) for row in rows}
    assert set(errors) == {0.7, 0.85, 1.0}
    assert errors[1.0] < 8 and errors[1.0] < errors[0.7]
    assert "HAS SEEN s7 and s8" in written.read_text()
    assert written.read_text() == done.stdout
