"""Fit how fast recorded bodies move and turn, and how far joints of the trunk shift, to `BodyMotion`."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.body._articulation import Articulation, mirror_of
from torchpose.body._skeleton import other_side
from torchpose.errors import InputError
from torchpose.learning._motion_sequences import (
    MotionSequence,
    MotionSets,
    clipped,
    known_columns,
    known_joints,
)

_NEAR, _FAR = 1 / 30, 1 / 15  # seconds, lags between which velocities tell their decay
_DECAYS = (0.3, 15.0)  # per second
_LEAST_ACCELERATION = 0.05  # metres or radians per s^1.5
_CORRELATED = 0.9  # share of the correlations that other recordings are expected to have
_SHIFT_LAG = 0.2  # seconds
_SHIFT_TIMES = (0.05, 5.0)  # seconds; the shape of a person is for ever
_USUAL_SHIFT_TIME = 0.5  # seconds, where trunks are rigid
_RIGID = 1e-4  # metres


def long_enough(sequences: Sequence[MotionSequence]) -> list[MotionSequence]:
    """Return the sequences whose velocities tell their decay."""
    found = [s for s in sequences if len(s.residual) > _lags(s.fps)[1] + 2]
    if not found:
        longest = max((len(s.residual) for s in sequences), default=0)
        raise InputError(
            f"body motion needs recordings of at least {_FAR:.2f} seconds and three frames, the longest "
            f"has {longest} frames; add longer ones"
        )
    return found


def _lags(fps: float) -> tuple[int, int]:
    """Return the lags in frames between which velocities tell their decay."""
    near = max(1, round(_NEAR * fps))
    return near, near + max(1, round((_FAR - _NEAR) * fps))


def fit_velocities(articulation: Articulation, sets: MotionSets) -> tuple[Tensor, Tensor]:
    """Return acceleration and decay [V] of position and angles.

    Frame by frame, mean velocities of an Ornstein-Uhlenbeck process have

        E[v_t v_(t + k)] ~ exp(-decay k h),   k > 0,
        E[(v_(t + 1) - v_t)^2] = q^2 / decay (2 (x - 1 + e) - (1 - e)^2) / x^2,   x = decay h,  e = exp(-x).
    """
    powers, decays, known = [], [], []
    for own in sets.values():
        decay = _decay(articulation, own)
        powers.append(squared_accelerations(articulation, own, decay))
        decays.append(decay)
        known.append(known_columns(articulation, own))
    told = torch.stack(known)
    power = _geometric_mean(torch.stack(powers), told)
    return (
        _alike(articulation, power).sqrt().clamp_min(_LEAST_ACCELERATION),
        _alike(articulation, _geometric_mean(torch.stack(decays), told)),
    )


def _velocities(articulation: Articulation, sequence: MotionSequence) -> Float[Tensor, "T V"]:
    """Return the mean velocities between frames."""
    later = sequence.point.map(lambda value: value[1:])
    sooner = sequence.point.map(lambda value: value[:-1])
    return articulation.difference(later, sooner)[:, : articulation.n_pose] * sequence.fps


def _decay(articulation: Articulation, sequences: Sequence[MotionSequence]) -> Float[Tensor, " V"]:
    velocities = clipped([_velocities(articulation, s) for s in sequences])
    near, far = torch.zeros_like(velocities[0][0]), torch.zeros_like(velocities[0][0])
    between, count = 0.0, 0
    for sequence, v in zip(sequences, velocities, strict=True):
        first, second = _lags(sequence.fps)
        n = len(v) - second
        near = near + (v[:n] * v[first : first + n]).sum(0)
        far = far + (v[:n] * v[second:]).sum(0)
        between, count = between + n * (second - first) / sequence.fps, count + n
    ratio = far.clamp_min(0) / near.clamp_min(1e-12)
    return (-ratio.clamp(1e-12, 1.0).log() * (count / between)).clamp(*_DECAYS)


def squared_accelerations(
    articulation: Articulation, sequences: Sequence[MotionSequence], decay: Tensor
) -> Float[Tensor, " V"]:
    """Return the squares of the accelerations of a set."""
    changes = _accelerations(articulation, sequences, decay)
    return changes.square().mean(0).clamp_min(_LEAST_ACCELERATION**2)


def fit_correlation(
    articulation: Articulation, sets: MotionSets, decay: Float[Tensor, " V"]
) -> Float[Tensor, "V V"]:
    """Return how accelerations of angles correlate, those of mirrored bodies among them, mean over the sets.

    The position has none, since its axes are those of the world. Columns that a set does not tell on both
    sides have none in it.

    Args:
        articulation: of the bodies. sets: recordings. decay: of the velocities.
    """
    mirror = mirror_of(articulation)
    found = torch.zeros(len(decay), len(decay), dtype=torch.float64)
    for own in sets.values():
        told = known_columns(articulation, own)[3:]
        told = (told & told[mirror.columns]).double()
        changes = _accelerations(articulation, own, decay)[:, 3:]
        cov = changes.mT @ changes
        cov = cov + cov[mirror.columns][:, mirror.columns] * torch.outer(mirror.sign, mirror.sign)
        size = cov.diagonal().sqrt().clamp_min(_LEAST_ACCELERATION)
        found[3:, 3:] += cov / torch.outer(size, size) * torch.outer(told, told) / len(sets)
    found = _CORRELATED * found
    return found.fill_diagonal_(1.0)


def _accelerations(
    articulation: Articulation, sequences: Sequence[MotionSequence], decay: Tensor
) -> Float[Tensor, "T V"]:
    """Return the accelerations between frames of a set, per root of a second."""
    changes = []
    for sequence in sequences:
        v = _velocities(articulation, sequence)
        x = decay / sequence.fps
        kept = torch.exp(-x)
        share = (2 * (x - 1 + kept) - (1 - kept).square()) / (decay * x.square())
        changes.append((v[1:] - v[:-1]) / share.sqrt())
    return torch.cat(clipped(changes))


def _geometric_mean(values: Float[Tensor, "K V"], told: Bool[Tensor, "K V"]) -> Tensor:
    """Return the geometric mean over the sets that tell."""
    return (torch.where(told, values.log(), 0).sum(0) / told.sum(0)).exp()


def _alike(articulation: Articulation, values: Float[Tensor, " V"]) -> Tensor:
    """Return values that are the same in all directions and on both sides."""
    position, angles = values[:3].mean().expand(3), values[3:]
    return torch.cat([position, (angles * angles[mirror_of(articulation).columns]).sqrt()])


def fit_shifts(
    articulation: Articulation, sets: MotionSets, least: float
) -> tuple[Float[Tensor, " S"], Float[Tensor, "1"]]:
    """Return the deviation of joints from rigid parts, along each axis, and its correlation time."""
    variances, later, told = [], [], []
    for own in sets.values():
        residuals = [r.flatten(1) for r in clipped([s.residual.flatten(1) for s in own])]
        known = known_joints(own)[list(articulation.shifted)]
        pairs = [_lagged(r, s.fps) for r, s in zip(residuals, own, strict=True)]
        squares = torch.cat(residuals).square().mean(0)
        variances.append(squares.unflatten(0, (-1, 3)).mean(-1))
        later.append(torch.cat(pairs).mean(0).unflatten(0, (-1, 3)).mean(-1))
        told.append(known)
    known = torch.stack(told)
    variance, product = (_mean_of_known(torch.stack(v), known) for v in (variances, later))
    names = [articulation.skeleton.names[j] for j in articulation.shifted]
    other = [names.index(other_side(name)) for name in names]
    variance = (variance + variance[other]) / 2
    return variance.sqrt().clamp_min(least), _time(float(variance.sum()), float(product.sum()))


def _lagged(residual: Float[Tensor, "T C"], fps: float) -> Float[Tensor, "_ C"]:
    """Return products of residuals with those a lag later; with the last one where there are not so many."""
    lag = min(max(1, round(_SHIFT_LAG * fps)), len(residual) - 1)
    return residual[:-lag] * residual[lag:]


def _mean_of_known(values: Tensor, known: Tensor) -> Tensor:
    return torch.where(known, values, 0).sum(0) / known.sum(0).clamp_min(1)


def _time(variance: float, product: float) -> Float[Tensor, "1"]:
    """Return the time after which a correlation has fallen to 1/e, from that after the lag."""
    seconds = _USUAL_SHIFT_TIME
    if variance > _RIGID**2:
        share = min(max(product / variance, 1e-6), 1 - 1e-6)
        seconds = min(max(-_SHIFT_LAG / math.log(share), _SHIFT_TIMES[0]), _SHIFT_TIMES[1])
    return torch.tensor([seconds], dtype=torch.float64)
