"""Every benchmark runs on a tiny problem and finds that results agree; times are not tested."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = (
    "mixture_kalman_filter",
    "kalman_step",
    "expectation_maximisation",
    "batch_memory",
)


def run(script: str, *options: str) -> subprocess.CompletedProcess[str]:
    paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    command = [sys.executable, str(ROOT / "benchmarks" / f"{script}.py"), "--threads", "1"]
    return subprocess.run(
        [*command, *options],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.mark.parametrize("script", SCRIPTS)
def test_quick_run_agrees_and_is_written(script, tmp_path):
    written = tmp_path / "table.md"
    done = run(script, "--quick", "--runs", "1", "--out", str(written))
    assert done.returncode == 0, done.stdout + done.stderr
    text = written.read_text()
    assert "Agreement" in text
    assert "| ---" in text
    assert text.split() == done.stdout.split()
