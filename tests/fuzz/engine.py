"""Starts workers, notices those that die or hang, and makes a table of what came of the cases."""

import json
import os
import select
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

__all__ = ["BAD", "KINDS", "Result", "fuzz"]

KINDS = (
    "poses", "body poses", "keypoints npz", "keypoints csv", "OpenPose", "recording npz",
    "recording text", "recording yaml", "motion capture", "cameras", "HumanEva", "prior", "models",
    "video", "info", "calls",
)  # fmt: skip
"""Kinds of files, the command `torchpose info` on any of them, and odd calls of functions."""

BAD = ("untyped", "silent", "message", "memory", "slow", "killed")
"""What must not come of a case: an error that is no `TorchposeError`, something read that is not what it
should be, a refusal that is no printable line with the file's name, more memory than 512 MiB, more than
ten seconds, a process that died."""

_ROOT = Path(__file__).resolve().parents[2]
_PATIENCE = 90  # seconds without a word from a worker


class Result(NamedTuple):
    """Outcomes by kind, and the cases that must not be: kind, index, outcome, detail."""

    outcomes: dict[str, Counter[str]]
    bad: list[dict[str, Any]]

    def table(self) -> str:
        """A row for each kind, in Markdown."""
        columns = ("refused", "read", *BAD)
        head = ["kind", "cases", *columns]
        rows = [[kind, str(sum(found.values())), *(f"{found[c]:,}" for c in columns)]
                for kind, found in self.outcomes.items()]  # fmt: skip
        both = sum(self.outcomes.values(), Counter())
        rows.append(["**all**", f"{sum(both.values()):,}", *(f"{both[c]:,}" for c in columns)])
        lines = [head, ["---", *["--:"] * (len(head) - 1)], *rows]
        return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def fuzz(seconds: float, seed: int = 0, kinds: Sequence[str] = KINDS, start: int = 0) -> Result:
    """Try cases for so many seconds of processor time.

    The same seed gives the same cases; how many of them depends on the machine.

    Args:
        seconds: of processor time. seed: of all cases. kinds: of `KINDS`, in turn.
        start: index of the first case of each kind.
    """
    outcomes: dict[str, Counter[str]] = {kind: Counter() for kind in kinds}
    bad: list[dict[str, Any]] = []
    left = seconds
    while left > 0:
        began = time.monotonic()
        ended, start = _watch(seed, kinds, left, start, outcomes, bad)
        if ended:
            break
        left -= time.monotonic() - began
    return Result(outcomes, bad)


def _watch(
    seed: int, kinds: Sequence[str], seconds: float, start: int,
    outcomes: dict[str, Counter[str]], bad: list[dict[str, Any]],
) -> tuple[bool, int]:  # fmt: skip
    """One worker; whether it came to its end, and where the next one is to begin."""
    command = [
        sys.executable,
        "-m",
        "tests.fuzz.worker",
        str(seed),
        ",".join(kinds),
        str(seconds),
        str(start),
    ]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    worker = subprocess.Popen(
        command,
        cwd=_ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert worker.stdout is not None and worker.stderr is not None
    case: list[Any] = []
    while True:
        if not select.select([worker.stdout], [], [], _PATIENCE)[0]:
            worker.kill()
        line = worker.stdout.readline()
        if not line:
            break
        facts = json.loads(line)
        case = facts.get("case", case)
        if "outcome" in facts:
            outcomes[facts["kind"]][facts["outcome"]] += 1
            if facts["outcome"] in BAD:
                bad.append(facts)
    said = worker.communicate()[1]
    if worker.returncode == 0:
        return True, 0
    if not case or worker.returncode == 1:
        raise RuntimeError(
            f"the worker failed before its first case or between two:\n{said[-3000:]}"
        )
    kind, index = case
    outcomes[kind]["killed"] += 1
    detail = f"signal {-worker.returncode}: {said[-200:]}"
    bad.append({"kind": kind, "index": index, "outcome": "killed", "detail": detail})
    return False, index + 1
