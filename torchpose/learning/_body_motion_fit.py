"""Fit what `BodyMotion` holds to recorded bodies: how they move, which poses they take, how they are built.

Every set of recordings is looked at by itself, and the sets are then combined with equal weight, so that a
large one does not decide. A set says nothing about parts whose joint it lacks. Left and right are one.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.checks import check_positive
from torchpose.body._articulation import Articulation, mirror_of
from torchpose.errors import InputError
from torchpose.learning._motion_dynamics import (
    accelerations_left,
    fit_accelerations,
    fit_correlation,
    fit_decay,
    fit_drift,
    fit_shifts,
    long_enough,
    mean_squares,
)
from torchpose.learning._motion_sequences import (
    MotionSequence,
    MotionSets,
    by_origin,
    known_columns,
    known_joints,
)
from torchpose.priors._body_motion import BodyMotion
from torchpose.priors._gaussian_mixture import GaussianMixture

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
            check_positive(name, getattr(self, name))


def fit_body_motion(
    sequences: Sequence[MotionSequence], recipe: BodyMotionRecipe | None = None
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
    sets = by_origin(long_enough(sequences))
    _check_joints(articulation, sets)
    decay = fit_decay(articulation, sets)
    drift = fit_drift(articulation, sets, decay)
    left = [accelerations_left(articulation, own, decay, drift) for own in sets.values()]
    acceleration = fit_accelerations(articulation, sets, left)
    shift_std, shift_time = fit_shifts(articulation, sets, recipe.least_shift)
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
        correlation=fit_correlation(articulation, sets, left),
        drift=drift,
    )


def _check_joints(articulation: Articulation, sets: MotionSets) -> None:
    known = torch.stack([known_joints(own) for own in sets.values()]).any(0)
    missing = [n for n, k in zip(articulation.skeleton.names, known.tolist(), strict=True) if not k]
    if missing:
        raise InputError(
            f"no recording has the joint {', '.join(missing)}; add recordings of a joint set with it"
        )
    told = torch.stack([known_columns(articulation, own) for own in sets.values()]).any(0)[3:]
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


# --- proportions ----------------------------------------------------------------------------------


def _fit_scales(articulation: Articulation, sets: MotionSets) -> tuple[Tensor, Tensor]:
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
    lacking = (~known_joints(sequences)).double() @ articulation.in_group
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
    articulation: Articulation, sets: MotionSets, recipe: BodyMotionRecipe
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
    articulation: Articulation, sets: MotionSets, count: int, generator: torch.Generator
) -> Float[Tensor, "N Q"]:
    """Return poses of all sets, with shares as the roots of their durations.

    Angles that a set does not tell are those of random poses of the sets that tell them (`_donors`).
    """
    root = articulation.n_root
    poses = {origin: _poses(articulation, own) for origin, own in sets.items()}
    known = {o: known_columns(articulation, own)[3 + root :] for o, own in sets.items()}
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
    for own in by_origin(long_enough(sequences)).values():
        known = known_columns(body, own)
        left = accelerations_left(body, own, motion.decay, motion.drift)
        power = mean_squares(left) / motion.acceleration.square()
        sums, count = sums + float(power[known].sum()), count + int(known.sum())
    return math.sqrt(sums / count)


def pose_log_density(motion: BodyMotion, sequences: Sequence[MotionSequence]) -> float:
    """Return the mean log density of recorded poses, per angle, over the angles that the sets tell."""
    body, sums, count = motion.articulation, 0.0, 0
    root = body.n_root
    for own in by_origin(sequences).values():
        told = known_columns(body, own)[3 + root :].nonzero().squeeze(-1)
        poses = _poses(body, own)
        sums += float(motion.poses.marginal(told).log_prob(poses[:, told]).sum()) / len(told)
        count += len(poses)
    return sums / count
