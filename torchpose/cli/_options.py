"""Read options from signatures: names, types, defaults, choices, and the documentation of each.

A parameter is an option if a command line can give it: a number, a word, true or false, one of some
words, or a list of these. Tensors, models and cameras are none; where a parameter takes a model or the
name of one, the option takes the name. The help is the parameter's text in the section `Args` (or
`Attributes`) of the docstring, with the default.
"""

import inspect
import re
import types
import typing
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any, Literal, NamedTuple, Union

REQUIRED = inspect.Parameter.empty
"""The default of what has to be given."""

_SCALARS = (bool, int, float, str)


class Option(NamedTuple):
    """Describes one option of a command, or one of its positional arguments.

    Attributes:
        name: the name of the parameter that it is read from. key: its name on the command line and in
            configuration files, with underscores.
        kind: type of its value; None is a value besides where that is the default.
        default: `REQUIRED` where there is none. text: what it is for, without the default.
        positional: given by its place. spaced: a list whose words are separated by blanks.
    """

    name: str
    key: str
    kind: Any
    default: Any = None
    text: str = ""
    positional: bool = False
    spaced: bool = False

    @property
    def flag(self) -> str:
        """Return the flag on the command line, such as ``--frame-rate``."""
        return f"--{self.key.replace('_', '-')}"

    @property
    def is_list(self) -> bool:
        """Return whether the value is a list."""
        return any(_is_list(part) for part in (self.kind, *typing.get_args(self.kind)))

    @property
    def metavar(self) -> str:
        """Return the placeholder: choices, a letter for a number, a name, or a list of these."""
        words = _words(self.kind)
        if words:
            return "|".join(words)
        found = [part for part in (self.kind, *typing.get_args(self.kind)) if _is_list(part)]
        kinds = {part for kind in (self.kind, *found) for part in (kind, *typing.get_args(kind))}
        if bool in kinds:
            return "true|false"
        one = "N" if int in kinds else "X" if float in kinds else self.key.upper()
        return f"[{one},...]" if found and not self.spaced else one

    @property
    def help(self) -> str:
        """Return the text of the help, with the default where the text does not tell it."""
        text = re.sub(r" \(`[^`]*`\)", "", self.text).replace("`", "")
        told = "default" in text or self.default in (None, "", REQUIRED)
        if told or not isinstance(self.default, _SCALARS):
            return text
        shown = self.default
        shown = str(shown).lower() if isinstance(shown, bool) else shown
        shown = f"{shown:g}" if isinstance(shown, float) else shown
        return f"{text} (default {shown})"

    @property
    def choices(self) -> tuple[str, ...]:
        """Return the words that it takes, if only some."""
        return _words(self.kind)


def options_of(
    source: Callable[..., Any],
    leave_out: Collection[str] = (),
    keys: Mapping[str, str] = types.MappingProxyType({}),
    spaced: Collection[str] = (),
    refers_to: Callable[..., Any] | None = None,
    positional: bool = False,
) -> tuple[Option, ...]:
    """Return the options of a function, of a class by its constructor, or of a settings class.

    Of a class that hands further keywords to its base (`**options: Unpack[...]`) they include those
    of the base.

    Args:
        source: with annotations, and a docstring that documents its parameters.
        leave_out: parameters that are no options.
        keys: names on the command line that differ from those of the parameters.
        spaced: lists whose words are separated by blanks.
        refers_to: documents the parameters of which the docstring of `source` says "see ...".
        positional: whether parameters before `*` are given by their place.

    >>> class Recipe(NamedTuple):
    ...     '''Settings of a fit.
    ...
    ...     Attributes:
    ...         steps: of the optimiser. seed: of everything random.
    ...     '''
    ...     steps: int = 40
    ...     seed: int | None = None
    >>> [(option.flag, option.metavar, option.help) for option in options_of(Recipe)]
    [('--steps', 'N', 'of the optimiser (default 40)'), ('--seed', 'N', 'of everything random')]
    """
    found: dict[str, Option] = {}
    referred = {} if refers_to is None else documented(refers_to)
    for parameter, hint, text in _parameters(source):
        name, kind = parameter.name, _given_on_a_line(hint)
        if name in leave_out or name in found or kind is None:
            continue
        if parameter.default is not None:
            kind = kind | None if type(None) in typing.get_args(hint) else kind
        elif kind not in (int, float, str) and not _words(kind):
            kind = kind | None  # what is typed may be null
        found[name] = Option(
            name,
            keys.get(name, name),
            kind,
            parameter.default,
            referred.get(name, text) if text.startswith("see ") else text,
            positional and parameter.kind is parameter.POSITIONAL_OR_KEYWORD,
            name in spaced,
        )
    return tuple(found.values())


def options_of_methods(
    methods: Mapping[str, Iterable[Option]], leave_out: Collection[str] = ()
) -> tuple[Option, ...]:
    """Return the options of several methods, each once; one that is not given is None.

    Args:
        methods: options of each method by its name. leave_out: parameters that are no options here.
    """
    found: dict[str, Option] = {}
    having: dict[str, list[str]] = {}
    for method, options in methods.items():
        for option in options:
            if option.name not in leave_out:
                found.setdefault(option.name, option)
                having.setdefault(option.name, []).append(method)
    return tuple(
        option._replace(default=None, text=f"{', '.join(having[name])}: {option.help or 'option'}")
        for name, option in found.items()
    )


def documented(source: Callable[..., Any]) -> dict[str, str]:
    """Return the text of each parameter in a docstring; a line may hold several, and a text be of several.

    >>> def blur(width, height, image, strength=1.0):
    ...     '''Blur an image.
    ...
    ...     Args:
    ...         width, height: of the window, in
    ...             pixels. image: to be blurred.
    ...     '''
    >>> documented(blur)
    {'width': 'of the window, in pixels', 'height': 'of the window, in pixels', 'image': 'to be blurred'}
    """
    section = re.search(
        r"\n\s*(?:Args|Attributes):\n(.*?)(?:\n\s*\n|\s*$)", inspect.getdoc(source) or "", re.DOTALL
    )
    names = "|".join(inspect.signature(source).parameters)
    if not section or not names:
        return {}
    text = " ".join(section[1].split())
    name = rf"\*{{0,2}}(?:{names})"
    parts = re.split(rf"(?:^|(?<=[.;,?] ))((?:{name}, )*{name}): ", text)
    return {
        name.lstrip("*"): words.strip().rstrip(".,;")
        for several, words in zip(parts[1::2], parts[2::2], strict=True)
        for name in several.split(", ")
    }


def summary_of(source: Callable[..., Any]) -> str:
    """Return the text of a docstring before its sections, on one line."""
    text = re.split(r"\n\s*(?:Args|Attributes|Returns|Raises):\n", inspect.getdoc(source) or "")[0]
    return " ".join(text.split())


def _parameters(source: Callable[..., Any]) -> list[tuple[inspect.Parameter, Any, str]]:
    """Return parameters with their types and texts; of a class, also those handed on to its bases."""
    found = []
    for one in _handed_on(source):
        hints, texts = _types(one), documented(one)
        for parameter in inspect.signature(one).parameters.values():
            if parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
                hint = hints.get(parameter.name)
                found.append((parameter, hint, texts.get(parameter.name, "")))
    return found


def _handed_on(source: Callable[..., Any]) -> list[Callable[..., Any]]:
    """Return a callable and, while they take typed keywords beside their own, its bases."""
    if not isinstance(source, type):
        return [source]
    found: list[Callable[..., Any]] = []
    for one in source.__mro__:
        if "__init__" not in vars(one) and found:
            continue
        found.append(one)
        last = list(inspect.signature(one).parameters.values())[-1:]
        if not (last and last[0].kind is inspect.Parameter.VAR_KEYWORD):
            break
        if typing.get_origin(last[0].annotation) is not typing.Unpack:
            break
    return found


def _types(source: Callable[..., Any]) -> dict[str, Any]:
    """Return the type of each parameter; those that only type checkers see are left out."""
    settings = hasattr(source, "__dataclass_fields__") or hasattr(source, "_fields")
    of = source.__init__ if isinstance(source, type) and not settings else source  # type: ignore[misc]
    try:
        return typing.get_type_hints(of)
    except NameError:
        raw = inspect.get_annotations(of)
        return {name: hint for name, hint in raw.items() if not isinstance(hint, str)}


def _given_on_a_line(hint: Any) -> Any:
    """Return the part of a type that a command line can give, None apart; None if there is none."""
    if hint in _SCALARS or typing.get_origin(hint) is Literal:
        return hint
    if hint is Path:
        return str
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint
    parts = typing.get_args(hint)
    if typing.get_origin(hint) in (Union, types.UnionType):
        kinds = [kind for part in parts if (kind := _given_on_a_line(part)) is not None]
        return Union[tuple(kinds)] if kinds else None  # noqa: UP007  # of a list
    if _is_list(hint):
        plain = all(part is Ellipsis or _given_on_a_line(part) is not None for part in parts)
        return hint if plain else None
    return None


def _is_list(hint: Any) -> bool:
    return typing.get_origin(hint) in (list, tuple, typing.get_origin(Sequence[str]))


def _words(kind: Any) -> tuple[str, ...]:
    if typing.get_origin(kind) is Literal:
        return tuple(map(str, typing.get_args(kind)))
    if isinstance(kind, type) and issubclass(kind, Enum):
        return tuple(kind.__members__)
    return ()
