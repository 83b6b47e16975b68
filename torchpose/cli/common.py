"""What the commands share: parsers, input files, interruption, pictures."""

import os
import shlex
import signal
import textwrap
from argparse import ArgumentError, RawDescriptionHelpFormatter
from collections.abc import Callable, Iterable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

from jsonargparse import ActionConfigFile, ArgumentParser, Namespace

__all__ = [
    "UntilInterrupted",
    "add_seed",
    "command_line",
    "input_files",
    "new_parser",
    "pictures_possible",
    "save_pictures",
    "share_cores",
]

T = TypeVar("T")
_HOW = ("out", "config", "pictures")  # no part of what is made
_SHOWN_PATHS = 8
_SEED_DIGITS = 18  # so that it stays one of 64 bits when a little is added

_COMMON = """\
exit codes: 0 done; 1 done, but the result is not good; 2 refused, with one line on stderr
--debug shows the traceback of an error"""


def new_parser(
    command: str, description: str, examples: str, program: str = "torchpose"
) -> ArgumentParser:
    """Parser of a command, with --config.

    Args:
        command: name after the program. description: first paragraph of the help.
        examples: command lines, one each line, without indentation. program: what is typed first.
    """
    listed = "\n".join(f"  {line}" for line in examples.strip().splitlines())
    parser = ArgumentParser(
        prog=f"{program} {command}".strip(),
        description=textwrap.fill(description, 79),
        epilog=f"examples:\n{listed}\n\n{_COMMON}",
        formatter_class=RawDescriptionHelpFormatter,
        exit_on_error=False,
        allow_abbrev=False,
    )
    parser.add_argument(
        "--config",
        action=ActionConfigFile,
        metavar="FILE",
        help="options as YAML, as --print_config writes them; what follows it on the line wins",
    )
    return parser


def add_seed(parser: ArgumentParser, of: str) -> None:
    """Add --seed; `of` says what it is the seed of."""
    parser.add_argument(
        "--seed", type=_seed, default=0, metavar="N", help=f"seed of {of} (default 0)"
    )


def command_line(
    words: Sequence[str], args: Namespace, defaults: Namespace, out: str | Path
) -> str:
    """Return a command over recordings with every option that differs from its default.

    Args:
        words: after `torchpose`. args, defaults: values of the options, and those by default.
        out: the output as it is to be said.
    """
    paths = list(args.recordings)
    if len(paths) > _SHOWN_PATHS:
        paths = [*paths[:1], f"...{len(paths) - 1} more"]
    parts = ["torchpose", *words, *paths, "--out", str(out)]
    for key, value in vars(args).items():
        if key in ("recordings", *_HOW) or value == defaults.get(key):
            continue
        values = value if isinstance(value, list) else [value]
        shown = [str(one).lower() if isinstance(one, bool) else str(one) for one in values]
        parts += [f"--{key.replace('_', '-')}", *shown]
    return shlex.join(parts)


def input_files(args: Namespace, output: str = "out") -> list[Path]:
    """Files that the options name, that of the output apart."""
    given = [value for key, value in vars(args).items() if key != output]
    words = [word for value in given for word in (value if isinstance(value, list) else [value])]
    return [Path(word) for word in words if isinstance(word, str) and _is_file(word)]


def _is_file(word: str) -> bool:
    try:
        return Path(word).is_file()
    except (OSError, ValueError):  # too long, or with a zero byte
        return False


def _seed(value: Any) -> int:
    """A whole number that generators take."""
    text = str(value)
    if not (text.isascii() and text.isdigit() and len(text) <= _SEED_DIGITS):
        raise ArgumentError(
            None,
            f"--seed must be a whole number of at most {_SEED_DIGITS} digits, got {text!r:.60}",
        )
    return int(text)


class UntilInterrupted(Generic[T]):
    """Items of an iterable until Ctrl-C, or until `stop` says so; a second Ctrl-C is a real one.

    A context manager, to be used in the main thread; the items may be taken in another.

    Attributes:
        count: items so far. interrupted: whether they ended early.
    """

    def __init__(self, items: Iterable[T], stop: Callable[[], bool] = lambda: False) -> None:
        self._items, self._stop = items, stop
        self.count, self.interrupted = 0, False

    def __enter__(self) -> Self:
        self._before = signal.signal(signal.SIGINT, self._interrupt)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._before)

    def __iter__(self) -> Iterator[T]:
        for item in self._items:
            if self.interrupted or self._stop():
                self.interrupted = True
                return
            self.count += 1
            yield item

    def _interrupt(self, *_: object) -> None:
        if self.interrupted:
            raise KeyboardInterrupt
        self.interrupted = True


def share_cores() -> None:
    """Threads for video: the tensors are small, and stages run side by side.

    More threads inside a stage cost more than they bring where there is no core left for them.
    """
    import cv2
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(max(1, (os.cpu_count() or 1) - 1))


def pictures_possible(wanted: bool) -> bool:
    """Whether pictures are wanted and can be drawn; says how to get them if they cannot."""
    if wanted and find_spec("matplotlib") is None:
        print(
            "no pictures: matplotlib is not installed; `python -m pip install matplotlib` brings it"
        )
        return False
    return wanted


def save_pictures(folder: Path, pictures: dict[str, Callable[[], Any]]) -> list[Path]:
    """Draw and write pictures by file name; returns their paths."""
    from torchpose.viz._style import save_figure

    return [save_figure(draw(), folder / name) for name, draw in pictures.items()]
