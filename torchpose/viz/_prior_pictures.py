"""Draw the components of a prior, samples from it, and its likelihood over EM."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_count
from torchpose.errors import InputError
from torchpose.priors._arm_state import arm_in_body_axes
from torchpose.viz._skeletons import ARM_LIMBS, _limits, _set_view, draw_skeleton
from torchpose.viz._style import (
    GRID,
    INK,
    LEFT,
    MIDDLE,
    MUTED,
    NORMAL,
    RIGHT,
    SIDE_COLORS,
    SMALL,
    add_legend,
    label_row,
    legend_line,
    new_figure,
    style_axes,
    to_numpy,
    weight_bar,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from torchpose.priors._upper_body_prior import UpperBodyPrior
else:
    Axes = Figure = SubFigure = UpperBodyPrior = Any

_FRONT, _SIDE = (0, 1), (2, 1)
_VIEWS = {"front": _FRONT, "side": _SIDE}
_PER_ROW, _PANEL = 6, 1.9  # panels and their width in inches
_DRAWS_OF_A_COMPONENT = 25
_SEEN, _UNSEEN = LEFT, RIGHT  # the same two colours


class _Component(NamedTuple):
    """Holds one Gaussian as arms in body axes: by side, the mean [5, 3] and draws [N, 5, 3]."""

    weight: float
    means: dict[str, Tensor]
    draws: dict[str, Tensor]


def plot_prior_components(
    prior: UpperBodyPrior,
    mixture: str = "pose",
    n_shown: int = 30,
    seed: int = 0,
    title: str | None = None,
) -> Figure:
    """Return the components of a prior as bodies from the front and the side, heaviest first.

    A strong line is a component's mean, transformed from its camera's view to the body (BL 5). Thin
    lines are draws from the component, which show its spread. The line is stronger for a larger weight.
    The number is the weight, the bar the weight relative to the largest. Where the right arm is the
    mirror image of the left one, both are drawn on one body; otherwise each arm has a block of its own.

    Args:
        prior: whose components are drawn.
        mixture: "pose", or the name of a window ("causal", "full").
        n_shown: at most this many components of each arm. seed: the seed of the draws.
        title: above the picture; by default what is shown.

    Raises:
        InputError: no such mixture, or nothing to be shown.

    Reference: Burke & Lasenby, Figure 6.
    """
    check_count("n_shown", n_shown)
    blocks = _components(prior, mixture, n_shown, seed)
    n_columns = min(_PER_ROW, max(len(block) for block in blocks.values()))
    n_rows = [math.ceil(len(block) / n_columns) for block in blocks.values()]
    spread = torch.cat(
        [arm.flatten(0, 1) for block in blocks.values() for c in block for arm in c.draws.values()]
    )
    levels = torch.tensor([0.01, 0.99], dtype=torch.float64)
    low, high = _limits(torch.quantile(spread, levels, dim=0), margin=0.06)
    if title is None:
        title = _components_title(prior, mixture, blocks)
    size = (high - low).tolist()
    tall = _PANEL * size[1] / (size[0] + size[2])
    figure = new_figure(_PANEL * n_columns, (tall + 0.45) * sum(n_rows) + 0.8, title)
    parts = figure.subfigures(len(blocks), 1, height_ratios=n_rows, squeeze=False)[:, 0]
    for part, (name, block), rows in zip(parts, blocks.items(), n_rows, strict=True):
        if len(blocks) > 1:
            part.suptitle(name, fontsize=NORMAL, color=INK)
        _draw_components(part, block, rows, n_columns, low, high)
    add_legend(figure, _component_legend(_on_one_body(prior, mixture)))
    return figure


def _components_title(
    prior: UpperBodyPrior, mixture: str, blocks: Mapping[str, list[_Component]]
) -> str:
    total = (prior.left if mixture == "pose" else prior.windows[mixture].left).n_components
    shown = max(len(block) for block in blocks.values())
    count = f"{shown} heaviest of {total}" if shown < total else f"{total}"
    of = "" if mixture == "pose" else f', windows "{mixture}"'
    return f"{prior.info.name or 'prior'}{of}: {count} components, from the front and the side"


def _components(
    prior: UpperBodyPrior, name: str, n_shown: int, seed: int
) -> dict[str, list[_Component]]:
    """Return blocks of components, heaviest first: one of both arms, or one for each arm."""
    if name == "pose":
        arms = {"left": prior.left, "right": prior.right}
    elif name in prior.windows:
        arms = {side: getattr(prior.windows[name], side) for side in ("left", "right")}
    else:
        known = ", ".join(["pose", *prior.windows])
        raise InputError(f"mixture must be one of {known}, got {name!r}")
    if _on_one_body(prior, name):
        groups = {"both arms": ["left", "right"]}
    else:
        groups = {"left arm": ["left"], "right arm": ["right"]}
    blocks = {}
    for label, sides in groups.items():
        weights = arms[sides[0]].weights.detach().cpu().double()
        means, draws = {}, {}
        for side in sides:
            mean = arms[side].means.detach().cpu().double()[:, :21]
            root = arms[side].cholesky().detach().cpu().double()[:, :21]
            generator = torch.Generator().manual_seed(seed)
            noise = torch.randn(
                len(mean), _DRAWS_OF_A_COMPONENT, root.shape[-1], generator=generator,
                dtype=torch.float64,
            )  # fmt: skip
            means[side] = _in_body(prior, mean)
            draws[side] = _in_body(prior, mean[:, None] + noise @ root.mT)
        blocks[label] = [
            _Component(
                float(weights[k]),
                {side: value[k] for side, value in means.items()},
                {side: value[k] for side, value in draws.items()},
            )
            for k in weights.argsort(descending=True)[:n_shown].tolist()
        ]
    return blocks


def _on_one_body(prior: UpperBodyPrior, mixture: str) -> bool:
    """Return whether the k-th components of both arms are mirror images of each other."""
    return prior.info.mirrored and mixture == "pose"


def _in_body(prior: UpperBodyPrior, states: Float[Tensor, "*batch 21"]) -> Tensor:
    """Return the hand, elbow, shoulder, head and neck of states in body axes, metres, from the neck."""
    joints = arm_in_body_axes(states, prior.info.matrix, prior.info.rotation_order)
    return joints - joints[..., 4:, :]


def _draw_components(
    part: SubFigure,
    block: list[_Component],
    n_rows: int,
    n_columns: int,
    low: Tensor,
    high: Tensor,
) -> None:
    """Draw a panel for each component: the front view beside the side view."""
    size = (high - low).tolist()
    middle = float((low + high)[2]) / 2
    aside = float(high[0]) - middle + size[2] / 2  # where the side view has its z = 0
    panels = part.subplots(n_rows, n_columns, squeeze=False)
    for ax in panels.flat:
        ax.set_axis_off()
    heaviest = block[0].weight
    for ax, component in zip(panels.flat, block, strict=False):
        share = component.weight / heaviest
        _draw_view(ax, component, _FRONT, 0.0, share)
        _draw_view(ax, component, _SIDE, aside, share)
        ax.set_aspect("equal")
        ax.set(
            xlim=(float(low[0]), float(high[0]) + size[2]),
            ylim=(float(high[1]), float(low[1])),
        )
        ax.plot(2 * [float(high[0])], [float(low[1]), float(high[1])], color=GRID, linewidth=0.8)
        weight_bar(ax, component.weight, share)


def _draw_view(
    ax: Axes, component: _Component, pick: tuple[int, int], shift: float, share: float
) -> None:
    """Draw a component from the front or the side, so far to the right; the heavier, the thicker."""
    offset = torch.tensor([shift, 0.0], dtype=torch.float64)
    for side, mean in component.means.items():
        if pick == _SIDE and side == "right" and len(component.means) > 1:
            continue  # the mirror image looks the same from the side
        _draw_arms(ax, component.draws[side][..., pick] + offset, side)
        colors = [SIDE_COLORS[side]] * 3 + [MIDDLE] * 2
        draw_skeleton(
            ax, mean[:, pick] + offset, colors=colors, limbs=ARM_LIMBS,
            linewidth=1.0 + 1.4 * share, alpha=0.35 + 0.65 * share,
        )  # fmt: skip


def _draw_arms(ax: Axes, arms: Float[Tensor, "N 5 2"], side: str, alpha: float = 0.22) -> None:
    """Draw thin lines from shoulder to hand."""
    flat = to_numpy(arms[:, :3])
    ax.plot(flat[..., 0].T, flat[..., 1].T, color=SIDE_COLORS[side], linewidth=0.6,
            alpha=alpha, zorder=1)  # fmt: skip


def _component_legend(on_one_body: bool) -> list[Any]:
    right = "right arm, the mirror image" if on_one_body else "person's right arm"
    return [
        legend_line("person's left arm", LEFT, linewidth=3),
        legend_line(right, RIGHT, linewidth=3),
        legend_line("mean", MUTED, linewidth=2.4, marker="o"),
        legend_line("draws from the component", MUTED, linewidth=0.6, alpha=0.6),
    ]


def plot_prior_samples(
    prior: UpperBodyPrior,
    n_samples: int = 12,
    seed: int = 0,
    n_cloud: int = 300,
    title: str | None = None,
) -> Figure:
    """Return samples of a prior as bodies from the front and the side, one by one and superimposed.

    The arms are sampled independently, as in the prior, each with a camera of its own, and joined at the
    neck. Pairs of arms that no person could have show the error of that independence.

    Args:
        prior: to draw from.
        n_samples: bodies that are shown one by one. seed: the seed of the draws.
        n_cloud: draws in the two large panels.
        title: above the picture; by default the prior's name.

    Raises:
        InputError: fewer than one draw.
    """
    if n_samples < 1 or n_cloud < 1:
        raise InputError(f"n_samples and n_cloud must be at least 1, got {n_samples} and {n_cloud}")
    generator = torch.Generator().manual_seed(seed)
    count = max(n_samples, n_cloud)
    arms = {
        side: _in_body(prior, mixture.sample((count,), generator).detach().cpu().double())
        for side, mixture in (("left", prior.left), ("right", prior.right))
    }
    shared = (arms["left"][:, 3:] + arms["right"][:, 3:]) / 2
    bodies = torch.cat([arms["left"][:, :3], shared, arms["right"][:, :3].flip(1)], 1)
    limits = _limits(bodies[:n_samples], margin=0.06)
    columns = min(6, n_samples)
    lines = math.ceil(n_samples / columns)
    size = (limits[1] - limits[0]).tolist()
    tall = 1.25 * size[1] / size[0]
    title = title or f"{prior.info.name or 'prior'}: draws from the front and the side"
    height = max(6.4, lines * (2 * tall + 0.25) + 0.8)
    figure = new_figure(1.25 * columns + 4.2, height, title)
    widths = [1.25 * columns, 4.2]
    strip, cloud = figure.subfigures(1, 2, width_ratios=widths, squeeze=False)[0]
    grid = strip.subplots(2 * lines, columns, squeeze=False)
    for ax in grid.flat:
        ax.set_axis_off()
    for place, body in enumerate(bodies[:n_samples]):
        line, column = divmod(place, columns)
        for row, (name, pick) in enumerate(_VIEWS.items()):
            ax = grid[2 * line + row, column]
            draw_skeleton(ax, body[:, pick], linewidth=2.2)
            _set_view(ax, *limits, pick)
            if column == 0:
                label_row(ax, name)
    _draw_cloud(cloud, bodies[:n_cloud])
    add_legend(figure, _sample_legend())
    return figure


def _draw_cloud(part: SubFigure, bodies: Float[Tensor, "N 8 3"]) -> None:
    """Draw all samples superimposed, the hands as dots."""
    levels = torch.tensor([0.005, 0.995], dtype=torch.float64)
    low, high = _limits(torch.quantile(bodies.flatten(0, 1), levels, dim=0), margin=0.08)
    panels = part.subplots(2, 1, sharey=True)
    for ax, (name, pick) in zip(panels, _VIEWS.items(), strict=True):
        axis = "x, to the right (m)" if name == "front" else "z, away (m)"
        style_axes(ax, axis, "y, down (m)", f"{len(bodies)} draws, {name}")
        for side, joints in (("left", [0, 1, 2, 4, 3]), ("right", [7, 6, 5, 4, 3])):
            arms = bodies[:, joints][..., pick]
            _draw_arms(ax, arms, side, alpha=0.12)
            trunk = to_numpy(arms[:, 2:])
            ax.plot(trunk[..., 0].T, trunk[..., 1].T, color=MIDDLE, linewidth=0.6, alpha=0.06)
            hands = to_numpy(arms[:, 0])
            ax.scatter(
                hands[:, 0], hands[:, 1], s=7, color=SIDE_COLORS[side], linewidths=0, alpha=0.6
            )
        ax.set_aspect("equal")
        ax.set_xlim(float(low[pick[0]]), float(high[pick[0]]))
    panels[0].set_ylim(float(high[1]), float(low[1]))


def _sample_legend() -> list[Any]:
    return [
        legend_line("person's left arm", LEFT, linewidth=3),
        legend_line("person's right arm", RIGHT, linewidth=3),
        legend_line("hands of all draws", MUTED, marker="o", linestyle="", markersize=4),
    ]


def plot_log_likelihood(
    training: Mapping[str, Sequence[float] | Tensor],
    held_out: Mapping[str, Sequence[float] | Tensor] | None = None,
    title: str | None = "Log-likelihood over EM steps",
) -> Figure:
    """Return the mean log-likelihood over the steps of EM, a panel for each mixture.

    The best step of a curve is marked. The scale leaves out the first steps, whose values are far
    below the rest.

    Args:
        training: by mixture, a value for each step, counted from 1, in nats per state; NaN where a
            step was not scored. held_out: the same of held-out persons, of any of the mixtures.
        title: above the picture.

    Raises:
        InputError: no mixture, held-out values of an unknown one, or a curve without finite value.
    """
    held_out = held_out or {}
    unknown = sorted(set(held_out) - set(training))
    if not training or unknown:
        got = f"held-out values of {', '.join(unknown)}" if unknown else "none"
        raise InputError(
            f"training must hold the curve of every mixture and at least one, got {got}"
        )
    columns = min(3, len(training))
    rows = math.ceil(len(training) / columns)
    figure = new_figure(3.7 * columns + 0.6, 2.7 * rows + 0.9, title)
    grid = figure.subplots(rows, columns, squeeze=False)
    for ax in grid.flat[len(training) :]:
        ax.set_visible(False)
    for place, (ax, name) in enumerate(zip(grid.flat, training, strict=False)):
        style_axes(ax, "EM step" if place + columns >= len(training) else "", title=name)
        bounds = [_draw_likelihood(ax, f"training curve of {name}", training[name])]
        if name in held_out:
            bounds.append(
                _draw_likelihood(ax, f"held-out curve of {name}", held_out[name], unseen=True)
            )
        low, high = min(b[0] for b in bounds), max(b[1] for b in bounds)
        room = max(0.08 * (high - low), 1e-6)
        ax.set_ylim(low - room, high + 2 * room)
    for ax in grid[:, 0]:
        ax.set_ylabel("mean log-likelihood (nats)", fontsize=NORMAL, color=INK)
    add_legend(figure, _likelihood_legend(bool(held_out)))
    return figure


def _likelihood_legend(held_out: bool) -> list[Any]:
    entries = [legend_line("training persons", _SEEN, linewidth=1.8)]
    if held_out:
        entries.append(
            legend_line("held-out persons", _UNSEEN, marker="o", markersize=4, linewidth=1.8)
        )
    return [*entries, legend_line("best step", marker="D", markersize=5, linestyle="")]


def _draw_likelihood(
    ax: Axes, name: str, values: Sequence[float] | Tensor, unseen: bool = False
) -> tuple[float, float]:
    """Draw one curve; return the lowest and highest value for the scale."""
    y = torch.as_tensor(values, dtype=torch.float64).detach().cpu().flatten()
    steps = torch.arange(1, len(y) + 1)
    finite = torch.isfinite(y)
    if not bool(finite.any()):
        raise InputError(f"the {name} has no finite value")
    y, steps = y[finite], steps[finite]
    style = {"color": _UNSEEN, "marker": "o", "markersize": 3} if unseen else {"color": _SEEN}
    ax.plot(steps.numpy(), y.numpy(), linewidth=1.8, **style)
    at = int(y.argmax())
    ax.plot([int(steps[at])], [float(y[at])], color=INK, marker="D", markersize=5, zorder=5)
    ax.annotate(
        f"{float(y[at]):.2f}".replace("-", "\N{MINUS SIGN}"), (int(steps[at]), float(y[at])),
        xytext=(0, -8 if unseen else 6), textcoords="offset points", ha="right",
        va="top" if unseen else "bottom", fontsize=SMALL, color=INK,
    )  # fmt: skip
    kept = y[steps > max(2, len(steps) // 20)]
    shown = kept if len(kept) > 1 else y
    return float(shown.min()), float(y.max())
