"""Print errors on one line, and progress bars only to a terminal."""

import re
import sys

from torchpose.errors import InputError, printable

__all__ = ["check_positive", "one_line", "show_progress"]

_POSITIONALS = {"input": "INPUT", "recordings": "DIR"}


def check_positive(option: str, value: float | None) -> None:
    """Raise `InputError` unless the value of an option is None or above zero."""
    if value is not None and not 0 < value < float("inf"):
        raise InputError(f"{option} must be positive, got {value:g}")


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
    """Return whether bars go to somebody who looks at them."""
    return sys.stderr.isatty()
