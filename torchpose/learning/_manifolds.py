"""Fit manifolds of poses, back-constrained GPLVMs, and the noise of a motion about them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_rate
from torchpose.errors import InputError
from torchpose.learning._gplvm_fit import GPLVMFit, best_fit, median_gamma
from torchpose.priors._manifold.gplvm import BackConstrainedGPLVM, MotionNoise, join_sequences
from torchpose.priors._manifold.manifold_file import ManifoldInfo

_WATCHED, _ALONE = {"steps": 40, "n_init": 4}, {"steps": 3, "n_init": 1}
_LEAST_SHARE = 0.05  # of the root mean square over all columns: a deviation that is not nothing
_STRIDES = (2, 3, 4)  # frames, over which the growth of steps is looked at


@torch.inference_mode(False)
@torch.enable_grad()
def fit_gplvm(
    poses: Float[Tensor, "T Q"] | Sequence[Float[Tensor, "_ Q"]],
    latent_dim: int = 2,
    *,
    gamma_x: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    optimiser: str = "lbfgs",
    learning_rate: float | None = None,
    tolerance: float = 1e-5,
    n_init: int | None = None,
    smoothness: float = 0.0,
    standardise: bool = False,
    validation: Float[Tensor, "V Q"] | Sequence[Float[Tensor, "_ Q"]] | None = None,
    patience: int = 3,
    info: ManifoldInfo | None = None,
    progress: bool = False,
) -> BackConstrainedGPLVM:
    """Fit a manifold to the poses of one motion, or of several sequences.

    The mean pose is subtracted, latent points start from principal components, and the objective
    (MR 16) is maximised. Time and memory of a step grow with the cube and the square of the
    number of frames: 0.1 s for 350 frames, some 20 s for 2,000, on one core.

    Args:
        poses: one sequence [T, Q], or several of the same columns.
        latent_dim: d.
        gamma_x: of (MR 22); by default one over the squared median distance of the poses. The
            published 1e-4 is for other units.
        steps: of ten iterations of the optimiser, at most; by default 40 with validation poses and
            3 without. Further ones make the back constraints follow the training poses so closely
            that other poses come back worse.
        seed: the seed of the frames whose distances are compared, where there are more than 2,000.
        optimiser: "lbfgs" or "adam". learning_rate: None for the optimiser's own.
        tolerance: gain of the objective per number and step at which to stop.
        n_init: starts, see `principal_start`; the one with the lowest held-out error, or else
            the highest objective, is kept. By default 4 with validation poses and 1 without.
        smoothness: the smoothness of the back constraints, see `GPLVMFit`.
        standardise: divide every column by its standard deviation, so that all weigh the same
            in the objective and in gamma_x; the published form does not.
        validation: poses of other trials. With them the fit stops after `patience` steps that
            bring them back no better, x - f(g(x)), and returns to the step that was best.
        patience: number of steps without gain after which a fit with validation poses stops.
        info: facts about the poses and their body. progress: show a bar for every start.

    Returns:
        `BackConstrainedGPLVM` without noise, see `fit_gplvm_noise`.

    Raises:
        InputError: fewer than 10 frames, NaN (frame and column are named), no motion, bad
            settings. ShapeError: not [T, Q], or sequences with different columns.
    """
    info = ManifoldInfo() if info is None else info
    target = fit_target(poses, info.columns, standardise, gamma_x, seed)
    defaults = _ALONE if validation is None else _WATCHED
    steps = defaults["steps"] if steps is None else steps
    n_init = defaults["n_init"] if n_init is None else n_init
    error = None
    if validation is not None:
        watched, _ = join_sequences(validation, info.columns, target.poses.shape[1])
        error = lambda fit: (  # noqa: E731
            gplvm_of_fit(fit, target).reconstruction_error(watched)
        )
    best = best_fit(
        lambda start: GPLVMFit(
            target.scaled, latent_dim, target.gamma_x, optimiser, learning_rate, smoothness,
            start=start,
        ),
        n_init, steps, tolerance, progress, error, patience,
    )  # fmt: skip
    return gplvm_of_fit(best, target, info)


class FitTarget(NamedTuple):
    """Holds the poses of all sequences, with the centred and scaled poses that the objective is of.

    Attributes:
        poses: [T, Q]. lengths: frames of each sequence. scale: s [Q]. scaled: (poses - mean) / s.
        gamma_x: of (MR 22), for the scaled poses.
    """

    poses: Float[Tensor, "T Q"]
    lengths: list[int]
    scale: Float[Tensor, " Q"]
    scaled: Float[Tensor, "T Q"]
    gamma_x: float


def fit_target(
    poses: Float[Tensor, "T Q"] | Sequence[Float[Tensor, "_ Q"]],
    columns: Sequence[str],
    standardise: bool,
    gamma_x: float | None,
    seed: int,
) -> FitTarget:
    """Join sequences, subtract their mean and scale their columns.

    Args:
        poses, standardise, gamma_x, seed: see `fit_gplvm`. columns: names, for errors.

    Raises:
        InputError, ShapeError: as `fit_gplvm`.
    """
    joined, lengths = join_sequences(poses, columns)
    scale = column_scale(joined) if standardise else torch.ones_like(joined[0])
    scaled = (joined - joined.mean(0)) / scale
    gamma = median_gamma(scaled, seed) if gamma_x is None else gamma_x
    return FitTarget(joined, lengths, scale, scaled, gamma)


def gplvm_of_fit(
    fit: GPLVMFit, target: FitTarget, info: ManifoldInfo | None = None
) -> BackConstrainedGPLVM:
    """Return the manifold at the fit's current parameters, with latent axes turned to the principal ones.

    Args:
        fit: to the scaled poses of `target`. info: facts about the poses and their body.
    """
    with torch.no_grad():
        latents = fit.features @ fit.coordinates + fit.bias
        turn = principal_axes(latents)
        weights, bias = fit.weights @ turn, fit.bias @ turn
        sizes = torch.tensor(list(target.lengths))
        return BackConstrainedGPLVM(
            target.poses, sizes, weights, bias, fit.gamma_x, fit.kernel, scale=target.scale,
            info=info,
        )  # fmt: skip


def fit_gplvm_noise(
    manifold: BackConstrainedGPLVM,
    poses: Float[Tensor, "T Q"] | Sequence[Float[Tensor, "_ Q"]],
    fps: float,
) -> BackConstrainedGPLVM:
    """Set the three standard deviations of a manifold from validation poses.

    sigma x->z: root mean square of g(x_t) - g(x_t-1) (MR 27); sigma z->x: of x_t - f(g(x_t))
    (MR 30); sigma x->x: of x_t - x_t-1 (MR 29), each dimension apart; see `motion_noise`.

    Args:
        manifold: that is changed.
        poses: one sequence or several that were not fitted to; on those that were, sigma z->x
            comes out too small. fps: their frame rate, which all three are for.

    Returns:
        The same manifold, changed.

    Raises:
        InputError: fewer than 10 frames, NaN, no motion, a frame rate that is not positive, or a
            sequence that starts with a frame that was fitted to. ShapeError: other columns.
    """
    check_rate("fps", fps)
    joined, lengths = join_sequences(poses, manifold.info.columns, manifold.dim)
    joined = joined.to(manifold.poses)
    check_unseen(joined, lengths, manifold.poses)
    latents = manifold.to_latent(joined)
    noise = motion_noise(joined, latents, manifold.pose_mean(latents), lengths)
    if not bool((noise.std_step > 0).all()):
        raise InputError(
            "the standard deviations need poses that move, got the same one in all frames of each sequence"
        )
    for name, value in noise._asdict().items():
        getattr(manifold, name).copy_(value)
    growth = {"latent": steps_growth(latents, lengths), "step": steps_growth(joined, lengths)}
    manifold.info = manifold.info.with_noise(fps, growth)
    return manifold


def motion_noise(
    poses: Float[Tensor, "T Q"],
    latents: Float[Tensor, "T d"],
    returned: Float[Tensor, "T Q"],
    lengths: Sequence[int],
) -> MotionNoise:
    """Return root mean squares of g(x_t) - g(x_t-1), of x_t - f(g(x_t)) and of x_t - x_t-1.

    A column that stands still, such as the twist of an arm, gets a twentieth of the root mean square
    over all columns.

    Args:
        poses: x. latents: g(x). returned: f(g(x)). lengths: frames of each sequence; no step is taken
            from one to the next.

    Raises:
        InputError: no sequence has two frames.
    """
    found = (steps_within(latents, lengths), poses - returned, steps_within(poses, lengths))
    squared = [values.square().mean(0) for values in found]
    return MotionNoise(*(s.sqrt().maximum(_LEAST_SHARE * s.mean().sqrt()) for s in squared))


def check_unseen(
    poses: Float[Tensor, "T Q"], lengths: Sequence[int], fitted: Float[Tensor, "N Q"]
) -> None:
    """Raise `InputError` if a sequence starts with a pose that was fitted to."""
    first = torch.stack([part[0] for part in poses.split(list(lengths)) if len(part)])
    if bool((first[:, None] == fitted).all(-1).any()):
        raise InputError(
            "the standard deviations need poses that were not fitted to, got some that were; "
            "take another trial of the same person"
        )


# --- poses to fit to ------------------------------------------------------------------------------


def steps_within(values: Float[Tensor, "T D"], lengths: Sequence[int]) -> Float[Tensor, "steps D"]:
    """Return differences of consecutive rows of one sequence, for all sequences.

    Raises:
        InputError: no sequence has two frames.
    """
    steps = torch.cat([part.diff(dim=0) for part in values.split(list(lengths))])
    if not len(steps):
        raise InputError("a step takes two frames of one sequence, got sequences of one frame each")
    return steps


def steps_growth(values: Float[Tensor, "T D"], lengths: Sequence[int]) -> float:
    """Return the exponent g with which steps grow with their frames k, RMS(x_t+k - x_t) ~ k^g.

    1/2 for a random walk, 1 for a motion that goes on; by least squares over 2, 3 and 4 frames, from 0
    to 1, and 1/2 where no sequence is long enough.

    Args:
        values: of all sequences. lengths: frames of each; no step is taken from one to the next.

    >>> steps_growth(torch.arange(20.0)[:, None], [20])
    1.0
    """
    parts, sizes = values.split(list(lengths)), {}
    for k in (1, *_STRIDES):
        steps = [part[k:] - part[:-k] for part in parts if len(part) > k]
        sizes[k] = float(torch.cat(steps).square().mean().sqrt()) if steps else 0.0
    if not sizes[1] > 0:
        return 0.5
    found = [(math.log(k), math.log(sizes[k] / sizes[1])) for k in _STRIDES if sizes[k] > 0]
    slope = sum(x * y for x, y in found) / sum(x * x for x, _ in found) if found else 0.5
    return min(1.0, max(0.0, slope))


def column_scale(poses: Float[Tensor, "T Q"]) -> Float[Tensor, " Q"]:
    """Return the standard deviation of each column; at least a hundredth of the largest one."""
    spread = poses.std(0)
    largest = spread.max()
    return spread.maximum(0.01 * largest) if bool(largest > 0) else torch.ones_like(spread)


def principal_axes(latents: Float[Tensor, "T d"]) -> Float[Tensor, "d d"]:
    """Return the rotation or reflection to the axes of largest variance, with the first point positive."""
    _, _, axes = torch.linalg.svd(latents - latents.mean(0), full_matrices=False)
    signs = torch.where(latents[0] @ axes.mT < 0, -1.0, 1.0).to(latents)
    return axes.mT * signs


def thin(sequences: Sequence[Float[Tensor, "_ Q"]], frames: int) -> list[Tensor]:
    """Return at most `frames` poses in all, evenly spread over all sequences.

    Poses spread over many trials make a better manifold than as many in a row.

    Args:
        sequences: [T_s, Q] each. frames: at most, but at least one of each sequence.

    >>> [len(part) for part in thin([torch.zeros(10, 3), torch.zeros(7, 3)], 8)]
    [4, 3]
    """
    total = sum(len(part) for part in sequences)
    kept = []
    for part in sequences:
        count = max(1, len(part) * min(frames, total) // max(total, 1))
        index = (torch.arange(count) * len(part) / count).long()
        kept.append(part[index.to(part.device)])
    return kept
