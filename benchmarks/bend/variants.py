"""Variants of the tracker of the protocol Bend, and the person that they track: body, action model, views."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks.bodies.clips import Split
from benchmarks.bodies.views import Conditions, Subject, Tracked, body_of, view_of
from benchmarks.engine import Setting
from torchpose.body import BODY_15, Body, centres_of, fit_body, fit_state
from torchpose.io._mocap import MocapClip
from torchpose.learning._action_spaces import fit_synchronised
from torchpose.priors import ActionBank, ActionSpace, posture_angles, state_postures
from torchpose.priors._actions.action_file import ActionInfo, Synchronised
from torchpose.priors._actions.gate import Acceptance
from torchpose.priors._actions.polar_limbs import LIMBS_12
from torchpose.whole_body import ConstrainedParticleFilter, constant_velocity_std

SHARPNESS = (30.0, 1.0, 10.0, 100.0, 300.0)
"""Exponents of the intersection over union that validation chooses among, 1 as published; the first
is the one with which the diffusion is chosen."""

DIMENSIONS = 13
"""Of the action space, as published."""

MOST_DIMENSIONS = 25

REDRAWS = 8
"""How often a rejected prediction is drawn again; then it is moved to the gate."""


class Variant(NamedTuple):
    """One tracker of the comparison.

    Attributes:
        constrained: predictions by the action model, else of the first order alone.
        particles: N. dimensions: D of the action space; what it is without constraint counts for
            nothing. limb_shape: cylinders or rectangles.
    """

    constrained: bool
    particles: int
    dimensions: int = DIMENSIONS
    limb_shape: str = "cylinders"

    @property
    def label(self) -> str:
        """Return the name in tables."""
        return "constrained" if self.constrained else "first order"


Performed = tuple[Tensor, ...]
"""Return states [T, D] of one person's performances of an action."""


@dataclass(frozen=True)
class BendPerson(Tracked):
    """A person with an action model of the others.

    Args:
        space: of the performances of everybody else, with as many dimensions as they have.
        known: [36], False for the angles of limbs that the recordings lack.
        own, trained: all postures [T, 36] of this person, and of one who trained.
        bank: of several actions of the others, where there is one.
    """

    space: ActionSpace
    known: Tensor
    own: Tensor
    trained: Tensor
    bank: ActionBank | None = None


def perform(clips: Sequence[MocapClip], centres: Float[Tensor, "P 3"] | None = None) -> Performed:
    """Return states [T, D] of one person's performances, of a body with constant bone lengths.

    Args:
        clips: of the person, one performance each. centres: of the parts; none if None.
    """
    joints = torch.cat([clip.joints for clip in clips])
    states = fit_state(fit_body(joints, centres=centres), joints)
    return states.split([len(clip) for clip in clips])


def arm_centres(clips: Sequence[MocapClip]) -> Float[Tensor, "P 3"]:
    """Return centres of the parts (DX 1): arms above the head are half a turn away from hanging ones, where
    the vectors of their rotations would jump."""
    joints = torch.cat([clip.joints for clip in clips])
    body = fit_body(joints)
    return centres_of(body, fit_state(body, joints))


def prepare(
    split: Split,
    performed: Mapping[str, Performed],
    conditions: Conditions,
    name: str = "bend",
    centres: Float[Tensor, "P 3"] | None = None,
) -> BendPerson:
    """Fit body, action space and noise, and render what the camera sees.

    Args:
        split: of `leave_one_out`. performed: of everybody, of whom the person is left out.
        conditions: of the silhouettes. name: of the action. centres: those of `performed`.
    """
    body = body_of(split.body, conditions)
    if centres is not None:
        body = body.altered(centres=centres)
    others = [one for person, one in performed.items() if person != split.person]
    space = fit_space(body, others, name, split.test[0].fps)
    step_std = constant_velocity_std(body, [s for one in others for s in one])
    tests = tuple(view_of(body, clip, conditions) for clip in split.test)
    own, trained = performed[split.person], others[0]
    return BendPerson(
        split, body, step_std, tests, (), space, known_angles(split.test[0]),
        state_postures(body, torch.cat(own)), state_postures(body, torch.cat(trained)),
    )  # fmt: skip


def fit_space(body: Body, performed: Sequence[Performed], name: str, fps: float) -> ActionSpace:
    """Return the action space of some persons' performances, put on the body that is to be tracked.

    With the same rotations, where somebody's shoulders and hips are makes no difference. It has as
    many dimensions as are ever asked for.
    """
    space, _ = synchronised_space(body, performed, ActionInfo(name=name, fps=fps))
    return space


def synchronised_space(
    body: Body, performed: Sequence[Performed], info: ActionInfo
) -> tuple[ActionSpace, Synchronised]:
    """Return the same, and the performances in it before and after they are put in step."""
    postures = [state_postures(body, states) for one in performed for states in one]
    rank = min(MOST_DIMENSIONS, int(torch.linalg.matrix_rank(torch.cat(postures), rtol=1e-4)))
    return fit_synchronised(postures, rank, name=info.name, fps=info.fps, info=info)


def known_angles(clip: MocapClip) -> Bool[Tensor, "36"]:
    """Return True for the angles of limbs whose joints are recorded."""
    there = dict(zip(BODY_15.names, clip.joints.isfinite().all(-1).all(0).tolist(), strict=True))
    return torch.tensor([there[limb.start] and there[limb.end] for limb in LIMBS_12 for _ in "xyz"])


def true_postures(body: Body, clip: MocapClip) -> Float[Tensor, "T 36"]:
    """Return the angles of a body fitted to the recorded joints, degrees."""
    return state_postures(body, fit_state(body, clip.joints))


def recorded_gap(subject: Subject[BendPerson]) -> float:
    """Return the mean squared difference of these from the angles of the recorded joints, degrees^2."""
    clip = subject.view.clip
    apart = true_postures(subject.body, clip) - posture_angles(clip.joints)
    return float(apart[:, subject.person.known].square().mean())


def make_filter(
    variant: Variant, tracked: BendPerson, setting: Setting, action: Any = None
) -> ConstrainedParticleFilter:
    """Return the tracker of a variant, in single precision.

    Args:
        variant: which. tracked: whose body and action space. setting: sharpness, and factor of the
            noise. action: a bank, or another space, instead of this person's.
    """
    if action is None and variant.constrained:
        action = tracked.space.with_dimensions(min(variant.dimensions, tracked.space.n_dimensions))
    tracker = ConstrainedParticleFilter(
        tracked.body, action if variant.constrained else None, variant.particles,
        process_cov=(setting.scale * tracked.step_std).square(), likelihood="overlap",
        sharpness=setting.value, limb_shape=variant.limb_shape, max_redraws=REDRAWS,
    )  # fmt: skip
    return copy.deepcopy(tracker).float()


def true_acceptance(tracked: BendPerson, dimensions: int) -> tuple[Acceptance, Acceptance]:
    """Return the share of recorded postures that pass: of the person left out, and of a trainer."""
    space = tracked.space.with_dimensions(dimensions)
    generators = [torch.Generator().manual_seed(seed) for seed in (0, 1)]
    unseen, trained = (
        space.acceptance(postures, generator=generator)
        for postures, generator in zip((tracked.own, tracked.trained), generators, strict=True)
    )
    return unseen, trained
