"""The structure of the package: what its rooms show, and no circles of imports."""

import ast
import subprocess
import sys
import warnings
from collections import defaultdict
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

import pytest

import torchpose
from benchmarks.import_graph import circles, distinct_names, module_files, module_imports
from torchpose._core.moved import NAMES, moved_from

ROOT = Path(__file__).parents[1]
ROOMS = sorted(
    m.name
    for m in iter_modules(torchpose.__path__)
    if not m.name.startswith("_") and m.name != "cli"
)
MOVED = [(room, old, f"{home}.{new}") for room in NAMES for home, old, new in moved_from(room)]


def test_tarjan_finds_the_components_of_a_graph():
    graph = {"a": "b", "b": "cd", "c": "a", "d": "e", "e": "d", "f": "af", "g": "x"}
    assert circles(graph) == [["a", "b", "c"], ["d", "e"]]


def test_every_kind_of_import_is_seen(tmp_path):
    package = tmp_path / "torchpose"
    (package / "room").mkdir(parents=True)
    (package / "__init__.py").write_text("from .room import b\n")
    (package / "room" / "__init__.py").write_text("")
    (package / "room" / "a.py").write_text("def f():\n    import torchpose.room.b\n")
    (package / "room" / "b.py").write_text(
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from .a import f\n"
    )
    imports = module_imports(module_files(tmp_path))
    assert imports["torchpose"] == {"torchpose.room.b"}
    assert circles(imports) == [["torchpose.room.a", "torchpose.room.b"]]


def test_no_circles_between_modules():
    """Imports inside functions and those for type checkers only count as well."""
    imports = module_imports(module_files(ROOT, ["torchpose"]))
    del imports["torchpose"]  # re-exports lazily what stands in its rooms
    assert circles(imports) == []


def test_no_circles_in_the_programs_beside_the_package():
    assert circles(module_imports(module_files(ROOT, ["train", "benchmarks"]))) == []


def test_the_root_lists_its_rooms():
    assert set(ROOMS) <= set(dir(torchpose))
    assert set(ROOMS) == torchpose._PACKAGES


@pytest.mark.parametrize("name", ["torchpose", *(f"torchpose.{room}" for room in ROOMS)])
def test_a_room_shows_public_names_and_subpackages_alone(name):
    room = import_module(name)
    packages = {m.name for m in iter_modules(getattr(room, "__path__", [])) if m.ispkg}
    rooms = torchpose._PACKAGES if room is torchpose else set()
    plain = {n for n in dir(room) if not (n.startswith("__") and n.endswith("__"))}
    assert plain - rooms - packages == set(room.__all__)
    assert not [n for n in plain if n.startswith("_")]
    assert len(set(room.__all__)) == len(room.__all__)
    for public in room.__all__:
        assert getattr(room, public) is not None


def test_everything_else_is_private():
    """Outside `__all__`, nothing can be imported from a room without writing an underscore."""
    rooms = {f"torchpose.{room}" for room in ROOMS}
    open_modules = {
        module
        for module in module_files(ROOT, ["torchpose"])
        if not any(part.startswith("_") for part in module.split("."))
    }
    assert open_modules == {"torchpose", "torchpose.cli", *rooms}


def test_no_two_modules_share_a_file_name():
    """Who searches for a file by its name finds one; only packages' own files repeat."""
    homes = defaultdict(list)
    for path in module_files(ROOT, ["torchpose"]).values():
        homes[path.name].append(str(path.relative_to(ROOT)))
    del homes["__init__.py"]
    assert {name: paths for name, paths in homes.items() if len(paths) > 1} == {}


def test_no_two_modules_define_a_class_of_the_same_name():
    """Those with an underscore are of one module alone."""
    homes = defaultdict(list)
    for module, path in module_files(ROOT, ["torchpose"]).items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(module)
    assert {name: modules for name, modules in homes.items() if len(modules) > 1} == {}


def test_few_names_are_public():
    assert len(distinct_names(ROOT)) <= 200


@pytest.mark.parametrize(("room", "name", "home"), MOVED, ids=lambda value: value)
def test_a_name_that_left_a_room_is_found_with_a_warning(room, name, home):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        module, _, present_name = home.rpartition(".")
        present = getattr(import_module(f"torchpose.{module}"), present_name)
    with pytest.warns(DeprecationWarning, match=rf"{room}\.{name} "):
        assert getattr(import_module(room), name) is present


def test_every_module_that_moved_is_imported_with_a_warning():
    """In a process of its own, since an import leaves its module behind."""
    code = """
import sys, warnings
from importlib import import_module
from torchpose._core.moved import MODULES
for old, home in MODULES.items():
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        module = import_module(f"torchpose.{old}")
    if module is not import_module(f"torchpose.{home}"):
        print(old, "is not", home)
    if not any(str(w.message).startswith(f"torchpose.{old} is torchpose.{home} now") for w in said):
        print(old, "without a warning")
"""
    found = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert (found.returncode, found.stdout) == (0, ""), found.stderr


@pytest.mark.parametrize(
    ("old", "present"),
    [
        ("evaluation.score", "evaluation._score"),
        ("protocols.report", "evaluation._report"),
        ("cli.track", "cli._track"),
    ],
)
def test_a_module_is_found_by_its_old_path_with_a_warning(old, present):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", DeprecationWarning)
        assert import_module(f"torchpose.{old}") is import_module(f"torchpose.{present}")
    said = f"torchpose.{old} is torchpose.{present} now"
    assert any(said in str(warning.message) for warning in caught)


@pytest.mark.parametrize("module", NAMES)
def test_what_had_other_names_lists_its_own(module):
    assert dir(import_module(module))


def test_a_name_that_no_room_had_is_refused():
    with pytest.raises(AttributeError, match=r"torchpose\.math.* no attribute 'no_such_name'"):
        import_module("torchpose.math").no_such_name  # noqa: B018
