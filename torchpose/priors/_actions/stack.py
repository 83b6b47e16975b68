"""Stack the tensors of several actions into a bank, and step the Markov chain over its states."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.errors import InputError
from torchpose.priors._actions.polar_limbs import POSTURE_DIM
from torchpose.priors._actions.space import ActionSpace

NONE = "none"
"""Name of the last state: none of the known actions."""

_LEAST_RESIDUAL = 2.0  # degrees, of every direction outside of an action's subspace


def stack_spaces(spaces: Sequence[ActionSpace], background: float) -> dict[str, Tensor]:
    """Return the tensors of a bank by the names of its buffers, see `ActionBank`.

    Args:
        spaces: of different D and K, which are padded to the largest ones.
        background: factor on the deviations of the Gaussian of none of the actions.
    """
    return {**_padded(spaces), **_densities(spaces, background)}


def names_of(spaces: Sequence[ActionSpace]) -> tuple[str, ...]:
    """Return the names of the actions, or raise `InputError` unless each has one of its own."""
    others = [type(space).__name__ for space in spaces if not isinstance(space, ActionSpace)]
    if others:
        raise InputError(f"a bank is made of a list of ActionSpace, got {', '.join(others)}")
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
    """Return the performances' frame rate, None if unknown; raise `InputError` if they differ."""
    rates = {space.info.fps for space in spaces if space.info.fps is not None}
    if len(rates) > 1:
        raise InputError(
            "the actions of a bank must be fitted at one frame rate, got "
            f"{', '.join(f'{r:g}' for r in sorted(rates))}; resample the performances"
        )
    return next(iter(rates), None)


def _padded(spaces: Sequence[ActionSpace]) -> dict[str, Tensor]:
    """Return the tensors of all actions, padded to the same D and K."""
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
    """Return the deviation outside of the subspaces, and the Gaussian of none of the actions."""
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


def chain_transition(n_states: int, stay: float, fps: float, like: Tensor) -> Float[Tensor, "S S"]:
    """Return probabilities of going from each state to each in one frame of 1 / fps seconds.

        p(A_t = A_{t-1}) = 1/n + (1 - 1/n) e^(-r / fps),   all other states alike

    Args:
        n_states: n. stay: probability of the same state a second later, which gives r.
        fps: frames per second. like: of the dtype and on the device that are wanted.

    >>> two_frames = torch.linalg.matrix_power(chain_transition(3, 0.8, 60.0, torch.ones(())), 2)
    >>> torch.allclose(two_frames, chain_transition(3, 0.8, 30.0, torch.ones(())))
    True
    """
    lasting = (stay - 1 / n_states) / (1 - 1 / n_states)  # e^-r
    lasting = lasting ** (1 / fps)
    eye = torch.eye(n_states, dtype=like.dtype, device=like.device)
    return lasting * eye + (1 - lasting) / n_states


def chain_step(
    log_posterior: Float[Tensor, "*#batch S"],
    log_likelihood: Float[Tensor, "*batch S"],
    log_transition: Float[Tensor, "S S"],
    share: float,
) -> Float[Tensor, "*batch S"]:
    """Take one frame of the posterior over states.

        log p(A_t | phi_1:t) = e log p(phi_t | A_t) + log sum p(A_t | A_{t-1}) p(A_{t-1} | ...) + const

    Args:
        log_posterior: of the frame before, [..., S]. log_likelihood: of this frame, [..., S].
        log_transition: [S, S]. share: e, see `evidence_share`.
    """
    moved = (log_posterior.unsqueeze(-1) + log_transition).logsumexp(-2)
    return (moved + share * log_likelihood).log_softmax(-1)


def evidence_share(evidence_rate: float, fps: float) -> float:
    """Return e = min(1, evidence_rate / fps), the power to which the likelihood of a frame counts.

    Args:
        evidence_rate: frames per second that count as independent of each other.

    >>> evidence_share(1.0, 4.0)
    0.25
    """
    return min(1.0, evidence_rate / fps)


def check_chain(n_states: int, stay: float, evidence_rate: float) -> None:
    """Raise `InputError` unless these are settings of a chain whose states last."""
    if not 1 / n_states < stay < 1:
        raise InputError(
            f"stay must lie between 1/{n_states}, where nothing lasts, and 1, got {stay:g}"
        )
    if not 0 < evidence_rate < math.inf:
        raise InputError(f"evidence_rate must be positive, got {evidence_rate:g}")
