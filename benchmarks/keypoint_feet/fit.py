"""Fit the prior over feet, which comes with torchpose, to motion capture with toes.

The line from ankle to toe tells two of the three angles of a foot. About that line it is taken to turn by
`_ROLL_STD`. Every set of recordings counts alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks.keypoint_bodies.clips import TRAINING, recorded
from torchpose.body import BODY_15, Body
from torchpose.body._articulation import Articulation, BodyPoint
from torchpose.body._feet import ANKLES, FEET, foot_points, foot_shape
from torchpose.body._fitting import fit_state
from torchpose.io._mocap import MocapClip
from torchpose.math._rotations import (
    matrix_to_quaternion_vector,
    minimal_rotation,
    quaternion_vector_to_matrix,
)
from torchpose.priors._foot_prior import FootPrior, FootPriorInfo, LegTurns

__all__ = ["fit_shipped", "toes_of"]

_LONGEST = 600  # frames of a recording
_RIDGE = 0.01  # of the variance of a feature, of what each frame is
_ROLL_STD = 0.15  # radians, about the line from ankle to toe, which nothing recorded tells
_WIDER, _FASTER = 1.2, 1.4
"""Factors on spread and speed, for feet that are not rigid, chosen with the filter on `clips.CHOOSING`."""
_TOES = tuple(FEET.index(f"{side}_big_toe") for side in ("left", "right"))


class _Feet(NamedTuple):
    """Feet of one recording: features [N, F], rotation vectors [N, 3] and rates [N, 3], as left feet."""

    origin: str
    person: str
    features: Tensor
    turn: Tensor
    fps: float


def fit_shipped(data: Path, quick: bool) -> FootPrior:
    """Return the prior that comes with torchpose.

    Args:
        data: folder with the sets. quick: few recordings, to see that it works.
    """
    patterns = {folder: chosen[:1] if quick else chosen for folder, chosen in TRAINING.items()}
    feet = [
        one
        for folder, chosen in patterns.items()
        for clip in tqdm([*recorded(data / folder, chosen, _LONGEST)], desc=folder)
        for one in _feet_of(clip, folder)
    ]
    info = FootPriorInfo(
        name="whole-body",
        recordings=tuple(f"{folder}/{p}" for folder, chosen in patterns.items() for p in chosen),
        licence="MIT; see the card for the recordings",
        command="python -m benchmarks.keypoint_feet --data DIR --fit FILE.safetensors",
    )
    return _fitted(feet, info)


def toes_of(clip: MocapClip) -> Float[Tensor, "T 2 3"]:
    """Return the recorded toes, left and right, metres."""
    points = foot_points(clip.recorded, clip.names)
    assert points is not None  # of sets that are known to have toes
    return points[:, list(_TOES)].double()


def _feet_of(clip: MocapClip, origin: str) -> list[_Feet]:
    """Return the left foot of a recording, and the right one in a mirror."""
    articulation, joints = Articulation(), clip.joints.double()
    lengths = _lengths(joints)
    body = Body(
        BODY_15, lengths, BODY_15.standard_radii(BODY_15.height(lengths)),
        centres=matrix_to_quaternion_vector(articulation.centres),
    )  # fmt: skip
    state = fit_state(body, joints)
    n = len(state)
    rotations = quaternion_vector_to_matrix(state[:, 3:].unflatten(-1, (-1, 3)))
    none = (
        state.new_zeros(n, len(articulation.groups)),
        state.new_zeros(n, len(articulation.shifted), 3),
    )
    point = BodyPoint(state[:, :3], rotations, state.new_zeros(n, articulation.n_pose), *none)
    rates = clip.fps * torch.gradient(articulation.relative_angles(point), dim=0)[0]
    first = 3 + articulation.n_root
    point.velocity[:, first:] = rates
    features = LegTurns(articulation).features(point)
    shanks = [BODY_15.part_of[ankle] for ankle in ANKLES]
    shank = articulation.world_rotations(point)[:, shanks]
    seen = (shank.mT @ (toes_of(clip) - joints[:, ANKLES])[..., None]).squeeze(-1)
    toe = foot_shape()[:, _TOES[0]].expand_as(seen)
    turn = _rotation_vector(minimal_rotation(toe, seen))
    turn = turn * turn.new_tensor([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0]])
    return [
        _Feet(origin, clip.person_id, features[:, side], turn[:, side], clip.fps) for side in (0, 1)
    ]


def _lengths(joints: Float[Tensor, "T 15 3"]) -> Float[Tensor, " 15"]:
    """Return the median length of every bone; those of average proportions where a joint is missing."""
    parents = torch.tensor(BODY_15.parents)
    lengths = (joints - joints[:, parents]).norm(dim=-1).nanmedian(0).values
    lengths[0] = 0
    usual = BODY_15.standard_lengths(BODY_15.height(lengths))
    return torch.where(lengths.isfinite(), lengths, usual)


def _rotation_vector(quaternion: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    length = quaternion.norm(dim=-1, keepdim=True).clamp(1e-12, 1.0)
    return 2 * quaternion * (length.asin() / length)


def _fitted(feet: Sequence[_Feet], info: FootPriorInfo) -> FootPrior:
    """Return the prior: a ridge regression, and the spread and speed of what it leaves of each person."""
    origins = sorted({one.origin for one in feet})
    weights = [_weight(one, feet) / len(origins) for one in feet]
    mean = sum(w * one.features.sum(0) for w, one in zip(weights, feet, strict=True))
    square = sum(
        w * (one.features - mean).square().sum(0) for w, one in zip(weights, feet, strict=True)
    )
    std = torch.as_tensor(square).sqrt()
    centre = sum(w * one.turn.sum(0) for w, one in zip(weights, feet, strict=True))
    matrix: Tensor = _RIDGE * torch.eye(len(std), dtype=std.dtype)
    pulled: Tensor = torch.zeros(len(std), 3, dtype=std.dtype)
    for w, one in zip(weights, feet, strict=True):
        f = (one.features - mean) / std
        matrix = matrix + w * f.mT @ f
        pulled = pulled + w * f.mT @ (one.turn - centre)
    slope = torch.linalg.solve(matrix, pulled)
    rest = [one.turn - centre - ((one.features - mean) / std) @ slope for one in feet]
    spread, speed = _moments(feet, rest, origins)
    turn_std, rate = spread.sqrt(), (speed / spread).sqrt()
    turn_std[2], rate[2] = _ROLL_STD, rate[:2].mean()
    return FootPrior(
        torch.as_tensor(mean), std, slope, torch.as_tensor(centre), _WIDER * turn_std, _FASTER * rate,
        info,
    )  # fmt: skip


def _weight(one: _Feet, feet: Sequence[_Feet]) -> float:
    """Return one over the number of frames of a set."""
    return 1 / sum(len(other.turn) for other in feet if other.origin == one.origin)


def _moments(
    feet: Sequence[_Feet], rest: Sequence[Tensor], origins: Sequence[str]
) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """Return variances of what is left about each person's mean, and of its rate, mean over sets."""
    spreads, speeds = [], []
    for origin in origins:
        persons = sorted({one.person for one in feet if one.origin == origin})
        values = {p: [r for f, r in zip(feet, rest, strict=True) if f.person == p] for p in persons}
        middles = {p: torch.cat(v).mean(0) for p, v in values.items()}
        apart = [r - middles[p] for p, v in values.items() for r in v]
        spreads.append(torch.cat(apart).square().mean(0))
        rates = [
            f.fps * torch.gradient(r, dim=0)[0]
            for f, r in zip(feet, rest, strict=True)
            if f.origin == origin
        ]
        speeds.append(torch.cat(rates).square().mean(0))
    return torch.stack(spreads).mean(0), torch.stack(speeds).mean(0)
