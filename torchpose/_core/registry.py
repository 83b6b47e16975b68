"""Keep tables of methods by name, to which programs add their own."""

from typing import TypeVar

from torchpose.errors import InputError

_Method = TypeVar("_Method")


def add_method(table: dict[str, _Method], name: str, method: _Method) -> None:
    """Add a method to a table; the same one once more changes nothing.

    Raises:
        InputError: another method has this name.
    """
    known = table.get(name, method)
    if known != method:
        raise InputError(f"method {name!r} exists ({known!r:.80}); choose another name")
    table[name] = method
