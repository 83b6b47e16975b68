"""Runs of the protocol Silhouette: filters tuned alike, and every run kept in a folder.

A run is one method on one clip with one seed. Runs that are missing are filtered as one batch, each
with random numbers of its own, so a run does not depend on which others were missing.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from math import inf, isfinite
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks.silhouette.trackees import (
    METHODS,
    SCALES,
    Setting,
    Tracked,
    Trackee,
    View,
    make_filter,
)
from torchpose._core.reading import require_file
from torchpose.body import Body
from torchpose.errors import FileFormatError, InputError
from torchpose.evaluation.common import settings_hash
from torchpose.evaluation.kept_runs import keep, kept, read_kept
from torchpose.whole_body import BodyTrack, SilhouetteParticleFilter, find_first_pose, fit_sharpness
from torchpose.whole_body._sharpness import ValidationSequence

__all__ = [
    "Run",
    "Runs",
    "Tuning",
    "choose_setting",
    "generators_of",
    "run_all",
    "sequence_name",
    "track_view",
    "tune",
    "view_errors",
]

_VERSION = 1
_LOOK_AHEAD = 30  # frames that decide where somebody faces, if the first pose is found


class Run(NamedTuple):
    """One method on one clip with one seed.

    Attributes:
        errors: distance of every joint [T, 15], mm, NaN where the truth is unknown (MR 31).
        mean: estimated states [T, D]. std: of the particles [T, D].
        coasting, respread: [T], as `BodyTrack`. seconds: [1], per frame, of the batch it ran in.
    """

    errors: Tensor
    mean: Tensor
    std: Tensor
    coasting: Tensor
    respread: Tensor
    seconds: Tensor


Runs = dict[str, dict[str, list[Run]]]
"""Runs by method and sequence, one for each seed."""


class Tuning(NamedTuple):
    """What validation chose for a method, and the mean errors (mm) of all settings it tried."""

    setting: Setting
    tried: tuple[Setting, ...] = ()
    errors: tuple[float, ...] = ()

    @property
    def error(self) -> float:
        """The error of what was chosen, mm, or NaN if nothing was tried."""
        found = [e for s, e in zip(self.tried, self.errors, strict=True) if s == self.setting]
        return found[0] if found else float("nan")


def sequence_name(trackee: Tracked, view: View) -> str:
    """What a sequence is called in tables."""
    return f"{trackee.split.person} {view.clip.trial}"


def tune(
    trackees: Sequence[Trackee],
    method: str,
    n_particles: int,
    likelihood: str,
    folder: Path,
    seeds: int = 1,
) -> Tuning:
    """The setting with the smallest mean error over everybody's validation clips.

    First the scale of the diffusion, then the sharpness (or survival rate) at that scale. Every
    method has the same clips, seeds and number of settings to choose among.
    """

    def error(setting: Setting) -> float:
        found = [
            _kept_error(t, body, view, method, setting, n_particles, likelihood, folder, seeds)
            for t in trackees
            for body, view in t.validation
        ]
        return sum(found) / len(found)

    return choose_setting(error, METHODS[method].first, METHODS[method].values)


def choose_setting(
    error: Callable[[Setting], float],
    first: float,
    values: Sequence[float],
    scales: Sequence[float] = SCALES,
) -> Tuning:
    """The setting with the smallest error: first the scale at the value `first`, then the value.

    Args:
        error: of a setting; one that is not finite is never chosen.
        first: value with which the scale is chosen. values, scales: what is tried.
    """
    tried: dict[Setting, float] = {}

    def best() -> Setting:
        return min(tried, key=lambda s: tried[s] if isfinite(tried[s]) else inf)

    for scale in scales:
        tried[Setting(first, scale)] = error(Setting(first, scale))
    scale = best().scale
    for value in values:
        if Setting(value, scale) not in tried:
            tried[Setting(value, scale)] = error(Setting(value, scale))
    return Tuning(best(), tuple(tried), tuple(tried.values()))


def read_settings(
    path: str | Path, methods: Sequence[str], condition: str | None = None
) -> dict[str, Setting]:
    """What an earlier run chose for these methods.

    Args:
        path: report.json of the run, or its folder. methods: by name.
        condition: for which it chose, where it chose for several, such as frame rates.

    Raises:
        InputError: no such file, or a method that the run, or the condition, did not have.
        FileFormatError: no report of one choice for each method.
    """
    path = require_file(Path(path) / "report.json" if Path(path).is_dir() else path)
    try:
        chosen = json.loads(path.read_text(encoding="utf-8"))["settings"]["settings"]
        if condition is not None:
            chosen = chosen.get(condition, {})
        known = {name: Setting(float(s["value"]), float(s["scale"])) for name, s in chosen.items()}
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise FileFormatError(
            f"{path}: expected the report.json of a run of this protocol with one number of particles "
            f"and one size, whose settings hold a value and a scale for each method ({error!r})"
        ) from error
    missing = [name for name in methods if name not in known]
    if missing:
        at = f" at {condition}" if condition else ""
        raise InputError(
            f"{path}: expected settings of {', '.join(methods)}{at}; there are none of "
            f"{', '.join(missing)}, only of {', '.join(known) or 'nobody'}: run without --settings, or "
            "choose with --method"
        )
    return {name: known[name] for name in methods}


def _kept_error(
    trackee: Trackee, body: Body, view: View, method: str, setting: Setting, n_particles: int,
    likelihood: str, folder: Path, seeds: int,
) -> float:  # fmt: skip
    """Mean error on a validation clip, mm, read from the folder if it is there."""
    facts = ["tuning", _VERSION, method, list(setting), n_particles, likelihood, seeds]
    path = folder / f"tuning-{settings_hash([*facts, *_facts(trackee, body, view, method)])}.npz"
    sequence = ValidationSequence(
        view.silhouettes, view.rig, None, view.initial_state, view.clip.joints
    )

    def tracker(value: float) -> SilhouetteParticleFilter:
        return make_filter(
            method, trackee, Setting(value, setting.scale), n_particles, likelihood, body
        )

    def error() -> float:
        fit = fit_sharpness(tracker, [sequence], values=[setting.value], seeds=seeds)
        return 1000 * fit.errors[0]

    return kept(path, error)


def run_all(
    trackees: Sequence[Trackee],
    settings: Mapping[str, Setting],
    folder: Path,
    *,
    seeds: int = 5,
    seed: int = 0,
    n_particles: int = 500,
    likelihood: str = "bidirectional",
    initial: str = "given",
    progress: bool = False,
) -> Runs:
    """All runs that are not in the folder yet, and those that are.

    Args:
        trackees: who is tracked. settings: of each method.
        folder: where runs are kept. seeds: how many runs, numbered from `seed`.
        n_particles: likelihoods per frame. initial: "given", or "found" in the first frames.
        progress: whether to show a bar.
    """
    runs: Runs = {method: {} for method in settings}
    frames = sum(len(view.clip) for t in trackees for view in t.tests) * len(settings) * seeds
    with tqdm(total=frames, disable=not progress, unit="frame", desc="tracking") as bar:
        for trackee in trackees:
            for view in trackee.tests:
                name = sequence_name(trackee, view)
                for method, setting in settings.items():
                    bar.set_postfix_str(f"{name} {method}")
                    facts = [_VERSION, method, list(setting), n_particles, likelihood]
                    facts += [initial if initial == "given" else f"{initial} in {_LOOK_AHEAD}"]
                    facts += _facts(trackee, trackee.body, view, method)
                    paths = {
                        s: folder / f"run-{settings_hash([*facts, s])}.npz"
                        for s in range(seed, seed + seeds)
                    }
                    missing = [s for s, path in paths.items() if _read(path) is None]
                    if missing:
                        track = (trackee, view, method, setting, n_particles, likelihood)
                        found = _filtered(*track, initial, missing)
                        for s, run in zip(missing, found, strict=True):
                            keep(paths[s], run)
                    # read back, so that a run that goes on works with the same bits
                    runs[method][name] = [r for r in map(_read, paths.values()) if r is not None]
                    bar.update(seeds * len(view.clip))
    return runs


def _read(path: Path) -> Run | None:
    run: Run | None = read_kept(path, Run, Run._fields)
    return run


def _filtered(
    trackee: Trackee, view: View, method: str, setting: Setting, n_particles: int, likelihood: str,
    initial: str, seeds: Sequence[int],
) -> list[Run]:  # fmt: skip
    """Runs of some seeds on one clip, as one batch."""
    tracker = make_filter(method, trackee, setting, n_particles, likelihood)
    generators = generators_of(seeds)
    start = view.initial_state.expand(len(seeds), -1)
    if initial == "found":
        start = torch.stack([_found_pose(trackee, view, g) for g in generators])
    return track_view(tracker, trackee.body, view, start, generators)


def generators_of(seeds: Sequence[int]) -> list[torch.Generator]:
    """A stream of random numbers for every run."""
    return [torch.Generator().manual_seed(7919 * s + 1) for s in seeds]


def track_view(
    tracker: SilhouetteParticleFilter,
    body: Body,
    view: View,
    start: Float[Tensor, "S D"],
    generators: list[torch.Generator],
) -> list[Run]:
    """One run for each generator, as one batch, each from its own initial state."""
    began = perf_counter()
    out: BodyTrack = tracker(view.silhouettes, view.rig, start, generator=generators)
    seconds = (perf_counter() - began) / len(view.clip) / len(generators)
    errors = view_errors(body, view, out.mean)
    return [
        Run(
            errors[i].float(), out.mean[i].float(), out.std[i].float(), out.coasting[i],
            out.respread[i], torch.tensor([seconds], dtype=torch.float64),
        )
        for i in range(len(generators))
    ]  # fmt: skip


def view_errors(
    body: Body, view: View, states: Float[Tensor, "*batch T D"]
) -> Float[Tensor, "*batch T 15"]:
    """Distance of the estimated joints from the recorded ones, mm (MR 31)."""
    return 1000 * (body.joints(states) - view.clip.joints).norm(dim=-1)


def _found_pose(trackee: Trackee, view: View, generator: torch.Generator) -> Float[Tensor, " D"]:
    """The first pose from the first silhouettes alone, about the poses of the manifold."""
    found = find_first_pose(
        trackee.body, view.silhouettes[:_LOOK_AHEAD], view.rig, trackee.manifold, generator,
        fps=view.clip.fps, up=view.clip.up,
    )  # fmt: skip
    return found.state.to(view.initial_state)


def _facts(trackee: Trackee, body: Body, view: View, method: str) -> list[Any]:
    """Everything that a run depends on, beside the filter's own settings."""
    facts: list[Any] = [
        view.silhouettes.byte(), view.rig.matrix, view.rig.rotation, view.rig.translation,
        view.initial_state, view.clip.joints, body.offsets, body.radii, body.tips,
        trackee.step_std,
    ]  # fmt: skip
    if method.startswith("mrpf"):
        facts += [trackee.manifold.poses, trackee.manifold.weights]
        facts += [trackee.manifold.std_latent, trackee.manifold.std_pose]
    return facts
