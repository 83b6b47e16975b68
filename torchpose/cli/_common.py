"""What several commands need: threads for video, pictures, an early end on Ctrl-C."""

import os
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

T = TypeVar("T")

HANG_UP: signal.Signals | None = getattr(signal, "SIGHUP", None)  # Windows has none


class UntilInterrupted(Generic[T]):
    """Items of an iterable until Ctrl-C or until `stop` returns true; a second Ctrl-C interrupts as usual.

    A context manager, to be used in the main thread; the items may be taken in another. A terminal that is
    closed may hang up twice, by its shell and by the system: that is one request.

    Args:
        items: to be passed on. stop: asked before each.
        signals: that count as Ctrl-C.

    Attributes:
        count: items so far. interrupted: whether items were left out.
    """

    def __init__(
        self,
        items: Iterable[T],
        stop: Callable[[], bool] = lambda: False,
        signals: Sequence[signal.Signals] = (signal.SIGINT,),
    ) -> None:
        self._items, self._stop, self._signals = items, stop, signals
        self.count, self.interrupted, self._asked = 0, False, False

    def __enter__(self) -> Self:
        self._before = [signal.signal(one, self._interrupt) for one in self._signals]
        return self

    def __exit__(self, *_: object) -> None:
        for one, before in zip(self._signals, self._before, strict=True):
            signal.signal(one, before)

    def __iter__(self) -> Iterator[T]:
        for item in self._items:
            if self._asked or self._stop():
                self.interrupted = True
                return
            self.count += 1
            yield item

    def _interrupt(self, number: int, _: object) -> None:
        if self._asked and number != HANG_UP:
            raise KeyboardInterrupt
        self._asked = True


def share_cores() -> None:
    """Set the number of threads for video, whose tensors are small and whose stages run side by side.

    More threads inside a stage cost more than they bring where there is no core left for them.
    """
    import cv2
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(max(1, (os.cpu_count() or 1) - 1))


def pictures_possible(wanted: bool) -> bool:
    """Return whether pictures are wanted and can be drawn; say so if they cannot."""
    if wanted and find_spec("matplotlib") is None:
        print(
            "no pictures: matplotlib is not installed; `python -m pip install matplotlib` brings it"
        )
        return False
    return wanted


def save_pictures(folder: Path, pictures: dict[str, Callable[[], Any]]) -> list[Path]:
    """Draw and write pictures by file name, and return their paths."""
    from torchpose.viz._style import save_figure

    return [save_figure(draw(), folder / name) for name, draw in pictures.items()]
