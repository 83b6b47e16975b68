"""Fit how fast recorded bodies move and turn, and how far joints of the trunk shift, to `BodyMotion`."""

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
from torchpose.priors._motion_drift import moving

_NEAR, _FAR = 1 / 30, 1 / 15  # seconds, lags between which velocities tell their decay
_DECAYS = (0.3, 15.0)  # per second
_DRIFT_LAG = 0.1  # seconds after which velocities tell mean accelerations, and what is left of them
_SHRUNK = 0.03  # information that there are no mean accelerations, in standard deviations
_LEAST_DEVIATION = 0.01  # radians, metres and radians per second
_LEAST_ACCELERATION = 0.05  # metres or radians per s^1.5
_CORRELATED = 0.9  # share of the correlations that other recordings are expected to have
_SHIFT_LAG = 0.2  # seconds
_SHIFT_TIMES = (0.05, 60.0)  # seconds; the shape of a person is for ever
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


def fit_decay(articulation: Articulation, sets: MotionSets) -> Float[Tensor, " V"]:
    """Return the decay of the velocities, E[v_t v_(t + k)] ~ exp(-decay k h), k > 0."""
    decays = torch.stack([_decay(articulation, own) for own in sets.values()])
    return _symmetric(articulation, _geometric_mean(decays, _known_of_sets(articulation, sets)))


def fit_drift(
    articulation: Articulation, sets: MotionSets, decay: Float[Tensor, " V"]
) -> Float[Tensor, "V D"]:
    """Return mean accelerations by pose and velocity, of mirrored bodies as well (`moving`).

    Every set counts alike, and tells only of what it knows. Small regressions on all of that at once would
    follow accidents of the recordings, so they are shrunk.

    Args:
        articulation: of the bodies. sets: recordings. decay: of the velocities.
    """
    told = _known_of_sets(articulation, sets).double()
    pairs = [_changes_of_set(articulation, own, decay) for own in sets.values()]
    means = torch.stack([x.mean(0) for x, _ in pairs]).mean(0)
    means[0] = 0.0
    spread = torch.stack([(x - means).square().mean(0) for x, _ in pairs]).mean(0)
    size = spread.sqrt().clamp_min(_LEAST_DEVIATION)
    squares, products = [], []
    for x, y in pairs:
        x = (x - means) / size
        squares.append(x.mT @ x / len(x))
        products.append(x.mT @ y / len(x))
    share = told / told.sum(0)
    square = torch.einsum("kv,kij->vij", share, torch.stack(squares))
    product = torch.einsum("kv,kiv->vi", share, torch.stack(products))
    shrunk = square + _SHRUNK * torch.eye(len(size), dtype=torch.float64)
    found = torch.linalg.solve(shrunk, product) / size
    found[:, 0] -= found[:, 1:] @ means[1:]
    return found


def fit_accelerations(
    articulation: Articulation, sets: MotionSets, left: Sequence[Float[Tensor, "_ V"]]
) -> Float[Tensor, " V"]:
    """Return the accelerations of position and angles that their mean leaves.

    Args:
        articulation: of the bodies. sets: recordings. left: of each set (`accelerations_left`).
    """
    powers = torch.stack([mean_squares(changes) for changes in left])
    power = _geometric_mean(powers, _known_of_sets(articulation, sets))
    return _symmetric(articulation, power).sqrt().clamp_min(_LEAST_ACCELERATION)


def _changes_of_set(
    articulation: Articulation, sequences: Sequence[MotionSequence], decay: Tensor
) -> tuple[Float[Tensor, "T D"], Float[Tensor, "T V"]]:
    """Return (1, x, v) of frames, and accelerations beside the decay in the time after them, mirrored too."""
    found = [_changes(articulation, s, decay) for s in sequences]
    y = torch.cat(clipped([rate for _, rate in found]))
    x = torch.cat([state for state, _ in found])
    mirror = mirror_of(articulation)
    own = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)  # of the position, in the root's axes
    columns = torch.cat([torch.arange(3), 3 + mirror.columns])
    sign = torch.cat([own, mirror.sign])
    n, root = articulation.n_pose, articulation.n_root
    angles, first = mirror.columns[root:] - root, x.shape[1] - n
    other = torch.cat([torch.zeros(1, dtype=torch.long), 1 + angles, first + columns])
    signs = torch.cat([torch.ones(1, dtype=torch.float64), mirror.sign[root:], sign])
    return torch.cat([x, x[:, other] * signs]), torch.cat([y, y[:, columns] * sign])


def _changes(
    articulation: Articulation, sequence: MotionSequence, decay: Tensor
) -> tuple[Float[Tensor, "T D"], Float[Tensor, "T V"]]:
    """Return (1, x, v) of frames, and mean accelerations beside the decay in the lag after each.

    Those of the position are in the axes that the root has in the frame.
    """
    lag = _drift_lag(sequence.fps)
    v = _velocities(articulation, sequence)
    n = max(len(v) - lag, 0)
    point = sequence.point.map(lambda value: value[1 : 1 + n])
    kept = torch.exp(-decay * lag / sequence.fps)
    change = v[lag : lag + n] - kept * v[:n]
    own = (point.rotations[:, 0].mT @ change[:, :3, None]).squeeze(-1)
    change = torch.cat([own, change[:, 3:]], -1)
    return moving(articulation, point, v[:n]), change * (decay / (1 - kept))


def _drift_lag(fps: float) -> int:
    return max(1, round(_DRIFT_LAG * fps))


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


def mean_squares(left: Float[Tensor, "T V"]) -> Float[Tensor, " V"]:
    """Return the mean squares of accelerations that their mean leaves (`accelerations_left`)."""
    return left.square().mean(0).clamp_min(_LEAST_ACCELERATION**2)


def fit_correlation(
    articulation: Articulation, sets: MotionSets, left: Sequence[Float[Tensor, "_ V"]]
) -> Float[Tensor, "V V"]:
    """Return how accelerations of angles correlate, those of mirrored bodies among them, mean over the sets.

    The position has none, since its axes are those of the world. Columns that a set does not tell on both
    sides have none in it.

    Args:
        articulation: of the bodies. sets: recordings. left: of each set (`accelerations_left`).
    """
    mirror, n = mirror_of(articulation), articulation.n_pose
    found = torch.zeros(n, n, dtype=torch.float64)
    for told, changes in zip(_known_of_sets(articulation, sets)[:, 3:], left, strict=True):
        told = (told & told[mirror.columns]).double()
        cov = changes[:, 3:].mT @ changes[:, 3:]
        cov = cov + cov[mirror.columns][:, mirror.columns] * torch.outer(mirror.sign, mirror.sign)
        size = cov.diagonal().sqrt().clamp_min(_LEAST_ACCELERATION)
        found[3:, 3:] += cov / torch.outer(size, size) * torch.outer(told, told) / len(sets)
    found = _CORRELATED * found
    return found.fill_diagonal_(1.0)


def accelerations_left(
    articulation: Articulation,
    sequences: Sequence[MotionSequence],
    decay: Float[Tensor, " V"],
    drift: Float[Tensor, "V D"],
) -> Float[Tensor, "T V"]:
    """Return the accelerations of a set in the lag after frames, less their mean, per root of a second.

    Frame by frame, mean velocities of an Ornstein-Uhlenbeck process have, with x = decay h and e = exp(-x),

        E[v_t^2] = q^2 / decay (x - 1 + e) / x^2,
        E[v_t v_(t + k)] = q^2 / (2 decay) (1 - e)^2 / x^2 e^(k - 1),   k > 0.

    Over a lag of several frames errors of recordings count less than in the change from one to the next.

    Args:
        articulation: of the bodies. sequences: of a set. decay: of the velocities. drift: of `fit_drift`.
    """
    changes = []
    for sequence in sequences:
        lag = _drift_lag(sequence.fps)
        state, rate = _changes(articulation, sequence, decay)
        x = decay / sequence.fps
        kept, over = torch.exp(-x), torch.exp(-x * lag)
        variance = (x - 1 + kept) / (decay * x.square())
        later = (1 - kept).square() * torch.exp(-x * (lag - 1)) / (2 * decay * x.square())
        share = variance * (1 + over.square()) - 2 * over * later
        left = (rate - state @ drift.mT) * ((1 - over) / decay)
        changes.append(left / share.sqrt())
    return torch.cat(clipped(changes))


def _known_of_sets(articulation: Articulation, sets: MotionSets) -> Bool[Tensor, "K V"]:
    """Return which columns of position and angles each set tells."""
    return torch.stack([known_columns(articulation, own) for own in sets.values()])


def _geometric_mean(values: Float[Tensor, "K V"], told: Bool[Tensor, "K V"]) -> Tensor:
    """Return the geometric mean over the sets that tell."""
    return (torch.where(told, values.log(), 0).sum(0) / told.sum(0)).exp()


def _symmetric(articulation: Articulation, values: Float[Tensor, " V"]) -> Tensor:
    """Return values that are the same in all directions and on both sides."""
    position, angles = values[:3].mean().expand(3), values[3:]
    return torch.cat([position, (angles * angles[mirror_of(articulation).columns]).sqrt()])


def fit_shifts(
    articulation: Articulation, sets: MotionSets, least: float
) -> tuple[Float[Tensor, " S"], Float[Tensor, " S"]]:
    """Return the deviation of joints from rigid parts, along each axis, and the correlation time of each."""
    variances, changes, told = [], [], []
    for own in sets.values():
        residuals = [r.flatten(1) for r in clipped([s.residual.flatten(1) for s in own])]
        known = known_joints(own)[list(articulation.shifted)]
        moved = [_moved(r, s.fps) for r, s in zip(residuals, own, strict=True)]
        squares = torch.cat(residuals).square().mean(0)
        variances.append(squares.unflatten(0, (-1, 3)).mean(-1))
        changes.append(torch.cat(moved).mean(0).unflatten(0, (-1, 3)).mean(-1))
        told.append(known)
    known = torch.stack(told)
    variance, change = (_mean_of_known(torch.stack(v), known) for v in (variances, changes))
    names = [articulation.skeleton.names[j] for j in articulation.shifted]
    other = [names.index(other_side(name)) for name in names]
    variance, change = (variance + variance[other]) / 2, (change + change[other]) / 2
    return variance.sqrt().clamp_min(least), _times(variance, change)


def _moved(residual: Float[Tensor, "T C"], fps: float) -> Float[Tensor, "_ C"]:
    """Return squares of the changes of residuals in a lag; with the last one where there are not so many."""
    lag = min(max(1, round(_SHIFT_LAG * fps)), len(residual) - 1)
    return (residual[lag:] - residual[:-lag]).square()


def _mean_of_known(values: Tensor, known: Tensor) -> Tensor:
    return torch.where(known, values, 0).sum(0) / known.sum(0).clamp_min(1)


def _times(variance: Float[Tensor, " S"], change: Float[Tensor, " S"]) -> Float[Tensor, " S"]:
    """Return times after which correlations have fallen to 1/e, from mean squares of changes in the lag."""
    share = (1 - change / (2 * variance).clamp_min(_RIGID**2)).clamp(1e-6, 1 - 1e-6)
    seconds = (-_SHIFT_LAG / share.log()).clamp(*_SHIFT_TIMES)
    return torch.where(variance > _RIGID**2, seconds, _USUAL_SHIFT_TIME)
