"""Runs of the protocol Bend: both trackers tuned alike, and every run kept in a folder."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks.bend.trackees import REDRAWS, SHARPNESS, BendTrackee, Variant, make_filter
from benchmarks.silhouette.runs import (
    Tuning,
    choose_setting,
    generators_of,
    sequence_name,
    view_errors,
)
from benchmarks.silhouette.trackees import SCALES, Setting, View
from torchpose.errors import DegenerateFilterWarning
from torchpose.evaluation.common import settings_hash
from torchpose.evaluation.kept_runs import keep, read_kept
from torchpose.priors._actions.postures import state_postures
from torchpose.whole_body import BodyTrack, SilhouetteParticleFilter

__all__ = [
    "BendRun",
    "BendRuns",
    "Start",
    "mean_squared",
    "run_variants",
    "tune_variant",
    "variant_facts",
]

_VERSION = 1


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


BendRuns = dict[Variant, dict[str, list[BendRun]]]
"""Runs by tracker and sequence, one for each seed."""

Start = Callable[[BendTrackee, View], Tensor]
"""The pose before the first frame, [D]."""


def run_variants(
    trackees: Sequence[BendTrackee],
    settings: Mapping[Variant, Setting],
    folder: Path,
    *,
    seeds: int = 3,
    seed: int = 0,
    progress: bool = False,
    title: str = "tracking",
    start: Start | None = None,
) -> BendRuns:
    """All runs that are not in the folder yet, and those that are.

    Args:
        trackees: who is tracked. settings: of every tracker. folder: where runs are kept.
        seeds: how many runs, numbered from `seed`. progress: whether to show a bar, called `title`.
        start: pose before the first frame, instead of the true one.
    """
    runs: BendRuns = {variant: {} for variant in settings}
    frames = sum(len(view.clip) for t in trackees for view in t.tests)
    total = frames * seeds * sum(variant.particles for variant in settings) // 1000
    with tqdm(total=total, disable=not progress, unit="k particles", desc=title) as bar:
        for trackee in trackees:
            for i, view in enumerate(trackee.tests):
                name = sequence_name(trackee, view)
                for variant, setting in settings.items():
                    bar.set_postfix_str(f"{name} {variant.label} {variant.particles}")
                    facts = variant_facts(trackee, view, variant, setting)
                    make = lambda v=variant, s=setting, t=trackee: make_filter(v, t, s)  # noqa: E731
                    first = None if start is None else start(trackee, view)
                    runs[variant][name] = kept_tracks(
                        make, trackee, i, facts, folder, range(seed, seed + seeds), first
                    )
                    bar.update(len(view.clip) * seeds * variant.particles // 1000)
    return runs


def kept_tracks(
    make: Callable[[], SilhouetteParticleFilter],
    trackee: BendTrackee,
    index: int,
    facts: Sequence[Any],
    folder: Path,
    seeds: Sequence[int],
    start: Float[Tensor, " D"] | None = None,
) -> list[BendRun]:
    """Runs of one filter on one clip, those that are missing as one batch.

    Args:
        make: gives the filter. trackee, index: whose clip. facts: all that the runs depend on.
        folder: where they are kept. seeds: one run each. start: pose before the first frame, instead
            of the true one.
    """
    view = trackee.tests[index]
    start = view.initial_state if start is None else start
    paths = {s: folder / f"run-{settings_hash([_VERSION, *facts, start, s])}.npz" for s in seeds}
    found = {s: read_kept(path, BendRun, BendRun._fields) for s, path in paths.items()}
    missing = [s for s in seeds if found[s] is None]
    if missing:
        for s, run in zip(missing, _tracked(make(), trackee, index, start, missing), strict=True):
            keep(paths[s], run)
            # read back, so that a run that goes on works with the same bits
            found[s] = read_kept(paths[s], BendRun, BendRun._fields)
    return list(found.values())


def _tracked(
    tracker: SilhouetteParticleFilter, trackee: BendTrackee, index: int, start: Tensor,
    seeds: Sequence[int],
) -> list[BendRun]:  # fmt: skip
    view, truth, known = trackee.tests[index], trackee.truth[index], trackee.known
    generators = generators_of(seeds)
    began = perf_counter()
    with warnings.catch_warnings():  # frames in which every particle was clamped are counted
        warnings.simplefilter("ignore", DegenerateFilterWarning)
        out: BodyTrack = tracker(
            view.silhouettes, view.rig, start.expand(len(seeds), -1), generator=generators
        )
    seconds = (perf_counter() - began) / len(view.clip) / len(seeds)
    mean = out.mean.double()
    errors = view_errors(trackee.body, view, mean)
    apart = state_postures(trackee.body, mean)[..., known] - truth[:, known]
    squared = apart.square().mean(-1)
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


def mean_squared(runs: Mapping[str, Sequence[BendRun]]) -> Float[Tensor, "Q S"]:
    """Mean squared error of the angles, degrees^2, of every sequence and seed."""
    return torch.stack(
        [torch.stack([run.squared.double().mean() for run in seeds]) for seeds in runs.values()]
    )


def tune_variant(
    trackees: Sequence[BendTrackee],
    variant: Variant,
    folder: Path,
    seeds: int = 1,
    scales: Sequence[float] = SCALES,
    values: Sequence[float] = SHARPNESS,
) -> Tuning:
    """The setting with the smallest mean squared error over other persons' clips.

    First the scale of the diffusion, then the sharpness of the likelihood: the same clips, seeds and
    number of settings for every tracker.
    """

    def error(setting: Setting) -> float:
        runs = run_variants(trackees, {variant: setting}, folder, seeds=seeds, seed=1000)
        return float(mean_squared(runs[variant]).mean())

    return choose_setting(error, values[0], values, scales)


def variant_facts(
    trackee: BendTrackee, view: View, variant: Variant, setting: Setting
) -> list[Any]:
    """Everything that a run depends on."""
    facts: list[Any] = [
        [*variant, REDRAWS] if variant.constrained else [False, variant.particles, variant.limb_shape],
        list(setting), view.silhouettes.byte(), view.rig.matrix, view.rig.rotation,
        view.rig.translation, view.clip.joints, trackee.body.offsets, trackee.body.radii,
        trackee.body.tips, trackee.step_std,
    ]  # fmt: skip
    return facts + (list(trackee.space.buffers()) if variant.constrained else [])
