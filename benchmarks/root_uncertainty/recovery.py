"""Part of the protocol Root uncertainty: how filters recover after all particles were displaced."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.bodies.tracking import generators_of, view_errors
from benchmarks.bodies.views import Subject, View, subjects_of
from benchmarks.engine import Experiment, Grid, Results, Setting, mean, pivot
from benchmarks.root_uncertainty.walkers import (
    METHODS,
    SOURCES,
    Budget,
    Filter,
    Walker,
    filter_facts,
    make_filter,
)
from torchpose.body import Body
from torchpose.evaluation import Report
from torchpose.math import compose
from torchpose.whole_body import SilhouetteParticleFilter

_BACK = 30.0  # mm from the error without a displacement: recovered
_WINDOW = 0.1  # seconds over which the error after a displacement is taken


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


class _Displaced(NamedTuple):
    """A filter, and how its particles are moved at a frame and tracked for some more."""

    how: Filter
    displacement: Displacement
    at: int
    n_frames: int


class Recovered(NamedTuple):
    """Mean error of the joints after a displacement, mm, [T]."""

    errors: Tensor


def displaced_grids(
    walkers: Sequence[Walker], settings: Mapping[str, Setting], budget: Budget,
    displacements: Sequence[Displacement], times: Sequence[float], seconds: float,
) -> dict[str, Grid[Subject[Walker], _Displaced]]:  # fmt: skip
    """Return everybody's first clip, tracked after every displacement at every time.

    Args:
        walkers, settings, budget: as `grid_of`. displacements: the first one none.
        times: when particles are moved, seconds from the start. seconds: tracked from then on.
    """
    fps = walkers[0].fps
    subjects = subjects_of([replace(walker, tests=walker.tests[:1]) for walker in walkers])
    return {
        _name(displacement, time): Grid(
            subjects,
            {
                METHODS[name].label: _Displaced(
                    Filter(name, setting, budget),
                    displacement,
                    round(time * fps),
                    round(seconds * fps),
                )
                for name, setting in settings.items()
            },
        )
        for time in times
        for displacement in displacements
    }


def _name(displacement: Displacement, time: float) -> str:
    return f"{displacement}, {f'after {time:g} s' if time else 'start'}"


def _recover(subject: Subject[Walker], how: _Displaced, seeds: Sequence[int]) -> list[Recovered]:
    method = how.how
    tracker = make_filter(method.name, subject.person, method.setting, method.budget, subject.body)
    errors = _after(
        tracker, subject.body, subject.view, seeds, how.displacement, how.at, how.n_frames
    )
    return [Recovered(own) for own in errors]


def _facts(subject: Subject[Walker], how: _Displaced) -> list[Any]:
    return [*how[1:], *filter_facts(subject, how.how)]


RECOVERY = Experiment(
    Recovered, _recover, _facts, (*SOURCES, "benchmarks/root_uncertainty/recovery.py"),
    lambda subject, how: how.at + how.n_frames, "frame",
)  # fmt: skip
"""Runs of a filter whose particles are moved at some time to another place or heading."""


def _after(
    tracker: SilhouetteParticleFilter, body: Body, view: View, seeds: Sequence[int],
    displacement: Displacement, at: int, n_frames: int,
) -> Float[Tensor, "S T"]:  # fmt: skip
    """Return errors from the frame `at` on, before which every particle is moved by the same step."""
    generators = generators_of(seeds)
    shift, turn = _steps(displacement, view.clip.up, seeds)
    state = tracker.init(view.initial_state.expand(len(seeds), -1), generator=generators)
    estimates = []
    for t in range(min(at + n_frames, len(view.clip))):
        if t == at:
            moved = displaced(state.particles, shift[:, None], turn[:, None])
            state = state._replace(particles=moved, mean=displaced(state.mean, shift, turn))
        frame = view.silhouettes[t].expand(len(seeds), *view.silhouettes.shape[1:])
        state, out = tracker.step(state, frame, view.rig, generator=generators)
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
    """Return states whose root is moved and turned about itself.

    Args:
        states: [..., D]. shift: metres. turn: quaternion vector, about axes of the room.
    """
    position = states[..., :3] + shift
    heading = compose(turn, states[..., 3:6])
    return torch.cat([position, heading, states[..., 6:]], -1)


def _steps(
    displacement: Displacement, up: Float[Tensor, "3"], seeds: Sequence[int]
) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3"]]:
    """Return a level direction and a sign for each seed, the same for all methods and displacements."""
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


def add_recovery(report: Report, runs: Results, fps: float, seconds: float) -> None:
    """Add the error some time after the root was displaced, and the share of runs that are back.

    Args:
        report: gets the table. runs: by displacement and time. fps: frames per second.
        seconds: between displacement and error.
    """
    width = max(1, round(_WINDOW * fps))

    def last(run: Recovered) -> Tensor:
        return run.errors[-width:].mean()

    def back(own: Results) -> float:
        (condition,), (method,) = own.names("condition"), own.names("method")
        undisturbed = f"{DISPLACEMENTS[0]}, {condition.partition(', ')[2]}"
        usual = runs.where(condition=undisturbed, method=method).values(last).mean(1)
        return 100 * float((own.values(last) <= usual[:, None] + _BACK).double().mean())

    pivot(
        report, "recovery", f"Error (mm) {seconds:g} s after all particles were displaced", runs,
        ["condition"], {"{}": mean(last), "back, {} (%)": back}, columns="method",
        note=f"Mean over joints, persons, seeds and the last {_WINDOW:g} s. Back: runs within "
        f"{_BACK:g} mm of what the method has there without a displacement, mean over its seeds. "
        "Displaced are the particles before the first frame, or in the middle, to a level direction "
        "or about the vertical, the same ones for all methods.",
    )  # fmt: skip
