"""Runs of the protocol Root uncertainty: conditions, scale of the diffusion, displaced bodies.

Every run is kept in a folder, so that parts of the protocol may be run apart and killed ones go on.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks.root_uncertainty.trackees import METHODS, Budget, Walker, make_filter
from benchmarks.silhouette.runs import (
    Run,
    Runs,
    generators_of,
    sequence_name,
    track_view,
    view_errors,
)
from benchmarks.silhouette.trackees import Setting, View
from torchpose.body import Body
from torchpose.evaluation.common import settings_hash
from torchpose.evaluation.kept_runs import keep, kept, read_kept, source_hash
from torchpose.math import compose
from torchpose.whole_body import SilhouetteParticleFilter

__all__ = [
    "DISPLACEMENTS",
    "Displacement",
    "Recovery",
    "displaced",
    "progress_bar",
    "recover_all",
    "run_condition",
    "validation_error",
]

_MADE_WITH = (
    "torchpose/body", "torchpose/filters", "torchpose/math", "torchpose/priors",
    "torchpose/whole_body", "benchmarks/root_uncertainty/runs.py",
    "benchmarks/root_uncertainty/trackees.py", "benchmarks/silhouette/runs.py",
)  # fmt: skip
"""What the numbers of a run depend on beside its facts: files and folders of a checkout."""


# --- conditions -----------------------------------------------------------------------------------


def run_condition(
    walkers: Sequence[Walker],
    settings: Mapping[str, Setting],
    budget: Budget,
    folder: Path,
    seeds: Sequence[int],
    bar: Any,
) -> Runs:
    """All runs of a condition, by method and sequence; those in the folder are read.

    Args:
        walkers: with the cameras and the frame rate of the condition.
        settings: by method. seeds: of the runs. bar: counts frames.
    """
    runs: Runs = {METHODS[method].label: {} for method in settings}
    for walker in walkers:
        for view in walker.tests:
            name = sequence_name(walker, view)
            for method, setting in settings.items():
                bar.set_postfix_str(f"{name} {method}")
                found = _kept(walker, view, method, setting, budget, folder, seeds)
                runs[METHODS[method].label][name] = found
                bar.update(len(seeds) * len(view.clip))
    return runs


def _kept(
    walker: Walker, view: View, method: str, setting: Setting, budget: Budget, folder: Path,
    seeds: Sequence[int],
) -> list[Run]:  # fmt: skip
    """Runs of some seeds on one clip; those that are missing are filtered as one batch."""
    facts = ["root", *_facts(walker, walker.body, view, method, setting, budget)]
    paths = {s: folder / f"run-{settings_hash([*facts, s])}.npz" for s in seeds}
    missing = [s for s in seeds if _read(paths[s]) is None]
    if missing:
        tracker = make_filter(method, walker, setting, budget)
        start = view.initial_state.expand(len(missing), -1)
        found = track_view(tracker, walker.body, view, start, generators_of(missing))
        for s, run in zip(missing, found, strict=True):
            keep(paths[s], run)
    # read back, so that a run that goes on works with the same bits
    return [run for run in map(_read, paths.values()) if run is not None]


def _read(path: Path) -> Run | None:
    run: Run | None = read_kept(path, Run, Run._fields)
    return run


def validation_error(
    walkers: Sequence[Walker], method: str, setting: Setting, budget: Budget, folder: Path
) -> float:
    """Mean error over everybody's validation clips, mm, of one seed; read from the folder if there.

    Args:
        walkers: at the frame rate that counts. Others as in `run_condition`.
    """
    found = [
        _kept_error(walker, body, view, method, setting, budget, folder)
        for walker in walkers
        for body, view in walker.validation
    ]
    return sum(found) / len(found)


def _kept_error(
    walker: Walker,
    body: Body,
    view: View,
    method: str,
    setting: Setting,
    budget: Budget,
    folder: Path,
) -> float:
    facts = ["root-tuning", *_facts(walker, body, view, method, setting, budget)]

    def measured() -> float:
        tracker = make_filter(method, walker, setting, budget)
        (run,) = track_view(tracker, body, view, view.initial_state[None], generators_of([0]))
        return float(run.errors.double().nanmean())

    return kept(folder / f"tuning-{settings_hash(facts)}.npz", measured)


def _facts(
    walker: Walker, body: Body, view: View, method: str, setting: Setting, budget: Budget
) -> list[Any]:
    """Everything that a run depends on."""
    facts: list[Any] = [
        source_hash(*_MADE_WITH), method, METHODS[method].options, list(setting), list(budget),
        walker.fps, view.silhouettes.byte(), view.rig.matrix,
        view.rig.rotation, view.rig.translation, view.initial_state, view.clip.joints,
        body.offsets, body.radii, body.tips, body.centres, walker.step_std,
    ]  # fmt: skip
    if budget.limits:
        facts += [walker.limits.lower, walker.limits.upper]
    if method.startswith("root"):
        learnt = walker.conditionals
        facts += [learnt.mean, learnt.covariance, learnt.diffusion]
    return facts


# --- recovery -------------------------------------------------------------------------------------


class Displacement(NamedTuple):
    """How far a body is put beside the true one: metres to some side, degrees about the vertical."""

    metres: float = 0.0
    degrees: float = 0.0

    def __str__(self) -> str:
        if self.metres:
            return f"{100 * self.metres:g} cm"
        return f"{self.degrees:g} degrees" if self.degrees else "none"


DISPLACEMENTS = (
    Displacement(),
    Displacement(0.1),
    Displacement(0.2),
    Displacement(0.3),
    Displacement(degrees=20.0),
    Displacement(degrees=40.0),
)

Recovery = dict[str, dict[tuple[str, float], Float[Tensor, "W S T"]]]
"""Errors (mm) of every frame from the displacement on, by method and (displacement, time in s)."""


class _Errors(NamedTuple):
    """Mean error of the joints after a displacement, mm, [S, T]."""

    errors: Tensor


def recover_all(
    walkers: Sequence[Walker],
    settings: Mapping[str, Setting],
    budget: Budget,
    folder: Path,
    seeds: Sequence[int],
    displacements: Sequence[Displacement],
    times: Sequence[float],
    seconds: float,
    bar: Any,
) -> Recovery:
    """Track everybody's first clip after all particles were moved to another place or heading.

    Args:
        displacements: the first one none. times: when particles are moved, seconds from the start.
        seconds: tracked from then on. bar: counts frames. Others as in `run_condition`.
    """
    found: Recovery = {METHODS[method].label: {} for method in settings}
    fps = walkers[0].fps
    for method, setting in settings.items():
        for time in times:
            at, n_frames = round(time * fps), round(seconds * fps)
            for displacement in displacements:
                bar.set_postfix_str(f"{method} {displacement}")
                errors = [
                    _recovered(
                        w, method, setting, budget, folder, seeds, displacement, at, n_frames
                    )
                    for w in walkers
                ]
                shortest = min(e.shape[1] for e in errors)
                found[METHODS[method].label][str(displacement), time] = torch.stack(
                    [e[:, :shortest] for e in errors]
                )
                bar.update(len(walkers) * len(seeds) * (at + n_frames))
    return found


def _recovered(
    walker: Walker, method: str, setting: Setting, budget: Budget, folder: Path, seeds: Sequence[int],
    displacement: Displacement, at: int, n_frames: int,
) -> Float[Tensor, "S T"]:  # fmt: skip
    view = walker.tests[0]
    facts = ["recovery", *_facts(walker, walker.body, view, method, setting, budget)]
    facts += [list(displacement), at, n_frames, list(seeds)]
    path = folder / f"recovery-{settings_hash(facts)}.npz"
    if read_kept(path, _Errors, _Errors._fields) is None:
        tracker = make_filter(method, walker, setting, budget)
        keep(path, _Errors(_after(tracker, walker.body, view, seeds, displacement, at, n_frames)))
    return read_kept(path, _Errors, _Errors._fields).errors


def _after(
    tracker: SilhouetteParticleFilter, body: Body, view: View, seeds: Sequence[int],
    displacement: Displacement, at: int, n_frames: int,
) -> Float[Tensor, "S T"]:  # fmt: skip
    """Errors from the frame `at` on, before which every particle is moved by the same step."""
    generators = generators_of(seeds)
    shift, turn = _steps(displacement, view.clip.up, seeds)
    state = tracker.init(view.initial_state.expand(len(seeds), -1), generators)
    estimates = []
    for t in range(min(at + n_frames, len(view.clip))):
        if t == at:
            moved = displaced(state.particles, shift[:, None], turn[:, None])
            state = state._replace(particles=moved, mean=displaced(state.mean, shift, turn))
        frame = view.silhouettes[t].expand(len(seeds), *view.silhouettes.shape[1:])
        state, out = tracker.step(state, frame, view.rig, generators)
        estimates.append(out.mean)
    errors = view_errors(body, _cut(view, len(estimates)), torch.stack(estimates, 1))
    return errors[:, at:].nanmean(-1)


def _cut(view: View, n_frames: int) -> View:
    return view._replace(clip=view.clip.cut(0, n_frames))


def displaced(
    states: Float[Tensor, "*batch D"],
    shift: Float[Tensor, "*#batch 3"],
    turn: Float[Tensor, "*#batch 3"],
) -> Float[Tensor, "*batch D"]:
    """States whose root is moved and turned about itself.

    Args:
        states: [..., D]. shift: metres. turn: quaternion vector, about axes of the room.
    """
    position = states[..., :3] + shift
    heading = compose(turn, states[..., 3:6])
    return torch.cat([position, heading, states[..., 6:]], -1)


def _steps(
    displacement: Displacement, up: Float[Tensor, "3"], seeds: Sequence[int]
) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3"]]:
    """A level direction and a sign for each seed, the same for all methods and displacements."""
    drawn = []
    for seed in seeds:
        generator = torch.Generator().manual_seed(104729 * seed + 5)
        drawn.append(torch.randn(4, generator=generator, dtype=torch.float64))
    numbers = torch.stack(drawn)
    up = up.double()
    level = numbers[:, :3] - (numbers[:, :3] @ up)[:, None] * up
    shift = displacement.metres * torch.nn.functional.normalize(level, dim=-1)
    half = torch.deg2rad(torch.tensor(displacement.degrees / 2, dtype=torch.float64))
    return shift, numbers[:, 3:].sign() * half.sin() * up


def progress_bar(total: int, progress: bool, text: str) -> Any:
    """A bar that counts frames."""
    return tqdm(total=total, disable=not progress, unit="frame", desc=text)
