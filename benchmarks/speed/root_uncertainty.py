"""How many frames a second does the tracker with root uncertainty take, beside SIR and annealing?

    python -m benchmarks.speed.root_uncertainty --threads 1

114 root hypotheses (798 likelihoods) of the default body in three cameras at 160x120, beside SIR with
800 particles and annealing with 5 x 160, which evaluate as many: every method takes turns on the same
frame. Then where the tracker's time goes, and the floor: counting the same limbs once without the rest.
"""

import math
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import torch

from benchmarks._command import run_command
from benchmarks.speed._timing import (
    Case,
    Report,
    Setup,
    Timing,
    begin,
    measure_limits,
    number,
    ratio,
    take_turns,
)
from benchmarks.speed.silhouettes import make_rig
from torchpose.body import BODY_15, Body, Limbs
from torchpose.camera import CameraRig
from torchpose.learning import fit_limb_conditionals
from torchpose.math._tree_messages import propagate
from torchpose.math._unscented import sigma_points
from torchpose.priors import in_body_frame
from torchpose.priors._limb_conditionals import LimbConditionals
from torchpose.whole_body import (
    AnnealedParticleFilter,
    RootUncertaintyTracker,
    SilhouetteParticleFilter,
    SIRParticleFilter,
    count_pixels,
    render,
)
from torchpose.whole_body._filters.limb_observations import (
    count_positions,
    observation_gaussians,
    part_log_likelihood,
    part_positions,
)
from torchpose.whole_body._silhouettes.rendering import prepare_silhouettes, render_limbs

SIZES = ((120, 160), (480, 640))
HYPOTHESES, LAYERS, CAMERAS, POINTS = 114, 5, 3, 7
FPS = 60.0


class Scene(NamedTuple):
    """A standing body, conditionals of swinging limbs, cameras, and one silhouette of each."""

    body: Body
    conditionals: LimbConditionals
    rig: CameraRig
    state: torch.Tensor
    silhouettes: torch.Tensor


def main(setup: Setup = Setup(runs=9)) -> None:
    """Run and print the tables."""
    report = begin("Root uncertainty: one frame", setup)
    n = 4 if setup.quick else HYPOTHESES
    sizes = ((30, 40),) if setup.quick else SIZES
    agree = check(make_scene(*sizes[0]), report)
    for size in sizes:
        scene = make_scene(*size)
        compare(scene, n, setup.runs, report)
    where(make_scene(*sizes[0]), n, setup.runs, report)
    report.close(limits=measure_limits(setup.quick))
    if not agree:
        sys.exit("counts differ from those of rendered parts")


def check(scene: Scene, report: Report) -> bool:
    """Compare counts of a few hypotheses with images of every part at each of its places."""
    spread = torch.full((scene.body.dim,), 0.05, dtype=torch.float64)
    one = tracker(scene, 3)
    states = one.init(
        scene.state[None], generator=torch.Generator().manual_seed(1), initial_cov=spread.square()
    ).particles[0]
    mean = states[..., 6:].unflatten(-1, (-1, 3))
    points = sigma_points(mean, one.first_memory(states[None])[0], centre=True)
    prepared = prepare_silhouettes(scene.silhouettes[0])
    counts = count_positions(scene.body, states, points, scene.rig, prepared, one.groups)
    wrong = 0
    for group in one.groups:
        limbs = part_positions(scene.body, states, points, group)
        limbs = Limbs(*limbs[:2], limbs.radii.expand(*limbs.start.shape[:-1], 2))
        covered = render_limbs(limbs, scene.rig, *scene.silhouettes.shape[-2:])
        image = scene.silhouettes[0].double().expand(3, len(group.parts), -1, -1, -1)
        if group.opposing:
            union = covered[:, list(group.opposing)].any(2)
            image = image * torch.where(union, 0.5, 1.0)
        pixels = (covered * image[:, :, None]).sum((-2, -1))
        wrong += int((pixels != counts.weight[:, list(group.parts)]).sum())
    report.add(
        f"Agreement with the definition (DX 4), {counts.weight.numel()} places and cameras: "
        f"{wrong} counts differ."
    )
    return wrong == 0


def make_scene(height: int, width: int) -> Scene:
    upright = Body.of_height(BODY_15, 1.75)
    g = torch.Generator().manual_seed(0)
    phase = torch.arange(120, dtype=torch.float64)[:, None] * 2 * math.pi / 60
    shift = 6 * torch.rand(upright.dim, generator=g, dtype=torch.float64)
    swing = 0.15 * torch.sin(phase + shift)
    swing[:, :6] = 0
    swing[:, 1] = 0.93
    body, recorded = in_body_frame([(upright, [swing])])
    conditionals = fit_limb_conditionals(body, recorded, FPS)
    rig = make_rig(CAMERAS, height, width)
    state = recorded[0][30]
    return Scene(body, conditionals, rig, state, render(body, state, rig, height, width)[None])


def compare(scene: Scene, n: int, runs: int, report: Report) -> None:
    """Time every filter on one frame, from the same particles each time."""
    budget = POINTS * n
    filters: dict[str, SilhouetteParticleFilter] = {
        f"root uncertainty, {n} hypotheses": tracker(scene, n),
        f"SIR, {budget} particles": SIRParticleFilter(scene.body, budget, survival_rate=0.5),
        f"annealed, {LAYERS} x {budget // LAYERS}": AnnealedParticleFilter(
            scene.body, budget // LAYERS, n_layers=LAYERS
        ),
    }
    cases = [Case(name, one_frame(one, scene)) for name, one in filters.items()]
    body, prepared = scene.body, prepare_silhouettes(scene.silhouettes)
    many = scene.state.expand(1, budget, -1)
    cases.append(
        Case(
            f"floor: {budget} bodies counted once",
            lambda: count_pixels(body, many, scene.rig, prepared),
        )
    )
    timings = take_turns(cases, runs)
    height, width = scene.silhouettes.shape[-2:]
    report.add(f"{CAMERAS} cameras, {width}x{height}:")
    report.table(
        ["", "ms a frame", "frames a second", "CPU ms", "times the floor (CPU)"],
        [row(timing, timings[-1]) for timing in timings],
    )


def row(timing: Timing, floor: Timing) -> list[str]:
    return [
        timing.case.name,
        number(1e3 * timing.median),
        number(1 / timing.median),
        number(1e3 * timing.median_cpu),
        number(ratio(timing, floor).cpu, 2),
    ]


def where(scene: Scene, n: int, runs: int, report: Report) -> None:
    """Time the steps of a frame one by one, on the same hypotheses."""
    one, (height, width) = tracker(scene, n), scene.silhouettes.shape[-2:]
    spread = torch.full((scene.body.dim,), 0.02, dtype=torch.float64)
    state = one.init(
        scene.state[None], generator=torch.Generator().manual_seed(0), initial_cov=spread.square()
    )
    prepared = prepare_silhouettes(scene.silhouettes)
    mean = state.particles[..., 6:].unflatten(-1, (-1, 3))
    memory = one.first_memory(state.particles)
    covariance = one.conditionals.diffuse(mean, memory)[1]
    points = sigma_points(mean, covariance, centre=True)
    counts = count_positions(scene.body, state.particles, points, scene.rig, prepared, one.groups)
    weights = part_log_likelihood(counts)
    observed = observation_gaussians(points, weights, mean, covariance, one.least_std)
    tree, transport = one.conditionals.tree, one.conditionals.transport
    steps: dict[str, Callable[[], Any]] = {
        "diffusion and sigma points": lambda: sigma_points(
            mean, one.conditionals.diffuse(mean, memory)[1], centre=True
        ),
        "counts": lambda: count_positions(
            scene.body, state.particles, points, scene.rig, prepared, one.groups
        ),
        "observation Gaussians": lambda: observation_gaussians(
            points, part_log_likelihood(counts), mean, covariance, one.least_std
        ),
        "messages": lambda: propagate(*observed, tree, transport),
        "whole frame": one_frame(one, scene),
    }
    timings = take_turns([Case(name, call) for name, call in steps.items()], runs)
    whole = timings[-1].median_cpu
    report.add(f"Where the time goes, {n} hypotheses, {CAMERAS} cameras, {width}x{height}:")
    rows = [
        [t.case.name, number(1e3 * t.median_cpu), f"{100 * t.median_cpu / whole:.0f} %"]
        for t in timings
    ]
    report.table(["", "CPU ms", "share"], rows)


def tracker(scene: Scene, n: int) -> RootUncertaintyTracker:
    return RootUncertaintyTracker(scene.body, scene.conditionals, n, fps=FPS)


def one_frame(one: SilhouetteParticleFilter, scene: Scene) -> Callable[[], object]:
    generator = torch.Generator().manual_seed(0)
    spread = torch.full((scene.body.dim,), 0.02, dtype=torch.float64)
    state = one.init(scene.state[None], generator=generator, initial_cov=spread.square())
    return lambda: one.step(state, scene.silhouettes, scene.rig, generator=generator)


if __name__ == "__main__":
    run_command(main)
