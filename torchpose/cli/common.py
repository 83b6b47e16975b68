"""What the commands share: parsers, error text, checks, pictures."""

import os
import re
import signal
import sys
import textwrap
from argparse import ArgumentError, RawDescriptionHelpFormatter
from collections.abc import Callable, Iterable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

from jsonargparse import ActionConfigFile, ArgumentParser, Namespace

from torchpose.errors import InputError, printable

__all__ = [
    "UntilInterrupted",
    "add_seed",
    "input_files",
    "new_parser",
    "one_line",
    "pictures_possible",
    "positive",
    "save_pictures",
    "share_cores",
    "show_progress",
]

T = TypeVar("T")
_SEED_DIGITS = 18  # so that it stays one of 64 bits when a little is added

_COMMON = """\
exit codes: 0 done; 1 done, but the result is not good; 2 refused, with one line on stderr
--debug shows the traceback of an error"""

_POSITIONALS = {"input": "INPUT", "recordings": "DIR"}


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


def positive(name: str, value: float | None) -> None:
    """Raise `InputError` unless None or above zero."""
    if value is not None and not 0 < value < float("inf"):
        raise InputError(f"{name} must be positive, got {value:g}")


def one_line(error: BaseException) -> str:
    """Text of an error on one line, with options named as they are typed."""
    text = " ".join(str(error).split())
    text = re.sub(r'^Parser key "(\w+)":', lambda m: f"argument --{m[1].replace('_', '-')}:", text)
    text = re.sub(r"<class '(\w+)'>", r"\1", text)
    missing = re.search(r'arguments are required: (.*)|Key "(\w+)" is required', text)
    if missing:
        names = (missing[1] or missing[2]).split(", ")
        options = (_POSITIONALS.get(name, f"--{name}") for name in names)
        text = f"missing: {', '.join(options)}; see --help for examples"
    return printable(text)


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


def show_progress() -> bool:
    """Whether bars go to somebody who looks at them."""
    return sys.stderr.isatty()


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
    from torchpose.viz.style import save_figure

    return [save_figure(draw(), folder / name) for name, draw in pictures.items()]
