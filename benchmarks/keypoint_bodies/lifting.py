"""Fit the networks that lift keypoints of one camera, which come with torchpose.

It sees pieces of recordings of the persons of `clips.TRAINING`, half of them of those of a Kinect, from
cameras that are drawn anew for each piece (`LiftingExamples`), with a detector's faults.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from benchmarks._lifters import train_lifter
from benchmarks.keypoint_bodies.clips import (
    KINECT,
    KINECT_TRAINING,
    TRAINING,
    WALKS,
    hips_for_pelvis,
    pair_of,
    recorded,
)
from benchmarks.keypoint_bodies.lifting_examples import LiftingExamples
from torchpose.io._mocap import MocapClip
from torchpose.priors._lifting_network import (
    LiftingNetwork,
    LiftingNetworkInfo,
    shipped_lifting_network,
)

__all__ = ["fit_shipped", "fit_upper_body"]

_STEPS, _QUICK_STEPS = 10_000, 2
_LATER_STEPS = 0.2  # of each later fit, as a share of the steps of the first one
_LATER_RATE = 1e-3  # of learning
_SEAT_SHARE = 0.25  # of the pieces of the last fit
_UPPER_SEED = 3  # of the pieces from which upper bodies are learnt
_LONGEST = 600  # frames of a recording
_UNIT = 0.3  # metres in which errors count
_KINECT_SHARE = 0.5  # of the pieces

Shares = Sequence[tuple[float, Sequence[MocapClip]]]
"""Shares of the pieces, and the recordings, of sets."""


def fit_shipped(data: Path, quick: bool) -> LiftingNetwork:
    """Return the network that comes with torchpose.

    Args:
        data: folder with the sets. quick: few recordings and steps, to see that it works.
    """
    return _fitted(data, _patterns(quick), _QUICK_STEPS if quick else _STEPS)


def fit_upper_body(data: Path, quick: bool) -> LiftingNetwork:
    """Return the network for upper bodies: the whole body's, fitted on to people whose hips are hidden.

    Args:
        data: folder with the sets. quick: few recordings and steps, to see that it works.
    """
    shares = _shares(data, _patterns(quick))
    network = copy.deepcopy(shipped_lifting_network()).requires_grad_(True)
    network.info = replace(
        network.info, name="upper-body", command=f"{network.info.command} --upper-body"
    )
    draw = LiftingExamples(shares, _UPPER_SEED, _SEAT_SHARE, any_rate=True, upper_body=True)
    steps = max(1, int(_LATER_STEPS * (_QUICK_STEPS if quick else _STEPS)))
    train_lifter(network, _loss(network, draw), steps, "upper bodies", _LATER_RATE)
    return network.requires_grad_(False)


def _patterns(quick: bool) -> Mapping[str, Sequence[str]]:
    """Return the patterns of the recordings that networks are fitted to, by set."""
    patterns: Mapping[str, Sequence[str]] = {**TRAINING, KINECT: KINECT_TRAINING}
    return {folder: patterns[folder][:1] for folder in (WALKS, KINECT)} if quick else patterns


def _shares(data: Path, patterns: Mapping[str, Sequence[str]]) -> Shares:
    """Return the shares of motion capture and of a Kinect, with their recordings."""
    sets = {name: [*recorded(data / name, given, _LONGEST)] for name, given in patterns.items()}
    kinect = [replace(one, joints=hips_for_pelvis(one.joints)) for one in sets.pop(KINECT)]
    mocap = [clip for clips in sets.values() for clip in clips]
    return (1 - _KINECT_SHARE, mocap), (_KINECT_SHARE, kinect)


def _fitted(
    data: Path, patterns: Mapping[str, Sequence[str]], steps: int, seed: int = 0
) -> LiftingNetwork:
    """Return a network that was fitted to recordings.

    Args:
        data: folder with the sets. patterns: of the recordings, by set.
        steps: of AdamW, 32 pieces of 48 frames each. seed: of weights and pieces.
    """
    shares = _shares(data, patterns)
    torch.manual_seed(seed)
    info = LiftingNetworkInfo(
        name="whole-body",
        recordings=tuple(f"{folder}/{p}" for folder, chosen in patterns.items() for p in chosen),
        licence="MIT; see the card for the recordings",
        command="python -m benchmarks.keypoint_bodies --data DIR --fit FILE.safetensors",
        legs=_legs(shares[0][1]),
    )
    network = LiftingNetwork(info)
    train_lifter(network, _loss(network, LiftingExamples(shares, seed)), steps, "lifting network")
    later = max(1, int(_LATER_STEPS * steps))
    return with_seats(at_any_rate(network, shares, later, seed), shares, later, seed)


def at_any_rate(
    network: LiftingNetwork, shares: Shares, steps: int, seed: int = 0
) -> LiftingNetwork:
    """Return a network that was fitted on, to pieces of any frame rate.

    Walks are recorded at other rates than exercises, so the rate alone tells the first fit which of the two
    a piece is of, and it takes everybody at 30 frames a second for somebody who exercises.

    Args:
        network: of the first fit, changed in place. shares: as of `LiftingExamples`.
        steps: of AdamW. seed: of pieces, the second next one is taken.
    """
    draw = LiftingExamples(shares, seed + 2, any_rate=True)
    train_lifter(network, _loss(network, draw), steps, "any frame rate", _LATER_RATE)
    return network


def with_seats(
    network: LiftingNetwork, shares: Shares, steps: int, seed: int = 0
) -> LiftingNetwork:
    """Return a network that was fitted on, to pieces of recordings in some of which people sit.

    Its parameters are midway between those before and after, as of Wortsman et al., "Robust fine-tuning of
    zero-shot models" (CVPR 2022): those after it alone take people with short legs who stand for people who
    sit.

    Args:
        network: of the earlier fits, changed in place. shares: as of `LiftingExamples`.
        steps: of AdamW. seed: of pieces, the next one is taken.
    """
    before = {name: value.clone() for name, value in network.state_dict().items()}
    draw = LiftingExamples(shares, seed + 1, _SEAT_SHARE, any_rate=True)
    train_lifter(network, _loss(network, draw), steps, "people who sit", _LATER_RATE)
    after = network.state_dict()
    network.load_state_dict({name: (before[name] + after[name]) / 2 for name in before})
    return network.requires_grad_(False)


def _loss(network: LiftingNetwork, draw: LiftingExamples) -> Callable[[], Tensor]:
    """Return what is to be small: the distance of joints, and how unlikely it is by the deviations."""

    def loss() -> Tensor:
        seen, joints = draw()
        lifted, _ = network(seen)
        off = (lifted.joints - joints.nan_to_num()).square().sum(-1) / _UNIT**2
        std = lifted.std / _UNIT
        spread = 3 * std.log() + 0.5 * off.detach() / std.square()
        known = joints.isfinite().all(-1)
        return (off + 1e-6).sqrt()[known].mean() + spread[known].mean()

    return loss


def _legs(clips: Sequence[MocapClip]) -> float:
    """Return the mean length of thigh and shank over recordings, metres."""
    hip, knee, ankle = map(pair_of, ("hip", "knee", "ankle"))
    lengths = [
        (x.joints[:, knee] - x.joints[:, hip]).norm(dim=-1)
        + (x.joints[:, ankle] - x.joints[:, knee]).norm(dim=-1)
        for x in clips
    ]
    return float(torch.stack([length.nanmean() for length in lengths]).nanmean())
