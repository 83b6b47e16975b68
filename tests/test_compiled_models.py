"""Trackers within models that `torch.compile` compiles: the same numbers, live and with gradients."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.compiled_models import CASES

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def differences():
    """Of every case; in a process without shape checks, which the compiler would trace for long."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TORCHPOSE_SHAPE_CHECKS": "0"}
    command = [sys.executable, "-m", "tests.compiled_models"]
    run = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-4000:]
    return dict(json.loads(line) for line in run.stdout.splitlines())


@pytest.mark.parametrize("case", CASES)
def test_a_compiled_model_gives_the_numbers_of_the_plain_one(differences, case):
    assert differences[case] == 0
