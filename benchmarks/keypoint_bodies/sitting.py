"""People who sit for a whole clip and never stand, in one camera.

Persons 9 to 12 of Berkeley MHAD sit down in one recording of each. The frames in which their thighs are about
level are shown forwards and backwards, with the arms of another recording of the same person, who gestures.
They are seen from the front, obliquely and from the side, at the height of a table, of a tripod and from
above, with a detector's faults; then with knees and ankles hidden.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._seeds import generator_of
from benchmarks.keypoint_bodies.clips import (
    MHAD,
    Clip,
    aimed,
    detect,
    mean_left,
    pair_of,
    recorded,
)
from benchmarks.keypoint_bodies.lifting_examples import with_arms
from benchmarks.keypoint_bodies.methods import Method, row_of
from benchmarks.keypoint_bodies.scoring import Estimate
from torchpose.body import BODY_15
from torchpose.camera import CameraRig
from torchpose.evaluation import Report
from torchpose.metrics import coverage

__all__ = ["add_sitting_table", "read_sitters", "sitting_clips"]

SCORED_SITTERS = {
    "s09": "a05_wave_two_hands",
    "s10": "a07_clap",
    "s11": "a04_punch",
    "s12": "a08_throw",
}
"""Persons who are scored, each with the recording that its arms are of."""
CHOOSING_SITTERS = {
    "s01": "a05_wave_two_hands",
    "s02": "a07_clap",
    "s03": "a04_punch",
    "s04": "a08_throw",
}
"""The same of persons for choosing."""
_VIEWS = {"front": 0.0, "oblique": 45.0, "side": 90.0}  # degrees to the person's left
_HEIGHTS, _DISTANCE, _AIM = (0.75, 1.3, 2.2), 2.5, 0.7  # metres; heights above the floor
_SOLE = 0.08  # metres, of an ankle above the floor
_FRAMES, _QUICK_FRAMES = 60, 4
_LEVEL = math.sin(math.radians(30.0))  # of thighs, downwards, while somebody sits
_PELVIS = BODY_15.joint("pelvis")
_HIPS, _KNEES, _ANKLES = map(pair_of, ("hip", "knee", "ankle"))
_HIDDEN = {"": [], ", no knees": [*_KNEES, *_ANKLES]}
_COLUMNS = ("all", "knees", "ankles", "50 %", "90 %", "knees 50 %", "knees 90 %", "ankles 50 %",
            "ankles 90 %")  # fmt: skip
_DIGITS = (1, 1, 1, 0, 0, 0, 0, 0, 0)
_NOTE = (
    "Errors are relative to the pelvis, mm, and so are ellipsoids, of which the shares that hold the true "
    "joints are given. 'no knees': no keypoints of knees and ankles. A method "
    "marked * has seen no later frame."
)


def add_sitting_table(
    report: Report, methods: Mapping[str, Method], data: Path, quick: bool
) -> None:
    """Add the table of people who sit.

    Args:
        report: gets the table. methods: by name, of one camera. data: folder with the sets.
        quick: one person, one height and few frames, to see that it works.
    """
    views = sitting_clips(data, quick)
    table = report.table("sitting", "One camera, people who sit (mm)", [*_COLUMNS], digits=_DIGITS,
                         note=_NOTE)  # fmt: skip
    for name, method in tqdm(methods.items(), desc="people who sit"):
        for view, clips in views.items():
            for label, hidden in _HIDDEN.items():
                scores = [_measures(method(*clip.without(hidden).given), clip) for clip in clips]
                mean = torch.tensor(scores).nanmean(0).tolist()
                table.add(f"{row_of(name)}, {view}{label}", mean)


def sitting_clips(data: Path, quick: bool = False) -> dict[str, list[Clip]]:
    """Return clips of people who sit, by the side from which they are seen.

    Args:
        data: folder with the sets. quick: one person, one height and few frames.
    """
    persons = read_sitters(data, SCORED_SITTERS, _QUICK_FRAMES if quick else _FRAMES, quick)
    heights = _HEIGHTS[:1] if quick else _HEIGHTS
    return {
        view: [_seen(one, azimuth, height) for one in persons for height in heights]
        for view, azimuth in _VIEWS.items()
    }


class Sitter(NamedTuple):
    """A person who sits: name, joints [T, 15, 3] from the floor, up and left [3], frame rate."""

    name: str
    joints: Tensor
    up: Tensor
    left: Tensor
    fps: float


def read_sitters(data: Path, persons: Mapping[str, str], frames: int, quick: bool) -> list[Sitter]:
    """Return people who sit.

    Args:
        data: folder with the sets. persons: the recordings of their arms, by person. frames: of each.
        quick: the first one alone.
    """
    chosen = list(persons.items())[: 1 if quick else None]
    return [_sitter(data, person, arms, frames) for person, arms in chosen]


def _sitter(data: Path, person: str, arms: str, frames: int) -> Sitter:
    (sits,), (moves,) = (
        [*recorded(data / MHAD, [f"{person}_{action}_r1"])] for action in ("a10_sit_down", arms)
    )
    up, joints = sits.up.double(), sits.joints.double()
    thighs = joints[:, _KNEES] - joints[:, _HIPS]
    level = ((-thighs @ up) / thighs.norm(dim=-1) < _LEVEL).all(-1)
    held = _to_and_fro(joints[level], frames)
    bodies = with_arms(held, _to_and_fro(moves.joints.double(), frames))
    floor = (bodies[:, _ANKLES] @ up).min() - _SOLE
    middle = bodies[:, _PELVIS].mean(0)
    return Sitter(
        person,
        bodies - middle + ((middle @ up) - floor) * up,
        up,
        mean_left(bodies, up),
        sits.fps,
    )


def _to_and_fro(joints: Float[Tensor, "N 15 3"], frames: int) -> Float[Tensor, "T 15 3"]:
    """Return frames forwards and backwards, as often as it takes."""
    both = torch.cat([joints, joints.flip(0)[1:-1]])
    return both[torch.arange(frames) % len(both)]


def _seen(one: Sitter, azimuth: float, height: float) -> Clip:
    """Return a person as a camera of a height sees it, from so many degrees to the left of its front."""
    angle = math.radians(azimuth)
    ahead = torch.linalg.cross(one.left, one.up)
    ray = math.cos(angle) * ahead + math.sin(angle) * one.left
    place = _DISTANCE * ray + height * one.up
    camera = aimed(place, _AIM * one.up, one.up, one.joints, "camera")
    rig = CameraRig([camera])
    name = f"{one.name} from {azimuth:g} degrees, {height:g} m"
    generator = generator_of(name)
    seen = detect(rig(one.joints).pixels, generator)
    return Clip(name, one.fps, one.joints, one.up, rig, seen)


def _measures(estimate: Estimate, clip: Clip) -> list[float]:
    """Return errors of all joints, knees and ankles, and shares in the ellipsoids of each."""
    joints, truth = (x - x[:, [_PELVIS]] for x in (estimate.joints, clip.joints))
    errors = 1000 * (joints - truth).norm(dim=-1)
    others = [j for j in range(len(BODY_15.names)) if j != _PELVIS]
    shares = [math.nan] * 6
    if estimate.covariance is not None:
        given = (joints, estimate.covariance, truth)
        shares = [
            100 * share
            for chosen in (others, _KNEES, _ANKLES)
            for share in coverage(*(value[:, chosen] for value in given)).overall.tolist()
        ]
    return [*(float(errors[:, x].nanmean()) for x in (others, _KNEES, _ANKLES)), *shares]
