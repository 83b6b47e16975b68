"""Pictures of the protocol Root uncertainty: predicted limbs, sigma points, diffusion, samples, poses.

Everything is drawn as the cameras see it; there are no frames of videos.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from benchmarks.bodies.pictures import plot_silhouettes
from benchmarks.bodies.tracking import generators_of
from benchmarks.bodies.views import View, subjects_of
from benchmarks.engine import Results, Setting
from benchmarks.root_uncertainty.walkers import METHODS, Budget, Walker, make_filter, slower
from torchpose.body import Body, Limbs, fit_state
from torchpose.camera import CameraRig
from torchpose.evaluation import Report
from torchpose.evaluation._trials import add_picture
from torchpose.math._unscented import sigma_points
from torchpose.viz._style import (
    INK,
    LEFT,
    MIDDLE,
    NORMAL,
    PALE,
    RIGHT,
    add_legend,
    new_figure,
    require_matplotlib,
    to_numpy,
)
from torchpose.whole_body import SilhouetteParticleFilter
from torchpose.whole_body._filters.body_particles import BodyFilterState

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:
    Axes = Figure = Any

_SEEN = (0.86, 0.89, 0.93)
_FOLLOWED = 30  # frames after which distributions are shown
_SHOWN = 114  # particles drawn of each method


class Sample(NamedTuple):
    """A filter after some frames: its state and the estimate."""

    body: Body
    state: BodyFilterState
    estimate: Tensor


def add_pictures(
    report: Report, walkers: Sequence[Walker], settings: Mapping[str, Setting], budget: Budget,
    runs: Results, out: Path,
) -> None:  # fmt: skip
    """Add all pictures of the first person."""
    walker = walkers[0]
    name, subject = next(iter(subjects_of([walker]).items()))
    view = subject.view
    frame = min(_FOLLOWED, len(view.clip) - 1)
    state = fit_state(walker.body, view.clip.joints[frame : frame + 1])[0]
    add_picture(report, out, "predictions.png", plot_predictions(walker, state, view.rig))
    add_picture(report, out, "diffusion.png", plot_diffusion(slower(walker, 2), state, view.rig))
    samples = {
        METHODS[name].label: follow(make_filter(name, walker, setting, budget), view, frame)
        for name, setting in settings.items()
        if name in ("sir", "root")
    }
    root = samples.get(METHODS["root"].label)
    if root is not None:
        add_picture(report, out, "sigma-points.png", plot_sigma_points(root, view, frame))
    if samples:
        add_picture(report, out, "samples.png", plot_distributions(samples, view, frame))
    shown = [(label, runs.where(method=label, subject=name).runs[0]) for label in samples]
    if shown:
        figure = plot_silhouettes(subject, shown, 6, f"{name}: estimated poses")
        add_picture(report, out, "poses.png", figure)


def follow(tracker: SilhouetteParticleFilter, view: View, n_frames: int) -> Sample:
    """Return a filter after the first frames of a clip, and one more."""
    generators = generators_of([0])
    state = tracker.init(view.initial_state[None], generator=generators)
    for t in range(n_frames + 1):
        state, out = tracker.step(
            state, view.silhouettes[t : t + 1], view.rig, generator=generators
        )
    return Sample(tracker.body, state, out.mean[0])  # type: ignore[arg-type]


# --- Figures 3 and 5: what was learnt -------------------------------------------------------------


def plot_predictions(walker: Walker, state: Tensor, rig: CameraRig) -> Figure:
    """Draw lower legs that the limb conditionals predict from the upper ones (DX, Figure 3)."""
    body, learnt = walker.body, walker.conditionals
    shanks = [body.skeleton.part(f"{side}_shank") for side in ("left", "right")]
    edges = torch.nonzero(torch.isin(learnt.edges[:, 1], torch.tensor(shanks))).flatten()
    above = state[3:].unflatten(0, (-1, 3))[learnt.edges[edges, 0]]
    certain = torch.zeros(len(edges), 3, 3, dtype=state.dtype)
    mean, covariance = learnt.transport(above, certain, edges, False)
    points = sigma_points(mean, covariance, centre=True)
    states = [_with_parts(state, learnt.edges[edges, 1], points[:, s]) for s in range(7)]
    title = "Lower legs predicted from the upper legs: sigma points of the limb conditionals"
    return _plot_positions(body, state, {"": torch.stack(states)}, rig, shanks, title)


def plot_diffusion(walker: Walker, state: Tensor, rig: CameraRig) -> Figure:
    """Draw limbs one, two and three frames later, if nothing is seen (DX, Figure 5)."""
    body, learnt = walker.body, walker.conditionals
    parts = torch.arange(1, len(body.skeleton.parts))
    mean = state[6:].unflatten(0, (-1, 3))
    covariance = torch.zeros(len(parts), 3, 3, dtype=state.dtype)
    later = {}
    for t in (1, 2, 3):
        mean, covariance = learnt.diffuse(mean, covariance)
        points = sigma_points(mean, covariance, centre=True)
        states = torch.stack([_with_parts(state, parts, points[:, s]) for s in range(7)])
        later[f"{1000 * t / walker.fps:.0f} ms later"] = states
    title = "Temporal diffusion of all parts, from a pose that is known"
    return _plot_positions(body, state, later, rig.select([0]), list(range(1, 11)), title)


def _with_parts(state: Tensor, parts: Tensor, vectors: Tensor) -> Tensor:
    """Return a state with other vectors [K, 3] of some parts."""
    turned = state[3:].unflatten(0, (-1, 3)).clone()
    turned[parts] = vectors
    return torch.cat([state[:3], turned.flatten()])


def _plot_positions(
    body: Body, state: Tensor, groups: Mapping[str, Tensor], rig: CameraRig, parts: Sequence[int],
    title: str,
) -> Figure:  # fmt: skip
    """Draw a body, and in every panel the limbs of some parts in several states [S, D]."""
    require_matplotlib()
    panels = [(name, c) for name in groups for c in range(len(rig))]
    figure = new_figure(3.0 * len(panels) + 0.4, 4.6, title)
    row = figure.subplots(1, len(panels), squeeze=False)[0]
    own = [i for i in range(len(body.skeleton.limbs)) if _part_of(body, i) in parts]
    extent = body.joints(torch.cat([*groups.values(), state[None]]))
    for ax, (name, c) in zip(row, panels, strict=True):
        _draw_limbs(ax, body.limbs(state), rig, c, [PALE] * len(body.skeleton.limbs), fill=True)
        colours = [_side_colour(body, i) for i in own]
        for one in groups[name]:
            limbs = body.limbs(one).select(torch.tensor(own))
            _draw_limbs(ax, limbs, rig, c, colours, width=1.0)
        _frame(ax, rig(extent).pixels[..., c, :, :].reshape(-1, 2), name or rig.names[c])
    return figure


# --- Figures 4 and 6: what a filter holds ---------------------------------------------------------


def plot_sigma_points(sample: Sample, view: View, frame: int, cameras: int = 2) -> Figure:
    """Draw seven places of every limb of the best hypothesis, in two views (DX, Figure 4)."""
    require_matplotlib()
    body, rig = sample.body, view.rig
    best = int(sample.state.log_weights[0].argmax())
    state = sample.state.particles[0, best]
    states = _sigma_states(sample, best)
    n = min(cameras, len(rig))
    limbs = list(range(len(body.skeleton.limbs)))
    colours = [_side_colour(body, i) for i in limbs]
    title = "Sigma points of the limbs of the hypothesis with the largest weight"
    figure = new_figure(3.6 * n + 0.4, 5.2, title)
    for c, ax in enumerate(figure.subplots(1, n, squeeze=False)[0]):
        _show(ax, view.silhouettes[frame, c])
        for one in states:
            _draw_limbs(ax, body.limbs(one), rig, c, colours, width=0.9)
        _frame(ax, rig(body.joints(state[None])).pixels[0, c], rig.names[c], margin=0.25)
    return figure


def plot_distributions(samples: Mapping[str, Sample], view: View, frame: int) -> Figure:
    """Draw particles of SIR, and hypotheses of the root tracker with their limbs (DX, Figure 6)."""
    require_matplotlib()
    from matplotlib.lines import Line2D

    rig = view.rig
    title = f"Distribution of the samples after {frame / view.clip.fps:.2f} s"
    figure = new_figure(3.2 * len(rig) + 0.8, 4.3 * len(samples) + 0.7, title)
    grid = figure.subplots(len(samples), len(rig), squeeze=False)
    for row, (label, sample) in zip(grid, samples.items(), strict=True):
        particles = sample.state.particles[0]
        shown = particles[:: max(1, len(particles) // _SHOWN)][:_SHOWN]
        for c, ax in enumerate(row):
            _show(ax, view.silhouettes[frame, c])
            _draw_bones(ax, sample.body, shown, rig, c, alpha=0.12)
            _draw_bones(ax, sample.body, sample.estimate[None], rig, c, alpha=1.0, width=2.4)
            points = rig(view.clip.joints[frame : frame + 1]).pixels[0, c]
            _frame(ax, points, rig.names[c], margin=0.35)
        row[0].set_ylabel(f"{label}: {len(particles)}", fontsize=NORMAL, color=INK)
    sides = (("the person's left", LEFT), ("right", RIGHT), ("middle", MIDDLE))
    add_legend(figure, [Line2D([], [], color=c, linewidth=2.4, label=n) for n, c in sides])
    return figure


def _sigma_states(sample: Sample, index: int) -> Tensor:
    """Return states [7, D] with every part at its s-th sigma point."""
    state = sample.state.particles[0, index]
    memory = sample.state.memory
    if memory is None:
        return state[None]
    mean = state[6:].unflatten(0, (-1, 3))
    points = sigma_points(mean, memory[0, index], centre=True)
    return torch.cat([state[:6].expand(7, 6), points.transpose(0, 1).flatten(1)], -1)


# --- drawing --------------------------------------------------------------------------------------


def _part_of(body: Body, limb: int) -> int:
    """Return the part that a limb's far end moves with."""
    skeleton = body.skeleton
    carrier = {name: skeleton.part_of[i] for i, name in enumerate(skeleton.names)}
    carrier |= {tip.name: skeleton.part(tip.part) for tip in skeleton.tips}
    return carrier[skeleton.limbs[limb].end]


def _side_colour(body: Body, limb: int) -> str:
    name = body.skeleton.limbs[limb].name
    return LEFT if name.startswith("left_") else RIGHT if name.startswith("right_") else MIDDLE


def _draw_limbs(
    ax: Axes, limbs: Limbs, rig: CameraRig, camera: int, colours: Sequence[str],
    width: float = 0.8, fill: bool = False,
) -> None:  # fmt: skip
    """Draw outlines of limbs in one camera: hulls of two discs."""
    import cv2
    import numpy as np
    from matplotlib.collections import PolyCollection

    from torchpose.whole_body._silhouettes.outlines import project_limbs

    ends = project_limbs(
        Limbs(limbs.start[None], limbs.end[None], limbs.radii), rig.select([camera])
    )
    angle = torch.linspace(0, 2 * torch.pi, 33, dtype=torch.float64)
    circle = torch.stack([angle.cos(), angle.sin()], -1)
    centres = torch.stack([ends.x, ends.y], -1)[:, 0, 0, :, None]  # [2, L, 1, 2]
    rims = centres + ends.radius[:, 0, 0, :, None, None] * circle
    points = to_numpy(rims.transpose(0, 1).flatten(1, 2)).astype(np.float32)
    hulls = [cv2.convexHull(p)[:, 0] for p in points]
    faces = list(colours) if fill else "none"
    edges = "white" if fill else list(colours)
    ax.add_collection(PolyCollection(hulls, facecolors=faces, edgecolors=edges, linewidths=width))


def _draw_bones(
    ax: Axes, body: Body, states: Tensor, rig: CameraRig, camera: int, alpha: float,
    width: float = 0.8,
) -> None:  # fmt: skip
    """Draw bones of several states [N, D] as lines, by side."""
    from matplotlib.collections import LineCollection

    pixels = to_numpy(rig(body.joints(states)).pixels[:, camera])
    names = body.skeleton.names
    for joint, parent in enumerate(body.skeleton.parents):
        if parent < 0:
            continue
        name = names[joint]
        left, right = name.startswith("left_"), name.startswith("right_")
        colour = LEFT if left else RIGHT if right else MIDDLE
        lines = LineCollection(
            list(pixels[:, [parent, joint]]), colors=colour, alpha=alpha, linewidths=width
        )
        ax.add_collection(lines)


def _show(ax: Axes, silhouette: Tensor) -> None:
    image = torch.ones(*silhouette.shape, 3)
    image[silhouette] = torch.tensor(_SEEN)
    ax.imshow(image.numpy(), interpolation="nearest")


def _frame(ax: Axes, points: Tensor, title: str, margin: float = 0.15) -> None:
    """Set limits around points [N, 2], with one scale and no ticks, v downwards."""
    low, high = points.amin(0), points.amax(0)
    room = margin * float((high - low).max())
    ax.set_xlim(float(low[0]) - room, float(high[0]) + room)
    ax.set_ylim(float(high[1]) + room, float(low[1]) - room)
    ax.set_aspect("equal")
    ax.set_xticks([])
    ax.set_yticks([])
    for spine in ax.spines.values():
        spine.set_color(PALE)
    ax.set_title(title, fontsize=NORMAL, color=INK)
