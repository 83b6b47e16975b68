"""Measures of tracks of several persons: errors, identities, who is found, and who is not there."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

NEAR = 0.3  # metres between joints, on average, within which a track is that of a person


class Found(NamedTuple):
    """A person whom a method found: joints [t, 15, 3] from a first frame on, NaN where it has none."""

    first: int
    joints: Tensor


class PeopleScore(NamedTuple):
    """Measures of a clip.

    Attributes:
        error: mean distance of the joints of tracked persons, mm. switches: times at which another track
            took a person over. tracked: share of persons and frames with a track, %. false: share of a
            track's frames at nobody's place, in percent of persons and frames.
    """

    error: float
    switches: float
    tracked: float
    false: float


def score_people(found: list[Found], truth: Float[Tensor, "T P 15 3"]) -> PeopleScore:
    """Return the measures of tracks.

    A person is tracked by the track that was its own in the frame before, as long as that is near, else by
    the nearest one.
    """
    n_frames, n_persons = truth.shape[:2]
    table = truth.new_full((n_frames, max(len(found), 1), *truth.shape[2:]), math.nan)
    for k, one in enumerate(found):
        table[one.first : one.first + len(one.joints), k] = one.joints
    apart = (table[:, None] - truth[:, :, None]).norm(dim=-1)
    away = apart.nanmean(-1).nan_to_num(math.inf)  # [T, P, K]
    owner = _owners(away)
    tracked = owner >= 0
    own = apart.gather(
        2, owner.clamp_min(0)[..., None, None].expand(*owner.shape, 1, apart.shape[-1])
    )
    error = 1000 * float(own[:, :, 0][tracked].nanmean())
    switches = sum(_switches(owner[:, p]) for p in range(n_persons))
    there = table.isfinite().all(-1).any(-1)
    used = torch.zeros_like(there)
    for p in range(n_persons):
        used |= (owner[:, [p]] == torch.arange(there.shape[1])) & tracked[:, [p]]
    false = float((there & ~used).sum()) / (n_frames * n_persons)
    return PeopleScore(error, switches, 100 * float(tracked.double().mean()), 100 * false)


def _owners(away: Float[Tensor, "T P K"]) -> Int[Tensor, "T P"]:
    """Return the track of every person, -1 if none is near."""
    n_frames, n_persons, _ = away.shape
    owner = torch.full((n_frames, n_persons), -1)
    before = [-1] * n_persons
    for t in range(n_frames):
        left = away[t].clone()
        for p in range(n_persons):  # who keeps a track goes first
            if before[p] >= 0 and left[p, before[p]] < NEAR:
                owner[t, p] = before[p]
                left[:, before[p]] = math.inf
                left[p] = math.inf
        while float(left.min()) < NEAR:
            p, k = divmod(int(left.argmin()), left.shape[1])
            owner[t, p] = before[p] = k
            left[p], left[:, k] = math.inf, math.inf
    return owner


def _switches(owner: Int[Tensor, " T"]) -> int:
    """Return how often the track of a person is another one than the last."""
    known = owner[owner >= 0]
    return int((known[1:] != known[:-1]).sum())
