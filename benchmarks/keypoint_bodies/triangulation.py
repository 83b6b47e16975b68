"""Points in the room from pixels of several cameras, and what fills their gaps."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.camera import CameraRig

THRESHOLD = 15.0
"""Reprojection error in pixels from which a point is refused; the default of Pose2Sim."""

LEAST_CONFIDENCE = 0.3
"""Keypoints below it are not used, as by Pose2Sim."""

_NORMAL_QUARTILE = 0.6745


class Triangulated(NamedTuple):
    """Points, NaN where there are none.

    Attributes:
        points: [T, J, 3], metres. error: [T, J], mean reprojection error in the cameras used, pixels.
        used: [T, C, J], cameras.
    """

    points: Tensor
    error: Tensor
    used: Tensor


def triangulate(
    rig: CameraRig, keypoints: Float[Tensor, "*batch C J 2"], weights: Float[Tensor, "*batch C J"]
) -> Float[Tensor, "*batch J 3"]:
    """Return points by the direct linear transformation: the least singular vector of its rows.

    Args:
        rig: cameras. keypoints: pixels, undistorted. weights: of the rows; those of 0 are left out.

    Returns:
        Metres, NaN where fewer than two cameras have a weight.
    """
    known = (weights > 0) & keypoints.isfinite().all(-1)
    pixels = keypoints.nan_to_num().movedim(-3, -2)
    weights = (weights * known).movedim(-2, -1)
    projection = rig.matrix @ torch.cat([rig.rotation, rig.translation[..., None]], -1)
    rows = pixels[..., None] * projection[:, None, 2] - projection[:, :2]  # [..., J, C, 2, 4]
    rows = (weights[..., None, None] * rows).flatten(-3, -2)
    least = torch.linalg.eigh(rows.mT @ rows).eigenvectors[..., 0]
    points = least[..., :3] / least[..., 3:]
    return torch.where((known.sum(-2) >= 2)[..., None], points, torch.nan)


def sure_keypoints(
    keypoints: Float[Tensor, "T C J 2"], confidence: Float[Tensor, "T C J"]
) -> Bool[Tensor, "T C J"]:
    """Return which keypoints are there and sure enough to be used."""
    return (confidence >= LEAST_CONFIDENCE) & keypoints.isfinite().all(-1)


def triangulate_subsets(
    rig: CameraRig,
    keypoints: Float[Tensor, "T C J 2"],
    confidence: Float[Tensor, "T C J"],
    threshold: float = THRESHOLD,
) -> Triangulated:
    """Return points of as many cameras as agree, weighted by confidence.

    All cameras are tried, then all but one, all but two and so on, down to two. Of the first number of
    cameras for which the mean reprojection error is below the threshold, the best ones are taken.

    Args:
        rig: cameras. keypoints: pixels, undistorted. confidence: of a detector.
        threshold: pixels.
    """
    sure = sure_keypoints(keypoints, confidence)
    chosen = torch.tensor(list(itertools.product((True, False), repeat=len(rig))))
    chosen = chosen[chosen.sum(1) >= 2][:, None, :, None]
    used = sure & chosen  # [S, T, C, J]
    points = triangulate(rig, keypoints, confidence * used)
    off = (rig(points).pixels - keypoints).norm(dim=-1)
    error = torch.where(used, off, 0).sum(2) / used.sum(2)
    left_out = sure.sum(1) - used.sum(2)
    refused = ~(error < threshold) | (used.sum(2) < 2)
    cost = (left_out * threshold + error).masked_fill(refused, torch.inf)
    if not len(cost):
        nothing = torch.full_like(keypoints[:, 0, :, 0], torch.nan)
        return Triangulated(nothing[..., None].repeat(1, 1, 3), nothing, torch.zeros_like(sure))
    best = cost.argmin(0)[None]
    none = cost.isinf().all(0)
    points = points.gather(0, best[..., None].expand(*best.shape, 3))[0]
    return Triangulated(
        points.masked_fill(none[..., None], torch.nan),
        error.gather(0, best)[0].masked_fill(none, torch.nan),
        used.gather(0, best[:, :, None].expand(1, *sure.shape))[0] & ~none[:, None],
    )


def interpolated(points: Float[Tensor, "T *rest"]) -> Float[Tensor, "T *rest"]:
    """Return values whose gaps are filled linearly over time; NaN where there is none at all."""
    columns = points.flatten(1).numpy().T.copy()
    place = np.arange(len(points))
    for column in columns:
        known = np.isfinite(column)
        if known.any():
            column[~known] = np.interp(place[~known], place[known], column[known])
    return torch.from_numpy(columns.T.copy()).reshape(points.shape)


def held(points: Float[Tensor, "T *rest"]) -> Float[Tensor, "T *rest"]:
    """Return values that stay as they last were where they are NaN."""
    rows = torch.arange(len(points)).reshape(-1, *[1] * (points.ndim - 1)).expand(points.shape)
    last = torch.where(points.isfinite(), rows, 0).cummax(0).values
    return points.gather(0, last)


def low_pass(
    points: Float[Tensor, "T *rest"], fps: float, cutoff: float = 6.0, order: int = 4
) -> Float[Tensor, "T *rest"]:
    """Return values after a Butterworth filter forwards and backwards, which halves the order of each.

    Args:
        points: over time, without gaps. fps: frames per second. cutoff: Hz. order: of both together.
    """
    from scipy.signal import butter, filtfilt

    b, a = butter(order / 2, cutoff / (fps / 2))
    smooth = filtfilt(b, a, points.numpy(), axis=0)
    return torch.from_numpy(smooth.copy())


def without_outliers(
    points: Float[Tensor, "T *rest"], window: int = 7, limit: float = 2.0
) -> Float[Tensor, "T *rest"]:
    """Return values, with the median of the frames around in place of outliers: the Hampel filter.

    Args:
        points: over time, without gaps; the first and last frames stay. window: frames. limit: of the
            distance from the median, in robust standard deviations.
    """
    if len(points) < window:
        return points
    half = window // 2
    around = points.unfold(0, window, 1)  # [T - window + 1, ..., window]
    median = around.median(-1).values
    spread = (around - median[..., None]).abs().median(-1).values
    inner = points[half : len(points) - half]
    wild = (_NORMAL_QUARTILE * (inner - median).abs() > limit * spread) & (spread > 0)
    found = points.clone()
    found[half : len(points) - half] = torch.where(wild, median, inner)
    return found
