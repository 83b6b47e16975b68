"""A manifold's fit from its start to its end, which goes on where an earlier one was stopped."""

import os
import pickle
from pathlib import Path

import torch
from tqdm.auto import tqdm

from torchpose._core.files import atomic_path
from torchpose.errors import OutputError
from torchpose.learning.recipes.manifold import ManifoldFitting

__all__ = ["run_to_end", "taken_up"]


def run_to_end(
    fitting: ManifoldFitting, kept: str | Path | None = None, progress: bool = False
) -> ManifoldFitting:
    """Take steps until the fit is finished.

    Args:
        fitting: at its start, or taken up. kept: file that holds the fit after every step, and is
            removed at the end; None keeps nothing. progress: show a bar.
    """
    with tqdm(
        total=fitting.recipe.steps, desc="manifold", unit="step", disable=not progress,
        initial=len(fitting.fit.scores),
    ) as bar:  # fmt: skip
        while not fitting.finished:
            found = fitting.step()
            if kept is not None:
                with atomic_path(kept) as temporary:
                    torch.save({"of": fitting.identity(), "fit": fitting.state_dict()}, temporary)
            bar.set_postfix_str(f"held-out error {found['held_out']:.5f}", refresh=False)
            bar.update()
    if kept is not None:
        Path(kept).unlink(missing_ok=True)
    return fitting


def taken_up(fitting: ManifoldFitting, kept: str | Path) -> int:
    """Take up a fit that `run_to_end` kept, if it is the same one; returns its steps so far, or 0.

    Raises:
        OutputError: the file is something else, which `run_to_end` would write over.
    """
    if not os.path.lexists(kept):
        return 0
    try:
        found = torch.load(kept, weights_only=True)
        if found["of"] != fitting.identity():
            return 0
        fitting.load_state_dict(found["fit"])
    except (
        OSError,
        RuntimeError,
        pickle.UnpicklingError,
        EOFError,
        LookupError,
        TypeError,
    ) as error:
        raise OutputError(
            f"{kept}: is in the place where a fit is kept, and is none; move it away"
        ) from error
    return len(fitting.fit.scores)
