"""Describe errors of the parser of a command in one sentence that names the key and the file."""

import itertools
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path

__all__ = ["configuration_files", "describe_argument_error"]

_UNKNOWN = (
    r"Option '(?P<key>[^']+)' is not accepted",
    r"Group '(?P<group>[^']+)' does not accept option '(?P<key>[^']+)'",
    r"Subcommand '\w+' does not accept option '(?P<key>[^']+)'",
    r"unrecognized arguments: --(?P<key>[\w.]+)",
)
_REQUIRED = r"arguments are required: ([\w., ]+)"
_CLASS = r"Problem with given class_path '[^']+':\s*"
_KEY = r'Parser key "([\w.]+)":\s*'


def describe_argument_error(text: str, arguments: Sequence[str], command: str) -> str:
    """Return what is wrong with arguments or a configuration, in one sentence.

    Args:
        text: what the parser says. arguments: of the command. command: its name.
    """
    key, text = _innermost(text)
    for pattern in _UNKNOWN:
        found = re.search(pattern, text)
        if found:
            parts = (key, found.groupdict().get("group"), found["key"])
            name = ".".join(part for part in parts if part)
            return (
                f"{_place(name.rpartition('.')[2], arguments)}there is no key {name}; "
                f"`python -m train {command} --print_config` shows all"
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
    return (
        f"{', '.join(map(str, configuration_files(arguments)))}: {text}"
        if "config" in text
        else text
    )


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
            given = None if "Got value" in text else re.search(r"Given value: (.+)", listed[1])
            text += f", got {given[1]}" if given else ""
        elif of_class:
            text = text[of_class.end() :]
        else:
            return ".".join(keys), text


def _place(key: str, arguments: Sequence[str]) -> str:
    """Return the configuration file that has this key in it, if it is not on the command line."""
    if any(argument.startswith("--") and key in argument.split("=")[0] for argument in arguments):
        return ""
    for file in configuration_files(arguments):
        text = file.read_text() if file.is_file() else ""
        if re.search(rf"(?m)^[\s-]*{re.escape(key)}\s*:", text):
            return f"{file}: "
    return ""


def configuration_files(arguments: Sequence[str]) -> list[Path]:
    """Return the configuration files."""
    words = [word for argument in arguments for word in argument.split("=", 1)]
    pairs = itertools.pairwise(words)
    return [Path(file) for name, file in pairs if name in ("--config", "-c")]
