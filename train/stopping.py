"""End a command on SIGTERM and Ctrl-C with the exit code that shells and schedulers expect."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

__all__ = ["StopAtOnce", "signal_of", "stopped_by_signals"]

_received: list[int] = []


class _Terminated(SystemExit):
    """The exit that is raised wherever the process is when SIGTERM comes."""


def _terminate(signum: int, _: Any) -> None:
    """Raise on the first signal only, so that cleaning up is not interrupted."""
    _received.append(signum)
    if len(_received) == 1:
        raise _Terminated(128 + signum)


@contextlib.contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Let SIGTERM end the block by an exception, as Ctrl-C does.

    Outside of the main thread, where Python hears no signals, nothing is changed.
    """
    _received.clear()
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def signal_of(error: BaseException) -> signal.Signals | None:
    """Return the signal that an exception comes from; None if it comes from none.

    Lightning makes an exit of code 1 out of Ctrl-C, and workers that hear a signal themselves fail in
    their own ways.
    """
    if _received:
        return signal.Signals(_received[0])
    interrupted = error.__context__ if isinstance(error, SystemExit) else error
    return signal.SIGINT if isinstance(interrupted, KeyboardInterrupt) else None


class StopAtOnce(Callback):
    """A callback that keeps SIGTERM from Lightning, which would end the epoch first and exit with code 0.

    The signal is passed on to the other processes that Lightning has started on this machine.
    """

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Set the handler of the signal again, after Lightning has set its own."""
        launcher = trainer.strategy.launcher

        def terminate(signum: int, frame: Any) -> None:
            if launcher is not None and not _received:
                launcher.kill(signal.Signals(signum))
            _terminate(signum, frame)

        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, terminate)
