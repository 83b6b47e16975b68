"""What one person is tracked with: body, manifold, noise, and the silhouettes of every clip."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks.silhouette.data import AZIMUTHS, Split, in_view, place_cameras, whole_frames
from torchpose.body import Body, fit_body, fit_state
from torchpose.camera import CameraRig
from torchpose.demo._rendering.clothed_body import TrueShape, true_silhouettes
from torchpose.errors import InputError
from torchpose.evaluation.common import settings_hash
from torchpose.io._mocap import MocapClip
from torchpose.learning import fit_gplvm, fit_gplvm_noise
from torchpose.priors import BackConstrainedGPLVM, ManifoldInfo
from torchpose.whole_body import (
    AnnealedParticleFilter,
    ManifoldParticleFilter,
    SilhouetteParticleFilter,
    SIRParticleFilter,
    count_pixels,
    motion_std,
)
from torchpose.whole_body._silhouettes.likelihood import intersection_over_union
from torchpose.whole_body._silhouettes.shape import fit_radii

__all__ = [
    "METHODS",
    "SCALES",
    "Conditions",
    "Footage",
    "Method",
    "Setting",
    "Tracked",
    "Trackee",
    "View",
    "any_heading",
    "body_of",
    "label_of",
    "make_filter",
    "prepare",
    "view_of",
]

LAYERS = 5
_RADII_FRAMES = 8


class Method(NamedTuple):
    """A filter of the comparison.

    Attributes:
        label: in tables. tuned: what validation chooses, beside the scale of the diffusion.
        first: the value with which the scale is chosen. values: what it then chooses among, the
            published one among them. options: of the filter.
    """

    label: str
    tuned: str
    first: float
    values: tuple[float, ...]
    options: dict[str, Any]


class Setting(NamedTuple):
    """What validation chose: sharpness (or survival rate), and factor of the diffusion."""

    value: float
    scale: float = 1.0


SCALES = (0.7, 1.0, 1.4, 2.0, 2.8)
"""Factors of the diffusion that validation chooses among; 1 is the motion of the validation clips."""

PUBLISHED_SURVIVAL = 0.5
_SHARPNESS = ("sharpness", 100.0, (1.0, 30.0, 100.0, 300.0))

METHODS = {
    "sir": Method("SIR", *_SHARPNESS, {}),
    "apf": Method("APF", "survival rate", PUBLISHED_SURVIVAL, (0.3, 0.5, 0.7, 0.85), {}),
    "mrpf": Method("MRPF", *_SHARPNESS, {"weights": "normalised", "proposal": "product"}),
    "mrpf-diffusion": Method(
        "MRPF, diffusion", *_SHARPNESS, {"weights": "normalised", "proposal": "diffusion"}
    ),
    "mrpf-published": Method(
        "MRPF as published", *_SHARPNESS, {"weights": "published", "proposal": "diffusion"}
    ),
    "mrpf-published-product": Method(
        "MRPF as published, product", *_SHARPNESS, {"weights": "published", "proposal": "product"}
    ),
}
"""The filters by the names that the command takes.

``mrpf`` has the exact form of the weights (MR 28 normalised over x_t) and samples the product of
both Gaussians; ``mrpf-published`` weighs by (MR 30) alone and samples the diffusion.
"""


def label_of(method: str) -> str:
    """What a method is called in tables and pictures; its name, if it is none of `METHODS`."""
    return METHODS[method].label if method in METHODS else method


@runtime_checkable
class Footage(Protocol):
    """Silhouettes of videos, in place of rendered ones."""

    def sees(self, clip: MocapClip) -> bool:
        """Whether there are videos of a clip."""

    def __call__(
        self, clip: MocapClip, size: tuple[int, int], n_cameras: int
    ) -> tuple[CameraRig, Bool[Tensor, "T C H W"]]:
        """The first `n_cameras` cameras, scaled to (height, width), and what they see of a clip."""


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


@dataclass(frozen=True)
class Trackee(Tracked):
    """A person with a manifold.

    Args:
        manifold: of the training clips.
    """

    manifold: BackConstrainedGPLVM


def prepare(
    split: Split,
    conditions: Conditions,
    test_frames: int,
    validation_frames: int,
    manifold_seed: int = 0,
) -> Trackee:
    """Fit body, manifold and noise to a person's training clips, and render what cameras see.

    Args:
        split: clips. conditions: of the silhouettes. test_frames: of each test trial, from its first.
        validation_frames: for the exponents. manifold_seed: of the manifold's fit.
    """
    body = body_of(split.body, conditions)
    bodies = {split.person: body}
    for clip in (*split.manifold, *split.validation):
        if clip.person not in bodies:
            theirs = [c for c in (*split.manifold, *split.validation) if c.person == clip.person]
            bodies[clip.person] = body_of(theirs, conditions)
    manifold = _manifold(split, bodies, manifold_seed)
    moved = [_states(bodies, clip) for clip in split.validation]
    tests = tuple(view_of(body, clip.cut(0, test_frames), conditions) for clip in split.test)
    first = split.validation[0].cut(0, validation_frames)
    owner = bodies[first.person]
    validation = ((owner, view_of(owner, first, conditions)),)
    step_std = any_heading(motion_std(body, moved), first.up)
    return Trackee(split, body, step_std, tests, validation, manifold)


def make_filter(
    name: str,
    trackee: Trackee,
    setting: Setting,
    n_particles: int = 500,
    likelihood: str = "bidirectional",
    body: Body | None = None,
) -> SilhouetteParticleFilter:
    """A filter that evaluates `n_particles` likelihoods a frame, whatever its method.

    Args:
        name: among `METHODS`. setting: sharpness or survival rate, and factor of the diffusion.
        body: instead of the trackee's.

    Raises:
        InputError: an unknown method, or fewer particles than an annealed filter has layers.
    """
    if name not in METHODS:
        raise InputError(f"method must be among {', '.join(METHODS)}, got {name!r}")
    method, own = METHODS[name], trackee.body if body is None else body
    common: dict[str, Any] = {
        "step_std": setting.scale * trackee.step_std,
        "likelihood": likelihood,
    }
    if name == "apf":
        if n_particles < LAYERS:
            raise InputError(f"{LAYERS} layers need {LAYERS} particles or more, got {n_particles}")
        return AnnealedParticleFilter(
            own, n_particles // LAYERS, n_layers=LAYERS, survival_rate=setting.value, **common
        )
    if name == "sir":
        return SIRParticleFilter(own, n_particles, sharpness=setting.value, **common)
    return ManifoldParticleFilter(
        own, trackee.manifold, n_particles, sharpness=setting.value, **method.options, **common
    )


# --- fits -----------------------------------------------------------------------------------------


def any_heading(std: Float[Tensor, " D"], up: Float[Tensor, "3"]) -> Float[Tensor, " D"]:
    """The root's steps the same in all horizontal directions: the next walk may go elsewhere."""
    along = up.abs() > 0.9
    level = ~along if bool(along.any()) else torch.ones_like(along)
    std = std.clone()
    std[:3] = torch.where(level, std[:3][level].square().mean().sqrt(), std[:3])
    return std


def person_seed(person: str, seed: int) -> int:
    """Seed of a person's shape, the same in all conditions of a run."""
    return int(settings_hash([person, seed])[:8], 16)


def body_of(clips: Sequence[MocapClip], conditions: Conditions) -> Body:
    """Bone lengths of all frames, radii of a few frames of the first clip that cameras see.

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


def _states(bodies: dict[str, Body], clip: MocapClip) -> Float[Tensor, "T D"]:
    return fit_state(bodies[clip.person], clip.joints)


def _manifold(split: Split, bodies: dict[str, Body], seed: int) -> BackConstrainedGPLVM:
    body = bodies[split.person]
    info = ManifoldInfo.of_body(
        body,
        name=f"{' '.join(dict.fromkeys(c.person for c in split.manifold))}",
        persons=tuple(dict.fromkeys(c.person for c in split.manifold)),
        actions=tuple(dict.fromkeys(c.action for c in split.manifold)),
        sequences=tuple(c.trial for c in split.manifold),
    )
    poses = [body.relative(_states(bodies, clip)) for clip in split.manifold]
    manifold = fit_gplvm(poses, seed=seed, info=info)
    held_out = [body.relative(_states(bodies, clip)) for clip in split.validation]
    return fit_gplvm_noise(manifold, held_out, split.validation[0].fps)


# --- views ----------------------------------------------------------------------------------------


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
    shape = TrueShape.draw(person_seed(clip.person, conditions.seed))
    generator = torch.Generator().manual_seed(person_seed(clip.trial, conditions.seed))
    return rig, true_silhouettes(clip, shape, rig, conditions.faults, generator)


def view_of(body: Body, clip: MocapClip, conditions: Conditions) -> View:
    """A clip as the cameras see it, with its first state for this body.

    Frames in which joints were lost count for nothing; the first one must be whole.
    """
    rig, silhouettes = _seen(clip, conditions)
    whole = whole_frames(clip)
    if not bool(whole[0]):
        raise InputError(f"{clip.person} {clip.trial}: joints are missing in the first frame")
    joints = clip.joints[whole]
    states = fit_state(body, joints)
    apart = (body.joints(states) - joints).norm(dim=-1)
    counts = count_pixels(body, states[:, None], rig, silhouettes[whole])
    overlap = intersection_over_union(counts)
    return View(
        clip, rig, silhouettes, states[0], 1000 * float(apart.nanmean()),
        float(overlap.mean()), float(in_view(clip, rig).min()),
    )  # fmt: skip
