"""Describe errors in what the user gave in one sentence that names the key and the file."""

import errno
import itertools
import re
import textwrap
import traceback
from argparse import ArgumentError
from collections.abc import Sequence
from pathlib import Path

import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException

from torchpose._core.terminal import one_line
from torchpose.errors import TorchposeError

__all__ = ["is_full", "reason"]

_UNKNOWN = (
    r"Option '(?P<key>[^']+)' is not accepted",
    r"Group '(?P<group>[^']+)' does not accept option '(?P<key>[^']+)'",
    r"Subcommand '\w+' does not accept option '(?P<key>[^']+)'",
    r"unrecognized arguments: --(?P<key>[\w.]+)",
)
_REQUIRED = r"arguments are required: ([\w., ]+)"
_CLASS = r"Problem with given class_path '[^']+':\s*"
_KEY = r'Parser key "([\w.]+)":\s*'
_SETTINGS = "accelerator_connector"  # where Lightning looks at devices and strategies
_SEED = "seed.py"  # where it looks at seeds
_FULL = (errno.EDQUOT, errno.EFBIG, errno.ENOSPC)
_REFUSED = (*_FULL, errno.EACCES, errno.EIO, errno.EPERM, errno.EROFS)  # by the system


def reason(error: BaseException, arguments: Sequence[str]) -> str | None:
    """Return what was wrong, in one sentence, or None if it was nothing that the user gave.

    Args:
        error: that was raised. arguments: of the command.
    """
    if isinstance(error, TorchposeError | MisconfigurationException):
        return one_line(error)
    if isinstance(error, ArgumentError) or "Does not validate against" in str(error):
        return _of_arguments(str(error), arguments)
    frames = traceback.extract_tb(error.__traceback__)
    if isinstance(error, ValueError) and frames and _SETTINGS in frames[-1].filename:
        return one_line(error)
    if isinstance(error, ValueError) and frames and frames[-1].filename.endswith(_SEED):
        return f"seed_everything: {one_line(error)}"
    if isinstance(error, UnicodeDecodeError) and _files(arguments):
        return f"{', '.join(map(str, _files(arguments)))}: expected UTF-8, got bytes that are none"
    if isinstance(error, OSError) and error.errno in _REFUSED:
        return f"{error.filename or 'logs'}: cannot be read or written ({error.strerror})"
    if isinstance(error, torch.distributed.DistError) or "gloo" in str(error):
        return "another process has gone, see its messages; go on with --ckpt_path last"
    return None


def is_full(error: BaseException) -> bool:
    """Return whether an error comes from a disk that is full."""
    cause = error if type(error) is OSError else error.__cause__
    return isinstance(cause, OSError) and cause.errno in _FULL


def _of_arguments(text: str, arguments: Sequence[str]) -> str:
    key, text = _innermost(text)
    for pattern in _UNKNOWN:
        found = re.search(pattern, text)
        if found:
            parts = (key, found.groupdict().get("group"), found["key"])
            name = ".".join(part for part in parts if part)
            return (
                f"{_place(name.rpartition('.')[2], arguments)}there is no key {name}; "
                "`python -m train fit --print_config` shows all"
            )
    found = re.search(_REQUIRED, text)
    if found:
        names = (
            name.strip().removeprefix("fit.").removeprefix("select.")
            for name in found[1].split(",")
        )
        return f"missing: {', '.join('.'.join(filter(None, (key, name))) for name in names)}"
    text = re.sub(r"<class '(\w+)'>", r"\1", " ".join(text.split()))
    if key and key != "config":
        return f"{_place(key.rpartition('.')[2], arguments)}{key}: {text}"
    return f"{', '.join(map(str, _files(arguments)))}: {text}" if "config" in text else text


def _innermost(text: str) -> tuple[str, str]:
    """Return the key that an error of the parser is about, and what is wrong with it."""
    keys = []
    while True:
        text = textwrap.dedent(text).strip()
        named = re.match(_KEY, text)
        listed = re.match(r"Does not validate against.*?Errors:\n(.*)", text, re.DOTALL)
        of_class = re.match(_CLASS, text)
        if named:
            keys.append(named[1])
            text = text[named.end() :]
        elif listed:
            first = re.split(r"\n\s*- ", textwrap.dedent(listed[1]).strip().removeprefix("- "))[0]
            text = first.partition("\nGiven value")[0]
        elif of_class:
            text = text[of_class.end() :]
        else:
            return ".".join(keys), text


def _place(key: str, arguments: Sequence[str]) -> str:
    """Return the configuration file that has this key in it, if it is not on the command line."""
    if any(argument.startswith("--") and key in argument.split("=")[0] for argument in arguments):
        return ""
    for file in _files(arguments):
        text = file.read_text() if file.is_file() else ""
        if re.search(rf"(?m)^[\s-]*{re.escape(key)}\s*:", text):
            return f"{file}: "
    return ""


def _files(arguments: Sequence[str]) -> list[Path]:
    """Return the configuration files."""
    words = [word for argument in arguments for word in argument.split("=", 1)]
    pairs = itertools.pairwise(words)
    return [Path(file) for name, file in pairs if name in ("--config", "-c")]
