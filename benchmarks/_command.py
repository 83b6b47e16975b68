"""Run a function as `python -m benchmarks.NAME`, with options read from its signature and its docstring."""

import inspect
import sys
import types
import typing
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, NoReturn, Union

from torchpose.cli import guarded
from torchpose.cli._command import add_options, new_parser
from torchpose.cli._options import Option, options_of
from torchpose.errors import InputError


class OneOf:
    """Check that an option, or each word of a list, is one of some words.

    It annotates a parameter: ``only: Annotated[Sequence[str], OneOf(ROWS)]``.

    Args:
        words: which are allowed.
    """

    def __init__(self, words: Iterable[str]) -> None:
        self.words = tuple(words)

    def __call__(self, value: Any) -> Any:
        """Return the value.

        Raises:
            InputError: another word.
        """
        for word in value if isinstance(value, list) else [value]:
            if word not in self.words:
                raise InputError(f"expected one of {', '.join(self.words)}, got {word!r}")
        return value


class _Parameter(NamedTuple):
    """A parameter of a function: one option, or settings of which every field is an option."""

    name: str
    settings: type | None
    options: tuple[Option, ...]
    kinds: dict[str, Any]

    def value(self, given: dict[str, Any]) -> Any:
        """Return the value from those of all options, by key."""
        read = {o.name: _read(o.flag, given[o.key], self.kinds[o.name]) for o in self.options}
        return read[self.name] if self.settings is None else self.settings(**read)


def run_command(function: Callable[..., None]) -> NoReturn:
    """Run a function with the options of the command line, and exit."""
    sys.exit(execute(function, sys.argv[1:]))


def execute(function: Callable[..., None], arguments: Sequence[str]) -> int:
    """Run a function with the options of a command line, and return the exit code.

    Each parameter is an option, documented by the docstring. A parameter whose type is a NamedTuple stands
    for the options that are its fields. A switch may be given without a value. The value of a type
    ``Annotated[..., check]`` is what `check` returns of it.

    Args:
        function: with annotations. If it exits with a text, the text is printed and the exit code is 1.
        arguments: what stands after the program; if they are refused, the exit code is 2.
    """

    def command(arguments: list[str]) -> int:
        parameters = _parameters(function)
        options = [option for parameter in parameters for option in parameter.options]
        parser = _new_parser(function, parameters)
        given = vars(parser.parse_args(spell_out_switches(arguments, options)))
        return _exit_code(
            lambda: function(**{parameter.name: parameter.value(given) for parameter in parameters})
        )

    return guarded(command, list(arguments))


def spell_out_switches(arguments: Sequence[str], options: Iterable[Option]) -> list[str]:
    """Return arguments in which every switch has a value: `--quick` becomes `--quick true`."""
    switches = {option.flag for option in options if option.kind is bool}
    found: list[str] = []
    for argument, following in zip(arguments, [*arguments[1:], ""], strict=False):
        found.append(argument)
        if argument in switches and following not in ("true", "false"):
            found.append("true")
    return found


def _parameters(function: Callable[..., None]) -> list[_Parameter]:
    """Return the parameters of a function with their options."""
    kinds = typing.get_type_hints(function, include_extras=True)
    own = {option.name: option for option in options_of(function, spaced=_lists(function))}
    found = []
    for name, parameter in inspect.signature(function).parameters.items():
        settings = kinds[name]
        if not hasattr(settings, "_fields"):
            found.append(_Parameter(name, None, (own[name],), kinds))
            continue
        options = options_of(settings, spaced=_lists(settings))
        if parameter.default is not parameter.empty:
            options = tuple(o._replace(default=getattr(parameter.default, o.name)) for o in options)
        fields = typing.get_type_hints(settings, include_extras=True)
        found.append(_Parameter(name, settings, options, fields))
    return found


def _new_parser(function: Callable[..., None], parameters: Iterable[_Parameter]) -> Any:
    """Return the parser, whose help has the first line and the examples of the function's module."""
    module = sys.modules[function.__module__]
    text = (inspect.getdoc(module) or "").splitlines()
    examples = "\n".join(line.strip() for line in text if line.strip().startswith("python -m"))
    name = module.__spec__.name if module.__spec__ else module.__name__
    parser = new_parser(name.removesuffix(".__main__"), text[0], examples, "python -m")
    for parameter in parameters:
        words = {o.key: "|".join(_words(parameter.kinds[o.name])) for o in parameter.options}
        words |= {o.key: "[true|false]" for o in parameter.options if o.kind is bool}
        metavars = {key: word for key, word in words.items() if word}
        add_options(parser, parameter.options, metavars=metavars)
    return parser


def _lists(source: Callable[..., Any]) -> list[str]:
    """Return the names of the parameters, or fields, that are lists."""
    lists = {list, typing.get_origin(Sequence[str])}
    return [
        name
        for name, kind in typing.get_type_hints(source).items()
        if lists & {typing.get_origin(part) for part in (kind, *typing.get_args(kind))}
    ]


def _words(kind: Any) -> list[str]:
    """Return the words that `OneOf` allows in a type."""
    own = [
        word for c in getattr(kind, "__metadata__", ()) if isinstance(c, OneOf) for word in c.words
    ]
    return own + [word for part in typing.get_args(kind) for word in _words(part)]


def _read(flag: str, value: Any, kind: Any) -> Any:
    """Return the value of an option as its type demands."""
    if value is None:
        return None
    if typing.get_origin(kind) is Annotated:
        value = _read(flag, value, kind.__origin__)
        try:
            for check in kind.__metadata__:
                value = check(value)
        except InputError as error:
            raise InputError(f"{flag}: {error}") from error
        return value
    if typing.get_origin(kind) in (Union, types.UnionType):
        return _read(flag, value, next(k for k in typing.get_args(kind) if k is not type(None)))
    return Path(value) if kind is Path else value


def _exit_code(call: Callable[[], None]) -> int:
    """Call a function, and return 1 if it exits with a text, which is printed, else 0."""
    try:
        call()
    except SystemExit as stop:
        if not isinstance(stop.code, str):
            raise
        print(stop.code, file=sys.stderr)
        return 1
    return 0
