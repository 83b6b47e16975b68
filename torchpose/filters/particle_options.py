"""What can be asked of a bootstrap particle filter, and the checks of it."""

import torch

from torchpose.errors import InputError
from torchpose.filters.resampling import RESAMPLING

__all__ = ["PROPOSALS", "STARTS", "check_model", "check_options"]

PROPOSALS = ("mixture", "random-walk", "random-walk-unscaled")
STARTS = ("prior", "measured")


def check_options(
    proposal: str,
    n_particles: int,
    threshold: float,
    resampling: str,
    start: str,
    dtype: torch.dtype,
) -> None:
    """Raise `InputError` for a setting that is not one of those that there are."""
    if proposal not in PROPOSALS:
        raise InputError(f"proposal must be one of {', '.join(PROPOSALS)}, got {proposal!r}")
    if resampling not in RESAMPLING:
        raise InputError(f"resampling must be one of {', '.join(RESAMPLING)}, got {resampling!r}")
    if start not in STARTS:
        raise InputError(f"start must be one of {', '.join(STARTS)}, got {start!r}")
    if isinstance(n_particles, bool) or not isinstance(n_particles, int) or n_particles < 1:
        raise InputError(f"n_particles must be a whole number of at least 1, got {n_particles!r}")
    if not 0 <= threshold <= 1:
        raise InputError(f"resample_threshold must be a share from 0 to 1, got {threshold}")
    if dtype not in (torch.float32, torch.float64):
        raise InputError(f"dtype must be torch.float32 or torch.float64, got {dtype}")


def check_model(proposal: str, transition: str) -> None:
    """Raise `InputError` for a transition that does not go with the proposal."""
    if proposal != "mixture" and transition != "paper":
        raise InputError(
            f"proposal {proposal!r} weighs by (BL 26), which holds for transition 'paper' only, "
            f"got {transition!r}; use proposal 'mixture'"
        )
