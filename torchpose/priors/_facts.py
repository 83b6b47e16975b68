"""Name the facts about a fit that do not follow from its data."""

from typing import Any, TypedDict


class FitFacts(TypedDict, total=False):
    """The fields of `LimbInfo` that do not follow from body and states."""

    name: str
    persons: tuple[str, ...]
    actions: tuple[str, ...]
    sources: tuple[str, ...]
    licence: str
    command: str
    extra: dict[str, Any]


class ManifoldFacts(FitFacts, total=False):
    """The fields of `ManifoldInfo` that do not follow from the body."""

    fps: float | None
    sequences: tuple[str, ...]
