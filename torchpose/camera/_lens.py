"""Distort rays and images as lenses do, and straighten them, by OpenCV."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

OPENCV_DISTORTIONS = 14  # the longest list that OpenCV takes; zeros change nothing
_UNTIL = (3, 100, 1e-12)  # steps at most, or this change, of OpenCV's search for an inverse


def is_distorted(distortions: Float[Tensor, "*cameras n"], fisheye: bool) -> bool:
    """Return whether a lens, or one of several, changes anything.

    Args:
        distortions: of the lens, or of all.
        fisheye: whether one is of the fisheye model, which changes rays without a coefficient too.
    """
    return fisheye or bool(distortions.any())


def distort_rays(
    rays: Float[Tensor, "N 2"], distortions: Float[Tensor, " n"], fisheye: bool
) -> Float[Tensor, "N 2"]:
    """Return where a lens puts rays (x / z, y / z) in the image plane at z = 1.

    Args:
        rays: in front of the camera. distortions: up to 14 of OpenCV's, or 4 of its fisheye model.
        fisheye: whether they are those.
    """
    import cv2

    if not len(rays) or not is_distorted(distortions, fisheye):
        return rays
    there = torch.cat([rays, torch.ones_like(rays[:, :1])], -1)
    source = np.ascontiguousarray(there.double().numpy(force=True))[:, None]
    model = cv2.fisheye if fisheye else cv2
    d, zero = _in_full(distortions, fisheye), np.zeros(3)
    found = model.projectPoints(source, zero, zero, np.eye(3), d)[0]
    return torch.from_numpy(np.asarray(found).reshape(-1, 2)).to(rays)


def straighten_rays(
    rays: Float[Tensor, "N 2"], distortions: Float[Tensor, " n"], fisheye: bool
) -> Float[Tensor, "N 2"]:
    """Return the rays that a lens puts somewhere in the image plane at z = 1: the inverse of `distort_rays`.

    It is found by iteration, and anything where there is none.

    Args:
        rays: as the lens puts them. distortions, fisheye: as of `distort_rays`.
    """
    import cv2

    if not len(rays) or not is_distorted(distortions, fisheye):
        return rays
    source = np.ascontiguousarray(rays.double().numpy(force=True))[:, None]
    d, eye = _in_full(distortions, fisheye), np.eye(3)
    if fisheye:
        found = cv2.fisheye.undistortPoints(source, eye, d, criteria=_UNTIL)
    else:
        found = cv2.undistortPointsIter(source, eye, d, eye, eye, _UNTIL)
    return torch.from_numpy(np.asarray(found)[:, 0]).to(rays)


def undistortion_maps(
    matrix: Float[Tensor, "3 3"], distortions: Float[Tensor, " n"], fisheye: bool,
    size: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray] | None:  # fmt: skip
    """Return the source pixel of each pixel of an undistorted image, for `cv2.remap`.

    Args:
        matrix: K, the same before and after. distortions: OpenCV's. size: (width, height).

    Returns:
        u and v [height, width], float32; None if nothing is distorted.
    """
    import cv2

    if not is_distorted(distortions, fisheye):
        return None
    d, K = _in_full(distortions, fisheye), matrix.double().numpy(force=True)
    if fisheye:
        u, v = cv2.fisheye.initUndistortRectifyMap(K, d, np.eye(3), K, size, cv2.CV_32FC1)
    else:
        u, v = cv2.initUndistortRectifyMap(K, d, np.eye(3), K, size, cv2.CV_32FC1)
    u, v = np.asarray(u), np.asarray(v)
    if K[0, 1]:  # OpenCV leaves the skew of the distorted image out
        u = u + np.float32(K[0, 1] / K[1, 1]) * (v - np.float32(K[1, 2]))
    return u, v


def _in_full(distortions: Float[Tensor, " n"], fisheye: bool) -> np.ndarray:
    """Return distortions in a length that OpenCV takes: zeros change nothing."""
    length = 4 if fisheye else OPENCV_DISTORTIONS
    full = np.zeros(length)
    full[: len(distortions)] = distortions.double().numpy(force=True)[:length]
    return full
