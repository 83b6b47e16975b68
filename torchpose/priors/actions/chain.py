"""Who does what when: a Markov chain over actions, and its posterior from frame to frame."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.errors import InputError

__all__ = ["chain_step", "chain_transition", "check_chain", "evidence_share"]


def chain_transition(n_states: int, stay: float, fps: float, like: Tensor) -> Float[Tensor, "S S"]:
    """Probabilities of going from each state to each in one frame of 1 / fps seconds.

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
    """One frame of the posterior over states.

        log p(A_t | phi_1:t) = e log p(phi_t | A_t) + log sum p(A_t | A_{t-1}) p(A_{t-1} | ...) + const

    Args:
        log_posterior: of the frame before, [..., S]. log_likelihood: of this frame, [..., S].
        log_transition: [S, S]. share: e, see `evidence_share`.
    """
    moved = (log_posterior.unsqueeze(-1) + log_transition).logsumexp(-2)
    return (moved + share * log_likelihood).log_softmax(-1)


def evidence_share(evidence_rate: float, fps: float) -> float:
    """e = min(1, evidence_rate / fps), the power to which the likelihood of a frame counts.

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
