"""Threads that run ahead: order, errors, early ends, and nothing left behind."""

import contextlib
import gc
import threading
import time
import weakref

import numpy as np
import pytest

from tests.video.make import make_video
from torchpose.errors import InputError
from torchpose.video import open_video
from torchpose.video._prefetch import prefetch


@pytest.fixture(autouse=True)
def _no_thread_is_left():
    yield
    assert [t for t in threading.enumerate() if t.name == "torchpose-prefetch"] == []


class Source:
    """Counts what was asked of it; `fails` at an index if given."""

    def __init__(self, n=10**9, fails=None, error=ValueError):
        self.n, self.fails, self.error = n, fails, error
        self.made, self.closed, self.threads = 0, 0, set()

    def __iter__(self):
        return self

    def __next__(self):
        self.threads.add(threading.get_ident())
        if self.made == self.fails:
            raise self.error("on purpose")
        if self.made == self.n:
            raise StopIteration
        self.made += 1
        return self.made - 1

    def close(self):
        self.closed += 1
        self.threads.add(threading.get_ident())


def wait_until(condition, seconds=5.0):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.001)
    assert condition()


@pytest.mark.parametrize("size", [1, 2, 7])
@pytest.mark.parametrize("n", [0, 1, 5, 300])
def test_same_items_in_order(size, n):
    source = Source(n)
    assert list(prefetch(source, size)) == list(range(n))
    assert source.closed == 1
    assert len(source.threads) == 1
    assert threading.get_ident() not in source.threads


def test_it_runs_ahead_but_no_further():
    source = Source()
    items = prefetch(source, 3)
    assert source.made == 0
    assert next(items) == 0
    wait_until(lambda: source.made == 4)  # three waiting, one with the consumer
    time.sleep(0.02)
    assert source.made == 4
    next(items)
    wait_until(lambda: source.made == 5)
    items.close()


def test_work_is_done_at_the_same_time():
    """Each side waits for the other to be at work, which one after the other would never end."""
    making, using = threading.Event(), threading.Event()

    def two():
        yield 0
        making.set()
        assert using.wait(10)
        yield 1

    items = prefetch(two())
    assert next(items) == 0
    using.set()
    assert making.wait(10)
    assert list(items) == [1]


@pytest.mark.parametrize("fails", [0, 1, 5])
@pytest.mark.parametrize("error", [ValueError, InputError, KeyboardInterrupt, SystemExit])
def test_exceptions_travel_after_the_items_before(fails, error):
    source, seen = Source(fails=fails, error=error), []
    with pytest.raises(error, match="on purpose"):
        for item in prefetch(source, 2):
            seen.append(item)
    assert seen == list(range(fails))
    assert source.closed == 1


def test_an_error_before_the_first_item():
    class Broken:
        def __iter__(self):
            raise ValueError("on purpose")

    with pytest.raises(ValueError, match="on purpose"):
        list(prefetch(Broken()))


@pytest.mark.parametrize("stop", ["break", "error", "interrupt", "close", "forget"])
def test_early_end(stop):
    source = Source()
    items = prefetch(source, 4)
    if stop == "break":
        for item in items:
            if item == 3:
                break
        del items  # a loop over the expression itself forgets it on leaving
    elif stop in ("error", "interrupt"):
        kind = ValueError if stop == "error" else KeyboardInterrupt
        with pytest.raises(kind), contextlib.closing(items):
            for item in items:
                if item == 3:
                    raise kind
    elif stop == "close":
        next(items)
        items.close()
    else:
        next(items)
        del items
        gc.collect()
    made = source.made
    assert made <= 8
    assert source.closed == 1
    time.sleep(0.01)
    assert source.made == made


def test_end_does_not_wait_for_more_than_one_item():
    def slow():
        while True:
            time.sleep(0.1)
            yield 1

    items = prefetch(slow(), 100)
    next(items)
    start = time.perf_counter()
    items.close()
    assert time.perf_counter() - start < 5  # a hundred take ten seconds


def test_interrupt_while_waiting_for_an_item():
    """Ctrl-C reaches the consumer in the middle of `next`."""
    import signal

    release = threading.Event()

    def stuck():
        yield 0
        release.wait(5)
        yield 1

    def press():
        time.sleep(0.05)
        signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        items = prefetch(stuck(), 2)
        assert next(items) == 0
        timer = threading.Timer(0.1, release.set)
        thread = threading.Thread(target=press)
        timer.start()
        thread.start()
        with pytest.raises(KeyboardInterrupt):
            next(items)
        thread.join()
        timer.join()
        with pytest.raises(StopIteration):
            next(items)
    finally:
        signal.signal(signal.SIGINT, before)


def test_stages_end_together():
    source = Source()

    def stage(items):
        for item in items:
            yield 2 * item

    items = prefetch(stage(prefetch(stage(prefetch(source)))))
    assert [next(items) for _ in range(5)] == [0, 4, 8, 12, 16]
    items.close()
    assert source.closed == 1


def test_errors_pass_through_stages():
    def stage(items):
        for item in items:
            yield item + 1

    seen = []
    with pytest.raises(ValueError, match="on purpose"):
        for item in prefetch(stage(prefetch(Source(fails=3)))):
            seen.append(item)
    assert seen == [1, 2, 3]


def test_a_generator_is_closed_in_its_thread():
    ended = []

    def count():
        try:
            yield from range(10**9)
        finally:
            ended.append(threading.current_thread().name)

    items = prefetch(count(), 2)
    next(items)
    items.close()
    assert ended == ["torchpose-prefetch"]


def test_never_started_never_touched():
    source = Source()
    items = prefetch(source)
    items.close()
    assert (source.made, source.closed) == (0, 0)


@pytest.mark.parametrize("size", [0, -1])
def test_size_must_be_positive(size):
    with pytest.raises(InputError, match="size must be at least 1"):
        prefetch([], size)


@pytest.mark.parametrize("size", [1, 4])
def test_memory_is_constant(size):
    """Of many frames no more than `size`, and the consumer's own, are alive at any time."""
    alive = weakref.WeakSet()
    most = 0

    class Frame:
        def __init__(self):
            self.image = np.zeros((48, 64, 3), np.uint8)
            alive.add(self)

    def frames():
        for _ in range(2000):
            yield Frame()

    for _ in prefetch((frame for frame in frames()), size):
        most = max(most, len(alive))
    # the generators above hold the frame that they gave last
    assert most <= size + 2


def test_a_video_ahead_of_its_reader(tmp_path):
    source = open_video(make_video(tmp_path / "a.mp4", 20))
    indices = [frame.index for frame in prefetch(source)]
    assert indices == list(range(20))
    with pytest.raises(InputError, match="closed"):
        next(source)
    again = source.reopen()
    for _ in prefetch(again, 2):
        break
    with pytest.raises(InputError, match="closed"):
        next(again)


def test_a_looped_file_stays_small(tmp_path):
    """Frames of a file that is read again and again: as many alive as are ahead, and no more."""
    path = make_video(tmp_path / "a.mp4", 100)
    alive, most, count = [0], 0, 0

    def died():
        alive[0] -= 1

    def loop():
        for _ in range(5):
            with open_video(path) as source:
                for frame in source:
                    alive[0] += 1
                    weakref.finalize(frame.image, died)
                    yield frame

    for _ in prefetch(loop(), 4):
        most, count = max(most, alive[0]), count + 1
    assert count == 500
    assert most <= 6
