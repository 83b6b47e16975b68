"""Recorded clips: splits into training, validation and test, and the places of the cameras."""

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.body import BODY_15
from torchpose.camera import CameraRig
from torchpose.demo._rendering.walk import AZIMUTHS, cameras_around
from torchpose.errors import InputError
from torchpose.io._mocap import MocapClip

LEAST_FRAMES = 110
"""A test trial should have as many; a shorter one is taken where there is no other."""

_PELVIS = BODY_15.joint("pelvis")


class Split(NamedTuple):
    """What one tracked person is tracked with.

    Attributes:
        person: who. test: trials to track. manifold: clips for the manifold.
        validation: clips for noise and sharpness, of the manifold's action. body: clips for bone
            lengths and radii, never of a test trial.
        seen: whether the manifold is made of other trials of the same person.
    """

    person: str
    test: tuple[MocapClip, ...]
    manifold: tuple[MocapClip, ...]
    validation: tuple[MocapClip, ...]
    body: tuple[MocapClip, ...]
    seen: bool


def select_persons(
    clips: Sequence[MocapClip], persons: Sequence[str]
) -> dict[str, list[MocapClip]]:
    """Return the clips by person, in the order asked for; ``07``, ``7`` and ``s07`` are the same person.

    Args:
        persons: their names; all persons if empty.

    Raises:
        InputError: nobody of that name; the names that are there are listed.
    """
    by_key: dict[str, list[MocapClip]] = {}
    for clip in clips:
        by_key.setdefault(_person_key(clip.person), []).append(clip)
    found = {}
    for name in persons or dict.fromkeys(clip.person for clip in clips):
        group = by_key.get(_person_key(name))
        if group is None:
            there = ", ".join(dict.fromkeys(clip.person for clip in clips))
            raise InputError(f"expected recordings of person {name}; there are those of {there}")
        found[group[0].person] = group
    return found


def _person_key(name: str) -> str:
    """Return the number of a person whose name is one, else the name in lower case.

    >>> _person_key("s07") == _person_key("7") == _person_key("07")
    True
    """
    match = re.fullmatch(r"[A-Za-z]?0*(\d+)", name.strip())
    return match[1] if match else name.strip().lower()


def split_clips(
    clips: Sequence[MocapClip],
    train_persons: Sequence[str] = (),
    test_persons: Sequence[str] = (),
    n_clips: int = 1,
    manifold_frames: int = 350,
    validation_frames: int = 300,
    tracked: Sequence[MocapClip] = (),
) -> list[Split]:
    """Return a split for each tracked person: its clips, and those of training and validation.

    A person who trains as well is tracked in the first trials, and the manifold and the validation
    have the following ones. Somebody else is tracked with a manifold of the others; bone lengths and
    radii come from their own remaining trials.

    Args:
        clips: of one action. train_persons, test_persons: names; all persons if empty.
        n_clips: trials tracked of each person. manifold_frames, validation_frames: at most so many.
        tracked: clips of another action, to be tracked instead of `clips`, which still make the
            manifold and choose noise and sharpness.

    Raises:
        InputError: no such person, or one with too few trials.
    """
    testers = select_persons(tracked or clips, test_persons)
    trainers = select_persons(clips, train_persons)
    found = []
    for person, group in testers.items():
        test = _test_trials(group, n_clips)
        tested = {clip.trial for clip in test}
        # of the manifold's action first, then other trials of the tracked one
        own = [c for c in (*clips, *tracked) if c.person == person and c.trial not in tested]
        seen = person in trainers
        if seen:
            pool = [clip for clip in trainers[person] if clip.trial not in tested]
        else:
            pool = [clip for group in trainers.values() for clip in group]
        if len(pool) < 2 or not own:
            raise InputError(
                f"person {person}: expected two trials or more beside the {len(test)} tracked ones "
                f"for manifold and validation, and one of their own for the body, got {len(pool)} "
                f"and {len(own)}; give --clips fewer or other persons"
            )
        manifold, rest = _share(pool, manifold_frames, seen)
        validation = take_frames(rest, validation_frames)
        found.append(Split(person, test, manifold, validation, take_frames(own, 350), seen))
    return found


def take_frames(clips: Sequence[MocapClip], n_frames: int) -> tuple[MocapClip, ...]:
    """Return clips from the first on until there are so many frames; the last one is cut."""
    taken: list[MocapClip] = []
    left = n_frames
    for clip in clips:
        if left < 2:
            break
        taken.append(clip.cut(0, left))
        left -= len(taken[-1])
    return tuple(taken)


def whole_frames(clip: MocapClip) -> Bool[Tensor, " T"]:
    """Return frames in which no joint was lost; one that the set lacks altogether does not count."""
    missing = clip.joints.isnan().any(-1)
    return ~(missing & ~missing.all(0)).any(-1) & ~missing.all(-1)


def _test_trials(group: Sequence[MocapClip], n_clips: int) -> tuple[MocapClip, ...]:
    long = [clip for clip in group if len(clip) >= LEAST_FRAMES]
    return tuple((long or list(group))[:n_clips])


def _share(
    pool: Sequence[MocapClip], n_frames: int, seen: bool
) -> tuple[tuple[MocapClip, ...], list[MocapClip]]:
    """Return clips for the manifold, and what is left for the validation: at least one.

    Of several persons everybody gives the same number of frames.
    """
    if not seen:
        by_person: dict[str, list[MocapClip]] = {}
        for clip in pool:
            by_person.setdefault(clip.person, []).append(clip)
        share = math.ceil(n_frames / len(by_person))
        taken = [
            take_frames(group[: max(1, len(group) - 1)], share) for group in by_person.values()
        ]
        rest = [clip for group in by_person.values() for clip in group[-1:]]
        return tuple(clip for part in taken for clip in part), rest
    taken_clips = take_frames(pool[:-1], n_frames)
    used = {clip.trial for clip in taken_clips}
    return taken_clips, [clip for clip in pool if clip.trial not in used]


# --- cameras --------------------------------------------------------------------------------------


def place_cameras(
    clip: MocapClip, azimuths: Sequence[float] = AZIMUTHS, **options: float
) -> CameraRig:
    """Return the rig of `cameras_around` a clip, which takes the options."""
    return CameraRig(cameras_around(clip, azimuths, **options))


def in_view(clip: MocapClip, cameras: CameraRig) -> Float[Tensor, " C"]:
    """Return the share of the joints that lie in each camera's image."""
    known = clip.joints.isfinite().all(-1)
    view = cameras(clip.joints.nan_to_num().double())
    height, width = cameras.size or (480, 640)
    limit = view.pixels.new_tensor([width - 0.5, height - 0.5])
    inside = (view.pixels > -0.5).all(-1) & (view.pixels < limit).all(-1) & (view.depth > 0)
    counted = known.unsqueeze(-2).expand(inside.shape)
    return (inside & counted).double().sum((0, 2)) / counted.double().sum((0, 2))


# --- a walk without end ---------------------------------------------------------------------------


def looped(clip: MocapClip, times: int, blend: int = 8) -> MocapClip:
    """Return one cycle of a walk, on the spot, so many times, its end blended into its start.

    The mean velocity is taken out of the clip; the cycle is that whose last pose is nearest to its
    first, in places and steps.

    Args:
        clip: two cycles or more are best. times: how often. blend: frames that are blended.

    Raises:
        InputError: the clip is too short for a cycle, or joints are missing.
    """
    if times < 1:
        raise InputError(f"a walk is looped once or more, got {times}")
    start, length = _cycle(clip, blend)
    joints, recorded = _on_the_spot(clip)

    def repeat(points: Tensor) -> Tensor:
        cycle = points[start : start + length].clone()
        share = (torch.arange(1, blend + 1) / (blend + 1)).to(points)[:, None, None]
        before = points[start - blend : start]
        cycle[-blend:] = (1 - share) * cycle[-blend:] + share * before
        return cycle.repeat(times, 1, 1)

    return replace(
        clip, joints=repeat(joints), recorded=repeat(recorded),
        trial=f"{clip.trial} looped {times} times",
    )  # fmt: skip


def _on_the_spot(clip: MocapClip) -> tuple[Tensor, Tensor]:
    pelvis = clip.joints[:, _PELVIS]
    t = torch.arange(len(clip), dtype=pelvis.dtype)
    t = t - t.mean()
    velocity = (t[:, None] * (pelvis - pelvis.mean(0))).sum(0) / (t * t).sum()
    velocity = velocity - (velocity @ clip.up) * clip.up
    drift = (t[:, None] * velocity)[:, None]
    return clip.joints - drift, clip.recorded - drift


def _cycle(clip: MocapClip, blend: int, shortest: int = 40, longest: int = 110) -> tuple[int, int]:
    """Return the first frame and length of the cycle whose ends are nearest to each other."""
    joints, _ = _on_the_spot(clip)
    points = joints.nan_to_num().flatten(1)
    step = 5 * (points[1:] - points[:-1])
    both = torch.cat([points[1:], step], -1)
    last = len(both) - 1
    if last < shortest + blend:
        raise InputError(
            f"{clip.trial}: a cycle needs {shortest + blend + 2} frames, got {len(clip)}"
        )
    apart = torch.cdist(both, both)
    lag = torch.arange(len(both)) - torch.arange(len(both))[:, None]
    allowed = (lag >= shortest) & (lag <= longest)
    allowed[:blend] = False
    if not bool(allowed.any()):
        raise InputError(f"{clip.trial}: a cycle needs more frames than {len(clip)}")
    best = int(torch.where(allowed, apart, torch.inf).argmin())
    first, end = divmod(best, len(both))
    return first + 1, end - first
