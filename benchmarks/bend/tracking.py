"""Runs of the protocol Bend: both trackers tuned alike."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchmarks.bend.variants import (
    REDRAWS,
    SHARPNESS,
    BendPerson,
    Variant,
    make_filter,
    true_postures,
)
from benchmarks.bodies.tracking import MADE_WITH, generators_of, subject_facts, view_errors
from benchmarks.bodies.views import Subject, subjects_of
from benchmarks.engine import Experiment, Grid, Setting, Tuning, choose_setting
from benchmarks.engine.tuning import SCALES
from torchpose.errors import DegenerateFilterWarning
from torchpose.priors import state_postures
from torchpose.whole_body import BodyFilterOutput

_VALIDATION_SEED = 1000


class BendRun(NamedTuple):
    """One tracker on one clip with one seed.

    Attributes:
        errors: distance of every joint from the recorded one [T, 15], mm, NaN where unknown (MR 31).
        squared: mean over the known angles of the squared error of postures [T], degrees^2.
        mean: estimated states [T, D].
        acceptance: share of the drawn predictions that the gates let through [T], NaN without gates.
        clamped: share of the particles that were moved to the gates after all [T], likewise.
        actions: probability of every action of a bank and of none of them [T, A + 1]; [T, 0] else.
        released: probability that the constraint is released [T], NaN without a bank.
        respread: frames in which all particles had died [T].
        seconds: [1], per frame, of the batch it ran in.
    """

    errors: Tensor
    squared: Tensor
    mean: Tensor
    acceptance: Tensor
    clamped: Tensor
    actions: Tensor
    released: Tensor
    respread: Tensor
    seconds: Tensor


class Filter(NamedTuple):
    """A tracker with all that it is run with.

    Attributes:
        variant: which one. setting: what other persons' clips chose.
        bank: whether the constraint is that of the person's bank of actions.
    """

    variant: Variant
    setting: Setting
    bank: bool = False


def _track(subject: Subject[BendPerson], how: Filter, seeds: Sequence[int]) -> list[BendRun]:
    person, body, view = subject
    bank = person.bank if how.bank else None
    tracker = make_filter(how.variant, person, how.setting, bank)
    generators = generators_of(seeds)
    start = view.initial_state.expand(len(seeds), -1)
    began = perf_counter()
    with warnings.catch_warnings():  # frames in which every particle was clamped are counted
        warnings.simplefilter("ignore", DegenerateFilterWarning)
        out: BodyFilterOutput = tracker(view.silhouettes, view.rig, start, generator=generators)
    seconds = (perf_counter() - began) / len(view.clip) / len(seeds)
    mean = out.mean.double()
    errors = view_errors(body, view, mean)
    apart = state_postures(body, mean) - true_postures(body, view.clip)
    squared = apart[..., person.known].square().mean(-1)
    none = torch.full(squared.shape, torch.nan)
    details = {name: value.float() for name, value in out.details.items()}
    return [
        BendRun(
            errors[i].float(), squared[i].float(), mean[i].float(),
            details.get("acceptance", none)[i], details.get("clamped", none)[i],
            details.get("actions", none[..., None][..., :0])[i], details.get("released", none)[i],
            out.respread[i], torch.tensor([seconds], dtype=torch.float64),
        )
        for i in range(len(seeds))
    ]  # fmt: skip


def _facts(subject: Subject[BendPerson], how: Filter) -> list[Any]:
    """Return the inputs of a run; without constraint the action space is none of them."""
    variant = how.variant
    if not variant.constrained:
        plain = [False, variant.particles, variant.limb_shape]
        return [plain, how.setting, *subject_facts(subject)]
    model = subject.person.bank if how.bank else subject.person.space
    buffers = [] if model is None else list(model.buffers())
    return [[*variant, REDRAWS], how.setting, *subject_facts(subject), *buffers]


TRACKING = Experiment(
    BendRun, _track, _facts,
    (*MADE_WITH, "benchmarks/bend/tracking.py", "benchmarks/bend/variants.py"),
    lambda subject, how: len(subject.view.clip) * how.variant.particles // 1000, "k particles",
)  # fmt: skip
"""Runs of a `Filter` on a subject."""


def mean_squared(run: BendRun) -> Tensor:
    """Return the mean squared error of the angles, degrees^2."""
    return run.squared.double().mean()


def grid_of(
    tracked_persons: Sequence[BendPerson], filters: Mapping[Variant, Setting]
) -> Grid[Subject[BendPerson], Filter]:
    """Return everybody, and the trackers by their labels.

    Args:
        tracked_persons: who is tracked. filters: settings of trackers of different labels.
    """
    methods = {variant.label: Filter(variant, setting) for variant, setting in filters.items()}
    return Grid(subjects_of(tracked_persons), methods)


def tune_variant(
    tracked_persons: Sequence[BendPerson],
    variant: Variant,
    folder: Path,
    scales: Sequence[float] = SCALES,
    values: Sequence[float] = SHARPNESS,
) -> Tuning:
    """Return the setting with the smallest mean squared error over other persons' clips.

    First the scale of the diffusion is chosen, then the sharpness of the likelihood: the same clips,
    seed and number of settings for every tracker.
    """

    def error(setting: Setting) -> float:
        grid = grid_of(tracked_persons, {variant: setting})
        runs = TRACKING.run({"": grid}, (_VALIDATION_SEED,), folder)
        return float(runs.values(mean_squared).mean())

    return choose_setting(error, values[0], values, scales)
