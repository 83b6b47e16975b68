"""Action spaces stacked to the tensors of a bank: padding, checks, the Gaussian of no known action."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchpose.errors import InputError
from torchpose.priors.actions.polar_limbs import POSTURE_DIM
from torchpose.priors.actions.space import ActionSpace

__all__ = ["NONE", "common_frame_rate", "names_of", "stack_spaces"]

NONE = "none"
"""Name of the last state: none of the known actions."""

_LEAST_RESIDUAL = 2.0  # degrees, of every direction outside of an action's subspace


def stack_spaces(spaces: Sequence[ActionSpace], background: float) -> dict[str, Tensor]:
    """The tensors of a bank by the names of its buffers, see `ActionBank`.

    Args:
        spaces: of different D and K, which are padded to the largest ones.
        background: factor on the deviations of the Gaussian of none of the actions.
    """
    return {**_padded(spaces), **_densities(spaces, background)}


def names_of(spaces: Sequence[ActionSpace]) -> tuple[str, ...]:
    """Names of the actions, or `InputError` unless each has one of its own."""
    names = tuple(space.info.name for space in spaces)
    if not names:
        raise InputError("a bank needs at least one action space, got none")
    if len(set(names)) < len(names) or "" in names or NONE in names:
        raise InputError(
            f"the actions of a bank need names of their own other than {NONE!r}, got "
            f"{', '.join(map(repr, names))}; fit each with `name`"
        )
    return names


def common_frame_rate(spaces: Sequence[ActionSpace]) -> float | None:
    """Frame rate of the performances, None if no space knows it, `InputError` if they differ."""
    rates = {space.info.fps for space in spaces if space.info.fps is not None}
    if len(rates) > 1:
        raise InputError(
            "the actions of a bank must be fitted at one frame rate, got "
            f"{', '.join(f'{r:g}' for r in sorted(rates))}; resample the performances"
        )
    return next(iter(rates), None)


def _padded(spaces: Sequence[ActionSpace]) -> dict[str, Tensor]:
    """The tensors of all actions, padded to the same D and K."""
    dims = torch.tensor([s.n_dimensions for s in spaces])
    counts = torch.tensor([s.n_postures for s in spaces])
    d, k = int(dims.max()), int(counts.max())

    def padded(name: str, fill: float) -> Tensor:
        parts = []
        for space in spaces:
            value = getattr(space, name)
            missing = [0, d - value.shape[-1]]
            if name in ("performance", "std"):
                missing += [0, k - len(value)]
            parts.append(torch.nn.functional.pad(value, missing, value=fill))
        return torch.stack(parts)

    device = spaces[0].mean.device
    return {
        "mean": torch.stack([s.mean for s in spaces]), "basis": padded("basis", 0.0),
        "performance": padded("performance", 0.0), "std": padded("std", 1.0),
        "match_std": padded("match_std", 1.0), "n_postures": counts.to(device),
        "n_dimensions": dims.to(device),
    }  # fmt: skip


def _densities(spaces: Sequence[ActionSpace], background: float) -> dict[str, Tensor]:
    """Deviation outside of the subspaces, and the Gaussian of none of the actions."""
    left = [s.lost_variance / max(POSTURE_DIM - s.n_dimensions, 1) for s in spaces]
    residual = torch.stack(left).mean().sqrt().clamp_min(_LEAST_RESIDUAL)
    means = torch.stack([s.mean for s in spaces])
    centre = means.mean(0)
    within = torch.stack([(s.basis * s.variances) @ s.basis.mT for s in spaces]).mean(0)
    between = (means - centre).mT @ (means - centre) / len(spaces)
    variances, axes = torch.linalg.eigh(within + between)
    std = torch.maximum(background * variances.clamp_min(0).sqrt(), residual)
    return {
        "residual_std": residual, "background_mean": centre, "background_axes": axes.contiguous(),
        "background_std": std,
    }  # fmt: skip
