"""Fit what `BodyMotion` holds to recorded bodies: how they move, which poses they take, how they are built.

Every set of recordings is looked at by itself, and the sets are then combined with equal weight, so that a
large one does not decide. A set says nothing about parts whose joint it lacks. Left and right are one.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose._core.checks import check_rate
from torchpose.body._articulation import Articulation, BodyPoint
from torchpose.body._kinematics import Body
from torchpose.body._skeleton import other_side
from torchpose.errors import InputError
from torchpose.math._rotations import quaternion_vector_to_matrix
from torchpose.priors._body_motion import BodyMotion
from torchpose.priors._gaussian_mixture import GaussianMixture

_NEAR, _FAR = 1 / 30, 1 / 15  # seconds, lags between which velocities tell their decay
_DECAYS = (0.3, 15.0)  # per second
_LEAST_ACCELERATION = 0.05  # metres or radians per s^1.5
_GLITCHES = 0.005  # share of frames whose changes count no more than those of the others
_SHIFT_LAG = 0.2  # seconds
_SHIFT_TIMES = (0.05, 5.0)  # seconds; the shape of a person is for ever
_USUAL_SHIFT_TIME = 0.5  # seconds, where trunks are rigid
_RIGID = 1e-4  # metres
_POSE_RATE = 10.0  # frames per second that poses are drawn from
_USUAL_SIZE, _USUAL_BUILD = 0.08, 0.05  # of log lengths over persons: of all alike, and of each
_USUAL_DEFINITION = {"hip": 0.3, "neck": 0.12, "shoulder": 0.1}  # of log lengths over joint sets
_USUAL_PERSONS, _USUAL_SETS = 10, 2  # persons and sets that the usual spread counts as


@dataclass(frozen=True)
class BodyMotionRecipe:
    """Holds the settings of the fit of a `BodyMotion`.

    Args:
        n_components: of the mixture over poses, an even number: half of them are mirror images.
        n_samples: poses that it is fitted to, before they are mirrored.
        covariance_floor: of the mixture, relative to the variance of each angle.
        acceleration_scale: factor on the accelerations, for motion that is not in the recordings.
        least_shift: metres, least standard deviation of shifts, for joints that recordings hold rigid.
        pull_time: seconds in which poses tend towards the mixture where nothing is measured.
        seed: of the drawn poses and of the mixture's start.
    """

    n_components: int = 16
    n_samples: int = 12000
    covariance_floor: float = 0.06
    acceleration_scale: float = 1.45
    least_shift: float = 0.01
    pull_time: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.n_components < 2 or self.n_components % 2:
            raise InputError(f"n_components must be even and positive, got {self.n_components}")
        if self.n_samples < self.n_components:
            raise InputError(f"n_samples must be at least n_components, got {self.n_samples}")
        for name in ("covariance_floor", "acceleration_scale", "least_shift", "pull_time"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise InputError(f"{name} must be positive and finite, got {value:g}")


class MotionSequence(NamedTuple):
    """Holds the motion of one person in one recording without gaps.

    Attributes:
        origin: the set that the recording is of. person: its id. fps: frames per second.
        point: [T], on the manifold of the articulation. residual: [T, S, 3], metres, of recorded joints of
            the trunk from where parts of the standard shape and the person's lengths have them, part axes.
            lengths: [J], metres, of the person's bones. known: [J], whether the set has the joint.
    """

    origin: str
    person: str
    fps: float
    point: BodyPoint
    residual: Tensor
    lengths: Tensor
    known: Tensor


class Mirror(NamedTuple):
    """Holds which column [R] of rotations the mirror image has in place of each, and its sign [R]."""

    columns: Tensor
    sign: Tensor


def mirror_of(articulation: Articulation) -> Mirror:
    """Return what mirroring left and right does to the angles of an articulation.

    In a mirror across x, rotation vectors (x, y, z) become (x, -y, -z), of the part on the other side.
    """
    parts = articulation.skeleton.parts
    places = list(zip(articulation.axis_part.tolist(), articulation.axis.tolist(), strict=True))
    other = [(parts.index(other_side(parts[p])), a) for p, a in places]
    sign = [1.0 if a == 0 else -1.0 for _, a in places]
    columns = torch.tensor([places.index(place) for place in other])
    return Mirror(columns, torch.tensor(sign, dtype=torch.float64))


def motion_sequence(
    articulation: Articulation,
    body: Body,
    states: Float[Tensor, "T D"],
    joints: Float[Tensor, "T J 3"],
    fps: float,
    person: str,
    origin: str | None = None,
) -> MotionSequence:
    """Return a recording as motion of an articulation.

    Args:
        articulation: whose centres the body has. body: of the person. states: fitted to the joints.
        joints: [T, J, 3], metres; NaN in all frames where the set lacks a joint. fps: of both.
        person: id, `origin#name`. origin: of the set that the recording is of; by default that in the id.
    """
    check_rate("fps", fps)
    n, shifted = len(states), list(articulation.shifted)
    point = BodyPoint(
        states[:, :3],
        quaternion_vector_to_matrix(states[:, 3:].unflatten(-1, (-1, 3))),
        states.new_zeros(n, articulation.n_pose),
        states.new_zeros(n, len(articulation.groups)),
        states.new_zeros(n, len(shifted), 3),
    )
    parents = [articulation.skeleton.parents[j] for j in shifted]
    carried = articulation.world_rotations(point)[:, articulation.part_of[shifted]]
    bones = (joints[:, shifted] - joints[:, parents]).to(states)
    standard = nn.functional.normalize(articulation.offsets[shifted], dim=-1)
    rigid = body.bone_lengths[shifted, None] * standard
    residual = (carried.mT @ bones[..., None]).squeeze(-1) - rigid
    known = joints.isfinite().all(-1).all(0)
    origin = person.partition("#")[0] if origin is None else origin
    return MotionSequence(origin, person, fps, point, residual, body.bone_lengths, known)


def fit_body_motion(
    sequences: Sequence[MotionSequence],
    recipe: BodyMotionRecipe | None = None,
) -> BodyMotion:
    """Fit how bodies move, their poses and proportions to recorded motion.

    Args:
        sequences: of all recordings. recipe: settings.

    Returns:
        `BodyMotion` in float64.

    Raises:
        InputError: too few frames in a row, or a joint that no set has.
    """
    recipe, articulation = recipe or BodyMotionRecipe(), Articulation()
    sets = _by_origin(_long_enough(sequences))
    _check_joints(articulation, sets)
    acceleration, decay = _fit_velocities(articulation, sets)
    shift_std, shift_time = _fit_shifts(articulation, sets, recipe.least_shift)
    scale_mean, scale_cov = _fit_scales(articulation, sets)
    return BodyMotion(
        recipe.acceleration_scale * acceleration,
        decay,
        shift_std,
        shift_time,
        torch.tensor([recipe.pull_time], dtype=torch.float64),
        scale_mean,
        scale_cov,
        _fit_poses(articulation, sets, recipe),
        articulation=articulation,
    )


_Sets = Mapping[str, list[MotionSequence]]


def _by_origin(sequences: Sequence[MotionSequence]) -> dict[str, list[MotionSequence]]:
    sets: dict[str, list[MotionSequence]] = {}
    for sequence in sequences:
        sets.setdefault(sequence.origin, []).append(sequence)
    return sets


def _lags(fps: float) -> tuple[int, int]:
    """Return the lags in frames between which velocities tell their decay."""
    near = max(1, round(_NEAR * fps))
    return near, near + max(1, round((_FAR - _NEAR) * fps))


def _long_enough(sequences: Sequence[MotionSequence]) -> list[MotionSequence]:
    """Return the sequences whose velocities tell their decay."""
    found = [s for s in sequences if len(s.residual) > _lags(s.fps)[1] + 2]
    if not found:
        longest = max((len(s.residual) for s in sequences), default=0)
        raise InputError(
            f"body motion needs recordings of at least {_FAR:.2f} seconds and three frames, the longest "
            f"has {longest} frames; add longer ones"
        )
    return found


def _check_joints(articulation: Articulation, sets: _Sets) -> None:
    known = torch.stack([_known_joints(own) for own in sets.values()]).any(0)
    missing = [n for n, k in zip(articulation.skeleton.names, known.tolist(), strict=True) if not k]
    if missing:
        raise InputError(
            f"no recording has the joint {', '.join(missing)}; add recordings of a joint set with it"
        )
    told = torch.stack([_known_columns(articulation, own) for own in sets.values()]).any(0)[3:]
    parts = articulation.axis_part[~told].unique().tolist()
    if parts:
        together = [
            ", ".join(n for n, p in zip(articulation.skeleton.names, articulation.part_of, strict=True)
                      if int(p) == part)
            for part in parts
        ]  # fmt: skip
        raise InputError(
            f"no set of recordings has all of the joints {'; or '.join(together)}, which tell how a part "
            "turns; add recordings of a joint set with them"
        )


def _known_joints(sequences: Sequence[MotionSequence]) -> Bool[Tensor, " J"]:
    return torch.stack([s.known for s in sequences]).all(0)


def _known_columns(
    articulation: Articulation, sequences: Sequence[MotionSequence]
) -> Bool[Tensor, " V"]:
    """Return whether position and angles of a set are recorded: those of a part if its joints are."""
    unknown = articulation.part_of[~_known_joints(sequences)]
    told = ~torch.isin(articulation.axis_part, unknown)
    return torch.cat([torch.ones(3, dtype=torch.bool), told])


# --- velocities -----------------------------------------------------------------------------------


def _fit_velocities(articulation: Articulation, sets: _Sets) -> tuple[Tensor, Tensor]:
    """Return acceleration and decay [V] of position and angles.

    Frame by frame, mean velocities of an Ornstein-Uhlenbeck process have

        E[v_t v_(t + k)] ~ exp(-decay k h),   k > 0,
        E[(v_(t + 1) - v_t)^2] = q^2 / decay (2 (x - 1 + e) - (1 - e)^2) / x^2,   x = decay h,  e = exp(-x).
    """
    powers, decays, known = [], [], []
    for own in sets.values():
        decay = _decay(articulation, own)
        powers.append(_power(articulation, own, decay))
        decays.append(decay)
        known.append(_known_columns(articulation, own))
    told = torch.stack(known)
    power = _geometric_mean(torch.stack(powers), told)
    return (
        _alike(articulation, power).sqrt().clamp_min(_LEAST_ACCELERATION),
        _alike(articulation, _geometric_mean(torch.stack(decays), told)),
    )


def _velocities(articulation: Articulation, sequence: MotionSequence) -> Float[Tensor, "T V"]:
    """Return the mean velocities between frames."""
    later, sooner = (sequence.point.map(take) for take in (_without_first, _without_last))
    return articulation.difference(later, sooner)[:, : articulation.n_pose] * sequence.fps


def _without_first(value: Tensor) -> Tensor:
    return value[1:]


def _without_last(value: Tensor) -> Tensor:
    return value[:-1]


def _decay(articulation: Articulation, sequences: Sequence[MotionSequence]) -> Float[Tensor, " V"]:
    velocities = _clipped([_velocities(articulation, s) for s in sequences])
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


def _power(
    articulation: Articulation, sequences: Sequence[MotionSequence], decay: Tensor
) -> Float[Tensor, " V"]:
    """Return the squares of the accelerations of a set."""
    changes = []
    for sequence in sequences:
        v = _velocities(articulation, sequence)
        x = decay / sequence.fps
        kept = torch.exp(-x)
        share = (2 * (x - 1 + kept) - (1 - kept).square()) / (decay * x.square())
        changes.append((v[1:] - v[:-1]) / share.sqrt())
    return torch.cat(_clipped(changes)).square().mean(0).clamp_min(_LEAST_ACCELERATION**2)


def _clipped(values: Sequence[Float[Tensor, "T V"]]) -> list[Tensor]:
    """Return values with the largest of every column no larger than nearly all others."""
    size = torch.cat(list(values)).abs()
    rank = max(1, math.ceil((1 - _GLITCHES) * len(size)))
    most = size.kthvalue(rank, 0).values
    return [value.clamp(-most, most) for value in values]


def _geometric_mean(values: Float[Tensor, "K V"], told: Bool[Tensor, "K V"]) -> Tensor:
    """Return the geometric mean over the sets that tell."""
    return (torch.where(told, values.log(), 0).sum(0) / told.sum(0)).exp()


def _alike(articulation: Articulation, values: Float[Tensor, " V"]) -> Tensor:
    """Return values that are the same in all directions and on both sides."""
    position, angles = values[:3].mean().expand(3), values[3:]
    return torch.cat([position, (angles * angles[mirror_of(articulation).columns]).sqrt()])


# --- shifts ---------------------------------------------------------------------------------------


def _fit_shifts(
    articulation: Articulation, sets: _Sets, least: float
) -> tuple[Float[Tensor, " S"], Float[Tensor, "1"]]:
    """Return the deviation of joints from rigid parts, along each axis, and its correlation time."""
    variances, later, told = [], [], []
    for own in sets.values():
        residuals = [r.flatten(1) for r in _clipped([s.residual.flatten(1) for s in own])]
        known = _known_joints(own)[list(articulation.shifted)]
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


# --- proportions ----------------------------------------------------------------------------------


def _fit_scales(articulation: Articulation, sets: _Sets) -> tuple[Tensor, Tensor]:
    """Return mean [G] and covariance [G, G] of logarithms of bone lengths over the standard ones.

    The covariance is that of persons within a set plus that of the sets, which define joints differently.
    Where persons or sets are few, the usual spread counts more.
    """
    scales = [_scales_of_set(articulation, own) for own in sets.values()]
    means = torch.stack([own.nanmean(0) for own in scales])
    mean = means.nanmean(0)
    own_spread = torch.zeros(len(mean), len(mean), dtype=torch.float64)
    n_persons = 0
    for own, centre in zip(scales, means, strict=True):
        away = _filled(own - centre)
        own_spread += away.mT @ away
        n_persons += len(own) - 1
    between = _filled(means - mean)
    person = _shrunk(own_spread, n_persons, _usual_persons(len(mean)), _USUAL_PERSONS)
    definition = _shrunk(
        between.mT @ between, len(means) - 1, _usual_definitions(articulation), _USUAL_SETS
    )
    return mean, person + definition


def _scales_of_set(
    articulation: Articulation, sequences: Sequence[MotionSequence]
) -> Float[Tensor, "N G"]:
    """Return the scales of every person of a set; NaN where the set lacks the joint."""
    persons = {s.person: s.lengths for s in sequences}
    scales = articulation.scales_of(torch.stack(list(persons.values())).double())
    lacking = (~_known_joints(sequences)).double() @ articulation.in_group
    return torch.where(lacking > 0, torch.nan, scales)


def _filled(away: Float[Tensor, "N G"]) -> Tensor:
    """Return deviations with those that are not known at the person's mean of the others."""
    return torch.where(away.isnan(), away.nanmean(-1, keepdim=True), away)


def _shrunk(total: Tensor, count: int, usual: Tensor, weight: int) -> Tensor:
    return (total + weight * usual) / (count + weight)


def _usual_persons(n: int) -> Tensor:
    eye = torch.eye(n, dtype=torch.float64)
    return _USUAL_BUILD**2 * eye + _USUAL_SIZE**2


def _usual_definitions(articulation: Articulation) -> Tensor:
    return torch.diag(
        torch.tensor([_USUAL_DEFINITION.get(name, 0.0) ** 2 for name in articulation.groups])
    ).double()


# --- poses ----------------------------------------------------------------------------------------


def _fit_poses(
    articulation: Articulation, sets: _Sets, recipe: BodyMotionRecipe
) -> GaussianMixture:
    """Return a mixture over relative angles whose components are mirror images of each other."""
    generator = torch.Generator().manual_seed(recipe.seed)
    drawn = _draw_poses(articulation, sets, recipe.n_samples, generator)
    mirror = mirror_of(articulation)
    root = articulation.n_root
    index, sign = mirror.columns[root:] - root, mirror.sign[root:]
    half = GaussianMixture.fit(
        drawn,
        n_components=recipe.n_components // 2,
        seed=recipe.seed,
        covariance_floor=recipe.covariance_floor,
    )
    means, covariances = half.means, half.covariances
    mirrored = covariances[:, index][:, :, index] * sign[:, None] * sign
    return GaussianMixture(
        torch.cat([half.weights, half.weights]) / 2,
        torch.cat([means, means[:, index] * sign]),
        torch.cat([covariances, mirrored]),
    )


def _draw_poses(
    articulation: Articulation, sets: _Sets, count: int, generator: torch.Generator
) -> Float[Tensor, "N Q"]:
    """Return poses of all sets, with shares as the roots of their durations.

    Angles that a set does not tell are those of random poses of the sets that tell them (`_donors`).
    """
    root = articulation.n_root
    poses = {origin: _poses(articulation, own) for origin, own in sets.items()}
    known = {o: _known_columns(articulation, own)[3 + root :] for o, own in sets.items()}
    roots = {origin: math.sqrt(len(own)) for origin, own in poses.items()}
    donors = _donors(list(poses.values()), torch.stack(list(known.values())))
    drawn = []
    for origin, own in poses.items():
        share = max(1, round(count * roots[origin] / sum(roots.values())))
        values = own[_random(len(own), share, generator)]
        for angles, told in donors:
            others = told[_random(len(told), share, generator)]
            values = torch.where(known[origin] | ~angles, values, others)
        drawn.append(values)
    return torch.cat(drawn)


def _donors(
    poses: Sequence[Float[Tensor, "_ Q"]], known: Bool[Tensor, "K Q"]
) -> list[tuple[Bool[Tensor, " Q"], Float[Tensor, "N Q"]]]:
    """Return groups of angles, with the poses that they may be taken from.

    Whole poses where sets tell all angles, else those of the sets that tell the group.
    """
    whole = [own for own, told in zip(poses, known, strict=True) if bool(told.all())]
    if whole:
        return [(torch.ones_like(known[0]), torch.cat(whole))]
    who, group = torch.unique(known, dim=1, return_inverse=True)
    return [
        (group == i, torch.cat([own for own, told in zip(poses, tells, strict=True) if told]))
        for i, tells in enumerate(who.mT.tolist())
    ]


def _poses(articulation: Articulation, sequences: Sequence[MotionSequence]) -> Tensor:
    def every(sequence: MotionSequence) -> Callable[[Tensor], Tensor]:
        step = max(1, round(sequence.fps / _POSE_RATE))
        return lambda value: value[::step]

    return torch.cat([articulation.relative_angles(s.point.map(every(s))) for s in sequences])


def _random(n: int, count: int, generator: torch.Generator) -> Int[Tensor, " N"]:
    return torch.randint(n, (count,), generator=generator)


# --- how well a prior fits others -----------------------------------------------------------------


def acceleration_ratio(motion: BodyMotion, sequences: Sequence[MotionSequence]) -> float:
    """Return how much recorded bodies accelerate relative to a prior, by the root mean square of all columns.

    Raises:
        InputError: too few frames in a row.
    """
    body, sums, count = motion.articulation, 0.0, 0
    for own in _by_origin(_long_enough(sequences)).values():
        known = _known_columns(body, own)
        power = _power(body, own, motion.decay) / motion.acceleration.square()
        sums, count = sums + float(power[known].sum()), count + int(known.sum())
    return math.sqrt(sums / count)


def pose_log_density(motion: BodyMotion, sequences: Sequence[MotionSequence]) -> float:
    """Return the mean log density of recorded poses, per angle, over the angles that the sets tell."""
    body, sums, count = motion.articulation, 0.0, 0
    root = body.n_root
    for own in _by_origin(sequences).values():
        told = _known_columns(body, own)[3 + root :].nonzero().squeeze(-1)
        poses = _poses(body, own)
        sums += float(motion.poses.marginal(told).log_prob(poses[:, told]).sum()) / len(told)
        count += len(poses)
    return sums / count
