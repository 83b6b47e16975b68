"""Simple ways to delays and poses of cameras: correlated speeds, and bundle adjustment of single joints."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix
from scipy.spatial.transform import Rotation
from torch import Tensor

from benchmarks.keypoint_bodies.triangulation import (
    interpolated,
    low_pass,
    sure_keypoints,
    triangulate,
)
from torchpose.camera import CameraRig

LONGEST = 10  # frames, of a delay
_STRIDE = 3  # frames between those that are adjusted to
_PIXELS = 5.0  # residuals from which the loss grows linearly


def correlated_delays(
    keypoints: Float[Tensor, "T C J 2"], confidence: Float[Tensor, "T C J"], fps: float
) -> list[int]:
    """Return the frames by which cameras began earlier than the first, in the way of Pose2Sim.

    Vertical speeds in the image, of interpolated keypoints after a low-pass of 6 Hz, are summed up over
    joints without their sign. The delay has the largest correlation with those of the first camera.
    """
    sure = keypoints.masked_fill(~sure_keypoints(keypoints, confidence)[..., None], torch.nan)
    speeds = []
    for c in range(keypoints.shape[1]):
        path = torch.nn.functional.pad(sure[:, c], (0, 1))
        smooth = low_pass(interpolated(path), fps)[..., 1]
        speeds.append(torch.gradient(smooth, dim=0)[0].abs().nansum(-1).numpy())
    return [0, *(_best_lag(speeds[0], other) for other in speeds[1:])]


def _best_lag(first: np.ndarray, other: np.ndarray) -> int:
    count = len(first)
    found = []
    for lag in range(-LONGEST, LONGEST + 1):
        a = first[max(0, -lag) : count - max(0, lag)]
        b = other[max(0, lag) : count + min(0, lag)]
        found.append(np.corrcoef(a, b)[0, 1])
    return int(np.nanargmax(found)) - LONGEST


def bundle_adjusted(
    rig: CameraRig, keypoints: Float[Tensor, "T C J 2"], confidence: Float[Tensor, "T C J"]
) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations [C, 3, 3] and translations [C, 3] after adjustment of cameras and points.

    Every third frame counts, with a loss that grows linearly from 5 pixels (soft L1). The first camera stays.
    """
    pixels, trust = keypoints[::_STRIDE], confidence[::_STRIDE]
    sure = sure_keypoints(pixels, trust)
    points = triangulate(rig, pixels, sure.to(pixels))
    t, c, j = (sure & points.isfinite().all(-1)[:, None]).nonzero().T.numpy()
    used, place = np.unique(t * points.shape[1] + j, return_inverse=True)
    start = points.reshape(-1, 3)[used].numpy()
    seen, K = pixels.numpy()[t, c, j], rig.matrix.numpy()[c]
    R0, t0, n = rig.rotation.numpy(), rig.translation.numpy(), len(rig) - 1

    def poses(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        turn = Rotation.from_rotvec(np.vstack([np.zeros(3), x[: 3 * n].reshape(n, 3)])).as_matrix()
        moved = np.vstack([np.zeros(3), x[3 * n : 6 * n].reshape(n, 3)])
        return turn @ R0, (turn @ t0[..., None])[..., 0] + moved

    def residuals(x: np.ndarray) -> np.ndarray:
        R, shift = poses(x)
        p = x[6 * n :].reshape(-1, 3)[place]
        uvw = (K @ ((R[c] @ p[..., None])[..., 0] + shift[c])[..., None])[..., 0]
        return (uvw[:, :2] / uvw[:, 2:] - seen).ravel()

    sparsity = lil_matrix((2 * len(t), 6 * n + 3 * len(start)), dtype=int)
    for axis in range(2):
        rows = 2 * np.arange(len(t)) + axis
        for k in range(3):
            sparsity[rows, 6 * n + 3 * place + k] = 1
            later = c > 0
            sparsity[rows[later], 3 * (c[later] - 1) + k] = 1
            sparsity[rows[later], 3 * n + 3 * (c[later] - 1) + k] = 1
    x = np.concatenate([np.zeros(6 * n), start.ravel()])
    found = least_squares(residuals, x, jac_sparsity=sparsity, loss="soft_l1", f_scale=_PIXELS,
                          x_scale="jac", max_nfev=30)  # fmt: skip
    return poses(found.x)
