"""Tell states of live streams apart by the settings of the trackers that made them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from torchpose.errors import InputError

StreamSettings = tuple[tuple[str, Any], ...]
"""Settings that give the numbers of a state their meaning, by name."""

_COMPARED = (bool, int, float, str, torch.dtype)


def settings_of(settings: Mapping[str, Any]) -> StreamSettings:
    """Return the settings that can be compared: numbers, texts, and mappings of these.

    Tensors may be learnt while streams go on, and objects may be copies: they are left out.

    Args:
        settings: by name; None where there is none.
    """
    found: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            found[name] = str(sorted((str(key), str(one)) for key, one in value.items()))
        elif isinstance(value, Path):
            found[name] = str(value)
        elif value is None or isinstance(value, _COMPARED):
            found[name] = value
    return tuple(found.items())


def check_settings(state: StreamSettings | None, own: StreamSettings) -> None:
    """Raise `InputError` for the state of a tracker with other settings.

    Args:
        state: settings of the tracker that made the state; None if they are not known.
        own: of the tracker that is to go on.
    """
    if state is None or state == own:
        return
    made, here = dict(state), dict(own)
    names = [name for name in {**made, **here} if made.get(name) != here.get(name)]
    if names:
        there, wanted = (
            ", ".join(f"{name}={facts.get(name)!r}" for name in names) for facts in (made, here)
        )
        raise InputError(
            f"state must be one of this tracker, with {wanted}, got that of a tracker with {there}; begin "
            "with init of this tracker, and keep a state for each"
        )
