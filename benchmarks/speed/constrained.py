"""How much does a filter cost that admits only postures of an action?

    python -m benchmarks.speed.constrained --threads 1

Seconds per frame of the constrained filter over the number of particles, beside the same filter without
an action and SIR, one camera at 160x120, in turns. The action is synthetic: a body that bends over,
learnt from twelve performances that differ. Then what a gate's decisions cost by themselves, and what
rectangles cost against cylinders.
"""

import math

import torch

from benchmarks._command import run_command
from benchmarks.speed._timing import Case, Report, Setup, begin, number, take_turns
from torchpose.body import BODY_15, Body
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.learning import fit_action_space
from torchpose.priors import ActionSpace, posture_angles, state_postures
from torchpose.priors._actions.part_postures import PartPostures
from torchpose.whole_body import (
    ConstrainedParticleFilter,
    SIRParticleFilter,
    constant_velocity_std,
    count_pixels,
    render,
)
from torchpose.whole_body._filters.posture_gate import PostureGate, Rows
from torchpose.whole_body._silhouettes.rendering import prepare_silhouettes

HEIGHT, WIDTH = 120, 160
PARTICLES = (100, 300, 1000, 3000, 10_000)
FRAMES, SKIPPED = 6, 8  # timed; the performance has begun
DIMENSIONS = 13
BODY = Body.of_height(BODY_15, 1.75)


def main(setup: Setup = Setup(runs=5)) -> None:
    """Run and print the tables."""
    report = begin("Constrained prediction", setup)
    performances = [performance(seed) for seed in range(12)]
    postures = [state_postures(BODY, states) for states in performances]
    action = fit_action_space(postures, DIMENSIONS, name="bend", fps=30.0)
    std = constant_velocity_std(BODY, performances)
    sizes = (20, 40) if setup.quick else PARTICLES
    frames(action, std, sizes, setup.runs, report)
    pieces(action, std, sizes[-1], setup.runs, report)
    report.close()


def performance(seed: int, n_frames: int = 60) -> torch.Tensor:
    """Return states [T, D] of one bend: trunk, legs and arms, each with its own size and timing."""
    g = torch.Generator().manual_seed(seed)
    t = torch.linspace(0, 1, n_frames, dtype=torch.float64)
    states = torch.zeros(n_frames, BODY.dim, dtype=torch.float64)
    states[:, 1] = 0.93
    sizes = {"torso": 1.1, "upper_arm": -0.5, "forearm": -0.3, "thigh": -0.4, "shank": 0.5}
    for i, part in enumerate(BODY.skeleton.parts[1:]):
        size = next((s for name, s in sizes.items() if part.endswith(name)), 0.1)
        draw = torch.randn(5, generator=g, dtype=torch.float64)
        phase = (math.pi * t ** (1 + 0.1 * draw[0])).sin().square()
        wobble = 0.03 * (2 * math.pi * (t[:, None] * (1 + i % 3) + draw[1:3])).sin()
        angle = size * (1 + 0.2 * draw[3]) * phase
        column = 6 + 3 * i
        states[:, column] = (angle / 2).sin() + wobble[:, 0] + 0.03 * draw[4]
        states[:, column + 2] = wobble[:, 1]
    return states


def rig() -> CameraRig:
    """Return one camera at the person's left, 3.4 m away."""
    turn = torch.tensor([[0.0, 0, -1], [0, -1, 0], [-1, 0, 0]], dtype=torch.float64)
    place = -turn @ torch.tensor([3.4, 0.95, 0.0], dtype=torch.float64)
    vector = (math.pi / 2**0.5, 0.0, -math.pi / 2**0.5)
    camera = PinholeCamera(
        130, 130, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT, "side",
        rotation=vector, translation=place.tolist(),
    )  # fmt: skip
    return CameraRig([camera])


def frames(
    action: ActionSpace, std: torch.Tensor, sizes: tuple[int, ...], runs: int, report: Report
) -> None:
    """Add the cost per frame and the acceptance over the number of particles."""
    states = performance(99)[SKIPPED : SKIPPED + FRAMES + 1]
    camera = rig()
    silhouettes = render(BODY, states[1:], camera, HEIGHT, WIDTH)
    options = {"process_cov": std.square(), "likelihood": "overlap", "sharpness": 30.0}
    rows = []
    for n in sizes:
        trackers = {
            "constrained": ConstrainedParticleFilter(BODY, action, n, **options),
            "first order": ConstrainedParticleFilter(BODY, None, n, **options),
            "SIR": SIRParticleFilter(BODY, n, **options),
        }

        def run(name: str, trackers: dict = trackers) -> object:
            g = torch.Generator().manual_seed(0)
            return trackers[name](silhouettes, camera, states[0], g)

        cases = [Case(name, lambda name=name: run(name), FRAMES) for name in trackers]
        timings = take_turns(cases, max(runs if n < 3000 else runs // 2, 1))
        details = run("constrained").details
        for timing in timings:
            found = timing.case.name == "constrained"
            shares = [float(details[k].mean()) if found else math.nan for k in details]
            rows.append(
                [timing.case.name, f"{n:,}", *timing.milliseconds]
                + [number(share, 2) if found else "" for share in shares]
            )  # fmt: skip
    report.add(f"One frame of one camera at {WIDTH}x{HEIGHT}, D = {action.n_dimensions}:")
    header = ("filter", "N", "ms", "min ms", "CPU ms", "acceptance", "redraws", "clamped")
    report.table(header, rows)


def pieces(action: ActionSpace, std: torch.Tensor, n: int, runs: int, report: Report) -> None:
    """Add the cost per particle of each part of a frame."""
    g = torch.Generator().manual_seed(0)
    noise = torch.randn(n, BODY.dim, generator=g, dtype=torch.float64)
    states = BODY.perturb(performance(99)[SKIPPED].expand(n, -1), noise * std)
    relative = states[:, 6:].float()
    gate, quick, camera = PostureGate(BODY, action), PartPostures(BODY), rig()
    everything = Rows.all(1, n, g, states.device)
    observed = prepare_silhouettes(render(BODY, states[0], camera, HEIGHT, WIDTH))
    cases = [
        Case("gate: postures, match, decision", lambda: gate.accept(relative, everything), n),
        Case("postures from the parts", lambda: quick.of_relative(relative), n),
        Case("postures from the joints", lambda: posture_angles(BODY.joints(states)), n),
        Case("silhouette, cylinders", lambda: count_pixels(BODY, states, camera, observed), n),
        Case(
            "silhouette, rectangles",
            lambda: count_pixels(BODY, states, camera, observed, limb_shape="rectangles"),
            n,
        ),
    ]
    timings = take_turns(cases, runs)
    report.add(f"Microseconds per particle, {n:,} at a time:")
    rows = [[t.case.name, number(1e6 * t.median), number(1e6 * t.best)] for t in timings]
    report.table(("piece", "us", "min us"), rows)


if __name__ == "__main__":
    run_command(main)
