"""The structure of the package: no circles of imports."""

from pathlib import Path

from benchmarks.import_graph import circles, module_files, module_imports

ROOT = Path(__file__).parents[1]
# Circles that are still there; none may be added.
KNOWN = (
    "torchpose.cli.",
    "torchpose.filters.",
    "torchpose.upper_body.",
)


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
    assert [c for c in circles(imports) if not c[0].startswith(KNOWN)] == []


def test_no_circles_in_the_programs_beside_the_package():
    assert circles(module_imports(module_files(ROOT, ["train", "benchmarks"]))) == []
