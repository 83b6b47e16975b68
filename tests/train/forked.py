"""Work in processes that are forked from one that has loaded Lightning, which takes seconds."""

import multiprocessing
import os
import signal
import traceback
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

_CONTEXT = multiprocessing.get_context("forkserver" if hasattr(os, "fork") else "spawn")
_CONTEXT.set_forkserver_preload(["train.command", __name__])


class ForkedFit:
    """A real process, to be watched and sent signals to as one of `subprocess.Popen`.

    Args:
        arguments: of `train fit`. errors: file for what it writes. ignored: warnings that are no
            errors in it. environment: variables that it has besides.
    """

    def __init__(
        self,
        arguments: list[object],
        errors: Path,
        ignored: tuple[type[Warning], ...] = (),
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._errors = errors
        given = [str(argument) for argument in arguments], errors, ignored, environment or {}
        self._process = _CONTEXT.Process(target=_fit, args=given)
        self._process.start()

    @property
    def returncode(self) -> int | None:
        """Its exit code, or less than zero the signal that killed it; None while it runs."""
        return self._process.exitcode

    def poll(self) -> int | None:
        return self.returncode

    def send_signal(self, signum: signal.Signals) -> None:
        if self._process.pid is not None:
            os.kill(self._process.pid, signum)

    def communicate(self, timeout: float) -> tuple[None, str]:
        """Wait for its end, and return what it wrote as errors."""
        self._process.join(timeout)
        assert self._process.exitcode is not None, f"it still runs after {timeout} s"
        return None, self._errors.read_text(encoding="utf-8")


def _fit(
    arguments: list[str],
    errors: Path,
    ignored: tuple[type[Warning], ...],
    environment: Mapping[str, str],
) -> None:
    from train.cli import end_process, main

    os.environ.update(environment)
    with errors.open("wb") as file, open(os.devnull, "wb") as nowhere:
        os.dup2(file.fileno(), 2)
        os.dup2(nowhere.fileno(), 1)
    warnings.simplefilter("error")
    for kind in (DeprecationWarning, *ignored):
        warnings.simplefilter("ignore", kind)
    end_process(main(["fit", *arguments]))


def run_apart(work: Callable[[], object], timeout: float = 120) -> None:
    """Do work in a process of its own, which ends without freeing what the work returned.

    A group of gloo that is freed waits for its threads, and now and then they wait for Python's lock,
    which the one that frees holds: what holds such a group is returned, and never freed.
    """
    process = _CONTEXT.Process(target=_work, args=(work,))
    process.start()
    process.join(timeout)
    if process.exitcode is None:
        process.kill()
    assert process.exitcode == 0, f"it ended with {process.exitcode}; None: not within {timeout} s"


def _work(work: Callable[[], object]) -> None:
    status = 1
    try:
        _kept = work()  # until the process ends
        status = 0
    except BaseException:
        traceback.print_exc()
    os._exit(status)
