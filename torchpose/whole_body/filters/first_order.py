"""First-order motion of body poses: the velocity of the estimate, and the noise that goes with it."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.errors import InputError
from torchpose.whole_body.filters.body_particles import PoseSpace

__all__ = ["constant_velocity_std", "next_velocity", "rescale_std"]

_RATE_POWER = 1.5  # of the interval, if accelerations are independent of each other


def next_velocity(
    body: PoseSpace,
    velocity: Float[Tensor, "*batch D"],
    estimate: Float[Tensor, "*batch D"],
    before: Float[Tensor, "*batch D"],
    rate: float = 0.5,
) -> Float[Tensor, "*batch D"]:
    """Velocity per frame, smoothed over the estimates so far.

    V_t = a V_{t-1} + (1 - a)(phi_{t-1} - phi_{t-2})

    with the difference of two states, `body.difference`: the root's orientation by the turn between
    them. It is what the prediction of frame t adds, so that the latest known difference counts.

    Args:
        velocity: V_{t-1}. estimate: phi_{t-1}. before: phi_{t-2}. All [..., D].
        rate: a, from 0 (the last difference alone) to below 1.

    Reference: AS, section 3.1.
    """
    return rate * velocity + (1 - rate) * body.difference(estimate, before)


def constant_velocity_std(
    body: PoseSpace,
    sequences: Float[Tensor, "T D"] | Sequence[Tensor],
    fps: float | None = None,
    target_fps: float | None = None,
    *,
    velocity_rate: float = 0.0,
    floor: float = 0.0,
) -> Float[Tensor, " D"]:
    """sigma_phi: how far a constant velocity model misses the next frame of recorded states.

    e_t = phi_{t+1} - (phi_t + V_t),   sigma_phi = root mean square of e

    The paper has the "standard deviation of the average error committed" by a constant velocity model;
    e is taken per entry and over all frames of all sequences.

    Args:
        sequences: states [T, D] of one sequence, or of several. Frames with NaN are passed over.
        fps: of the sequences. target_fps: of the frames to be tracked. Where it is lower the model
            predicts over as many frames at a time; what is left, and higher rates, go by
            `rescale_std`. None: the same rate.
        velocity_rate: a of V (`next_velocity`); 0 is plain constant velocity. With the rate of the
            filter the noise also covers how far its velocity lags behind.
        floor: no entry is smaller. The twist of a limb, which no joint shows, does not vary in
            recorded states.

    Returns:
        [D], in the units of a step (`Body.perturb`), per frame of `target_fps`.

    Raises:
        InputError: no three frames in a row, or a frame rate that is not positive.

    Reference: AS, section 3.1, after equation (3).
    """
    states = [sequences] if isinstance(sequences, Tensor) else list(sequences)
    stride, ratio = 1, 1.0
    if fps is not None and target_fps is not None:
        ratio = _positive("fps", fps) / _positive("target_fps", target_fps)
        stride = max(round(ratio), 1)
    slices = [one[first::stride] for one in states for first in range(stride)]
    errors = [_errors(body, one, velocity_rate) for one in slices if len(one) > 2]
    known = torch.cat(errors) if errors else torch.empty(0, body.dim)
    known = known[torch.isfinite(known).all(-1)]
    if len(known) == 0:
        raise InputError(
            f"states must hold three frames {stride} apart that follow each other, got none"
        )
    std = known.square().mean(0).sqrt()
    return rescale_std(std, stride, ratio).clamp_min(floor)


def rescale_std(
    std: Float[Tensor, " D"], interval: float, target_interval: float
) -> Float[Tensor, " D"]:
    """Noise of a constant velocity model for another time between frames.

    sigma' = sigma (dt' / dt)^(3/2), exact where accelerations are white noise.

    Args:
        std: for frames that are `interval` apart. target_interval: in the same unit.

    >>> rescale_std(torch.ones(1), 1 / 30, 1 / 60)
    tensor([0.3536])
    """
    ratio = _positive("target_interval", target_interval) / _positive("interval", interval)
    return std * ratio**_RATE_POWER


def _errors(body: PoseSpace, states: Tensor, rate: float) -> Tensor:
    """What is missed in every frame but the first two, [T - 2, D]."""
    velocity = body.difference(states[1:-1], states[:-2])
    if rate > 0:
        velocity = _smoothed(velocity, rate)
    return body.difference(states[2:], body.perturb(states[1:-1], velocity))


def _smoothed(steps: Tensor, rate: float) -> Tensor:
    velocity, smoothed = torch.zeros_like(steps[0]), []
    for step in steps:
        velocity = rate * velocity + (1 - rate) * step.nan_to_num()  # a gap leads nowhere
        smoothed.append(velocity)
    return torch.stack(smoothed)


def _positive(name: str, value: float) -> float:
    if not 0 < value < float("inf"):
        raise InputError(f"{name} must be positive and finite, got {value}")
    return value
