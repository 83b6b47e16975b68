"""Draw the latent space of a manifold, and the space of an action."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchpose._core.checks import check_count, check_finite, check_tensors
from torchpose.body._kinematics import Body
from torchpose.errors import InputError, ShapeError
from torchpose.priors._actions.action_file import Synchronised
from torchpose.priors._actions.space import ActionSpace
from torchpose.priors._manifold.gplvm import BackConstrainedGPLVM
from torchpose.viz._style import (
    INK,
    LEFT,
    MUTED,
    PALE,
    RIGHT,
    SIDE_COLORS,
    SMALL,
    add_legend,
    check_named,
    legend_line,
    method_styles,
    new_figure,
    side_of,
    style_axes,
    to_numpy,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:
    Axes = Figure = Any

_MARGIN, _ARROWS, _MARKS = 0.18, 5, "osD^v"
_SIDE, _UP = 2, 1  # part axes: z forward, y up


def plot_manifold(
    manifold: BackConstrainedGPLVM,
    others: Mapping[str, Tensor | Sequence[Tensor]] | None = None,
    body: Body | None = None,
    n_poses: int = 8,
    resolution: int = 160,
    title: str | None = None,
) -> Figure:
    """Return the first two latent dimensions, the trajectories in them, and the predictive deviation.

    The predictive deviation is least where the picture is lightest; where it is dark the manifold predicts
    the mean pose. A line is a sequence, with arrows in the direction of time and a mark at its start.
    Sequences of one name share colour and mark. With a body, poses along the first sequence are drawn
    below, seen from the side and facing right; their numbers are in the latent space as well.

    Args:
        manifold: of two latent dimensions or more; the others are held at zero.
        others: more poses by name, such as of a validation trial, drawn dashed.
        body: whose states the poses are of. n_poses: the number of poses that are shown of it, at most one
            for each frame.
        resolution: points of the grey picture along either axis.
        title: above the picture; by default the manifold's name and size.

    Returns:
        matplotlib `Figure`.

    Raises:
        InputError: no manifold, one of one latent dimension only, other poses that are not finite or go by
            no names, or fewer than two points or poses asked for. PriorError: a body of another skeleton.
            ShapeError: poses with other columns.

    Reference: Gonczarek & Tomczak, Figure 5.
    """
    if not isinstance(manifold, BackConstrainedGPLVM):
        raise InputError(
            f"manifold must be a BackConstrainedGPLVM, got {type(manifold).__name__}; load_manifold reads "
            "one from a file"
        )
    others = {} if others is None else others
    check_named("others", others, '{"held out": poses}')
    if manifold.latent_dim < 2:
        raise InputError("a picture of the latent space needs two dimensions or more, got 1")
    for count in (resolution, n_poses):
        check_count("resolution and n_poses", count)
    if resolution < 2 or n_poses < 2:
        raise InputError(
            f"resolution and n_poses must be at least 2, got {resolution} and {n_poses}"
        )
    if body is not None:
        if not isinstance(body, Body):
            raise InputError(f"body must be a torchpose.body.Body, got {type(body).__name__}")
        manifold.check_for(body)
    fitted = _by_name(manifold)
    watched = {name: _latents(manifold, name, poses) for name, poses in others.items()}
    everything = torch.cat(
        [z[:, :2] for paths in (fitted, watched) for p in paths.values() for z in p]
    )
    figure = new_figure(7.6, 6.2 if body is None else 8.4, title or _title(manifold))
    if body is None:
        ax = figure.subplots()
    else:
        top, below = figure.subfigures(2, 1, height_ratios=[6.2, 2.2], squeeze=False)[:, 0]
        ax = top.subplots()
        places = _draw_poses(below, manifold, body, n_poses)
        _number(ax, places)
    style_axes(ax, "first latent dimension", "second latent dimension", grid=False)
    _draw_deviation(ax, manifold, everything, resolution)
    named, styles = [*fitted.items(), *watched.items()], _path_styles(len(fitted), len(watched))
    for (_, paths), style in zip(named, styles, strict=True):
        for path in paths:
            _draw_path(ax, path, style)
    ax.set_aspect("equal")
    labels = zip(named, styles, strict=True)
    add_legend(figure, [legend_line(name, **style) for (name, _), style in labels])
    return figure


def _title(manifold: BackConstrainedGPLVM) -> str:
    name = manifold.info.name or "manifold"
    return f"{name}: {len(manifold.poses)} frames of {manifold.dim} columns"


def _by_name(manifold: BackConstrainedGPLVM) -> dict[str, list[Tensor]]:
    """Return the latent points of the training sequences by name."""
    names, paths = manifold.info.sequences, manifold.trajectories()
    if len(names) != len(paths):
        names = tuple(f"sequence {i + 1}" for i in range(len(paths)))
    found: dict[str, list[Tensor]] = {}
    for name, path in zip(names, paths, strict=True):
        found.setdefault(name, []).append(path.detach().cpu())
    return found


def _latents(manifold: BackConstrainedGPLVM, name: str, poses: Any) -> list[Tensor]:
    parts = [poses] if hasattr(poses, "shape") else list(poses)
    for part in parts:
        check_tensors(**{f"others[{name!r}]": part})
        check_finite(f"others[{name!r}]", part, hint="leave out the frames with gaps")
    return [manifold.to_latent(part.to(manifold.poses)).detach().cpu() for part in parts]


def _draw_deviation(
    ax: Axes, manifold: BackConstrainedGPLVM, points: Tensor, resolution: int
) -> None:
    room = _MARGIN * (points.amax(0) - points.amin(0)).max()
    left, bottom = (points.amin(0) - room).tolist()
    right, top = (points.amax(0) + room).tolist()
    x = torch.linspace(left, right, resolution, dtype=torch.float64)
    y = torch.linspace(bottom, top, resolution, dtype=torch.float64)
    grid = torch.zeros(resolution, resolution, manifold.latent_dim, dtype=torch.float64)
    grid[..., 0], grid[..., 1] = x, y[:, None]
    with torch.no_grad():
        _, variance = manifold.to_pose(grid.to(manifold.poses))
    deviation = variance.sqrt() * manifold.scale.square().mean().sqrt()
    image = ax.imshow(
        to_numpy(deviation), extent=(left, right, bottom, top), origin="lower",
        cmap="Greys", vmin=0.0, vmax=1.6 * float(deviation.max()), interpolation="bilinear",
    )  # fmt: skip
    bar = ax.figure.colorbar(image, ax=ax, shrink=0.7, pad=0.02)
    bar.ax.set_ylim(float(deviation.min()), float(deviation.max()))
    unit = " (sines of half angles)" if manifold.info.skeleton else ""
    bar.set_label(f"standard deviation of a column{unit}", fontsize=SMALL, color=INK)
    bar.ax.tick_params(labelsize=SMALL, colors=MUTED, length=3)
    bar.outline.set_edgecolor(PALE)


def _path_styles(n_fitted: int, n_watched: int) -> list[dict[str, Any]]:
    """Return how the sequences of each name are drawn: where colours come again, marks are others."""
    looks = method_styles([str(i) for i in range(n_fitted + n_watched)]).values()
    colors = [look["color"] for look in looks]
    return [
        {
            "color": color, "linestyle": "-" if i < n_fitted else (0, (4, 1.5)), "linewidth": 1.3,
            "marker": _MARKS[colors[:i].count(color) % len(_MARKS)], "markersize": 7,
            "markeredgewidth": 1.6, "markerfacecolor": color if i < n_fitted else "white",
        }
        for i, color in enumerate(colors)
    ]  # fmt: skip


def _draw_path(ax: Axes, path: Tensor, style: Mapping[str, Any]) -> None:
    x, y, color = to_numpy(path[:, 0]), to_numpy(path[:, 1]), style["color"]
    ax.plot(x, y, **{**style, "marker": "", "alpha": 0.9})
    ax.plot(x[:1], y[:1], **{**style, "linestyle": ""})
    for i in range(_ARROWS):
        at = round((i + 0.5) / _ARROWS * (len(x) - 2))
        if len(x) > 2 and (x[at] != x[at + 1] or y[at] != y[at + 1]):
            ax.annotate(
                "", (x[at + 1], y[at + 1]), (x[at], y[at]),
                arrowprops={"arrowstyle": "-|>", "color": color, "mutation_scale": 13},
            )  # fmt: skip


def _draw_poses(part: Any, manifold: BackConstrainedGPLVM, body: Body, n_poses: int) -> Tensor:
    """Draw poses along the first sequence, beside each other; return their latent points."""
    path = next(path for path in manifold.trajectories() if len(path))
    cycle = path[: _cycle(path)]
    n_poses = min(n_poses, len(cycle))
    at = torch.arange(n_poses) * len(cycle) // n_poses
    with torch.no_grad():
        poses = manifold.pose_mean(cycle[at]).detach().cpu().double()
    rest = torch.zeros(n_poses, body.dim, dtype=torch.float64)
    joints = body.joints(body.with_relative(rest.to(body.offsets), poses.to(body.offsets)))
    joints = joints.detach().cpu().double()
    ax = part.subplots()
    ax.set_axis_off()
    ax.set_aspect("equal")
    wide = 0.62 * body.height
    for i, pose in enumerate(joints):
        _draw_figure(ax, body, pose, i * wide)
        ax.text(i * wide, float(joints[..., _UP].max()) + 0.12, str(i + 1), ha="center",
                fontsize=SMALL, color=INK)  # fmt: skip
    return cycle[at]


def _draw_figure(ax: Axes, body: Body, pose: Tensor, shift: float) -> None:
    for joint, parent in enumerate(body.skeleton.parents):
        if parent < 0:
            continue
        side = side_of(body.skeleton.names[joint])
        ends = to_numpy(pose[[parent, joint]])
        ax.plot(
            ends[:, _SIDE] + shift, ends[:, _UP], color=SIDE_COLORS[side], linewidth=2.4,
            solid_capstyle="round", zorder=("left", "middle", "right").index(side) + 1,
        )  # fmt: skip


def _cycle(path: Tensor) -> int:
    """Return the frames until a trajectory is back where it started; all of them if it never is."""
    distance = (path - path[0]).norm(dim=-1)
    away = int((distance > 0.6 * distance.max()).long().argmax())
    for frame in range(max(away, 1), len(path) - 1):
        nearest = distance[frame] <= distance[frame - 1 : frame + 2].min()
        if nearest and distance[frame] < 0.35 * distance.max():
            return frame
    return len(path)


def _number(ax: Axes, places: Tensor) -> None:
    for i, place in enumerate(to_numpy(places[:, :2])):
        ax.annotate(
            str(i + 1), place, fontsize=SMALL, color=INK, ha="center", va="center", zorder=6,
            bbox={"boxstyle": "circle,pad=0.2", "facecolor": "white", "edgecolor": INK, "lw": 0.8},
        )  # fmt: skip


_MOST_LINES = 60


def plot_action_space(
    space: ActionSpace,
    synchronised: Synchronised | None = None,
    n_dimensions: int = 4,
    deviations: float = 3.0,
    title: str | None = None,
) -> Figure:
    """Return the first dimensions over time: above with lengths normalised only, below synchronised.

    Thin lines are performances, the thick one is their mean, dashed lines are so many deviations to
    either side of it; upright lines stand at the key frames.

    Args:
        space: the fitted action, from `torchpose.learning.fit_action_space`.
        synchronised: other performances in step; by default those that the space was fitted to.
        n_dimensions: that are shown, as many as there are at most. deviations: of the dashed lines.
        title: above the picture; by default the action's name and size.

    Returns:
        matplotlib `Figure`, a panel for each dimension.

    Raises:
        InputError: no action space, one from a file, which has no performances, or no dimension is asked
            for. ShapeError: performances of another action space.

    Reference: Rius, Varona, Roca & Gonzalez, 2006, Figure 1.
    """
    check_count("n_dimensions", n_dimensions)
    for name, value, kind in (
        ("space", space, ActionSpace), ("synchronised", synchronised, Synchronised | None)
    ):  # fmt: skip
        if not isinstance(value, kind):
            raise InputError(
                f"{name} must be from torchpose.learning.fit_action_space, got {type(value).__name__}"
            )
    synchronised = space.synchronised if synchronised is None else synchronised
    if synchronised is None:
        raise InputError(
            "an action space from a file has no performances to draw; draw it where it is fitted, or by "
            "torchpose fit actions"
        )
    if synchronised.after.shape[1:] != space.performance.shape:
        raise ShapeError(
            f"the performances have {list(synchronised.after.shape[1:])} postures and dimensions, the "
            f"action space has {list(space.performance.shape)}"
        )
    shown = min(n_dimensions, space.n_dimensions)
    figure = new_figure(2.4 * shown + 0.6, 5.2, title or _action_title(space))
    axes = figure.subplots(2, shown, sharex=True, sharey="col", squeeze=False)
    before, after = synchronised.before, synchronised.after
    for d in range(shown):
        ax = style_axes(
            axes[0, d], "", "length normalised\ndegrees" if d == 0 else "", f"dimension {d + 1}"
        )
        _draw(ax, before[..., d], before.mean(0)[:, d], deviations * before.std(0)[:, d])
        ax = style_axes(axes[1, d], "posture k", "synchronised\ndegrees" if d == 0 else "")
        _draw(ax, after[..., d], space.performance[:, d], deviations * space.std[:, d])
        for key in synchronised.key_frames[1:-1]:
            ax.axvline(key, color=MUTED, linewidth=0.8, linestyle=":")
    add_legend(figure, _action_legend(deviations))
    return figure


def _draw(ax: Axes, lines: Tensor, mean: Tensor, reach: Tensor) -> None:
    every = max(1, len(lines) // _MOST_LINES)
    ax.plot(to_numpy(lines[::every].mT), color=LEFT, linewidth=0.5, alpha=0.45)
    for edge in (mean - reach, mean + reach):
        ax.plot(to_numpy(edge), color=INK, linewidth=1.1, linestyle=(0, (4, 2)))
    ax.plot(to_numpy(mean), color=RIGHT, linewidth=2.4)
    ax.set_xlim(0, len(mean) - 1)
    ax.tick_params(labelsize=SMALL)
    ax.spines["left"].set_color(PALE)


def _action_legend(deviations: float) -> list[Any]:
    spread = f"{deviations:g} standard deviations"
    return [
        legend_line("performances", LEFT, linewidth=0.8, alpha=0.7),
        legend_line("mean performance", RIGHT, linewidth=2.4),
        legend_line(spread, linewidth=1.1, linestyle=(0, (4, 2))),
        legend_line("key frames", MUTED, linewidth=0.8, linestyle=":"),
    ]


def _action_title(space: ActionSpace) -> str:
    name = space.info.name or "action"
    return f"{name}: {space.info.performances} performances in {space.n_dimensions} dimensions"
