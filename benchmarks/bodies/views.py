"""Views of recorded people: the tracker's body, and the silhouettes of every clip."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks._seeds import generator_of, seed_of
from benchmarks.bodies.clips import AZIMUTHS, Split, in_view, place_cameras, whole_frames
from benchmarks.bodies.silhouettes import true_silhouettes
from torchpose.body import Body, fit_body, fit_state
from torchpose.camera import CameraRig
from torchpose.demo._rendering.clothed_body import TrueShape
from torchpose.errors import InputError
from torchpose.io._mocap import MocapClip
from torchpose.metrics import joint_errors
from torchpose.whole_body import count_pixels
from torchpose.whole_body._silhouettes.likelihood import intersection_over_union
from torchpose.whole_body._silhouettes.shape import fit_radii

_RADII_FRAMES = 8


@runtime_checkable
class Footage(Protocol):
    """Silhouettes of videos, in place of rendered ones."""

    def sees(self, clip: MocapClip) -> bool:
        """Return whether there are videos of a clip."""

    def __call__(
        self, clip: MocapClip, size: tuple[int, int], n_cameras: int
    ) -> tuple[CameraRig, Bool[Tensor, "T C H W"]]:
        """Return the first cameras, scaled to (height, width), and what they see of a clip."""


@dataclass(frozen=True)
class Conditions:
    """What silhouettes are like.

    Args:
        size: (height, width), pixels. faults: severity. cameras_used: the first so many of the rig.
        rig: the cameras, or None to place three around each clip. seed: of shapes and faults.
        azimuths: where cameras are placed, degrees from the direction of the walk or of the chest,
            to the person's left.
        footage: silhouettes that were filmed; with it, faults, rig, seed and azimuths have no part.
    """

    size: tuple[int, int] = (120, 160)
    faults: float = 1.0
    cameras_used: int = 3
    rig: CameraRig | None = None
    seed: int = 0
    azimuths: tuple[float, ...] = AZIMUTHS
    footage: Footage | None = None


class View(NamedTuple):
    """A clip as the cameras see it.

    Attributes:
        clip: with the true joints. rig: cameras of the silhouettes' size.
        silhouettes: [T, C, H, W]. initial_state: [D], that of the first frame.
        floor: mean error of the nearest state, mm. overlap: intersection over union of the body at
            that state with the silhouettes, mean. in_view: share of joints within the images.
    """

    clip: MocapClip
    rig: CameraRig
    silhouettes: Bool[Tensor, "T C H W"]
    initial_state: Float[Tensor, " D"]
    floor: float
    overlap: float
    in_view: float


@dataclass(frozen=True)
class Tracked:
    """A person, ready to be tracked.

    Args:
        split: whose clips. body: with bone lengths and radii of training clips.
        step_std: [D], of clips that are not tracked.
        tests: clips to track. validation: (body, view) of clips that choose the settings.
    """

    split: Split
    body: Body
    step_std: Float[Tensor, " D"]
    tests: tuple[View, ...]
    validation: tuple[tuple[Body, View], ...]


Person = TypeVar("Person", bound=Tracked)


class Subject(NamedTuple, Generic[Person]):
    """A person in one clip.

    Attributes:
        person: with the noise and the models that the clip is tracked with.
        body: that is tracked; another one's where somebody else's clip chooses the settings.
        view: what cameras see.
    """

    person: Person
    body: Body
    view: View


SEEN = {
    "nearest state (mm)": lambda subject: subject.view.floor,
    "overlap": lambda subject: subject.view.overlap,
    "in view (%)": lambda subject: 100 * subject.view.in_view,
}
"""Columns of a table of subjects: how near the tracker's body can come to what the cameras see."""


def subjects_of(people: Sequence[Person]) -> dict[str, Subject[Person]]:
    """Return everybody in every clip that is tracked, by person and trial."""
    return {
        f"{person.split.person} {view.clip.trial}": Subject(person, person.body, view)
        for person in people
        for view in person.tests
    }


def validation_subjects(people: Sequence[Person]) -> dict[str, Subject[Person]]:
    """Return everybody in every clip that chooses settings."""
    pairs = [(person, body, view) for person in people for body, view in person.validation]
    return {str(i): Subject(*pair) for i, pair in enumerate(pairs)}


def image_size(text: str) -> tuple[int, int]:
    """Return (height, width) of ``160x120``.

    Raises:
        InputError: these are no two whole numbers above zero.
    """
    match = re.fullmatch(r"\s*(\d+)\s*[x×]\s*(\d+)\s*", text)
    if match is None or 0 in (int(match[1]), int(match[2])):
        raise InputError(f"--size must be width x height such as 160x120, got {text!r}")
    return int(match[2]), int(match[1])


def any_heading(std: Float[Tensor, " D"], up: Float[Tensor, "3"]) -> Float[Tensor, " D"]:
    """Make the root's steps the same in all horizontal directions: the next walk may go elsewhere."""
    along = up.abs() > 0.9
    level = ~along if bool(along.any()) else torch.ones_like(along)
    std = std.clone()
    std[:3] = torch.where(level, std[:3][level].square().mean().sqrt(), std[:3])
    return std


def body_of(clips: Sequence[MocapClip], conditions: Conditions) -> Body:
    """Fit bone lengths to all frames, radii to a few frames of the first clip that cameras see.

    Where they see none, radii are those of an average person of these lengths: enough for states.
    """
    body = fit_body(torch.cat([clip.joints for clip in clips]))
    footage = conditions.footage
    first = next((clip for clip in clips if footage is None or footage.sees(clip)), None)
    if first is None:
        return body
    rig, silhouettes = _seen(first, conditions)
    rows = torch.linspace(0, len(first) - 1, min(_RADII_FRAMES, len(first))).round().long()
    states = fit_state(body, first.joints[rows])
    return fit_radii(body, states, silhouettes[rows], rig, seed=conditions.seed)


def view_of(body: Body, clip: MocapClip, conditions: Conditions) -> View:
    """Return a clip as the cameras see it, with its first state for this body.

    Frames in which joints were lost count for nothing; the first one must be whole.

    Raises:
        InputError: joints are missing in the first frame, or no camera sees the person.
    """
    rig, silhouettes = _seen(clip, conditions)
    whole = whole_frames(clip)
    if not bool(whole[0]):
        raise InputError(f"{clip.person} {clip.trial}: joints are missing in the first frame")
    joints = clip.joints[whole]
    states = fit_state(body, joints)
    apart = joint_errors(body.joints(states), joints)
    counts = count_pixels(body, states[:, None], rig, silhouettes[whole])
    overlap = intersection_over_union(counts)
    return View(
        clip, rig, silhouettes, states[0], 1000 * float(apart.nanmean()),
        float(overlap.mean()), float(in_view(clip, rig).min()),
    )  # fmt: skip


def _seen(clip: MocapClip, conditions: Conditions) -> tuple[CameraRig, Bool[Tensor, "T C H W"]]:
    if conditions.footage is not None:
        return conditions.footage(clip, conditions.size, conditions.cameras_used)
    rig = place_cameras(clip, conditions.azimuths) if conditions.rig is None else conditions.rig
    if conditions.cameras_used > len(rig):
        raise InputError(
            f"{conditions.cameras_used} cameras are asked for, and there are {len(rig)}"
        )
    rig = rig.select(range(conditions.cameras_used)).scaled(*conditions.size)
    if float(in_view(clip, rig).max()) == 0:
        raise InputError(
            f"{clip.trial}: no camera sees the person; cameras must be in the axes and metres of the "
            "recordings"
        )
    shape = TrueShape.draw(seed_of(clip.person, conditions.seed))  # the same in all conditions
    generator = generator_of(clip.trial, conditions.seed)
    return rig, true_silhouettes(clip, shape, rig, conditions.faults, generator)
