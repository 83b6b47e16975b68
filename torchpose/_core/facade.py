"""Show the public names and subpackages of a room, and for one release the names that have left it."""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from torchpose._core.moved import NAMES, moved_names


def set_up_facade(module: str, later: Mapping[str, str] = {}) -> None:
    """Give a room its `__dir__`, and a room or module its `__getattr__` for names that have left it.

    Both are set here and not written in the room, so that type checkers go by the imports there and
    report a name that does not exist.

    Args:
        module: `__name__` of the room, whose `__all__` is set before, or of a private module, which has none.
        later: public names that are imported when they are first used, by the module that has them.
    """
    names = vars(sys.modules[module])
    if "__all__" in names:
        names["__dir__"] = list_public(module)
    if later:
        names["__getattr__"] = _imported_later(module, later)
    elif module in NAMES:
        names["__getattr__"] = moved_names(module)


def _imported_later(module: str, later: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a room that imports names when they are first used."""
    homes = {name: home for home, names in later.items() for name in names.split()}
    others = moved_names(module)

    def attribute(name: str) -> Any:
        if name not in homes:
            return others(name)
        value = getattr(import_module(f"{module}.{homes[name]}"), name)
        setattr(sys.modules[module], name, value)
        return value

    return attribute


def list_public(module: str) -> Callable[[], list[str]]:
    """Return the `__dir__` of a room: names in `__all__`, subpackages, and names like `__doc__`."""

    def names() -> list[str]:
        from pkgutil import iter_modules  # here, since `import torchpose` is to be quick

        room = sys.modules[module]
        packages = [m.name for m in iter_modules(getattr(room, "__path__", [])) if m.ispkg]
        public = {name for name in packages if not name.startswith("_")}
        special = {name for name in vars(room) if name.startswith("__") and name.endswith("__")}
        return sorted({*room.__all__, *public, *special})

    return names


def package_version() -> str:
    """Return the version of the installed package, "0+unknown" in a source tree that is not installed."""
    from importlib.metadata import (  # takes longer than all of torchpose
        PackageNotFoundError,
        version,
    )

    try:
        return version("torchpose")
    except PackageNotFoundError:
        return "0+unknown"
