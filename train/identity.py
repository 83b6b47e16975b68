"""Which fit a checkpoint is of: one of another model, recipe or recordings is refused."""

from collections.abc import Mapping
from typing import Any

from torchpose.errors import FileFormatError, InputError

__all__ = ["check_identity", "differences"]

_ADVICE = (
    "resume with the settings and recordings it was made with, or start anew without --ckpt_path"
)


def check_identity(kept: Any, wanted: Mapping[str, Any], path: Any) -> dict[str, Any]:
    """What a checkpoint says about itself, if it is of this fit.

    Args:
        kept: the entry of the checkpoint. wanted: the identity of this fit. path: of the file.

    Raises:
        FileFormatError: not a checkpoint of a fit like this one at all.
        InputError: of another one; every difference is named.
    """
    if not isinstance(kept, Mapping) or "identity" not in kept:
        raise FileFormatError(
            f"{path}: expected a checkpoint of {wanted.get('model', 'this model')}, got one of "
            "something else"
        )
    found = differences(kept["identity"], wanted)
    if found:
        raise InputError(f"{path}: the checkpoint is of another fit: {'; '.join(found)}; {_ADVICE}")
    return dict(kept)


def differences(kept: Any, wanted: Any, name: str = "") -> list[str]:
    """Sentences about what differs between two nested mappings.

    >>> differences({"recipe": {"seed": 0, "views": [1, 2]}}, {"recipe": {"seed": 3, "views": [1, 2]}})
    ['recipe seed was 0, is 3']
    """
    if isinstance(kept, Mapping) and isinstance(wanted, Mapping):
        inside = f"{name} " if name else ""
        return [
            sentence
            for key in dict.fromkeys([*kept, *wanted])
            for sentence in differences(kept.get(key), wanted.get(key), f"{inside}{key}")
        ]
    return [] if kept == wanted else [f"{name} was {_short(kept)}, is {_short(wanted)}"]


def _short(value: Any) -> str:
    text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
