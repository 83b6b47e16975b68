"""What can be asked of a bootstrap particle filter, and the checks of it."""

import math

import torch

from torchpose.errors import InputError
from torchpose.filters.resampling import RESAMPLING
from torchpose.filters.transition import TRANSITIONS

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


def check_model(proposal: str, transition: str, burn_in: int, burn_in_scale: float) -> None:
    """Raise `InputError` for a transition or a burn-in that does not go with the proposal."""
    if transition not in TRANSITIONS:
        raise InputError(f"transition must be one of {', '.join(TRANSITIONS)}, got {transition!r}")
    if proposal != "mixture" and transition != "paper":
        raise InputError(
            f"proposal {proposal!r} weighs by (BL 26), which holds for transition 'paper' only, "
            f"got {transition!r}; use proposal 'mixture'"
        )
    if burn_in and transition == "ou":
        raise InputError("burn_in inflates Q, which transition 'ou' does not use; leave it at 0")
    if burn_in < 0 or not (math.isfinite(burn_in_scale) and burn_in_scale > 0):
        raise InputError(
            "burn_in must be a number of frames >= 0 and burn_in_scale a positive factor of Q, "
            f"got {burn_in} and {burn_in_scale}"
        )
