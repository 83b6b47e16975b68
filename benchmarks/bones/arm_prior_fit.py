"""Fit a prior over arms that depends on no camera, to recordings of any sets together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from torchpose.errors import InputError
from torchpose.io import Recording
from torchpose.priors._arms import ArmPrior, ArmPriorInfo
from torchpose.priors._gaussian_mixture import GaussianMixture
from torchpose.skeleton._joint_sets import UPPER_BODY, canonical_names
from torchpose.skeleton._torso import upright_axes
from torchpose.skeleton._upper_body import LEFT_ARM, RIGHT_ARM, UpperBody

__all__ = ["arm_directions", "fit_arm_prior"]

_LEAST_SPREAD = 0.04  # of the log of a length over persons, however alike those are
_OUTLYING = 0.25  # log of a length beyond which a joint means something else
_FOREIGN = 0.5  # the same relative to the upper arm: a neck or a wrist that is none of Kinect's
_FEW = 4.0  # sets whose weight a default spread has
_DEFAULT_SPREAD = torch.tensor([0.07, 0.07, 0.09, 0.12, 0.16], dtype=torch.float64)
_DEFAULT_LENGTHS = torch.tensor([0.27, 0.24, 0.30, 0.32, 0.19], dtype=torch.float64)
_FLOOR = 0.01  # variance added to each coordinate of a direction: a tenth of a radian
_TILT = 8.0  # degrees by which cameras stand askew to what they look at
_APART = 0.1  # share of frames in which what one arm does says nothing of the other
_RATE = 30.0
_ARMS = (LEFT_ARM, RIGHT_ARM)
_SHOULDERS = tuple(UPPER_BODY.index(f"shoulder_{side}") for side in ("left", "right"))


def arm_directions(joints: Float[Tensor, "N 8 3"]) -> Float[Tensor, "N 2 6"]:
    """Return the directions of both bones of left and mirrored right arms in upright axes; see `ArmPrior`.

    Args:
        joints: in the order of `UPPER_BODY`, camera axes; NaN where missing.
    """
    left, right = (joints[:, i] for i in _SHOULDERS)
    across = left - right
    axes = upright_axes(torch.atan2(-across[..., 2], across[..., 0]))
    arms = []
    for arm, sign in zip(_ARMS, (1.0, -1.0), strict=True):
        hand, elbow, shoulder = (joints[:, i] for i in arm[:3])
        bones = torch.stack([elbow - shoulder, hand - elbow], 1)
        turned = normalize(bones, dim=-1) @ axes.mT
        arms.append((turned * turned.new_tensor([sign, 1.0, 1.0])).flatten(1))
    return torch.stack(arms, 1)


class _Person(NamedTuple):
    """Holds the measures of a person from the recordings.

    Attributes:
        directions: of both arms, [N, 2, 6], NaN of an arm that is not known. lengths: medians, [5].
    """

    directions: Tensor
    lengths: Tensor


def fit_arm_prior(
    recordings: Sequence[Sequence[Recording]],
    n_components: int = 48,
    seed: int = 0,
    *,
    n_samples: int = 40_000,
    shares: Sequence[float] | None = None,
    broad: float = 0.1,
) -> ArmPrior:
    """Fit a mixture over directions of limbs, and lengths over persons, to sets of recordings.

    Each set has its share of the samples, whatever its size, so that one large set does not decide what
    people do. Samples are tilted and turned by random angles with a standard deviation of 8 degrees,
    since cameras are not level.

    Args:
        recordings: of each set, in camera axes. n_components: Gaussians. seed: of samples and start.
        n_samples: arms that are drawn. shares: of each set; equal by default.
        broad: share of the part that expects nothing.

    Raises:
        InputError: no set, or one without a frame in which an arm and both shoulders are known.
    """
    if not recordings or not all(recordings):
        raise InputError("a prior over arms needs sets of at least one recording, got none")
    shares = [1 / len(recordings)] * len(recordings) if shares is None else list(shares)
    generator = torch.Generator().manual_seed(seed)
    samples, lengths, persons, trust, of = [], [], [], [], []
    for of_set, share in zip(recordings, shares, strict=True):
        by_person = _persons(of_set)
        pairs = torch.cat([person.directions for person in by_person.values()])
        if not len(pairs):
            raise InputError("a set of recordings has no frame with an arm and both shoulders")
        count = round(n_samples * share / sum(shares))
        rows = torch.randint(len(pairs), (count,), generator=generator)
        samples.append(pairs[rows])
        lengths += [person.lengths for person in by_person.values()]
        persons += list(by_person)
        trust += [share / sum(shares) / len(by_person)] * len(by_person)
        of += [len(samples)] * len(by_person)
    both = _tilted(torch.cat(samples), generator)
    points = _one_of(both, generator)
    mixture = GaussianMixture.fit(
        points, n_components=n_components, seed=seed, max_iter=60, covariance_floor=_FLOOR
    )
    whole = both[both.isfinite().flatten(1).all(1)]
    together = _together(mixture, whole) if len(whole) else None
    medians, spread = _length_statistics(
        torch.stack(lengths), torch.tensor(trust, dtype=torch.float64), torch.tensor(of)
    )
    info = ArmPriorInfo(persons=tuple(persons))
    return ArmPrior(mixture, medians, spread, broad, info, together)


def _one_of(pairs: Float[Tensor, "N 2 6"], generator: torch.Generator) -> Float[Tensor, "N 6"]:
    """Return one arm of each pair at random, the known one where the other is not."""
    known = pairs.isfinite().all(-1)
    left = torch.rand(len(pairs), generator=generator) < 0.5
    return torch.where(((left & known[:, 0]) | ~known[:, 1])[:, None], pairs[:, 0], pairs[:, 1])


def _together(
    mixture: GaussianMixture, pairs: Float[Tensor, "N 2 6"], rounds: int = 100
) -> Float[Tensor, "K K"]:
    """Return the joint probabilities of the components of both arms, the other arm mirrored (EM).

    Args:
        mixture: over one arm, which stays. pairs: of arms, both known.
    """
    weights = mixture.weights
    ratio = torch.softmax(mixture.component_log_prob(pairs), -1) / weights
    ratio = torch.cat([ratio, ratio.flip(1)])  # what left arms do, right ones may do
    left, right = ratio.unbind(1)
    found = weights[:, None] * weights
    for _ in range(rounds):
        density = ((left @ found) * right).sum(-1, keepdim=True)
        found = found * ((left / density).mT @ right) / len(left)
    found = (1 - _APART) * found + _APART * weights[:, None] * weights
    return _with_sums(found, weights)


def _with_sums(
    shares: Float[Tensor, "K K"], sums: Float[Tensor, " K"], rounds: int = 200
) -> Float[Tensor, "K K"]:
    """Return a symmetric matrix with its rows and columns scaled to these sums (Sinkhorn)."""
    scale = torch.ones_like(sums)
    for _ in range(rounds):
        scale = (scale * sums / (shares @ scale)).sqrt()
    return scale[:, None] * shares * scale


def _persons(recordings: Sequence[Recording]) -> dict[str, _Person]:
    """Return the arm directions and bone lengths of each person, at 30 frames a second."""
    directions: dict[str, list[Tensor]] = {}
    lengths: dict[str, list[Tensor]] = {}
    for recording in recordings:
        body = recording.upper_body()
        step = max(1, round(float(recording.fps or _RATE) / _RATE))
        joints = body.joints.double()[::step]
        arms = arm_directions(joints)
        person = recording.person_id
        directions.setdefault(person, []).append(arms[arms.isfinite().all(-1).any(-1)])
        lengths.setdefault(person, []).append(_lengths(recording, joints, body, step))
    return {
        person: _Person(torch.cat(found), torch.cat(lengths[person]).nanmedian(0).values)
        for person, found in directions.items()
    }


def _lengths(
    recording: Recording, joints: Float[Tensor, "T 8 3"], body: UpperBody, step: int
) -> Float[Tensor, "T 5"]:
    """Return the lengths of `ArmPrior` in each frame, NaN where they are not known."""

    def apart(a: Tensor, b: Tensor) -> Tensor:
        return torch.linalg.vector_norm(a - b, dim=-1)

    names = dict(zip(UPPER_BODY, joints.unbind(1), strict=True))
    unknown = torch.full_like(joints[:, 0, 0], math.nan)
    arms, wrists = [], _wrists(recording, step)
    for i, side in enumerate(("left", "right")):
        elbow = names[f"elbow_{side}"]
        ends = {body.hand: apart(names[f"hand_{side}"], elbow)}
        if wrists is not None:
            ends["wrist"] = apart(wrists[:, i], elbow)
        upper = apart(elbow, names[f"shoulder_{side}"])
        arms.append(torch.stack([upper, ends.get("wrist", unknown), ends.get("hand", unknown)], 1))
    width = apart(names["shoulder_left"], names["shoulder_right"])
    height = apart(names["head"], names["neck"]) if body.neck == "neck" else unknown
    return torch.cat([(arms[0] + arms[1]) / 2, width[:, None], height[:, None]], 1)


def _wrists(recording: Recording, step: int) -> Tensor | None:
    """Return both wrists [T, 2, 3] of recordings that have wrists beside hands."""
    names = canonical_names(recording.names)
    if not {"wrist_left", "wrist_right"} <= set(names):
        return None
    columns = [names.index(f"wrist_{side}") for side in ("left", "right")]
    return recording.joints.double()[::step, columns]


def _tilted(pairs: Float[Tensor, "N 2 6"], generator: torch.Generator) -> Float[Tensor, "N 2 6"]:
    """Return the directions as level cameras would see them that are tilted and turned at random."""
    angles = torch.randn(2, len(pairs), generator=generator, dtype=torch.float64)
    (c, d), (s, r) = (f(angles * math.radians(_TILT)) for f in (torch.cos, torch.sin))
    x, y, z = pairs.unflatten(-1, (2, 3)).unbind(-1)
    c, d, s, r = (value[:, None, None] for value in (c, d, s, r))
    r = r * r.new_tensor([1.0, -1.0])[:, None]  # right arms are mirrored
    y, z = c * y - s * z, s * y + c * z
    x, z = d * x + r * z, -r * x + d * z
    return torch.stack([x, y, z], -1).flatten(2)


def _length_statistics(
    lengths: Float[Tensor, "P 5"], trust: Float[Tensor, " P"], of: Int[Tensor, " P"]
) -> tuple[Tensor, Tensor]:
    """Return the weighted median of each length, and the spread of its log, shrunk to the usual spread.

    The persons of a set were measured alike: a set counts as one, however many persons it has.

    Args:
        lengths: of each person, NaN where not known. trust: weight of each person, of sum one.
        of: number of each person's set.
    """
    logs = lengths.log()
    in_proportion = logs - logs[:, :1] - (_DEFAULT_LENGTHS / _DEFAULT_LENGTHS[0]).log()
    known = logs.isfinite() & ~(in_proportion.abs() > _FOREIGN)
    weight = torch.where(known, trust[:, None], 0.0)
    count = torch.stack([known[of == i].any(0) for i in of.unique()]).sum(0)
    order = logs.where(known, math.inf).argsort(0)
    passed = weight.gather(0, order).cumsum(0) >= weight.sum(0) / 2
    middle = logs.gather(0, order).gather(0, passed.to(torch.uint8).argmax(0, keepdim=True))[0]
    centre = torch.where(count > 0, middle, _DEFAULT_LENGTHS.log())
    off = torch.where(known, (logs - centre).clamp(-_OUTLYING, _OUTLYING), 0.0)
    variance = (weight * off.square()).sum(0) / weight.sum(0).clamp_min(1e-12)
    spread = ((count * variance + _FEW * _DEFAULT_SPREAD**2) / (count + _FEW)).sqrt()
    return centre.exp(), spread.clamp_min(_LEAST_SPREAD)
