"""Pack the numbers of a track for the page: base64 of little-endian arrays, thinned if long."""

import base64
import math
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.metrics._calibration import chi2_quantile

CURVE_POINTS = 4000
"""Points of a curve in the page, at most."""

MAX_POSES = 10_000
"""Poses that the page keeps for its skeleton, at most, of all persons together."""

_LEVEL = 0.9
_TRIANGLE = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # what a symmetric matrix consists of


@runtime_checkable
class ReportedTrack(Protocol):
    """Declares the attributes of one person that the page needs, as of a `PoseTrack`.

    Attributes:
        joints3d: [1, T, J, 3], metres, in `frame`. covariance3d: [1, T, J, 3, 3].
        observed: [1, T, J], True where the joint was measured.
        failed_at: [1], the first frame without a pose, -1 if there is none.
        names: the names of the joints. fps: frames per second, or None. frame: "camera" or "body".
    """

    joints3d: Tensor
    covariance3d: Tensor
    observed: Tensor
    failed_at: Tensor
    names: tuple[str, ...]
    fps: float | None
    frame: str

    def __len__(self) -> int: ...


class Thinned(NamedTuple):
    """Holds the thinning of a track: every `stride`-th pose, curves in steps of `bucket`."""

    stride: int
    bucket: int


def pack_array(array: np.ndarray) -> dict[str, Any]:
    """Return an array as base64 with its type and shape, for JSON.

    >>> pack_array(np.array([[1.0, 2.0]], dtype=np.float32))
    {'type': 'float32', 'shape': [1, 2], 'base64': 'AACAPwAAAEA='}
    """
    little = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False)
    text = base64.b64encode(little.tobytes()).decode("ascii")
    return {"type": array.dtype.name, "shape": list(array.shape), "base64": text}


def pack_person(
    track: ReportedTrack,
    label: str,
    first_frame: int,
    truth: Float[Tensor, "T J 3"] | None,
    max_poses: int,
) -> tuple[dict[str, Any], Thinned]:
    """Return the data of one person in the page.

    Poses and covariances are those of every stride-th frame, so that at most `max_poses` remain. The
    page interpolates between them. `observed` is kept for every frame. With more frames than
    `CURVE_POINTS`, curves become the smallest and the largest value, and the widest band, in each of
    `CURVE_POINTS` / 2 buckets of equal length. So no peak is lost.

    Args:
        track: one sequence of T frames. label: its name in the page.
        first_frame: frame of the video with which it begins.
        truth: true joints [T, J, 3], metres, in the axes of the track.
        max_poses: see above.

    Returns:
        A dictionary for JSON, and the thinning.
    """
    joints, covariance = _array(track.joints3d[0]), _array(track.covariance3d[0])
    n = len(joints)
    thinned = Thinned(
        max(1, math.ceil(n / max(1, max_poses))),
        1 if n <= CURVE_POINTS else math.ceil(n / (CURVE_POINTS // 2)),
    )
    there = np.isfinite(joints).all((1, 2))
    observed = track.observed[0].detach().cpu().numpy().astype(bool)
    rows, columns = np.array(_TRIANGLE).T
    person: dict[str, Any] = {
        "label": label,
        "first": first_frame,
        "frames": n,
        "stride": thinned.stride,
        "bucket": thinned.bucket,
        "joints": pack_array(_float32(joints[:: thinned.stride])),
        "covariance": pack_array(_float32(covariance[:: thinned.stride][..., rows, columns])),
        "observed": pack_array(np.packbits(observed, axis=1, bitorder="little").reshape(-1)),
        "there": None if there.all() else pack_array(there.astype(np.uint8)),
        "measured": _shares(observed, there),
        "truth": None,
        "curves": None,
    }
    true = None if truth is None else _array(truth)
    if true is not None:
        person["truth"] = pack_array(_float32(true[:: thinned.stride]))
    if thinned.bucket > 1:
        person["curves"] = pack_array(_curves(joints, covariance, thinned.bucket))
    return person, thinned


def _shares(observed: np.ndarray, there: np.ndarray) -> list[float]:
    """Return the share of the frames with a pose in which each joint was measured."""
    counted = (observed & there[:, None]).sum(0)
    return (counted / max(1, int(there.sum()))).tolist()


def _curves(joints: np.ndarray, covariance: np.ndarray, bucket: int) -> np.ndarray:
    """Return lowest and highest value, lower and upper end of the band, by bucket [4, J, 3, N]."""
    quantile = chi2_quantile(torch.tensor(_LEVEL, dtype=torch.float64), 1)
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore"):  # NaN stays NaN, whatever its sign bit
        half = float(quantile.sqrt()) * np.sqrt(np.maximum(variance, 0))
    starts = np.arange(0, len(joints), bucket)
    ends = [
        reduce.reduceat(values, starts, axis=0)
        for reduce, values in (
            (np.fmin, joints),  # these ignore NaN unless all are NaN
            (np.fmax, joints),
            (np.fmin, joints - half),
            (np.fmax, joints + half),
        )
    ]
    return _float32(np.stack(ends).transpose(0, 2, 3, 1))


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().double().numpy()


def _float32(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array, dtype=np.float32)
