"""Run functions as commands: their parser, --config, and what was given, for results that name it."""

import inspect
import shlex
import textwrap
import typing
from argparse import ArgumentError, RawDescriptionHelpFormatter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jsonargparse import ActionConfigFile, ArgumentParser

from torchpose.cli._options import REQUIRED, Option, options_of, summary_of
from torchpose.errors import InputError

_METAVARS = {
    "action": "NAME|FILE", "actions": "ACTION", "arms": "FILE", "body": "FILE",
    "bone_lengths": "NAME=M,...", "camera": "FILE|fx,fy,cx,cy", "camera_height": "M", "camera_name": "NAME",
    "camera_names": "NAME,...", "components": "K", "conditionals": "NAME|FILE",
    "delays": "[n,n,...]", "face_model": "FILE",
    "facing": "[x,y,z]", "fps": "HZ", "height": "M", "held_out": "PERSON",
    "initial_pose": "FILE", "licence": "TEXT", "lifter": "FILE", "manifold": "NAME|FILE", "max_gap": "S",
    "measurement_std": "PX", "motion": "NAME|FILE", "neck": "KIND", "noise_of": "PRIOR",
    "out": "DIR", "person": "FILE", "persons": "PERSON", "prior": "NAME|FILE",
    "recordings": "DIR", "roll": "DEGREES", "seconds": "S", "smoothing": "N|full", "tilt": "DEGREES",
    "videos": "VIDEO",
    "what": "PRIOR|FILE", "window_components": "K", "without": "PERSON", "without_files": "NAME",
}  # fmt: skip
_NO_PART = ("out", "config", "pictures")  # options that are no part of what is made
_SHOWN_PATHS = 8
_SEED_DIGITS = 18  # so that it stays one of 64 bits when a little is added

_COMMON = """\
exit codes: 0 done; 1 done, but the result is not good; 2 refused, with one line on stderr
--debug shows the traceback of an error"""


class Given(NamedTuple):
    """Holds the arguments that were given to a command.

    Attributes:
        words: after the program, such as ("fit", "limbs"). values: of all options by key.
        defaults: the defaults of the options. typed: what stood after `words`.
    """

    words: tuple[str, ...]
    values: dict[str, Any]
    defaults: dict[str, Any]
    typed: tuple[str, ...] = ()

    def files(self, output: str = "out") -> list[Path]:
        """Return the files that options name, that of the output apart."""
        given = [value for key, value in self.values.items() if key != output]
        words = [w for value in given for w in (value if isinstance(value, list) else [value])]
        return [Path(word) for word in words if isinstance(word, str) and _is_file(word)]

    def refuse(self, keys: Iterable[str], why: str) -> None:
        """Raise `InputError` for the first of some options that is given.

        Args:
            keys: of the options. why: what they are for, and what is there in its place.
        """
        for key in keys:
            if self.values[key] != self.defaults[key]:
                raise InputError(f"--{key.replace('_', '-')} is for {why}; leave it out")

    def line(self, out: str | Path) -> str:
        """Return a command over recordings with every option that differs from its default.

        Args:
            out: the output as it is to be said.
        """
        paths = list(self.values["recordings"])
        if len(paths) > _SHOWN_PATHS:
            paths = [*paths[:1], f"...{len(paths) - 1} more"]
        parts = ["torchpose", *self.words, *paths, "--out", str(out)]
        for key, value in self.values.items():
            if key in ("recordings", *_NO_PART) or value == self.defaults.get(key):
                continue
            values = value if isinstance(value, list) else [value]
            shown = [str(one).lower() if isinstance(one, bool) else str(one) for one in values]
            parts += [f"--{key.replace('_', '-')}", *shown]
        return shlex.join(parts)


class Command(NamedTuple):
    """Wraps a function as a command, whose options are the function's parameters.

    Parameters before `*` are given by their place.
    A parameter named in `groups` is no option itself: the function gets a dictionary with the values of the
    options of that group, by the names of the parameters that they are read from. A parameter `given`
    gets the `Given` command. The help begins with the docstring.

    Attributes:
        name: what is typed after `torchpose`. run: does the work, and returns the exit code.
        examples: command lines, one each line. groups: options of settings, recipes and trackers; an
            option that two groups have is one option, as the first of them documents it.
        parse: from what was typed to the value, by key, where the type does not tell.
        spaced: parameters of `run` that are lists of words separated by blanks.
        metavars: what stands for values in the help, by key, where the name and the type do not tell.
    """

    name: str
    run: Callable[..., int]
    examples: str
    groups: Mapping[str, Sequence[Option]] = {}
    parse: Mapping[str, Callable[[Any], Any]] = {}
    spaced: Sequence[str] = ()
    metavars: Mapping[str, str] = {}

    @property
    def own(self) -> tuple[Option, ...]:
        """Return the options that are parameters of the function."""
        leave_out = (*self.groups, "given")
        return options_of(self.run, leave_out, spaced=self.spaced, positional=True)

    @property
    def options(self) -> tuple[Option, ...]:
        """Return all options; those of a group stand where the function has its parameter."""
        own = {option.name: (option,) for option in self.own}
        found: dict[str, Option] = {}
        for name in inspect.signature(self.run).parameters:
            for option in self.groups.get(name, own.get(name, ())):
                found.setdefault(option.key, option)
        return tuple(found.values())

    def parser(self) -> ArgumentParser:
        """Return the parser."""
        parser = new_parser(self.name, summary_of(self.run), self.examples)
        add_options(parser, self.options, self.parse, {**_METAVARS, **self.metavars})
        return parser

    def given(self, arguments: Sequence[str]) -> Given:
        """Parse command-line arguments.

        Raises:
            ArgumentError: arguments that it does not take.
        """
        parser = self.parser()
        by_place = sum(option.positional for option in self.own)
        values = vars(parser.parse_args(with_lists(arguments, self.options, by_place)))
        for option in self.own:  # what may be left out is not read from a configuration by itself
            if option.positional and values[option.key] is None and values["config"]:
                values[option.key] = parser.parse_path(values["config"][-1])[option.key]
        words = tuple(self.name.split())
        return Given(words, values, vars(parser.get_defaults()), tuple(arguments))

    def main(self, arguments: Sequence[str]) -> int:
        """Run the command and return its exit code."""
        return self.call(self.given(arguments))

    def call(self, given: Given) -> int:
        """Call the function with the given options, and return the exit code."""
        values: dict[str, Any] = {option.name: given.values[option.key] for option in self.own}
        for parameter, group in self.groups.items():
            values[parameter] = {option.name: given.values[option.key] for option in group}
        if "given" in self.run.__annotations__:
            values["given"] = given
        return self.run(**values)


def with_lists(
    arguments: Sequence[str], options: Iterable[Option], by_place: int, alone: bool = False
) -> list[str]:
    """Return arguments in which lists that are separated by commas or blanks are one word, as [a,b].

    Blanks separate a list only where everything that is given by its place stands before all options, or
    in the file of --config: another word behind an option can then be nothing else.

    Args:
        arguments: of a command. options: of it. by_place: how many words are given by their place, at least.
        alone: make a list of a single word, too, where no option takes one item by itself.
    """
    lists = {option.flag for option in options if option.is_list and not option.spaced}
    leading = next((i for i, word in enumerate(arguments) if word.startswith("--")), 0)
    placed = leading >= by_place or (leading == 0 and "--config" in arguments)
    words: list[str] = []
    rest = list(arguments)
    while rest:
        words.append(rest.pop(0))
        if words[-1] not in lists or not rest or rest[0].startswith("--"):
            continue
        items = [rest.pop(0)]
        while placed and rest and not rest[0].startswith("--"):
            items.append(rest.pop(0))
        one = len(items) == 1 and ("[" in items[0] or not (alone or "," in items[0]))
        words.append(items[0] if one else f"[{','.join(i.strip('[], ') for i in items)}]")
    return words


def new_parser(
    command: str, description: str, examples: str, program: str = "torchpose"
) -> ArgumentParser:
    """Return the parser of a command, with --config.

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
        action=_ConfigFile,
        metavar="FILE",
        help="options as YAML, as --print_config writes them; what follows it on the line wins",
    )
    return parser


class _ConfigFile(ActionConfigFile):
    """Reads --config; bytes that are no text are an error of the argument."""

    def __call__(self, parser: Any, namespace: Any, values: Any, *others: Any) -> None:
        try:
            super().__call__(parser, namespace, values, *others)
        except UnicodeDecodeError as error:
            raise ArgumentError(
                None,
                f"--config {values}: expected text in UTF-8, got bytes that are none ({error.reason})",
            ) from error


def add_options(
    parser: ArgumentParser,
    options: Iterable[Option],
    parse: Mapping[str, Callable[[Any], Any]] = {},
    metavars: Mapping[str, str] = {},
) -> None:
    """Add options to a parser.

    Args:
        parser: of a command. options: in the order of the help.
        parse: from what was typed to the value, by key, where the type does not tell; a seed is
            always read by `parse_seed`.
        metavars: what stands for values in the help, by key, in place of `Option.metavar`.
    """
    parse = {"seed": parse_seed, **parse}
    for option in options:
        kind = parse.get(option.key) or (_one_of(option) if option.choices else option.kind)
        _add(parser, option, kind, metavars.get(option.key, option.metavar))


def _add(parser: ArgumentParser, option: Option, kind: Any, metavar: str) -> None:
    settings: dict[str, Any] = {"type": kind, "metavar": metavar, "help": option.help}
    required = option.default is REQUIRED
    if option.spaced:
        settings |= {"type": _item(option.kind), "nargs": "+"}
    if option.positional:
        settings |= {} if required or option.spaced else {"nargs": "?"}
        parser.add_argument(option.key, **settings)
        return
    default = list(option.default) if isinstance(option.default, tuple) else option.default
    settings |= {"required": True} if required else {"default": default}
    action = parser.add_argument(option.flag, **settings)
    action.option_strings = [option.flag]  # of lists also with a +, which the help need not show


def _item(kind: Any) -> Any:
    """Return the type of the items of a list."""
    parts = [part for part in typing.get_args(kind) if part is not type(None)]
    nested = [part for part in parts if typing.get_args(part)]
    return _item(nested[0]) if nested else parts[0]


def _one_of(option: Option) -> Callable[[Any], Any]:
    """Return a parser that accepts only the choices of an option."""

    def check(value: Any) -> Any:
        if value not in option.choices:
            known = ", ".join(option.choices)
            raise ArgumentError(None, f"{option.flag} must be one of {known}, got {value!r}")
        return value

    return check


def parse_seed(value: Any) -> int:
    """Return a seed, a whole number that generators take.

    Raises:
        ArgumentError: anything else.
    """
    text = str(value)
    if not (text.isascii() and text.isdigit() and len(text) <= _SEED_DIGITS):
        raise ArgumentError(
            None,
            f"--seed must be a whole number of at most {_SEED_DIGITS} digits, got {text!r:.60}",
        )
    return int(text)


def _is_file(word: str) -> bool:
    try:
        return Path(word).is_file()
    except (OSError, ValueError):  # too long, or with a zero byte
        return False
