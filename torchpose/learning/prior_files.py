"""The files of a fit: what was fitted, and what describes it beside it."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torchpose.io.results import ResultsFolder

__all__ = ["prior_results"]


def prior_results(
    out: Path, inputs: Iterable[str | Path], beside: Sequence[str] = (".md", ".png")
) -> "ResultsFolder":
    """Where a fit puts its file, and those of the same name beside it.

    Args:
        out: the file, NAME.safetensors. inputs: files that are read. beside: suffixes of the others.
    """
    from torchpose.io.results import ResultsFolder

    return ResultsFolder(
        out.parent,
        f"fit-{out.stem}",
        rf"{re.escape(out.stem)}\.(safetensors|md|png)",
        [out.name, *(out.with_suffix(suffix).name for suffix in beside)],
        inputs,
        lambda _: _is_fitted(out),
    )


def _is_fitted(path: Path) -> bool:
    from torchpose._core.tensor_file import format_of

    return path.is_file() and (format_of(path) or "").startswith("torchpose")
