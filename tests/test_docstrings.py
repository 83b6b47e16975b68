"""The docstrings of public names: a verb first, every argument, what is returned, what is raised."""

import ast
import inspect
import re
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from functools import cache, cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import pytest

import torchpose

ROOMS = ("torchpose", *(f"torchpose.{room}" for room in sorted(torchpose._PACKAGES)))
NO_VERBS = {
    *("A", "An", "The", "This", "These", "That", "Each", "All", "Every", "One", "Both", "Any"),
    *("What", "How", "Where", "Which", "Who", "Whether", "When", "Why", "Whose", "Its", "It", "If"),
    *("For", "In", "Of", "As", "With", "Not", "No", "Same", "Number"),
    *(
        "Names",
        "Limbs",
        "Settings",
        "Facts",
        "Poses",
        "States",
        "Particles",
        "Gaussians",
        "Hypotheses",
    ),
}
SECTIONS = ("Args", "Attributes", "Returns", "Yields", "Raises")
HOOKS = {"extra_repr", "get_extra_state", "set_extra_state"}  # of torch.nn.Module, called by it
BRIEF = re.compile(r"(Return|Yield)\b")


class Documented(NamedTuple):
    """A function, method, property or class, with its definition in the source."""

    name: str
    kind: str
    """``function``, ``property`` or ``class``."""
    doc: str
    node: ast.FunctionDef | ast.ClassDef


@cache
def definitions(path: str) -> dict[str, ast.FunctionDef | ast.ClassDef]:
    """Return the last definition of every qualified name of a module; overloads stand above it."""
    found: dict[str, ast.FunctionDef | ast.ClassDef] = {}

    def collect(body: list[ast.stmt], prefix: str) -> None:
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found[prefix + node.name] = node
            if isinstance(node, ast.ClassDef):
                collect(node.body, f"{prefix}{node.name}.")
            elif isinstance(node, ast.If):
                collect([*node.body, *node.orelse], prefix)

    collect(ast.parse(Path(path).read_text(encoding="utf-8")).body, "")
    return found


def definition(value: Any) -> ast.FunctionDef | ast.ClassDef | None:
    """Return where a function or class is defined in the source; None for what is generated."""
    module = inspect.getmodule(value)
    if module is None or module.__file__ is None:
        return None
    return definitions(module.__file__).get(value.__qualname__)


def function_of(member: Any) -> Callable[..., Any] | None:
    """Return the function behind a method, class method, static method or property."""
    if isinstance(member, property):
        return member.fget
    if isinstance(member, cached_property):
        return member.func
    if isinstance(member, classmethod | staticmethod):
        member = member.__func__
    return inspect.unwrap(member) if inspect.isfunction(member) else None


def overridden_docs(cls: type, name: str) -> list[str]:
    """Return the docstrings of a method in a class and in those of its bases that have one, in this order."""
    found = [vars(base)[name] for base in ours(cls) if name in vars(base)]
    docs = [doc for one in found if (doc := (function_of(one) or one).__doc__)]
    return [inspect.cleandoc(doc) for doc in docs]


def members(cls: type) -> Iterator[Documented]:
    """Yield the public methods and properties of a class that torchpose defines, inherited ones too."""
    names = {n for base in ours(cls) for n in vars(base) if not n.startswith("_")}
    for name in sorted(names):
        home = next(base for base in ours(cls) if name in vars(base))
        member = vars(home)[name]
        function = function_of(member)
        node = None if function is None or name in HOOKS else definition(function)
        if function is not None and node is not None:
            kind = "property" if isinstance(member, property | cached_property) else "function"
            label = f"{function.__module__}.{function.__qualname__}"
            yield Documented(label, kind, with_inherited(overridden_docs(cls, name)), node)


def with_inherited(docs: list[str]) -> str:
    """Return the first of some docstrings, with the sections that it lacks and methods it overrides have."""
    doc = docs[0] if docs else ""
    for below in docs[1:]:
        for kind, text in sections(below).items():
            if kind not in sections(doc):
                doc += f"\n\n{kind}:\n{textwrap.indent(text, '    ')}"
    return doc


def ours(cls: type) -> list[type]:
    """Return a class and those of its bases that torchpose defines."""
    return [base for base in cls.__mro__ if base.__module__.startswith("torchpose")]


def public() -> dict[str, Documented]:
    """Return every public function, class, method and property by its full name."""
    found = {}
    for room in ROOMS:
        module = import_module(room)
        for name in module.__all__:
            value = getattr(module, name)
            if not (inspect.isfunction(value) or inspect.isclass(value)):
                continue
            value = inspect.unwrap(value)
            node = definition(value)
            if node is None or not value.__module__.startswith("torchpose"):
                continue
            label = f"{value.__module__}.{value.__qualname__}"
            kind = "class" if inspect.isclass(value) else "function"
            found[label] = Documented(label, kind, inspect.getdoc(value) or "", node)
            if inspect.isclass(value):
                found.update((member.name, member) for member in members(value))
    return found


def sections(doc: str) -> dict[str, str]:
    """Return the indented text below each heading of a docstring.

    >>> sections("Return x.\\n\\nArgs:\\n    x: a number.\\n")
    {'Args': 'x: a number.\\n'}
    """
    heading = rf"^({'|'.join(SECTIONS)}):[ ]?(.*)\n((?:(?:[ ]{{4}}.*)?\n)*)"
    return {
        kind: rest + textwrap.dedent(text).strip("\n") + "\n"
        for kind, rest, text in re.findall(heading, doc.rstrip() + "\n", re.MULTILINE)
    }


def entries(section: str) -> list[str]:
    """Return the names that begin the lines of a section, which may share a line.

    >>> entries("x, y: numbers\\n    of a kind.\\n*more: others. z: the last one.\\n")
    ['x', 'y', '*more', 'z']
    """
    name = r"\*{0,2}[A-Za-z_]\w*"
    found = re.findall(rf"(?:^|(?<=\. )|(?<=; ))({name}(?:,\s+{name})*): ", section, re.MULTILINE)
    return [part for group in found for part in re.split(r",\s+", group)]


def parameters(node: ast.FunctionDef) -> list[str]:
    """Return the parameters of a function as the docstring is to write them, without self and cls."""
    args = node.args
    names = [a.arg for a in (*args.posonlyargs, *args.args)]
    static = any(isinstance(d, ast.Name) and d.id == "staticmethod" for d in node.decorator_list)
    if names[:1] in (["self"], ["cls"]) and not static:
        names = names[1:]
    names += [f"*{args.vararg.arg}"] if args.vararg else []
    names += [a.arg for a in args.kwonlyargs]
    names += [f"**{args.kwarg.arg}"] if args.kwarg else []
    return [n for n in names if not n.startswith("_")]


def raised(node: ast.FunctionDef) -> set[str]:
    """Return the errors that a function raises itself, not in a function inside it."""
    found, todo = set(), list(node.body)
    while todo:
        inner: ast.AST = todo.pop()
        if isinstance(inner, ast.FunctionDef | ast.Lambda | ast.ClassDef):
            continue
        if isinstance(inner, ast.Raise) and isinstance(inner.exc, ast.Call):
            name = ast.unparse(inner.exc.func).rpartition(".")[2]
            found |= {name} if name[0].isupper() else set()
        todo += ast.iter_child_nodes(inner)
    return found - {"NotImplementedError", "AssertionError"}


def fields(cls: ast.ClassDef) -> tuple[list[str], set[str]]:
    """Return the public fields of a dataclass or named tuple, and those with a docstring below."""
    names, told = [], set()
    for node, below in zip(cls.body, [*cls.body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            if node.target.id.startswith("_") or "ClassVar" in ast.unparse(node.annotation):
                continue
            names.append(node.target.id)
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                told.add(node.target.id)
    return names, told


def first_line_problems(doc: str, third_person: bool) -> Iterator[str]:
    """Yield what is wrong with the first line; a class "holds", a function is told to "return"."""
    line = doc.partition("\n")[0].rstrip()
    if not line:
        yield "no docstring"
        return
    word = re.split(r"[^\w'-]", line)[0]
    verb = word[:1].isupper() and not word.isupper() and word not in NO_VERBS
    if not verb or third_person != (word.endswith("s") and not word.endswith("ss")):
        yield f"begins with no verb {'in the third person' if third_person else 'to do'}: {line!r}"
    if not line.endswith("."):
        yield f"no full stop at the end of the first line: {line!r}"


def argument_problems(wanted: list[str], told: list[str]) -> Iterator[str]:
    missing = [name for name in wanted if name not in told]
    unknown = [name for name in told if name not in wanted]
    if missing:
        yield f"Args lacks {', '.join(missing)}"
    if unknown:
        yield f"Args has {', '.join(unknown)}, which is no parameter"


def function_problems(item: Documented) -> Iterator[str]:
    assert isinstance(item.node, ast.FunctionDef)
    yield from first_line_problems(item.doc, third_person=False)
    parts = sections(item.doc)
    wanted = [] if item.kind == "property" else parameters(item.node)
    yield from argument_problems(wanted, entries(parts.get("Args", "")))
    returns = item.node.returns
    gives = returns is not None and ast.unparse(returns) not in ("None", "NoReturn")
    brief = not wanted and BRIEF.match(item.doc)
    if gives and not ({"Returns", "Yields"} & set(parts)) and not brief:
        yield "no Returns"
    untold = {e for e in raised(item.node) if e not in parts.get("Raises", "")}
    if untold:
        yield f"Raises lacks {', '.join(sorted(untold))}"


def class_problems(item: Documented, value: type) -> Iterator[str]:
    assert isinstance(item.node, ast.ClassDef)
    yield from first_line_problems(item.doc, third_person=True)
    parts = sections(item.doc)
    told = entries(parts.get("Args", "")) + entries(parts.get("Attributes", ""))
    homes = [] if getattr(value, "_is_protocol", False) else ours(value)
    init = next((b for b in homes if "__init__" in vars(b)), None)
    if is_dataclass(value) or hasattr(value, "_fields"):
        wanted, below = [], set(told)
        for base in reversed(ours(value)):
            node = definition(base)
            if isinstance(node, ast.ClassDef):
                names, documented = fields(node)
                wanted += names
                below |= documented
        missing = [name for name in dict.fromkeys(wanted) if name not in below]
        if missing:
            yield f"Args or Attributes lacks {', '.join(missing)}"
    elif init is not None and not issubclass(value, BaseException):
        node = definition(function_of(vars(init)["__init__"]))
        if isinstance(node, ast.FunctionDef):
            told = entries(parts.get("Args", ""))
            yield from argument_problems(parameters(node), told)


def problems() -> dict[str, list[str]]:
    """Return what is wrong with the docstring of each public name that has a fault."""
    found = {}
    for name, item in sorted(public().items()):
        if item.kind == "class":
            module, _, own = name.rpartition(".")
            faults = list(class_problems(item, getattr(import_module(module), own)))
        else:
            faults = list(function_problems(item))
        if faults:
            found[name] = faults
    return found


def test_every_public_docstring_is_complete():
    found = problems()
    assert not found, "\n".join(f"{name}: {'; '.join(faults)}" for name, faults in found.items())


def test_methods_repeat_no_section_of_the_methods_that_they_override():
    found = []
    for room in ROOMS:
        module = import_module(room)
        for cls in filter(inspect.isclass, (getattr(module, name) for name in module.__all__)):
            for name in {name for base in ours(cls) for name in vars(base)} - {"__init__"}:
                own, *below = map(sections, overridden_docs(cls, name) or [""])
                inherited = set().union(*(base.items() for base in below[:1]))
                found += [f"{cls.__name__}.{name}: {k}" for k, _ in own.items() & inherited]
    assert sorted(set(found)) == []


def test_the_public_names_are_found():
    found = public()
    assert len(found) > 400
    assert {item.kind for item in found.values()} == {"function", "property", "class"}
    for name in ("math._rotations.compose", "whole_body._body_tracker.BodyTracker.step"):
        assert f"torchpose.{name}" in found


@pytest.mark.parametrize(
    ("docstring", "fault"),
    [
        ("", "no docstring"),
        ("The sum of two numbers.", "begins with no verb"),
        ("Returns the sum.", "begins with no verb"),
        ("Return the sum", "no full stop"),
        ("Return the sum.", "Args lacks a, *more, **options"),
        ("Return it.\n\nArgs:\n    a, *more, **options, b: numbers.", "Args has b"),
        ("Return it.\n\nArgs:\n    a, *more, **options: numbers.", "no Returns"),
        ("Return it.\n\nRaises:\n    ValueError: a is negative.", "Raises lacks InputError"),
    ],
)
def test_a_fault_is_found(docstring, fault):
    code = """
def add(a, *more, **options) -> int:
    def inner():
        raise KeyError("not add's own")
    if a < 0:
        raise InputError("negative")
    return a
"""
    node = ast.parse(code).body[0]
    found = list(function_problems(Documented("add", "function", docstring, node)))
    assert any(line.startswith(fault) for line in found), found
    assert not any("KeyError" in line for line in found)


def test_a_docstring_without_faults_passes():
    doc = """Return the sum.

    Args:
        a: the first one. *more: the others.
        **options: of the addition,
            which are ignored.

    Returns:
        The sum.
    """
    node = ast.parse("def add(a, *more, **options) -> int: ...").body[0]
    assert not list(function_problems(Documented("add", "function", inspect.cleandoc(doc), node)))
