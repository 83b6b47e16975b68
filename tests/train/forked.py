"""`train fit` in processes that are forked from one that has loaded Lightning, which takes seconds."""

import multiprocessing
import os
import signal
import sys
import warnings
from pathlib import Path

_CONTEXT = multiprocessing.get_context("forkserver" if hasattr(os, "fork") else "spawn")
_CONTEXT.set_forkserver_preload(["train.command", __name__])


class ForkedFit:
    """A real process, to be watched and sent signals to as one of `subprocess.Popen`.

    Args:
        arguments: of `train fit`. errors: file for what it writes. ignored: warnings that are no
            errors in it.
    """

    def __init__(
        self, arguments: list[object], errors: Path, ignored: tuple[type[Warning], ...] = ()
    ) -> None:
        self._errors = errors
        names = [str(argument) for argument in arguments]
        self._process = _CONTEXT.Process(target=_fit, args=(names, errors, ignored))
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


def _fit(arguments: list[str], errors: Path, ignored: tuple[type[Warning], ...]) -> None:
    from train.cli import main

    with errors.open("wb") as file, open(os.devnull, "wb") as nowhere:
        os.dup2(file.fileno(), 2)
        os.dup2(nowhere.fileno(), 1)
    warnings.simplefilter("error")
    for kind in (DeprecationWarning, *ignored):
        warnings.simplefilter("ignore", kind)
    sys.exit(main(["fit", *arguments]))
