"""Run an iterable ahead of its consumer in a thread, to decode while filters run."""

import threading
from collections import deque
from collections.abc import Generator, Iterable
from typing import Any, Generic, TypeVar

from torchpose._core.checks import check_count

T = TypeVar("T")


def prefetch(iterable: Iterable[T], size: int = 4) -> Generator[T, None, None]:
    """Run an iterable in a thread of its own, at most `size` items ahead of the consumer.

    Stages of a pipeline are stacked: `prefetch(stage(prefetch(source)))` runs both in threads. An
    exception of the iterable is raised in the consumer, after the items before it. When the consumer
    stops early (break, exception, Ctrl-C, `close()`), the thread ends after the item that it is
    making and nothing more is read. The iterable is closed at the end in all of these cases, in the
    thread that ran it, if it has a `close`. The thread starts with the first item that is asked for.

    An exception keeps this generator alive through its traceback; to end the thread at the end of a
    block all the same, use `with contextlib.closing(prefetch(...))`.

    Args:
        iterable: what to run; nothing else may use it meanwhile.
        size: most items waiting or being made; the consumer holds one more.

    Returns:
        A generator over the same items.

    Raises:
        InputError: `size` is less than 1.

    >>> list(prefetch(range(5), size=2))
    [0, 1, 2, 3, 4]
    """
    check_count("size", size)
    return _consume(iterable, size)


def _consume(iterable: Iterable[T], size: int) -> Generator[T, None, None]:
    shelf: _Shelf[T] = _Shelf(size)
    thread = threading.Thread(
        target=_produce, args=(iterable, shelf), name="torchpose-prefetch", daemon=True
    )
    del iterable  # only the thread refers to it, so that it can be freed there
    try:
        thread.start()
        while shelf.wait():
            yield shelf.take()
        if shelf.error is not None:
            raise shelf.error
    finally:
        shelf.stop()
        if thread.ident is not None:
            thread.join()
        shelf.error = None  # its traceback would keep this generator alive


class _Shelf(Generic[T]):
    """Passes items from one thread to another."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.items: deque[T] = deque()
        self.changed = threading.Condition()
        self.stopped = self.finished = False
        self.error: BaseException | None = None

    def wait_for_room(self) -> bool:
        """Wait until an item may be made; return False if the consumer has stopped."""
        with self.changed:
            self.changed.wait_for(lambda: self.stopped or len(self.items) < self.size)
            return not self.stopped

    def put(self, item: T) -> None:
        with self.changed:
            if not self.stopped:
                self.items.append(item)
            self.changed.notify_all()

    def finish(self, error: BaseException | None) -> None:
        with self.changed:
            self.finished, self.error = True, error
            self.changed.notify_all()

    def wait(self) -> bool:
        """Wait for an item; return False if there are no more."""
        with self.changed:
            # on Windows Ctrl-C does not interrupt a wait without a limit
            while not self.changed.wait_for(lambda: bool(self.items) or self.finished, 0.5):
                pass
            return bool(self.items)

    def take(self) -> T:
        with self.changed:
            item = self.items.popleft()
            self.changed.notify_all()
            return item

    def stop(self) -> None:
        with self.changed:
            self.stopped = True
            self.items.clear()
            self.changed.notify_all()


def _produce(iterable: Iterable[Any], shelf: _Shelf[Any]) -> None:
    error: BaseException | None = None
    try:
        try:
            _fill(iterable, shelf)
        finally:
            close = getattr(iterable, "close", None)
            if close is not None:
                close()
    except BaseException as caught:  # raised again in the consumer
        error = caught
    del iterable
    shelf.finish(error)


def _fill(iterable: Iterable[Any], shelf: _Shelf[Any]) -> None:
    iterator = iter(iterable)
    while shelf.wait_for_room():
        try:
            item = next(iterator)
        except StopIteration:
            return
        shelf.put(item)
        del item
