"""Draw poses in the image, from three sides and as a strip of frames; draw a prior's means."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.checks import check_count, check_shape
from torchpose.errors import InputError, ShapeError
from torchpose.metrics._calibration import chi2_quantile
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.skeleton._upper_body import LIMBS
from torchpose.viz._pose_drawing import arm_entries, draw_bones, draw_strip
from torchpose.viz._style import (
    INK,
    LARGE,
    LEFT,
    MIDDLE,
    PALE,
    RIGHT,
    add_legend,
    check_named,
    joint_colors,
    new_figure,
    style_axes,
    to_numpy,
    weight_bar,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:
    Axes = Figure = Any

ARM_LIMBS = ((0, 1), (1, 2), (2, 4), (4, 3))
"""Lines of the five joints of an arm's state: hand, elbow, shoulder, head, neck."""


class Mixture(Protocol):
    """Declares weights [K] and means [K, D], as of `torchpose.priors.GaussianMixture`."""

    weights: Tensor
    means: Tensor


def as_drawn(
    sizes: Sequence[int | None] | None,
    joints: Any,
    covariance: Any = None,
    observed: Any = None,
    truth: Any = None,
) -> tuple[Tensor, Tensor | None, Tensor | None, Tensor | None]:
    """Return tensors of joints [..., D] and of what is drawn with them, all of which may be arrays.

    Args:
        sizes: of the joints; None is [T, 8, 2] or [T, 8, 3]. joints: [..., D]. covariance: [..., D, D].
        observed: [...]. truth: [..., D].

    Raises:
        InputError: neither tensors nor arrays. ShapeError: other sizes.
    """
    drawn = _as_tensor("joints", joints)
    if sizes is None:
        _check_poses(drawn)
    else:
        check_shape("joints", drawn, sizes)
    shape = tuple(drawn.shape)
    return (
        drawn,
        _as_tensor("covariance", covariance, (*shape, shape[-1])),
        _as_tensor("observed", observed, shape[:-1]),
        _as_tensor("truth", truth, shape),
    )


def _as_tensor(name: str, value: Any, sizes: Sequence[int] | None = None) -> Any:
    """Return a tensor or array as a tensor of these sizes; None stays, where sizes are given."""
    if value is None and sizes is not None:
        return None
    if not hasattr(value, "shape"):
        raise InputError(
            f"{name} must be a tensor, got {type(value).__name__}; of a track give a field of one sequence, "
            "such as track.joints3d[0] of a PoseTrack"
        )
    tensor = torch.as_tensor(value)
    if sizes is not None:
        check_shape(name, tensor, sizes)
    return tensor


def draw_skeleton(
    ax: Axes,
    joints: Float[Tensor, "J 2"],
    covariance: Float[Tensor, "J 2 2"] | None = None,
    observed: Bool[Tensor, " J"] | None = None,
    colors: Sequence[str] | None = None,
    limbs: Sequence[tuple[int, int]] = LIMBS,
    level: float = 0.9,
    linewidth: float = 3.0,
    alpha: float = 1.0,
) -> None:
    """Draw a skeleton on the given axes.

    Args:
        ax: matplotlib axes; its scale is not changed.
        joints: [J, 2]; NaN joints and their limbs are left out.
        covariance: [J, 2, 2], drawn as the ellipse of probability `level`.
        observed: [J], True = measured (filled marker), False = inferred (hollow).
        colors: of each joint; by default by side, for the 8 joints of the upper body.
        limbs: pairs of indices; a limb between two colours is grey.
        level: probability of the ellipses.
        linewidth: the line width of the limbs, points. alpha: opacity of everything.

    Raises:
        ShapeError: joints of another shape, or of another number than there are colours; covariances of
            other sizes. InputError: no tensors, such as a whole track.
    """
    joints, covariance, observed, _ = as_drawn([None, 2], joints, covariance, observed)
    colors = list(colors or joint_colors(UPPER_BODY))
    if len(colors) != joints.shape[0]:
        raise ShapeError(
            f"joints must be [{len(colors)}, 2], got {list(joints.shape)}; "
            "give colors and limbs for another joint set"
        )
    points = to_numpy(joints)
    if covariance is not None:
        for point, matrix, color in zip(points, covariance, colors, strict=True):
            _draw_ellipse(ax, point, matrix, color, level, alpha)
    filled = [True] * len(colors) if observed is None else observed.tolist()
    draw_bones(ax, points, filled, colors, limbs, linewidth, alpha)


def _draw_ellipse(
    ax: Axes, point: Any, covariance: Tensor, color: str, level: float, alpha: float
) -> None:
    from matplotlib.patches import Ellipse

    if not bool(torch.isfinite(covariance).all()) or not math.isfinite(float(point.sum())):
        return
    variances, axes = torch.linalg.eigh(covariance.detach().cpu().double())
    radius = chi2_quantile(torch.tensor(level, dtype=torch.float64), 2).sqrt()
    width, height = (2 * radius * variances.clamp_min(0).sqrt()).tolist()
    angle = math.degrees(math.atan2(float(axes[1, 0]), float(axes[0, 0])))
    for fill, opacity in ((True, 0.14), (False, 0.7)):
        ax.add_patch(
            Ellipse(
                (point[0], point[1]), width, height, angle=angle, fill=fill, color=color,
                alpha=opacity * alpha, linewidth=0.0 if fill else 1.0, zorder=2,
            )
        )  # fmt: skip


def _draw_truth(ax: Axes, joints: Tensor) -> None:
    draw_skeleton(ax, joints, colors=[PALE] * joints.shape[0], linewidth=2.0)


def plot_pose(
    joints: Float[Tensor, "8 2"],
    covariance: Float[Tensor, "8 2 2"] | None = None,
    observed: Bool[Tensor, " 8"] | None = None,
    image: Any = None,
    image_size: tuple[int, int] | None = None,
    truth: Float[Tensor, "8 2"] | None = None,
    level: float = 0.9,
    title: str | None = None,
) -> Figure:
    """Return one pose in the image, with the ellipses of its covariances.

    Args:
        joints: [8, 2], pixels. covariance: [8, 2, 2], squared pixels.
        observed: [8], True = measured.
        image: [H, W, 3] or [H, W] behind the skeleton, RGB.
        image_size: (width, height) of the frame to draw where there is no image.
        truth: [8, 2], drawn in grey.
        level: probability of the ellipses. title: above the picture.

    Returns:
        matplotlib `Figure`.

    Raises:
        ShapeError: other sizes. InputError: no tensors, such as a whole track. MissingDependencyError:
            matplotlib is missing.
    """
    joints, covariance, observed, truth = as_drawn([8, 2], joints, covariance, observed, truth)
    figure = new_figure(6.4, 5.6, title)
    ax = style_axes(figure.add_subplot(), "u (pixels)", "v (pixels)", grid=image is None)
    if image is not None:
        ax.imshow(image)
        image_size = (image.shape[1], image.shape[0])
    if truth is not None:
        _draw_truth(ax, truth)
    draw_skeleton(ax, joints, covariance, observed, level=level)
    ax.set_aspect("equal")
    if image_size is None:
        ax.invert_yaxis()
    else:
        ax.set(xlim=(0, image_size[0]), ylim=(image_size[1], 0))
    ellipse = None if covariance is None else level
    add_legend(figure, arm_entries(observed is not None, ellipse, truth is not None))
    return figure


def plot_pose_3d(
    joints: Float[Tensor, "8 3"],
    covariance: Float[Tensor, "8 3 3"] | None = None,
    observed: Bool[Tensor, " 8"] | None = None,
    truth: Float[Tensor, "8 3"] | None = None,
    level: float = 0.9,
    title: str | None = None,
) -> Figure:
    """Return one pose from the front, the side and above, at one scale.

    Args:
        joints: [8, 3], camera axes, metres. covariance: [8, 3, 3], m^2; each view shows the
            ellipse of its two coordinates' marginal.
        observed: [8], True = measured. truth: [8, 3], drawn in grey.
        level: probability of the ellipses. title: above the picture.

    Returns:
        matplotlib `Figure` of three panels.

    Raises:
        ShapeError: other sizes. InputError: no tensors, such as a whole track. MissingDependencyError:
            matplotlib is missing.
    """
    joints, covariance, observed, truth = as_drawn([8, 3], joints, covariance, observed, truth)
    figure = new_figure(11.0, 4.8, title)
    shown = [joints] if truth is None else [joints, truth]
    if covariance is not None:
        radius = chi2_quantile(torch.tensor(level, dtype=torch.float64), 2).sqrt().to(joints)
        reach = radius * covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
        shown += [joints - reach, joints + reach]
    low, high = _limits(torch.cat(shown), margin=0.05)
    size = (high - low).tolist()
    panels = figure.subplots(1, 3, width_ratios=[size[0], size[2], size[0]])
    views = (
        ("front (from the camera)", 0, 1, "x, to the right (m)", "y, down (m)"),
        ("side (camera at the left)", 2, 1, "z, away (m)", "y, down (m)"),
        ("top (camera below)", 0, 2, "x, to the right (m)", "z, away (m)"),
    )
    for ax, (name, a, b, x, y) in zip(panels, views, strict=True):
        style_axes(ax, x, y, name)
        pick = torch.tensor([a, b])
        if truth is not None:
            _draw_truth(ax, truth[:, pick])
        flat = None if covariance is None else covariance[:, pick[:, None], pick]
        draw_skeleton(ax, joints[:, pick], flat, observed, level=level)
        ax.set_aspect("equal")
        ax.set_xlim(float(low[a]), float(high[a]))
        ends = (float(low[b]), float(high[b]))
        ax.set_ylim(ends if b == 2 else ends[::-1])
    ellipse = None if covariance is None else level
    add_legend(figure, arm_entries(observed is not None, ellipse, truth is not None))
    return figure


def _limits(points: Tensor, margin: float) -> tuple[Tensor, Tensor]:
    """Return lowest and highest finite coordinates of [..., D] with a margin, relative to the range."""
    flat = points.detach().cpu().double().reshape(-1, points.shape[-1])
    flat = flat[torch.isfinite(flat).all(-1)]
    if flat.shape[0] == 0:
        raise InputError("expected at least one joint that is not NaN, got none")
    low, high = flat.amin(0), flat.amax(0)
    room = margin * (high - low).amax().clamp_min(1e-9)
    return low - room, high + room


def plot_pose_strip(
    joints: Float[Tensor, "T 8 D"],
    frames: Sequence[int] | None = None,
    n_frames: int = 8,
    fps: float = 30.0,
    observed: Bool[Tensor, "T 8"] | None = None,
    truth: Float[Tensor, "T 8 D"] | None = None,
    labels: Sequence[str] | None = None,
    title: str | None = None,
    first_frame: int = 0,
) -> Figure:
    """Return a strip of frames, at one scale; 3D poses get a second row, seen from the side.

    Args:
        joints: [T, 8, 2], pixels, or [T, 8, 3], camera axes, metres.
        frames: indices of the frames to draw; by default `n_frames` spread over all. More than 10 take new
            lines.
        n_frames: number of frames to draw where `frames` is None.
        fps: frames per second, for the times below the panels.
        observed: [T, 8], True = measured. truth: [T, 8, D], drawn in grey.
        labels: [T], a word for each frame. title: above the picture.
        first_frame: number of the first pose's frame in the recording, whose times are shown.

    Returns:
        matplotlib `Figure`.

    Raises:
        ShapeError: joints of another shape. InputError: no frame, one that there is not, labels of
            another number. MissingDependencyError: matplotlib is missing.
    """
    draw = prepare_pose_strip(
        joints, frames, n_frames, fps, observed, truth, labels, title, first_frame
    )
    return draw()


def prepare_pose_strip(
    joints: Float[Tensor, "T 8 D"],
    frames: Sequence[int] | None = None,
    n_frames: int = 8,
    fps: float = 30.0,
    observed: Bool[Tensor, "T 8"] | None = None,
    truth: Float[Tensor, "T 8 D"] | None = None,
    labels: Sequence[str] | None = None,
    title: str | None = None,
    first_frame: int = 0,
) -> Callable[[], Figure]:
    """Return what draws a strip of frames, which another process can do; see `plot_pose_strip`."""
    joints, _, observed, truth = as_drawn(None, joints, observed=observed, truth=truth)
    if labels is not None and len(labels) != len(joints):
        raise InputError(
            f"labels must be a word for each of {len(joints)} frames, got {len(labels)}"
        )
    frames = _choose_frames(frames, n_frames, joints.shape[0])
    chosen = joints if truth is None else torch.cat([joints, truth], 1)
    low, high = _limits(chosen[frames], margin=0.06)
    words = [
        f"{(frame + first_frame) / fps:.1f} s"
        + (f"\n{labels[frame]}" if labels is not None else "")
        for frame in frames
    ]
    return partial(
        draw_strip,
        to_numpy(joints[frames]),
        None if observed is None else to_numpy(observed[frames]),
        None if truth is None else to_numpy(truth[frames]),
        (to_numpy(low), to_numpy(high)),
        words,
        joint_colors(UPPER_BODY),
        LIMBS,
        title,
    )


def _check_poses(joints: Tensor) -> None:
    if joints.ndim != 3 or joints.shape[1] != 8 or joints.shape[2] not in (2, 3):
        raise ShapeError(f"joints must be [T, 8, 2] or [T, 8, 3], got {list(joints.shape)}")


def _choose_frames(frames: Sequence[int] | None, n_frames: int, total: int) -> list[int]:
    if total == 0:
        raise InputError("joints must hold at least one frame, got none")
    if frames is None:
        check_count("n_frames", n_frames)
        return torch.linspace(0, total - 1, min(n_frames, total)).round().long().tolist()
    if not frames or not all(0 <= i < total for i in frames):
        raise InputError(f"frames must be indices below {total}, got {list(frames)}")
    return list(frames)


def _set_view(ax: Axes, low: Tensor, high: Tensor, pick: tuple[int, int]) -> None:
    """Set the scale of a panel: as wide as the front view, centred on this view's range."""
    half, middle = float((high - low)[0]) / 2, float((low + high)[pick[0]]) / 2
    ax.set_aspect("equal")
    ax.set(xlim=(middle - half, middle + half), ylim=(float(high[pick[1]]), float(low[pick[1]])))


def plot_prior_means(
    mixtures: Mapping[str, Mixture],
    n_shown: int = 30,
    title: str | None = "Mean poses of the prior's components and their weights",
) -> Figure:
    """Return the component means of a prior as skeletons, heaviest first, with their weights.

    Args:
        mixtures: by name, e.g. ``{"left": prior.left, "right": prior.right}``; the first fifteen
            dimensions of the means are (u, v, lambda) of hand, elbow, shoulder, head, neck. A name
            that contains "right" is drawn in the colour of the right arm.
        n_shown: at most this many components of each. title: above the picture.

    Returns:
        matplotlib `Figure`.

    Raises:
        InputError: no mixture, or one without a name. ShapeError: states of fewer than 15 dimensions.

    The bar above a pose is its weight relative to the heaviest one's.

    Reference: Burke & Lasenby, Figure 6.
    """
    check_named("mixtures", mixtures, '{"left": prior.left}')
    if not mixtures:
        raise InputError("mixtures must hold at least one mixture, got none")
    for name, mixture in mixtures.items():
        check_shape(f"mixtures[{name!r}].means", mixture.means[:, :15], [None, 15])
    columns = min(10, max(len(m.weights) for m in mixtures.values()))
    rows = [math.ceil(min(len(m.weights), n_shown) / columns) for m in mixtures.values()]
    figure = new_figure(1.05 * columns, 1.5 * sum(rows) + 0.4 * len(rows) + 0.5, title)
    blocks = figure.subfigures(len(rows), 1, height_ratios=rows, squeeze=False)[:, 0]
    for block, (name, mixture), n_rows in zip(blocks, mixtures.items(), rows, strict=True):
        weights = mixture.weights.detach().cpu().double()
        poses = mixture.means.detach().cpu().double()[:, :15].reshape(-1, 5, 3)[..., :2]
        order = weights.argsort(descending=True)[:n_shown]
        low, high = _limits(poses[order], margin=0.1)
        side = RIGHT if "right" in name else LEFT
        colors = [side] * 3 + [MIDDLE] * 2
        block.suptitle(name, fontsize=LARGE, color=INK)
        panels = block.subplots(n_rows, columns, squeeze=False)
        for ax in panels.flat:
            ax.set_axis_off()
        for ax, k in zip(panels.flat, order.tolist(), strict=False):
            share = float(weights[k] / weights.max())
            draw_skeleton(ax, poses[k], colors=colors, limbs=ARM_LIMBS, linewidth=2.0)
            ax.set_aspect("equal")
            ax.set(xlim=(float(low[0]), float(high[0])), ylim=(float(high[1]), float(low[1])))
            weight_bar(ax, float(weights[k]), share)
    return figure
