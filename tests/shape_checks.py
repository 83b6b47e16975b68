"""Check the annotated shapes, dtypes and types of every call in torchpose.

`install` is called before the package is imported. Every annotated function of it, nested ones
included, is then checked by jaxtyping and beartype once it has returned. The outcome of a check
depends on types, dtypes and shapes alone, so a function is checked once for each combination of them,
and later calls with the same combination go through.
"""

import ast
import contextlib
import dataclasses
import functools
import inspect
import sys
import types
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence, Set
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from typing import Any, TypeVar, get_args, get_origin

import numpy as np
from beartype import BeartypeConf, beartype
from beartype.roar import BeartypeDecorHintPep673Exception
from jaxtyping import AbstractArray, jaxtyped
from torch import Tensor

__all__ = ["check_after_call", "checked", "install"]

_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is a float
_NAME = "@checked"  # of the decorator in a module; no name of the module itself can be like it
_MOST_ITEMS = 32  # of a collection that is told from others by its items
_ARRAYS, _SEQUENCES = (Tensor, np.ndarray), (tuple, list)
_COLLECTIONS = (Sequence, Mapping, Set, deque)
_PLAIN: set[type] = {range, int, float, types.NoneType}  # types that are facts enough
_PLAIN_AND_WORDS: set[type] = {*_PLAIN, str}  # where no Literal tells words apart


def install(package: str) -> None:
    """Have the functions of a package checked, from its import on.

    Raises:
        RuntimeError: a module of the package was imported before.
    """
    if any(name.startswith(f"{package}.") for name in sys.modules):
        raise RuntimeError(f"{package} was imported before the shape checks were set up")
    sys.meta_path.insert(0, _Finder(package))


def check_after_call(function: Callable) -> Callable:
    """Check annotated shapes of arguments and results once the function has returned.

    jaxtyping checks twice, the arguments alone before the call and everything after it. The first
    check is left out, so that a function can refuse bad input with its own typed error; one that
    takes a wrong shape without a word still fails.
    """
    before_call = inspect.isfunction(function) and (
        inspect.signature(function).return_annotation is Any
    )
    if before_call:
        return function
    try:
        return _beartype(function)
    except BeartypeDecorHintPep673Exception:  # it takes `Self` only where it decorates the class
        return function


# --- one function


def checked(function: Any) -> Any:
    """Decorate a function, or the initialiser of a dataclass, so that its calls are checked."""
    if inspect.isclass(function):
        init = vars(function).get("__init__")
        if dataclasses.is_dataclass(function) and inspect.isfunction(init):
            function.__init__ = checked(init)  # type: ignore[misc]
        return function
    if not inspect.isfunction(function) or hasattr(function, "__wrapped__"):
        return function
    wrapper = _check_of(function).wrapper_of(function)
    wrapper.__defaults__, wrapper.__kwdefaults__ = function.__defaults__, function.__kwdefaults__
    return functools.wraps(function)(wrapper)


_checks: dict[int, tuple[types.CodeType, "_Check"]] = {}


def _check_of(function: types.FunctionType) -> "_Check":
    """Return the check of a function: one for all closures that the same lines define."""
    code = function.__code__
    if id(code) not in _checks:
        _checks[id(code)] = code, _Check(function)  # the code is kept, so that its id stays its own
    return _checks[id(code)][1]


class _Check:
    """The check of one function's arguments and result, made at the first call."""

    def __init__(self, function: types.FunctionType) -> None:
        self.function = function
        self.signature = inspect.signature(function)
        hints = _hints_known_by_now(function)
        self.plain = _PLAIN if _may_have_literals(hints) else _PLAIN_AND_WORDS
        self.call: Callable | None = None
        self.being_made = False
        self.passed: set[Hashable] = set()
        source = _wrapper_source(self.signature, hints)
        names = {"__check": self, "__passed": self.passed, "__facts_of": self.facts_of}
        names["__types_of"] = _types_of
        exec(_compiled(source), names)
        self.wrapper_of: Callable[[Callable], types.FunctionType] = names["__wrapper_of"]  # type: ignore[assignment]

    def facts_of(self, *values: Any) -> tuple[Hashable, ...]:
        """Return what the outcome depends on, of values of which it takes more than the annotation.

        Raises:
            TypeError: a collection too large to be told from others by its items.
        """
        facts: list[Hashable] = []
        _add_facts(values, facts, self.plain)
        return tuple(facts)

    def __call__(
        self, args: tuple, kwargs: dict[str, Any], returned: Any, key: Hashable | None
    ) -> None:
        """Raise `jaxtyping.TypeCheckError` if a value is not what its annotation says.

        Args:
            args, kwargs, returned: of the call. key: what the outcome depends on, None if it is not
                known.
        """
        __tracebackhide__ = True
        if self.call is None:
            if self.being_made:  # making it imports modules, and torchpose has a finder of these
                return
            self.being_made = True
            self.call = _make_check(self.function)
        given, parameters = self.signature.bind(*args, **kwargs), self.signature.parameters
        given.arguments = {  # a default may be a mark that is none of what is annotated
            name: value
            for name, value in given.arguments.items()
            if value is not parameters[name].default
        }
        self.call(*given.args, **given.kwargs, _returned=returned)
        if key is not None:
            self.passed.add(key)


# Nearly all calls end at the first `return`, millions in a run: nothing is done that can be left out.
_WRAPPER = """
def __wrapper_of(__function):
    def wrapper{parameters}:
        __tracebackhide__ = True
        __returned = __function({passed_on})
        try:
            __key = ({facts},)
            if __key in __passed:
                return __returned
        except (AttributeError, LookupError, TypeError):  # not as annotated, or with symbolic sizes
            __key = None
        __check(({by_place}), dict({by_name}), __returned, __key)
        return __returned
    return wrapper
"""


@functools.cache
def _compiled(source: str) -> types.CodeType:
    return compile(source, f"<{__name__}>", "exec")


def _wrapper_source(signature: inspect.Signature, hints: Mapping[str, Any]) -> str:
    """Return the source of a function of the same parameters, which has new combinations checked."""
    parameters = signature.parameters.values()
    bare = [p.replace(annotation=p.empty, default=p.empty) for p in parameters]
    several = [p.name for p in bare if p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    by_place = [p.name for p in bare if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    by_place += [f"*{p.name}" for p in bare if p.kind is p.VAR_POSITIONAL]
    by_name = [f"{p.name}={p.name}" for p in bare if p.kind is p.KEYWORD_ONLY]
    by_name += [f"**{p.name}" for p in bare if p.kind is p.VAR_KEYWORD]
    values = {p.name: _fact(p.name, hints.get(p.name)) for p in bare if p.name not in several}
    values |= {p.name: _facts_of_several(p, hints) for p in bare if p.name in several}
    values["__returned"] = _fact("__returned", hints.get("return"))
    facts = [fact for fact in values.values() if fact is not None]
    if others := [value for value, fact in values.items() if fact is None]:
        facts.append(f"__facts_of({', '.join(others)})")
    return _WRAPPER.format(
        parameters=inspect.Signature(bare),
        passed_on=", ".join(by_place + by_name),
        facts=", ".join(facts),
        by_place="".join(f"{name}, " for name in by_place),
        by_name=", ".join(by_name),
    )


def _fact(value: str, hint: Any) -> str | None:
    """Return the source of what an annotation asks of a value; None if that is not known beforehand."""
    if _told_by_type(hint):
        return f"type({value})"
    of_array = f"type({value}), {value}.dtype, {value}.shape"
    if _is_array(hint):
        return of_array
    if isinstance(hint, types.UnionType) and all(
        kind is types.NoneType or _is_array(kind) for kind in hint.__args__
    ):
        return f"{value} is None or ({of_array})"
    if _is_of_one_kind(hint):
        return f"__types_of({value})"
    if get_origin(hint) is tuple:
        items = [_fact(f"{value}[{i}]", item) for i, item in enumerate(get_args(hint))]
        known = [item for item in items if item is not None]
        if len(known) == len(items):
            return ", ".join([f"type({value})", f"len({value})", *known])
    return None


def _facts_of_several(parameter: inspect.Parameter, hints: Mapping[str, Any]) -> str | None:
    """Return the source of what counts of all values of `*name` or `**name`, None as in `_fact`."""
    if not _told_by_type(hints.get(parameter.name)):
        return None
    named = parameter.kind is parameter.VAR_KEYWORD
    return f"(*map(type, {parameter.name}{'.values()' if named else ''}),)"


def _is_of_one_kind(hint: Any) -> bool:
    """Return whether a sequence has any number of items, of which the types are enough."""
    origin, items = get_origin(hint), get_args(hint)
    several = items[1:] == (...,) if origin is tuple else origin in (Sequence, list)
    return several and _told_by_type(items[0])


def _types_of(values: Sequence[Any]) -> tuple[type, ...]:
    """Return the types of a sequence and of its items.

    Raises:
        TypeError: it is too long to be told from others by its items.
    """
    if len(values) > _MOST_ITEMS:
        raise TypeError(f"more than {_MOST_ITEMS} items")
    return (type(values), *map(type, values))


def _is_array(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, AbstractArray)


def _pass_on(*args, _returned, **kwargs):
    return _returned


def _make_check(function: types.FunctionType) -> Callable:
    """Return a function of the same arguments and their result, `_returned`, that is checked."""
    signature = inspect.signature(function)
    parameters = list(signature.parameters.values())
    place = len(parameters) - any(p.kind is p.VAR_KEYWORD for p in parameters)
    extra = inspect.Parameter("_returned", inspect.Parameter.KEYWORD_ONLY, annotation=Any)
    expected = signature.return_annotation
    if expected in (Any, signature.empty):  # the arguments are checked all the same
        expected = object
    made = types.FunctionType(_pass_on.__code__, function.__globals__)  # where names are looked up
    functools.update_wrapper(made, function)
    made.__signature__ = signature.replace(  # type: ignore[attr-defined]
        parameters=[*parameters[:place], extra, *parameters[place:]], return_annotation=expected
    )
    return jaxtyped(made, typechecker=check_after_call)


def _hints_known_by_now(function: types.FunctionType) -> dict[str, Any]:
    """Return the annotations; one that is a string stays so where it names what is defined further down."""
    hints = dict(function.__annotations__)
    for name, hint in hints.items():
        if isinstance(hint, str):
            with contextlib.suppress(NameError, AttributeError, TypeError):
                hints[name] = eval(hint, function.__globals__)
    return hints


def _may_have_literals(hints: Mapping[str, Any]) -> bool:
    """Return whether an annotation has a Literal, or is a string that may stand for one."""
    return any(isinstance(hint, str) or "Literal" in repr(hint) for hint in hints.values())


def _told_by_type(hint: Any) -> bool:
    """Return whether the type of a value says all about an annotation: classes, no shapes or items."""
    if isinstance(hint, types.UnionType):
        return all(map(_told_by_type, hint.__args__))
    if hint is None or hint is Any or get_origin(hint) is Callable:
        return True
    if isinstance(hint, TypeVar):
        return hint.__bound__ is None and not hint.__constraints__
    return isinstance(hint, type) and not _is_array(hint)


def _add_facts(values: Iterable[Any], facts: list[Hashable], plain: set[type]) -> None:
    """Append what the outcome of a check of these values depends on.

    Args:
        plain: types of which nothing else counts.

    Raises:
        TypeError: a collection too large to be told from others by its items.
    """
    for value in values:
        kind = type(value)
        facts.append(kind)
        if kind is Tensor:
            facts.append(value.dtype)
            facts.append(value.shape)
        elif kind in plain:
            pass
        elif kind is bool or kind is str:  # a word of a Literal
            facts.append(value)
        elif isinstance(value, _SEQUENCES) and len(value) <= _MOST_ITEMS:
            facts.append(len(value))
            _add_facts(value, facts, plain)
        else:
            _add_more(value, kind, facts, plain)


def _add_more(value: Any, kind: type, facts: list[Hashable], plain: set[type]) -> None:
    """Append what counts of a value of a rarer type, beside that type."""
    if isinstance(value, _ARRAYS):
        facts += value.dtype, value.shape
    elif isinstance(value, type):
        facts.append(value)
    elif kind is dict and len(value) <= _MOST_ITEMS:
        facts.append(len(value))
        _add_facts(value, facts, plain)
        _add_facts(value.values(), facts, plain)
    elif issubclass(kind, _COLLECTIONS):
        raise TypeError(f"{kind.__name__} with items that may be of any type")
    else:
        _PLAIN.add(kind)
        _PLAIN_AND_WORDS.add(kind)


# --- a package


class _Finder(MetaPathFinder):
    """Finds the modules of a package, with a loader that decorates their functions."""

    def __init__(self, package: str) -> None:
        self.package = package

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> ModuleSpec | None:
        if name != self.package and not name.startswith(f"{self.package}."):
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


class _Loader(SourceFileLoader):
    def get_code(self, fullname: str) -> types.CodeType:
        path = self.get_filename(fullname)
        tree = ast.parse(self.get_data(path), path)
        _decorate(tree.body)
        return compile(tree, path, "exec", dont_inherit=True)

    def exec_module(self, module: types.ModuleType) -> None:
        setattr(module, _NAME, checked)
        super().exec_module(module)


def _decorate(body: Sequence[ast.AST]) -> None:
    """Decorate every annotated function and every class in statements, and in the blocks of these."""
    for node in body:
        if isinstance(node, ast.ClassDef):
            node.decorator_list.insert(0, _decorator(node))  # after `dataclass`
        elif isinstance(node, ast.FunctionDef) and _is_annotated(node):
            node.decorator_list.append(_decorator(node))  # before `property` and the like
        for block in ("body", "orelse", "finalbody", "handlers", "cases"):
            inner = getattr(node, block, None)
            if isinstance(inner, list):
                _decorate(inner)


def _decorator(node: ast.AST) -> ast.Name:
    return ast.copy_location(ast.Name(_NAME, ast.Load()), node)


def _is_annotated(node: ast.FunctionDef) -> bool:
    arguments = node.args
    several = (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)
    every = (*several, arguments.vararg, arguments.kwarg)
    return node.returns is not None or any(a is not None and a.annotation for a in every)
