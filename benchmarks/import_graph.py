"""Print the import graph between the rooms of torchpose: edges, circles, sizes, public names.

    python -m benchmarks.import_graph                    # this checkout
    python -m benchmarks.import_graph --checkout FOLDER  # another one, for a comparison

A room is a package or module directly in `torchpose`, or one of the programs beside it (`benchmarks`,
`train`). Every import statement counts: those that run on import, inside a function, or for type
checkers only.
No module of the checkout is imported: the files are parsed.
"""

import ast
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from benchmarks._command import run_command
from torchpose.errors import InputError

__all__ = [
    "Room",
    "circles",
    "code_lines",
    "distinct_names",
    "module_files",
    "module_imports",
    "public_names",
    "room_of",
    "rooms",
]

PROGRAMS = ("benchmarks", "train")
_ROOT = Path(__file__).parents[1]


class Room(NamedTuple):
    """Size and imports of one room."""

    files: int
    lines: int
    code: int
    """Lines without docstrings, comments and blank ones."""
    public: int
    """Names in `__all__` of the room itself; those of its subpackages are not counted."""
    imports: frozenset[str]
    """Names of the other rooms that it imports."""


def module_files(root: Path, packages: Iterable[str] = ("torchpose", *PROGRAMS)) -> dict[str, Path]:
    """Return the file of every module of some packages, by the module's full name."""
    files = {}
    for package in packages:
        for path in sorted((root / package).rglob("*.py")):
            name = ".".join(path.relative_to(root).with_suffix("").parts)
            files[name.removesuffix(".__init__")] = path
    return files


def module_imports(files: Mapping[str, Path]) -> dict[str, set[str]]:
    """Return, for every module, which of the other modules its import statements name.

    `from package import name` is an import of the submodule where `name` is one, else of the package.
    """
    return {
        module: {found for found in _imported(path, module, files) if found != module}
        for module, path in files.items()
    }


def _imported(path: Path, module: str, files: Mapping[str, Path]) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in files)
        elif isinstance(node, ast.ImportFrom):
            source = _source(node, module, is_package=path.name == "__init__.py")
            for alias in node.names:
                submodule = f"{source}.{alias.name}"
                if submodule in files or source in files:
                    yield submodule if submodule in files else source


def _source(node: ast.ImportFrom, module: str, is_package: bool) -> str:
    """Return the full name of the module after `from`."""
    if node.level == 0:
        return node.module or ""
    parts = module.split(".")
    base = parts[: len(parts) - node.level + is_package]
    return ".".join([*base, *([node.module] if node.module else [])])


def circles(imports: Mapping[str, Iterable[str]]) -> list[list[str]]:
    """Return the strongly connected components of more than one node (Tarjan's algorithm).

    Args:
        imports: by node, the nodes that it points to; nodes that are no keys are ignored.

    Returns:
        Each component in alphabetical order.

    >>> circles({"a": ["b"], "b": ["c"], "c": ["a"], "d": ["a"]})
    [['a', 'b', 'c']]
    """
    index: dict[str, int] = {}
    lowest: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = lowest[node] = len(index)
        stack.append(node)
        for other in imports[node]:
            if other not in imports:
                continue
            if other not in index:
                visit(other)
                lowest[node] = min(lowest[node], lowest[other])
            elif other in stack:
                lowest[node] = min(lowest[node], index[other])
        if lowest[node] == index[node]:
            at = stack.index(node)
            component = stack[at:]
            del stack[at:]
            if len(component) > 1:
                found.append(sorted(component))

    for node in imports:
        if node not in index:
            visit(node)
    return sorted(found)


def room_of(module: str) -> str:
    """Return the room of a module: `torchpose.body._limbs` is in `body`, `train.cli` in `train`.

    The module `torchpose` itself, which re-exports from its rooms, is the room `torchpose`.
    """
    first, _, rest = module.partition(".")
    return rest.split(".")[0] if first == "torchpose" and rest else first


def public_names(path: Path) -> list[str]:
    """Return `__all__` of a module as it is written there; empty where there is none."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and any(
            isinstance(target, ast.Name) and target.id == "__all__" for target in node.targets
        ):
            return list(ast.literal_eval(node.value))
    return []


def distinct_names(root: Path) -> set[str]:
    """Return the public names of a checkout as `room.name`; those that the root repeats are counted once."""
    heads = sorted((root / "torchpose").glob("*/__init__.py"))
    heads += sorted(p for p in (root / "torchpose").glob("*.py") if not p.name.startswith("_"))
    found = {f"{_room_of(path)}.{name}" for path in heads for name in public_names(path)}
    in_rooms = {name.rpartition(".")[2] for name in found}
    own = set(public_names(root / "torchpose" / "__init__.py")) - in_rooms
    return found | {f"torchpose.{name}" for name in own}


def _room_of(path: Path) -> str:
    return path.parent.name if path.name == "__init__.py" else path.stem


def code_lines(text: str) -> int:
    """Return the number of lines of a module that hold code: no docstring, comment or blank line.

    >>> code_lines("# one\\n\\nx = 1  # two\\n")
    1
    """
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    told: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, documented) and ast.get_docstring(node, clean=False) is not None:
            first = node.body[0]
            told.update(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    kept = (line.strip() for i, line in enumerate(text.splitlines(), 1) if i not in told)
    return sum(bool(line) and not line.startswith("#") for line in kept)


def rooms(root: Path) -> dict[str, Room]:
    """Return the rooms of a checkout by name."""
    files = module_files(root)
    imports = module_imports(files)
    members: dict[str, list[str]] = defaultdict(list)
    for module in files:
        members[room_of(module)].append(module)
    result = {}
    for name, modules in sorted(members.items()):
        head = name if name in files else f"torchpose.{name}"
        others = {room_of(found) for module in modules for found in imports[module]} - {name}
        texts = [files[module].read_text(encoding="utf-8") for module in modules]
        lines = sum(len(text.splitlines()) for text in texts)
        public = len(public_names(files[head])) if head in files else 0
        code = sum(map(code_lines, texts))
        result[name] = Room(len(modules), lines, code, public, frozenset(others))
    return result


def main(*, checkout: Path | None = None) -> None:
    """Print the table of rooms, the circles and the sums.

    Args:
        checkout: folder of a checkout; the one that this program is in, if it is left out.
    """
    root = _ROOT if checkout is None else checkout
    if not (root / "torchpose").is_dir():
        raise InputError(f"{root}: expected a checkout, with a folder torchpose")
    found = rooms(root)
    inside = {n: room for n, room in found.items() if n not in PROGRAMS}
    print(f"{'room':<12} {'files':>5} {'lines':>6} {'code':>6} {'public':>6}  imports")
    for name, room in found.items():
        print(
            f"{name:<12} {room.files:>5} {room.lines:>6} {room.code:>6} {room.public:>6}  "
            f"{' '.join(sorted(room.imports)) or '-'}"
        )
    # The root re-exports from its rooms, so it is left out where circles between rooms are sought.
    graph = {n: room.imports for n, room in inside.items() if n != "torchpose"}
    files = module_files(root)
    modules = {m: i for m, i in module_imports(files).items() if m != "torchpose"}
    print(f"\ncircles between rooms: {circles(graph) or 'none'}")
    print(f"circles between modules: {circles(modules) or 'none'}")
    print(
        f"torchpose: {len(inside)} rooms, {sum(len(r.imports) for r in inside.values())} edges, "
        f"{sum(r.files for r in inside.values())} files, {sum(r.lines for r in inside.values())} lines, "
        f"{sum(r.code for r in inside.values())} of code, {len(distinct_names(root))} public names"
    )


if __name__ == "__main__":
    run_command(main)
