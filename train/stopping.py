"""End a command on SIGTERM and Ctrl-C with the exit code that shells and schedulers expect.

Nothing here needs Lightning, which takes seconds to load: a signal that comes meanwhile is heard too.
"""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

__all__ = ["raise_if_signalled", "signal_of", "stopped_by_signals", "terminate"]

_received: list[int] = []


class _Terminated(SystemExit):
    """The exit that is raised wherever the process is when SIGTERM comes."""


def terminate(signum: int, _: Any, first: Callable[[], None] = lambda: None) -> None:
    """Raise on the first signal only, so that cleaning up is not interrupted.

    Args:
        signum: of the signal. first: is called before.
    """
    _received.append(signum)
    if len(_received) == 1:
        first()
        raise _Terminated(128 + signum)


def _interrupt(signum: int, _: Any) -> None:
    """Raise what Python raises at Ctrl-C, and note it."""
    _received.append(signum)
    raise KeyboardInterrupt


@contextlib.contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Let SIGTERM end the block by an exception, as Ctrl-C does.

    Outside of the main thread, where Python hears no signals, nothing is changed.
    """
    _received.clear()
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {signal.SIGTERM: signal.signal(signal.SIGTERM, terminate)}
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else it is ignored
        before[signal.SIGINT] = signal.signal(signal.SIGINT, _interrupt)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def raise_if_signalled() -> None:
    """Raise at a signal whose exception was lost: some modules catch everything while they are loaded."""
    if _received:
        raise _Terminated(128 + _received[0])


def signal_of(error: BaseException) -> signal.Signals | None:
    """Return the signal that an exception comes from; None if it comes from none.

    Lightning makes an exit of code 1 out of Ctrl-C, and workers that hear a signal themselves fail in
    their own ways.
    """
    if _received:
        return signal.Signals(_received[0])
    interrupted = error.__context__ if isinstance(error, SystemExit) else error
    return signal.SIGINT if isinstance(interrupted, KeyboardInterrupt) else None
