"""Claim recordings for one process by locks that vanish with the process that holds them.

A claim is a lock (`flock`) on a small file, which the system releases when the process ends, however it
ends. So claims need no expiry and no common clock. Events of a recording are appended to the same file, a
line of JSON each.
"""

import contextlib
import hashlib
import json
import os
import socket
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

from torchpose._core.files import as_output_error
from torchpose.errors import InputError, OutputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

__all__ = ["Claim", "Claims", "Event", "Run"]

Event = dict[str, Any]
"""What happened to a recording: `event` ("started", "stopped", "finished", "failed"), by whom, and facts."""


class Claim(NamedTuple):
    """The right to work on a recording, and its earlier events."""

    stream: IO[bytes]
    history: list[Event]

    @property
    def deaths(self) -> int:
        """Count how many processes in a row have started to work on it and did not finish."""
        events = [event["event"] for event in reversed(self.history)]
        return next((i for i, event in enumerate(events) if event != "started"), len(events))

    def record(self, event: str, **facts: Any) -> None:
        """Append an event; it is on the disk when this returns."""
        line = {"event": event, "host": socket.gethostname(), "pid": os.getpid()} | facts
        self.stream.seek(0, os.SEEK_END)
        self.stream.write(b"\n" + json.dumps(line, sort_keys=True).encode() + b"\n")
        self.stream.flush()
        os.fsync(self.stream.fileno())
        self.history.append(line)


class Run(NamedTuple):
    """The run that all processes at work in a folder belong to."""

    id: str
    task: str


class Claims:
    """The claims of the results in a folder.

    Args:
        folder: of the claims' files; made if need be.
        alone: whether there is only one process, which needs no locks where the file system has
            none.

    Raises:
        OutputError: several processes, but no locks.
    """

    def __init__(self, folder: Path, alone: bool = True) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{folder}: cannot be made ({error.strerror or error})") from error
        self._folder, self._alone = folder, alone

    def path(self, name: str) -> Path:
        """Return the file of a recording's claim."""
        return self._folder / f"{hashlib.sha256(name.encode()).hexdigest()[:20]}.jsonl"

    @contextlib.contextmanager
    def claim(self, name: str, wait: bool = False) -> Iterator[Claim | None]:
        """Hold the claim of a recording; None if another process has it and `wait` is False.

        Raises:
            OutputError: its file cannot be written.
        """
        with as_output_error(self._folder), self.path(name).open("a+b") as stream:
            if not self._lock(stream, exclusive=True, wait=wait):
                yield None
                return
            yield Claim(stream, _events(stream))

    @contextlib.contextmanager
    def run(self, task: str) -> Iterator[Run]:
        """Join the run that is going on in the folder, or begin one.

        Args:
            task: what the run does; processes of one run have to have the same.

        Raises:
            InputError: a run with another task is going on. OutputError: its file cannot be written.
        """
        with as_output_error(self._folder), (self._folder / "run.json").open("a+b") as stream:
            if self._lock(stream, exclusive=True, wait=False):
                begun = json.dumps({"run": uuid.uuid4().hex, "task": task})
                stream.truncate(0)
                stream.write(begun.encode())
                stream.flush()
            self._lock(stream, exclusive=False, wait=True)
            stream.seek(0)  # another one may have begun while the lock was made a shared one
            current = json.loads(stream.read())
            if current["task"] != task:
                raise InputError(
                    f"{self._folder.parent}: another run with other recordings or settings is writing "
                    "into this folder; wait until it ends, or choose another --out"
                )
            yield Run(current["run"], task)

    def _lock(self, stream: IO[bytes], exclusive: bool, wait: bool) -> bool:
        """Lock an open file until it is closed; return whether that succeeded."""
        if fcntl is None:
            return self._without_locks("this system has none")
        kind = fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH
        try:
            fcntl.flock(stream, kind if wait else kind | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError as error:
            return self._without_locks(error.strerror or str(error))
        return True

    def _without_locks(self, reason: str) -> bool:
        if self._alone:
            return True
        raise OutputError(
            f"{self._folder}: several processes need a folder whose files can be locked ({reason}); "
            "choose another --out, or run one process"
        )


def _events(stream: IO[bytes]) -> list[Event]:
    """Return the events in a file, without a line that a killed process did not finish."""
    stream.seek(0)
    events = []
    for line in stream.read().splitlines():
        with contextlib.suppress(ValueError):
            events.append(json.loads(line))
    return events
