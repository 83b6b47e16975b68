"""Compute the noise of the motion from frame to frame, learnt or by default, and velocities.

A random walk has the noise of `default_step_std` or `motion_std`; first-order motion goes on with the
velocity of the estimate, and has that of `constant_velocity_std`.
"""

import warnings
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose._core.checks import (
    check_finite,
    check_positive,
    check_shape,
    check_tensors,
    number_of,
)
from torchpose.errors import InputError
from torchpose.whole_body._filters.body_particles import PoseSpace

# Per frame at 60 Hz, about twice the motion of a walk: metres, then sines of half angles.
_POSITION_STD, _HEADING_STD, _PART_STD = 0.015, 0.015, 0.03
_RATE = 60.0  # frames per second for which these are
_DIFFUSION_POWER = 0.5  # of the interval: steps of a random walk are independent of each other
_RATE_POWER = 1.5  # of the interval, if accelerations are independent of each other


# --- a random walk --------------------------------------------------------------------------------


def default_step_std(body: PoseSpace, fps: float = _RATE) -> Float[Tensor, " D"]:
    """Return a diffusion per frame that is about twice the motion of a walk.

    At 60 Hz it is 15 mm for the root, 1.7 degrees for its orientation and 3.4 degrees for parts; it
    grows with the root of the time between frames.

    Args:
        body: of D columns. fps: frames per second.

    Returns:
        [D], standard deviation per frame: metres, and sines of half angles.

    Raises:
        InputError: a frame rate that is not positive.
    """
    std = torch.full((body.dim,), _PART_STD, dtype=torch.float64)
    std[:3], std[3:6] = _POSITION_STD, _HEADING_STD
    return std if fps == _RATE else std * (_RATE / check_positive("fps", fps)) ** _DIFFUSION_POWER


def motion_std(
    body: PoseSpace, states: Float[Tensor, "T D"] | Sequence[Tensor], floor: float = 0.0
) -> Float[Tensor, " D"]:
    """Return the root mean square change of recorded states from frame to frame.

    Its square is a `process_cov` of the filters.

    Args:
        body: of D columns, which tells how rotations differ.
        states: one sequence [T, D], or several. Frames with NaN are passed over.
        floor: no element is smaller. The twist of a limb, which no joint shows, does not vary in
            recorded states: with 0 it stays as it is.

    Returns:
        [D], standard deviation per frame: metres, and sines of half angles.

    Raises:
        InputError: no two frames that follow each other.
    """
    changes = [body.difference(s[1:], s[:-1]) for s in _sequences(states)]
    steps = torch.cat(changes) if changes else torch.empty(0, body.dim)
    steps = steps[torch.isfinite(steps).all(-1)]
    if len(steps) == 0:
        raise InputError("states must hold two frames that follow each other, got none")
    return steps.square().mean(0).sqrt().clamp_min(floor)


def std_of_covariance(name: str, cov: Tensor | float, dim: int) -> Float[Tensor, " D"]:
    """Return the standard deviations of a diagonal covariance.

    Args:
        name: of the argument. cov: variances [D], the diagonal matrix [D, D], or one variance for all
            columns, in squares of the units of a step. dim: D.

    Raises:
        ShapeError: another size. InputError: negative or infinite variances, or entries off the diagonal,
        which the filters do not support.

    >>> std_of_covariance("process_cov", torch.tensor([4.0, 9.0]), 2)
    tensor([2., 3.])
    """
    cov = _floating(cov)
    if cov.ndim == 2:
        check_shape(name, cov, [dim, dim])
        if bool((cov - torch.diag(cov.diagonal())).any()):
            raise InputError(
                f"{name} must be diagonal, [{dim}] or [{dim}, {dim}], got other entries"
            )
        cov = cov.diagonal()
    return _not_negative(name, cov, dim).sqrt()


def diffusion_std(
    body: PoseSpace, process_cov: Tensor | float | None, step_std: Tensor | float | None
) -> Float[Tensor, " D"]:
    """Return the standard deviations of a filter's diffusion, in the dtype and on the device of the body.

    Args:
        body: of D columns. process_cov: as `std_of_covariance` takes it; the square of
            `default_step_std` if None. step_std: deprecated, the deviations [D] or one number, instead.

    Raises:
        ShapeError, InputError: as `std_of_covariance`, or both arguments are given.
    """
    if process_cov is not None and step_std is not None:
        raise InputError("process_cov and step_std say the same; leave one of them out")
    if step_std is not None:
        warnings.warn(
            "step_std is deprecated and goes with version 0.3.0; give its square as process_cov",
            DeprecationWarning,
            stacklevel=4,
        )
        std = _not_negative("step_std", _floating(step_std), body.dim)
    elif process_cov is not None:
        std = std_of_covariance("process_cov", process_cov, body.dim)
    else:
        std = default_step_std(body)
    if isinstance(body, nn.Module):
        std = std.to(next((b for b in body.buffers() if b.is_floating_point()), std))
    return std.clone()


def _floating(value: Tensor | float) -> Tensor:
    """Return a tensor as it is if it holds floating-point numbers, anything else in double precision."""
    value = torch.as_tensor(value, dtype=None if isinstance(value, Tensor) else torch.float64)
    return value.detach() if value.is_floating_point() else value.double()


def _not_negative(name: str, value: Tensor, dim: int) -> Float[Tensor, " D"]:
    """Return values [D], one repeated for every column, or raise unless all are finite and not negative."""
    value = value.double().expand(dim) if value.ndim == 0 else value
    check_shape(name, value, [dim])
    check_finite(name, value)
    if bool((value < 0).any()):
        raise InputError(f"{name} must not be negative, got {float(value.min()):g}")
    return value


# --- first-order motion ---------------------------------------------------------------------------


def next_velocity(
    body: PoseSpace,
    velocity: Float[Tensor, "*batch D"],
    estimate: Float[Tensor, "*batch D"],
    before: Float[Tensor, "*batch D"],
    rate: float = 0.5,
) -> Float[Tensor, "*batch D"]:
    """Return the velocity per frame, smoothed over the estimates so far.

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
    """Return sigma_phi: how far a constant velocity model misses the next frame of recorded states.

    e_t = phi_{t+1} - (phi_t + V_t),   sigma_phi = root mean square of e

    The paper has the "standard deviation of the average error committed" by a constant velocity model;
    e is taken per entry and over all frames of all sequences.

    Args:
        body: of D columns, which tells how rotations differ.
        sequences: states [T, D] of one sequence, or of several. Frames with NaN are passed over.
        fps: the frame rate of the sequences.
        target_fps: of the frames to be tracked; None is the same rate. Where it is lower the model
            predicts over as many frames at a time; what is left, and higher rates, go by
            `rescale_std`.
        velocity_rate: a of V (`next_velocity`); 0 is plain constant velocity. With the rate of the
            filter the noise also covers how far its velocity lags behind.
        floor: no entry is smaller. The twist of a limb, which no joint shows, does not vary in
            recorded states.

    Returns:
        [D], in the units of a step (`Body.perturb`), per frame of `target_fps`.

    Raises:
        InputError: no three frames in a row, a `velocity_rate` that is not from 0 to below 1, a
            frame rate that is not positive, or a `target_fps` without the rate of the sequences.

    Reference: AS, section 3.1, after equation (3).
    """
    if not 0 <= number_of(velocity_rate) < 1:
        raise InputError(f"velocity_rate must be from 0 to below 1, got {velocity_rate}")
    if fps is None and target_fps is not None:
        raise InputError(
            f"target_fps={target_fps:g} needs the frame rate of the sequences; give fps as well"
        )
    states = _sequences(sequences)
    stride, ratio = 1, 1.0
    if fps is not None and target_fps is not None:
        ratio = check_positive("fps", fps) / check_positive("target_fps", target_fps)
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
    """Return the noise of a constant velocity model for another time between frames.

    sigma' = sigma (dt' / dt)^(3/2), exact where accelerations are white noise.

    Args:
        std: for frames that are `interval` apart. target_interval: in the same unit.

    >>> rescale_std(torch.ones(1), 1 / 30, 1 / 60)
    tensor([0.3536])
    """
    ratio = check_positive("target_interval", target_interval) / check_positive(
        "interval", interval
    )
    return std * ratio**_RATE_POWER


def _sequences(states: Tensor | Sequence[Tensor]) -> list[Tensor]:
    """Return one or several sequences as a list, or raise `InputError` or `ShapeError` for what are none."""
    parts: list[Any] = [states] if hasattr(states, "shape") else list(states)
    for part in parts:
        check_tensors(states=part)
        check_shape("states", part, ["T", "D"])
    return parts


def _errors(body: PoseSpace, states: Tensor, rate: float) -> Tensor:
    """Return the prediction errors in every frame but the first two, [T - 2, D]."""
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
