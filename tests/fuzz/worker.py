"""Runs cases, one line of JSON each, in a process whose memory is bounded."""

import json
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path
from random import Random
from typing import Any

import torch

from tests.fuzz import calls, mutate, readers
from tests.fuzz.mutate import place
from tests.fuzz.samples import SAMPLES, Content
from torchpose.errors import DegenerateFilterWarning, TorchposeError

__all__ = ["KINDS", "main"]

KINDS = (*SAMPLES, "info", "calls")  # as in `tests.fuzz.engine`, which starts without the library
_MEMORY = 512 << 20  # bytes that a case may take beyond those of the start
_SECONDS, _WAITING = 10, 60  # of processor time, and by the clock for what waits for something
_LEAST_CASES = 50  # of each kind, of which some are read and some refused


class _Slow(BaseException):
    """A case that takes too long."""


def main(seed: int, kinds: list[str], seconds: float, start: int) -> None:
    """Cases of each kind in turn, until so many seconds of processor time are used.

    There are `_LEAST_CASES` of each at least: on a busy machine cases take more processor time.
    """
    torch.set_num_threads(1)
    torch.set_warn_always(True)  # else only the first of all cases would be seen to lose values
    with tempfile.TemporaryDirectory() as folder:
        whole = _samples(Path(folder))
        _check_whole(Path(folder), whole)
        _limit()
        begin, index = time.process_time(), start
        while index < start + _LEAST_CASES or time.process_time() < begin + seconds:
            for kind in kinds:
                _say(case=[kind, index])
                _say(**run_case(seed, kind, index, Path(folder), whole))
            index += 1


def run_case(
    seed: int, kind: str, index: int, folder: Path, whole: dict[str, dict[str, Content]]
) -> dict[str, Any]:
    """What came of one case."""
    rng = Random(f"{seed}/{kind}/{index}")
    began = time.perf_counter()
    with tempfile.TemporaryDirectory(dir=folder) as name, warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", DegenerateFilterWarning)
        signal.setitimer(signal.ITIMER_PROF, _SECONDS)
        signal.setitimer(signal.ITIMER_REAL, _WAITING)
        try:
            outcome, detail = _outcome(kind, rng, Path(name), whole)
        except _Slow:
            outcome, detail = "slow", ""
        finally:
            for timer in (signal.ITIMER_PROF, signal.ITIMER_REAL):
                signal.setitimer(timer, 0)
    taken = round(time.perf_counter() - began, 3)
    return {"kind": kind, "index": index, "outcome": outcome, "detail": detail[:600], "s": taken}


def _outcome(
    kind: str, rng: Random, folder: Path, whole: dict[str, dict[str, Content]]
) -> tuple[str, str]:
    path = None
    try:
        if kind == "calls":
            return "read", calls.odd_call(rng)
        own = rng.choice([k for k in SAMPLES if k not in ("HumanEva",)]) if kind == "info" else kind
        name = rng.choice(list(whole[own]))
        path = place(folder, name, whole[own][name], rng)
        if kind == "info":
            refused = readers.info(path)
            return ("read", "") if refused is None else _refused(refused.rstrip("\n"), path)
        readers.READERS[own](path)
        return "read", ""
    except TorchposeError as error:
        wrong = readers.check_message(error)
        return ("message", f"{wrong}: {error!r:.300}") if wrong else _refused(str(error), path)
    except readers.SilentError as error:
        return "silent", f"{path and path.name}: {error}"
    except MemoryError:
        return "memory", _where()
    except Exception as error:
        big = "allocate memory" in str(error) or "Insufficient memory" in str(error)
        return (
            "memory" if big else "untyped"
        ), f"{type(error).__name__}: {error!s:.100} | {_where()}"


def _refused(message: str, path: Path | None) -> tuple[str, str]:
    names = path is None or len(path.name) > 60 or "\0" in path.name or path.name in message
    named = names or (path is not None and path.is_dir() and path.name in message)
    return ("refused", "") if named else ("message", f"does not name the file: {message:.200}")


def _where() -> str:
    """Where in the library it came from."""
    frames = traceback.extract_tb(sys.exc_info()[2])
    own = [f for f in frames if "/torchpose/" in f.filename and "/tests/" not in f.filename]
    return " < ".join(f"{Path(f.filename).name}:{f.lineno} {f.name}" for f in own[::-1][:3])


def _samples(folder: Path) -> dict[str, dict[str, Content]]:
    mutate.bomb()  # before time and memory are bounded
    made = folder / "whole"
    made.mkdir()
    return {
        kind: {name: make(made) for name, make in files.items()} for kind, files in SAMPLES.items()
    }


def _check_whole(folder: Path, whole: dict[str, dict[str, Content]]) -> None:
    """Every file is accepted as long as it is whole; the readers' own checks would else mean nothing."""
    for kind, files in whole.items():
        for name, content in files.items():
            with tempfile.TemporaryDirectory(dir=folder) as place_of:
                path = Path(place_of) / name
                if isinstance(content, bytes):
                    path.write_bytes(content)
                else:
                    path.mkdir()
                    for own, data in content.items():
                        (path / own).write_bytes(data)
                readers.READERS[kind](path)


def _limit() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + _MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for number in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(number, _slow)


def _slow(*_: object) -> None:
    raise _Slow


def _say(**facts: Any) -> None:
    print(json.dumps(facts), file=sys.__stdout__, flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2].split(","), float(sys.argv[3]), int(sys.argv[4]))
