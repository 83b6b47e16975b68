"""Print errors on one line, progress bars only to a terminal, and commands without some options."""

import re
import sys
from collections.abc import Sequence

from torchpose.errors import printable

_POSITIONALS = {"input": "INPUT", "recordings": "DIR"}


def one_line(error: BaseException) -> str:
    """Return the text of an error on one line, with options named as they are typed."""
    text = " ".join(str(error).split())
    text = re.sub(r'^Parser key "(\w+)":', lambda m: f"argument --{m[1].replace('_', '-')}:", text)
    text = re.sub(r"<class '(\w+)'>", r"\1", text)
    missing = re.search(r'arguments are required: (.*)|Key "(\w+)" is required', text)
    if missing:
        names = (missing[1] or missing[2]).split(", ")
        options = (_POSITIONALS.get(name, f"--{name}") for name in names)
        text = f"missing: {', '.join(options)}; see --help for examples"
    return printable(text)


def show_progress() -> bool:
    """Return whether progress bars are shown: standard error is a terminal."""
    return sys.stderr.isatty()


def without_options(arguments: Sequence[str], options: tuple[str, ...]) -> list[str]:
    """Return arguments of a command without the options that begin with some words, and their values.

    >>> without_options(["--out", "b", "a/", "--seed", "1", "--pictures=false"], ("--out", "--pictures"))
    ['a/', '--seed', '1']
    """
    before = ["", *arguments]
    return [
        argument
        for last, argument in zip(before, arguments, strict=False)
        if not argument.startswith(options)
        and (argument.startswith("--") or not last.startswith(options) or "=" in last)
    ]
