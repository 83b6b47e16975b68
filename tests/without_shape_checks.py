"""Run a module of tests in a process without shape checks, which are not for tracing and compiling."""

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def differences_of(module: str, *cases: str) -> dict[str, float]:
    """Return what a module prints, a line [name, difference] for each case."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TORCHPOSE_SHAPE_CHECKS": "0"}
    command = [sys.executable, "-m", module, *cases]
    run = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-4000:]
    return dict(json.loads(line) for line in run.stdout.splitlines())
