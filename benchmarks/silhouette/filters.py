"""Persons, filters and runs of the protocol Silhouette."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.bodies.clips import Split
from benchmarks.bodies.tracking import (
    LAYERS,
    MADE_WITH,
    PUBLISHED_SURVIVAL,
    Method,
    Run,
    generators_of,
    subject_facts,
    track_view,
)
from benchmarks.bodies.views import (
    Conditions,
    Subject,
    Tracked,
    any_heading,
    body_of,
    validation_subjects,
    view_of,
)
from benchmarks.engine import Experiment, Grid, Setting, Tuning, choose_setting
from torchpose.body import Body, fit_state
from torchpose.errors import InputError
from torchpose.io._mocap import MocapClip
from torchpose.learning import fit_gplvm, fit_gplvm_noise
from torchpose.priors import BackConstrainedGPLVM, ManifoldInfo
from torchpose.whole_body import (
    AnnealedParticleFilter,
    ManifoldParticleFilter,
    SilhouetteParticleFilter,
    SIRParticleFilter,
    find_first_pose,
    fit_sharpness,
    motion_std,
)
from torchpose.whole_body._sharpness import ValidationSequence

_LOOK_AHEAD = 30  # frames that decide where somebody faces, if the first pose is found
_SHARPNESS = ("sharpness", 100.0, (1.0, 30.0, 100.0, 300.0))
_SOURCES = (*MADE_WITH, "benchmarks/silhouette/filters.py")

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
    """Return the name of a method in tables and pictures; the given one if it is none of `METHODS`."""
    return METHODS[method].label if method in METHODS else method


@dataclass(frozen=True)
class SilhouettePerson(Tracked):
    """A person with a manifold.

    Args:
        manifold: of the training clips.
    """

    manifold: BackConstrainedGPLVM


class Filter(NamedTuple):
    """A method with all that it is run with.

    Attributes:
        name: among `METHODS`. setting: what validation chose. n_particles: likelihoods a frame.
        likelihood: "bidirectional" (MR 12) or "overlap" (AS 7).
        initial: the first pose, "given" or "found" in the first frames.
    """

    name: str
    setting: Setting
    n_particles: int = 500
    likelihood: str = "bidirectional"
    initial: str = "given"


def prepare(
    split: Split,
    conditions: Conditions,
    test_frames: int,
    validation_frames: int,
    manifold_seed: int = 0,
) -> SilhouettePerson:
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
    return SilhouettePerson(split, body, step_std, tests, validation, manifold)


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


def make_filter(
    name: str,
    tracked: SilhouettePerson,
    setting: Setting,
    n_particles: int = 500,
    likelihood: str = "bidirectional",
    body: Body | None = None,
) -> SilhouetteParticleFilter:
    """Return a filter that evaluates `n_particles` likelihoods a frame, whatever its method.

    Args:
        name: among `METHODS`. tracked: whose noise and manifold.
        setting: sharpness or survival rate, and factor of the diffusion.
        n_particles, likelihood: as `Filter`. body: instead of this person's.

    Raises:
        InputError: an unknown method, or fewer particles than an annealed filter has layers.
    """
    if name not in METHODS:
        raise InputError(f"method must be among {', '.join(METHODS)}, got {name!r}")
    method, own = METHODS[name], tracked.body if body is None else body
    common: dict[str, Any] = {
        "process_cov": (setting.scale * tracked.step_std).square(),
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
        own, tracked.manifold, n_particles, sharpness=setting.value, **method.options, **common
    )


# --- runs -----------------------------------------------------------------------------------------


def _track(subject: Subject[SilhouettePerson], how: Filter, seeds: Sequence[int]) -> list[Run]:
    tracker = make_filter(
        how.name, subject.person, how.setting, how.n_particles, how.likelihood, subject.body
    )
    generators = generators_of(seeds)
    start = subject.view.initial_state.expand(len(seeds), -1)
    if how.initial == "found":
        start = torch.stack([_found_pose(subject, generator) for generator in generators])
    return track_view(tracker, subject.body, subject.view, start, generators)


def _found_pose(
    subject: Subject[SilhouettePerson], generator: torch.Generator
) -> Float[Tensor, " D"]:
    """Return the first pose from the first silhouettes alone, about the poses of the manifold."""
    view = subject.view
    found = find_first_pose(
        subject.body, view.silhouettes[:_LOOK_AHEAD], view.rig, subject.person.manifold, generator,
        fps=view.clip.fps, up=view.clip.up,
    )  # fmt: skip
    return found.state.to(view.initial_state)


def _facts(subject: Subject[SilhouettePerson], how: Filter) -> list[Any]:
    facts = [*how, *subject_facts(subject)]
    if how.name.startswith("mrpf") or how.initial == "found":
        manifold = subject.person.manifold
        facts += [manifold.poses, manifold.weights, manifold.std_latent, manifold.std_pose]
    return facts


TRACKING = Experiment(
    Run, _track, _facts, _SOURCES, lambda subject, how: len(subject.view.clip), "frame"
)
"""Runs of a `Filter` on a subject."""


class _Validation(NamedTuple):
    """Mean error of the joints on a validation clip, mm, [1]."""

    error: Tensor


def _validate(
    subject: Subject[SilhouettePerson], how: Filter, seeds: Sequence[int]
) -> list[_Validation]:
    view = subject.view
    sequence = ValidationSequence(
        view.silhouettes, view.rig, None, view.initial_state, view.clip.joints
    )

    def tracker(value: float) -> SilhouetteParticleFilter:
        setting = how.setting._replace(value=value)
        return make_filter(
            how.name, subject.person, setting, how.n_particles, how.likelihood, subject.body
        )

    fit = fit_sharpness(tracker, [sequence], values=[how.setting.value], seeds=len(seeds))
    return [_Validation(torch.tensor([1000 * fit.errors[0]], dtype=torch.float64))]


_VALIDATION = Experiment(_Validation, _validate, _facts, _SOURCES)


def tune(
    tracked_persons: Sequence[SilhouettePerson],
    method: str,
    n_particles: int,
    likelihood: str,
    folder: Path,
) -> Tuning:
    """Return the setting with the smallest mean error over everybody's validation clips.

    First the scale of the diffusion is chosen, then the sharpness (or survival rate) at that scale.
    Every method has the same clips, one seed and the same number of settings to choose among.

    Args:
        tracked_persons: with their validation clips. method: among `METHODS`.
        n_particles, likelihood: as `Filter`. folder: where errors are kept.
    """
    subjects = validation_subjects(tracked_persons)

    def error(setting: Setting) -> float:
        how = Filter(method, setting, n_particles, likelihood)
        found = _VALIDATION.run({"": Grid(subjects, {method: how})}, (0,), folder)
        return float(found.values(lambda run: run.error[0]).mean())

    return choose_setting(error, METHODS[method].first, METHODS[method].values)
