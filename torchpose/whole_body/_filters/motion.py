"""Move bodies from frame to frame: noise of the motion, learnt or by default, and exchanged legs.

A random walk has the noise of `default_step_std` or `motion_std`; first-order motion goes on with the
velocity of the estimate, and has that of `constant_velocity_std`."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose.body._kinematics import Body
from torchpose.body._skeleton import BodySkeleton
from torchpose.errors import InputError, SkeletonError, check_finite, check_shape
from torchpose.filters._base import Generators, uniform
from torchpose.math._rotations import compose, conjugate
from torchpose.whole_body._filters.body_particles import PoseSpace

__all__ = [
    "as_step_std",
    "check_leg_swap",
    "constant_velocity_std",
    "default_step_std",
    "exchange_legs",
    "extra_copies",
    "leg_angle",
    "leg_permutation",
    "motion_std",
    "next_velocity",
    "rescale_std",
    "std_of_covariance",
    "swap_legs",
]

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
    """
    std = torch.full((body.dim,), _PART_STD, dtype=torch.float64)
    std[:3], std[3:6] = _POSITION_STD, _HEADING_STD
    return std if fps == _RATE else std * (_RATE / _positive("fps", fps)) ** _DIFFUSION_POWER


def motion_std(
    body: PoseSpace, states: Float[Tensor, "T D"] | Sequence[Tensor], floor: float = 0.0
) -> Float[Tensor, " D"]:
    """Return the root mean square change of recorded states from frame to frame, for `step_std`.

    Args:
        states: one sequence [T, D], or several. Frames with NaN are passed over.
        floor: no element is smaller. The twist of a limb, which no joint shows, does not vary in
            recorded states: with 0 it stays as it is.

    Raises:
        InputError: no two frames that follow each other.
    """
    sequences = [states] if isinstance(states, Tensor) else list(states)
    steps = torch.cat([body.difference(s[1:], s[:-1]) for s in sequences])
    steps = steps[torch.isfinite(steps).all(-1)]
    if len(steps) == 0:
        raise InputError("states must hold two frames that follow each other, got none")
    return steps.square().mean(0).sqrt().clamp_min(floor)


def std_of_covariance(name: str, cov: Tensor, dim: int) -> Float[Tensor, " D"]:
    """Return the standard deviations of a diagonal covariance.

    Args:
        name: of the argument. cov: variances [D], or the diagonal matrix [D, D], in squares of the units
            of a step. dim: D.

    Raises:
        ShapeError: another size. InputError: negative or infinite variances, or entries off the diagonal:
        the filters let every column of a state diffuse by itself.

    >>> std_of_covariance("process_cov", torch.tensor([4.0, 9.0]), 2)
    tensor([2., 3.])
    """
    if cov.ndim == 2:
        check_shape(name, cov, [dim, dim])
        if bool((cov - torch.diag(cov.diagonal())).any()):
            raise InputError(
                f"{name} must be diagonal, [{dim}] or [{dim}, {dim}], got other entries"
            )
        cov = cov.diagonal()
    check_shape(name, cov, [dim])
    check_finite(name, cov)
    if bool((cov < 0).any()):
        raise InputError(f"{name} must not be negative, got {float(cov.min()):g}")
    return cov.sqrt()


def as_step_std(body: PoseSpace, value: Tensor | float | None) -> Float[Tensor, " D"]:
    """Return the `step_std` of a filter, checked, in the dtype and on the device of the body.

    Raises:
        ShapeError: not [D]. InputError: not finite, or negative.
    """
    std = default_step_std(body) if value is None else torch.as_tensor(value).detach()
    std = std if std.is_floating_point() else std.double()
    if std.ndim == 0:
        std = std.double().expand(body.dim)
    check_shape("step_std", std, [body.dim])
    check_finite("step_std", std)
    if bool((std < 0).any()):
        raise InputError(f"step_std must not be negative, got {float(std.min()):g}")
    if isinstance(body, nn.Module):
        std = std.to(next((b for b in body.buffers() if b.is_floating_point()), std))
    return std.clone()


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
    """Return the noise of a constant velocity model for another time between frames.

    sigma' = sigma (dt' / dt)^(3/2), exact where accelerations are white noise.

    Args:
        std: for frames that are `interval` apart. target_interval: in the same unit.

    >>> rescale_std(torch.ones(1), 1 / 30, 1 / 60)
    tensor([0.3536])
    """
    ratio = _positive("target_interval", target_interval) / _positive("interval", interval)
    return std * ratio**_RATE_POWER


def _errors(body: PoseSpace, states: Tensor, rate: float) -> Tensor:
    """Return what is missed in every frame but the first two, [T - 2, D]."""
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


_LEG_PARTS = ("thigh", "shank")
_ROOT_COLUMNS = 3  # the position; the vectors of all parts follow


def leg_permutation(skeleton: BodySkeleton) -> Int[Tensor, " P"]:
    """Return the indices of the parts with those of the left and the right leg exchanged.

    Args:
        skeleton: with the parts left_thigh, left_shank, right_thigh and right_shank.

    Raises:
        SkeletonError: it lacks one of them.

    >>> from torchpose.body._skeleton import BODY_15
    >>> leg_permutation(BODY_15).tolist()
    [0, 1, 2, 3, 4, 9, 10, 7, 8, 5, 6]
    """
    order = torch.arange(len(skeleton.parts))
    for part in _LEG_PARTS:
        left, right = skeleton.part(f"left_{part}"), skeleton.part(f"right_{part}")
        order[left], order[right] = right, left
    return order


def leg_angle(body: Body, states: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch"]:
    """Return the angle between the upper legs, theta_legs, radians from 0 to pi.

    Args:
        states: of `body`, [..., D].
    """
    thighs = [body.skeleton.part(f"{side}_thigh") for side in ("left", "right")]
    bones = [_bone(body, thigh) for thigh in thighs]
    rotations = body.part_rotations(states)[..., thighs, :, :]
    left, right = (rotations @ torch.stack(bones).unsqueeze(-1)).squeeze(-1).unbind(-2)
    across = torch.linalg.cross(left, right).norm(dim=-1)
    return torch.atan2(across, (left * right).sum(-1))  # an arccos would be NaN beyond 1


def exchange_legs(body: Body, states: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch D"]:
    """Return states whose left leg is turned as the right one was, and the other way round.

    C_l R(q_l') = C_r R(q_r),   C_r R(q_r') = C_l R(q_l)

    Doing so twice changes nothing.
    """
    order = leg_permutation(body.skeleton).to(states.device)
    centres = body.centres.to(states)
    vectors = states[..., _ROOT_COLUMNS:].unflatten(-1, (-1, 3))
    moved = order != torch.arange(len(order), device=order.device)
    shift = compose(conjugate(centres[moved]), centres[order[moved]])
    exchanged = vectors.clone()
    exchanged[..., moved, :] = compose(shift, vectors[..., order[moved], :])
    return torch.cat([states[..., :_ROOT_COLUMNS], exchanged.flatten(-2)], -1)


def extra_copies(ancestors: Int[Tensor, "B N"]) -> Bool[Tensor, "B N"]:
    """Tell which particles are copies beside the first one of the same ancestor.

    Args:
        ancestors: of the resampled particles, in any order.

    >>> extra_copies(torch.tensor([[2, 0, 2, 2, 3]])).tolist()
    [[False, False, True, True, False]]
    """
    ordered, place = ancestors.sort(dim=-1, stable=True)
    again = torch.zeros_like(ordered, dtype=torch.bool)
    again[..., 1:] = ordered[..., 1:] == ordered[..., :-1]
    return torch.zeros_like(again).scatter(-1, place, again)


def swap_legs(
    body: Any,
    particles: Float[Tensor, "B N D"],
    copies: Bool[Tensor, "B N"],
    rate: float,
    generator: Generators = None,
) -> tuple[Float[Tensor, "B N D"], Bool[Tensor, "B N"]]:
    """Exchange the legs of some extra copies of particles, the more often the wider they are apart.

    p(swap) = rate theta_legs / pi,   theta_legs the angle between the upper legs

    The first copy of every particle keeps its legs, and so does everything that was not resampled.

    Args:
        particles: [B, N, D], resampled. copies: those that may be swapped, see `extra_copies`.
        rate: probability for legs in opposite directions, 0 to 1.
        generator: as for `standard_normal`; nothing is drawn at a rate of 0.

    Returns:
        The particles, and which of them were swapped.

    Raises:
        InputError, SkeletonError: as `check_leg_swap`.

    Reference: Daubney & Xie, section 8: an extra copy of a particle is occasionally kept with the
    legs swapped, and the number of particles stays the same.
    """
    check_leg_swap(body, rate)
    if rate == 0:
        return particles, torch.zeros_like(copies)
    batch, n = particles.shape[:2]
    drawn = uniform(batch, (n,), generator, particles)
    swapped = copies & (drawn < rate * leg_angle(body, particles) / torch.pi)
    return torch.where(swapped[..., None], exchange_legs(body, particles), particles), swapped


def check_leg_swap(body: Any, rate: float) -> None:
    """Raise unless the legs of a body can be swapped at this rate.

    Raises:
        InputError: a rate that is not from 0 to 1. SkeletonError: a body without upper and lower legs.
    """
    if not 0 <= rate <= 1:
        raise InputError(f"leg_swap must be a probability, from 0 to 1, got {rate}")
    if rate == 0:
        return
    if not isinstance(body, Body):
        raise SkeletonError(
            f"leg_swap needs a torchpose.body.Body with two legs, got {type(body).__name__}; set "
            "leg_swap=0"
        )
    leg_permutation(body.skeleton)


def _bone(body: Body, part: int) -> Float[Tensor, "3"]:
    """Return the offset of the first joint that a part carries."""
    carried = [j for j, p in enumerate(body.skeleton.part_of) if p == part]
    if not carried:
        name = body.skeleton.parts[part]
        raise SkeletonError(f"part {name!r} carries no joint, so that it has no direction")
    return body.offsets[carried[0]]
