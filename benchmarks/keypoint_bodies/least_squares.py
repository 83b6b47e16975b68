"""Bodies as the least squares of reprojection, smoothness and bone lengths: the terms of aniposelib.

With e the errors in pixels times the confidence, p the threshold of 15 pixels, l the length of a bone in a
frame and L its length, which is sought as well,

    sum (2 p (sqrt(1 + |e| / p) - 1))^2 + s^2 sum |x_(t+1) - x_t|^2 + sum (200 (l - L) / L)^2

where s is 4 over the mean step of the median-filtered start: the defaults of `optim_points` of aniposelib
0.8. That has numerical derivatives and an iterative solver, stops when a step brings less than a thousandth;
here derivatives are exact, and steps are those of Levenberg and Marquardt with a direct solver. Both start at
plain triangulation, and leave out keypoints that are not sure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.keypoint_bodies.joint_filters import project_one
from benchmarks.keypoint_bodies.triangulation import THRESHOLD, interpolated
from torchpose.body import BODY_15
from torchpose.camera import CameraRig

_SMOOTH, _LENGTH = 4.0, 200.0  # weights; aniposelib's 100 for percent times 2
_MEDIAN = 7  # frames
_STEPS, _ENOUGH = 50, 1e-4


class _Problem(NamedTuple):
    """What the sum of squares depends on.

    Attributes:
        rig: cameras. keypoints: [T, C, J, 2]. weights: [T, C, J], 0 where there is none.
        bones: pairs of joints. smooth: weight of the steps.
    """

    rig: CameraRig
    keypoints: Tensor
    weights: Tensor
    bones: Sequence[tuple[int, int]]
    smooth: float


class _Guess(NamedTuple):
    """Points [T, J, 3] and lengths of bones [B], metres."""

    points: Tensor
    lengths: Tensor


def fit_bodies(
    rig: CameraRig,
    keypoints: Float[Tensor, "T C 15 2"],
    weights: Float[Tensor, "T C 15"],
    points: Float[Tensor, "T 15 3"],
) -> Float[Tensor, "T 15 3"]:
    """Return joints of least squares, NaN where a joint never had a point.

    Args:
        rig: cameras. keypoints: pixels, undistorted. weights: confidence, 0 where there is none.
            points: triangulated, where it starts.
    """
    kept = points.isfinite().all(-1).any(0).nonzero()[:, 0].tolist()
    start = interpolated(points[:, kept])
    weights = weights[:, :, kept]
    parents = [(joint, parent) for joint, parent in enumerate(BODY_15.parents)]
    bones = [(kept.index(a), kept.index(b)) for a, b in parents if a in kept and b in kept]
    problem = _Problem(
        rig, keypoints[:, :, kept].nan_to_num(), weights, bones, _SMOOTH / _mean_step(start)
    )
    lengths = _lengths(start, bones).median(0).values
    found = torch.full_like(points, torch.nan)
    found[:, kept] = _minimised(problem, _Guess(start, lengths)).points
    return found


def _mean_step(points: Float[Tensor, "T J 3"]) -> float:
    from scipy.ndimage import median_filter

    smooth = median_filter(points.numpy(), (_MEDIAN, 1, 1), mode="mirror")
    return max(float(np.abs(np.diff(smooth, axis=0)).mean()), 1e-6)


def _lengths(
    points: Float[Tensor, "T J 3"], bones: Sequence[tuple[int, int]]
) -> Float[Tensor, "T B"]:
    first, second = zip(*bones, strict=True)
    return (points[:, first] - points[:, second]).norm(dim=-1)


def _minimised(problem: _Problem, guess: _Guess) -> _Guess:
    """Return the guess after steps of Levenberg and Marquardt."""
    from scipy.sparse import identity
    from scipy.sparse.linalg import splu

    damping, (residual, slope) = 1e-3, _linearised(problem, guess)
    for _ in range(_STEPS):
        normal, gradient = (slope.T @ slope).tocsc(), slope.T @ residual
        scale = normal.diagonal().mean()
        damped = normal + damping * scale * identity(len(gradient), format="csc")
        factor = splu(damped, "MMD_AT_PLUS_A", 0.0, options={"SymmetricMode": True})
        step = torch.from_numpy(factor.solve(-gradient))
        n = guess.points.numel()
        new = _Guess(guess.points + step[:n].reshape(guess.points.shape), guess.lengths + step[n:])
        new_residual, new_slope = _linearised(problem, new)
        before, after = residual @ residual, new_residual @ new_residual
        if not after < before:
            damping *= 10
            continue
        guess, residual, slope, damping = new, new_residual, new_slope, damping / 10
        if before - after < _ENOUGH * before:
            break
    return guess


def _linearised(problem: _Problem, guess: _Guess) -> tuple[np.ndarray, Any]:
    """Return all residuals, and their sparse derivatives by points and lengths."""
    from scipy.sparse import csr_array, vstack

    index = torch.arange(guess.points.numel()).reshape(guess.points.shape)
    n_unknowns = guess.points.numel() + guess.lengths.numel()
    residuals, slopes = [], []
    for residual, values, columns in (
        *_reprojection(problem, guess, index),
        _smoothness(problem, guess, index),
        _bone_lengths(problem, guess, index),
    ):
        rows = torch.arange(residual.numel()).reshape(-1, 1).expand(columns.shape)
        entries = (values.flatten().numpy(), (rows.flatten().numpy(), columns.flatten().numpy()))
        residuals.append(residual.flatten().numpy())
        slopes.append(csr_array(entries, shape=(residual.numel(), n_unknowns)))
    return np.concatenate(residuals), vstack(slopes).tocsr()


Block = tuple[Tensor, Tensor, Tensor]
"""Residuals [N], the entries of their derivatives [N, K] and the columns of those [N, K]."""


def _reprojection(problem: _Problem, guess: _Guess, index: Tensor) -> list[Block]:
    """Return a block for each camera."""
    found = []
    for camera in range(len(problem.rig)):
        pixels, slope = project_one(problem.rig, camera, guess.points)
        weights = problem.weights[:, camera, :, None]
        error = weights * (pixels - problem.keypoints[:, camera])
        root = (1 + error.abs() / THRESHOLD).sqrt()
        residual = error.sign() * 2 * THRESHOLD * (root - 1)
        values = (weights / root)[..., None] * slope
        columns = index[:, :, None].expand(values.shape)
        found.append((residual.flatten(), values.flatten(0, -2), columns.flatten(0, -2)))
    return found


def _smoothness(problem: _Problem, guess: _Guess, index: Tensor) -> Block:
    columns = torch.stack([index[1:].flatten(), index[:-1].flatten()], -1)
    signs = torch.tensor([1.0, -1.0], dtype=guess.points.dtype)
    residual = problem.smooth * guess.points.diff(dim=0).flatten()
    return residual, problem.smooth * signs.expand(columns.shape), columns


def _bone_lengths(problem: _Problem, guess: _Guess, index: Tensor) -> Block:
    first, second = (list(ends) for ends in zip(*problem.bones, strict=True))
    across = guess.points[:, first] - guess.points[:, second]
    lengths = across.norm(dim=-1)
    expected = guess.lengths.expand(lengths.shape)
    direction = (across / (lengths * expected)[..., None].clamp_min(1e-9)) * _LENGTH
    by_length = -_LENGTH * lengths / expected.square()
    own = index.numel() + torch.arange(len(first)).expand(lengths.shape)
    values = torch.cat([direction, -direction, by_length[..., None]], -1)
    columns = torch.cat([index[:, first], index[:, second], own[..., None]], -1)
    residual = _LENGTH * (lengths - expected) / expected
    return residual.flatten(), values.flatten(0, 1), columns.flatten(0, 1)
