"""Bodies, limits, motion models and filters of the protocol Root uncertainty.

Parts turn in the body's own frame (DX), about centres that all persons share, so that one set of
limb conditionals, limits and diffusion holds for everybody. They are learnt from trials of all
persons, none of which is tracked.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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
    part_error,
    subject_facts,
    track_view,
)
from benchmarks.bodies.views import (
    Conditions,
    Subject,
    Tracked,
    View,
    any_heading,
    body_of,
    subjects_of,
    validation_subjects,
    view_of,
)
from benchmarks.engine import Experiment, Grid, Setting, Tuning, search_setting
from torchpose.body import Body, JointLimits, centres_of, fit_state
from torchpose.errors import InputError
from torchpose.filters._resampling import LEAST_SURVIVORS, survival_rate_per_frame
from torchpose.io._mocap import MocapClip
from torchpose.learning import fit_limb_conditionals
from torchpose.priors._limb_conditionals import LimbConditionals
from torchpose.whole_body import (
    AnnealedParticleFilter,
    RootUncertaintyTracker,
    SilhouetteParticleFilter,
    SIRParticleFilter,
    motion_std,
)

FPS = 60.0
POINTS = 7
"""Likelihoods of every limb that one hypothesis of the root costs (DX, section 5)."""

SOURCES = (*MADE_WITH, "benchmarks/root_uncertainty/walkers.py")
"""What the numbers of a run depend on beside its facts."""

_FIRST_SCALE = 1.4  # with which the search for a setting starts
_ROOM = 0.15  # beside the poses of training: 17 degrees
_SHARES = (0.04, 0.06, 0.1, 0.16, 0.25, 0.4)
_PER_FRAME = ("survival per frame", 0.16, _SHARES)
_LAYER_SHARES = (0.2, 0.3, 0.4, PUBLISHED_SURVIVAL, 0.6, 0.7, 0.85)
_PER_LAYER = ("survival per layer", PUBLISHED_SURVIVAL, _LAYER_SHARES)
_PER_SECOND = 0.01  # DX, section 8

METHODS = {
    "sir": Method("SIR", *_PER_FRAME, {}),
    "apf": Method("APF", *_PER_LAYER, {}),
    "root": Method("Root uncertainty", *_PER_FRAME, {}),
    "root-pixels": Method("Root uncertainty, pixels", *_PER_FRAME, {"normalisation": "published"}),
    "root-body": Method("Root uncertainty, whole body", *_PER_FRAME, {"weighting": "body"}),
}
"""The filters by the names that the command takes.

``root`` weighs every part by the share of its pixels on the silhouette, ``root-pixels`` by their
number as published; ``root-body`` weighs a hypothesis by the likelihood of the whole body.
"""


def published(name: str, fps: float) -> Setting:
    """Return the survival of a frame, or of a layer, as in section 8, and the diffusion as learnt.

    Args:
        name: among `METHODS`. fps: frames per second.
    """
    if name == "apf":
        return Setting(PUBLISHED_SURVIVAL)
    return Setting(survival_rate_per_frame(_PER_SECOND, fps))


class Budget(NamedTuple):
    """What every filter is given.

    Attributes:
        particles: likelihoods of whole bodies per frame. likelihood: of SIR and APF.
        leg_swap: see `SilhouetteParticleFilter`. limits: whether poses outside limits are discarded.
    """

    particles: int = 800
    likelihood: str = "bidirectional"
    leg_swap: float = 0.02
    limits: bool = True


class Filter(NamedTuple):
    """A method with all that it is run with.

    Attributes:
        name: among `METHODS`. setting: survival and scale of the diffusion. budget: that of all.
    """

    name: str
    setting: Setting
    budget: Budget


@dataclass(frozen=True)
class Walker(Tracked):
    """A person, with models learnt from trials of all persons.

    Args:
        limits: of the parts. conditionals: of limbs, with their diffusion per frame.
        training: states that all of these were learnt from, at 60 frames per second.
        fps: frames per second of clips, conditionals and `step_std`.
    """

    limits: JointLimits
    conditionals: LimbConditionals
    training: tuple[Tensor, ...]
    fps: float = FPS


def prepare(
    splits: Sequence[Split],
    conditions: Conditions,
    test_frames: int,
    validation_frames: int,
    fps: float = FPS,
) -> list[Walker]:
    """Fit everybody's body, learn the models of them all, and render what cameras see.

    Args:
        splits: one for each person; the clips of `Split.manifold` train.
        conditions: of the silhouettes. test_frames: of each test trial, from its first.
        validation_frames: for the scale of the diffusion. fps: of all clips.
    """
    upright = {split.person: body_of(split.body, conditions) for split in splits}
    plain = {name: body.altered(frame="body") for name, body in upright.items()}
    clips = [clip for split in splits for clip in split.manifold if clip.person in plain]
    recorded = [fit_state(plain[clip.person], clip.joints) for clip in clips]
    first = plain[splits[0].person]
    centres = centres_of(first, torch.cat(recorded))
    bodies = {name: body.altered(centres=centres) for name, body in plain.items()}
    # fitted anew: the twist that joints do not tell is none about the centres
    training = tuple(fit_state(bodies[clip.person], clip.joints) for clip in clips)
    body, up = bodies[splits[0].person], clips[0].up
    limits = _limits(torch.cat(training))
    conditionals, step_std = _motion(body, training, up, fps)
    walkers = []
    for split in splits:
        own = bodies[split.person]
        tests = tuple(view_of(own, clip.cut(0, test_frames), conditions) for clip in split.test)
        chosen = split.validation[0].cut(0, validation_frames)
        validation = ((bodies.get(chosen.person, own), view_of(own, chosen, conditions)),)
        walkers.append(
            Walker(split, own, step_std, tests, validation, limits, conditionals, training, fps)
        )
    return walkers


def _limits(states: Float[Tensor, "N D"]) -> JointLimits:
    """Return limits with a margin about the training states, also of the twist, which joints do not show."""
    learnt = JointLimits.fit(states)
    lower, upper = (learnt.lower - _ROOM).clamp_min(-1), (learnt.upper + _ROOM).clamp_max(1)
    return JointLimits(lower, upper, learnt.softness)


def _motion(
    body: Body, training: Sequence[Tensor], up: Tensor, fps: float
) -> tuple[LimbConditionals, Float[Tensor, " D"]]:
    conditionals = fit_limb_conditionals(body, list(training), fps)
    return conditionals, any_heading(motion_std(body, list(training)), up)


# --- other conditions -----------------------------------------------------------------------------


def slower(walker: Walker, n: int) -> Walker:
    """Take every n-th frame of the same silhouettes, with motion learnt from every n-th frame of training.

    A walk is smooth, so that over n frames it goes farther than a random walk of n times the variance:
    what was learnt at one rate and rescaled would be too slow.
    """
    if n < 1:
        raise InputError(f"every n-th frame is taken with n at least 1, got {n}")
    if n == 1:
        return walker
    fps = walker.fps / n
    training = tuple(states[::n] for states in walker.training)
    conditionals, step_std = _motion(walker.body, training, walker.tests[0].clip.up, fps)
    return replace(
        walker, step_std=step_std, conditionals=conditionals, training=training, fps=fps,
        tests=tuple(_slower_view(view, n, fps) for view in walker.tests),
        validation=tuple((body, _slower_view(view, n, fps)) for body, view in walker.validation),
    )  # fmt: skip


def _slower_view(view: View, n: int, fps: float) -> View:
    clip: MocapClip = replace(
        view.clip, joints=view.clip.joints[::n], recorded=view.clip.recorded[::n], fps=fps
    )
    return view._replace(clip=clip, silhouettes=view.silhouettes[::n])


def with_cameras(walker: Walker, n: int) -> Walker:
    """Take the first n cameras alone, of the same silhouettes."""
    return replace(
        walker,
        tests=tuple(_fewer_views(view, n) for view in walker.tests),
        validation=tuple((body, _fewer_views(view, n)) for body, view in walker.validation),
    )


def _fewer_views(view: View, n: int) -> View:
    if not 1 <= n <= len(view.rig):
        raise InputError(f"expected 1 to {len(view.rig)} cameras, got {n}")
    return view._replace(rig=view.rig.select(range(n)), silhouettes=view.silhouettes[:, :n])


# --- filters --------------------------------------------------------------------------------------


def make_filter(
    name: str,
    walker: Walker,
    setting: Setting,
    budget: Budget | None = None,
    body: Body | None = None,
) -> SilhouetteParticleFilter:
    """Return a filter that evaluates as many likelihoods a frame as any other.

    Args:
        name: among `METHODS`. setting: survival of a frame (of a layer for APF), and factor of the
            diffusion's deviation. budget: likelihoods and options, the same for all.
        walker: whose motion and limits. body: instead of the walker's.

    Raises:
        InputError: an unknown method, too few likelihoods, or a survival that leaves too few particles.
    """
    if name not in METHODS:
        raise InputError(f"method must be among {', '.join(METHODS)}, got {name!r}")
    budget, own = budget or Budget(), walker.body if body is None else body
    if budget.particles < POINTS:
        raise InputError(f"particles must be at least {POINTS}, got {budget.particles}")
    common: dict[str, Any] = {
        "process_cov": (setting.scale * walker.step_std).square(),
        "limits": walker.limits if budget.limits else None,
        "limit_mode": "discard",
        "leg_swap": budget.leg_swap,
    }
    if name == "apf":
        return AnnealedParticleFilter(
            own, selected_among(name, budget), n_layers=LAYERS, estimate="mean",
            survival_rate=setting.value, likelihood=budget.likelihood, **common,
        )  # fmt: skip
    if name == "sir":
        return SIRParticleFilter(
            own, budget.particles, estimate="map", likelihood=budget.likelihood,
            survival_rate=setting.value, **common,
        )  # fmt: skip
    return RootUncertaintyTracker(
        own, _diffusing(walker.conditionals, setting.scale),
        hypotheses(name, budget), fps=walker.fps, survival_rate=setting.value,
        estimate="map", **METHODS[name].options, **common,
    )  # fmt: skip


def hypotheses(name: str, budget: Budget) -> int:
    """Return the number of root hypotheses of the same cost as the particles of the other methods.

    One that is weighed by the whole body costs another likelihood beside the sigma points.
    """
    whole = METHODS[name].options.get("weighting") == "body"
    return round(budget.particles / (POINTS + whole))


def selected_among(name: str, budget: Budget) -> int:
    """Return the number of particles of which a share survives: hypotheses, or those of a layer."""
    if name == "apf":
        return budget.particles // LAYERS
    return budget.particles if name == "sir" else hypotheses(name, budget)


def _diffusing(conditionals: LimbConditionals, scale: float) -> LimbConditionals:
    """Return the same conditionals with another diffusion, `scale` times its standard deviation."""
    other = copy.deepcopy(conditionals)
    other.diffusion *= scale**2
    return other


# --- runs -----------------------------------------------------------------------------------------


def _track(subject: Subject[Walker], how: Filter, seeds: Sequence[int]) -> list[Run]:
    tracker = make_filter(how.name, subject.person, how.setting, how.budget, subject.body)
    start = subject.view.initial_state.expand(len(seeds), -1)
    return track_view(tracker, subject.body, subject.view, start, generators_of(seeds))


def filter_facts(subject: Subject[Walker], how: Filter) -> list[Any]:
    """Return the inputs of a run, beside its seed."""
    walker = subject.person
    facts = [*how, METHODS[how.name].options, walker.fps, *subject_facts(subject)]
    if how.budget.limits:
        facts += [walker.limits.lower, walker.limits.upper]
    if how.name.startswith("root"):
        learnt = walker.conditionals
        facts += [learnt.mean, learnt.covariance, learnt.diffusion]
    return facts


TRACKING = Experiment(
    Run, _track, filter_facts, SOURCES, lambda subject, how: len(subject.view.clip), "frame"
)
"""Runs of a `Filter` on a walk."""


def grid_of(
    walkers: Sequence[Walker], settings: Mapping[str, Setting], budget: Budget
) -> Grid[Subject[Walker], Filter]:
    """Return everybody, and the filters by their labels, of one condition.

    Args:
        walkers: with the cameras and the frame rate of the condition. settings: by method.
        budget: of every filter.
    """
    filters = {METHODS[name].label: Filter(name, s, budget) for name, s in settings.items()}
    return Grid(subjects_of(walkers), filters)


def tune(
    walkers: Sequence[Walker],
    method: str,
    budget: Budget,
    folder: Path,
    start: Setting | None = None,
) -> Tuning:
    """Return survival and diffusion with the smallest mean error over everybody's validation clips.

    Every method has the same clips and seed to choose by.

    Args:
        walkers: at the frame rate of the choice. budget: of the filter. folder: where runs are kept.
        start: of the search, such as what was chosen at another rate. Without one it starts from
            `Method.first`, and the published survival is tried as well.
    """
    known, usual = METHODS[method], published(method, walkers[0].fps).value
    subjects = validation_subjects(walkers)

    def error(setting: Setting) -> float:
        grid = Grid(subjects, {method: Filter(method, setting, budget)})
        return float(TRACKING.run({"": grid}, (0,), folder).values(part_error()).mean())

    return search_setting(
        error,
        start or Setting(known.first, _FIRST_SCALE),
        None if start else usual,
        known.values,
        LEAST_SURVIVORS / selected_among(method, budget),
    )
