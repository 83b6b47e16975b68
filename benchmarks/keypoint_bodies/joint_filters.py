"""Kalman filters that know nothing of bodies: every joint moves by itself at a constant velocity.

The state of a joint is place and velocity; the acceleration is white noise. One filter measures
triangulated points, the other one pixels of one camera after the other, linearised at the prediction. Both
refuse measurements outside of the 99 % ellipsoid of what they expect; a joint of which something was refused
for a quarter of a second begins anew at its next triangulated point.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks.keypoint_bodies.triangulation import sure_keypoints, triangulate_subsets
from torchpose.camera import CameraRig
from torchpose.metrics._calibration import chi2_quantile

_GATE = {dim: float(chi2_quantile(torch.tensor(0.99, dtype=torch.float64), dim)) for dim in (2, 3)}
_PATIENCE = 0.25  # seconds
_START_STD, _START_SPEED = 0.05, 1.0  # metres, metres per second


class Settings(NamedTuple):
    """Noise of a filter.

    Args:
        acceleration: spectral density of the acceleration's noise, m^2/s^3.
        noise: standard deviation of a measurement: of a point in metres, of a pixel in pixels.
    """

    acceleration: float
    noise: float


class Filtered(NamedTuple):
    """Joints after every frame, NaN before they were first triangulated.

    Attributes:
        joints: [T, J, 3], metres. covariance: [T, J, 3, 3].
    """

    joints: Tensor
    covariance: Tensor


class _State(NamedTuple):
    """Place and velocity of every joint: mean [J, 6] and covariance [J, 6, 6]."""

    mean: Tensor
    cov: Tensor


class _Measurement(NamedTuple):
    """What is measured of every joint, beside what was expected.

    Attributes:
        off: [J, M], measured less expected. slope: [J, M, 3], of what is measured by the place.
        known: [J], whether there is a measurement.
    """

    off: Tensor
    slope: Tensor
    known: Tensor


def filter_points(
    rig: CameraRig,
    keypoints: Float[Tensor, "T C J 2"],
    confidence: Float[Tensor, "T C J"],
    fps: float,
    settings: Settings,
) -> Filtered:
    """Return joints of a Kalman filter over triangulated points.

    Args:
        rig: cameras. keypoints: pixels, undistorted. confidence: of a detector. fps: frames per
            second. settings: noise.
    """
    points = triangulate_subsets(rig, keypoints, confidence).points
    slope = torch.eye(3, dtype=points.dtype).expand(points.shape[1], 3, 3)

    def measure(t: int, step: int, place: Tensor) -> _Measurement:
        return _Measurement(points[t] - place, slope, points[t].isfinite().all(-1))

    return _run(points, measure, 1, fps, settings)


def filter_pixels(
    rig: CameraRig,
    keypoints: Float[Tensor, "T C J 2"],
    confidence: Float[Tensor, "T C J"],
    fps: float,
    settings: Settings,
) -> Filtered:
    """Return joints of an extended Kalman filter over pixels, started by triangulation.

    Args:
        rig: cameras. keypoints: pixels, undistorted. confidence: of a detector. fps: frames per
            second. settings: noise.
    """
    points = triangulate_subsets(rig, keypoints, confidence).points
    sure = sure_keypoints(keypoints, confidence)

    def measure(t: int, camera: int, place: Tensor) -> _Measurement:
        pixels, slope = project_one(rig, camera, place)
        return _Measurement(keypoints[t, camera] - pixels, slope, sure[t, camera])

    return _run(points, measure, len(rig), fps, settings)


def project_one(
    rig: CameraRig, camera: int, points: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch 2 3"]]:
    """Return pixels in one camera, and their derivatives by the points."""
    linear = rig.matrix[camera] @ rig.rotation[camera]
    seen = points @ linear.T + rig.matrix[camera] @ rig.translation[camera]
    pixels = seen[..., :2] / seen[..., 2:]
    slope = (linear[:2] - pixels[..., None] * linear[2]) / seen[..., 2:, None]
    return pixels, slope


def _run(
    points: Float[Tensor, "T J 3"], measure: Callable[[int, int, Tensor], _Measurement], steps: int,
    fps: float, settings: Settings,
) -> Filtered:  # fmt: skip
    """Return the filtered places: predicted, measured, and begun at triangulated points.

    Args:
        points: triangulated. measure: from frame, step and place to a measurement. steps: measurements of
            a frame. fps: frames per second. settings: noise.
    """
    move, noise = _motion(fps, settings.acceleration, points.dtype)
    variances = torch.tensor([_START_STD**2] * 3 + [_START_SPEED**2] * 3, dtype=points.dtype)
    fresh = variances.diag().expand(points.shape[1], 6, 6)
    state = _State(torch.full_like(fresh[..., 0], torch.nan), fresh)
    refused = torch.zeros(points.shape[1])  # frames in a row in which not all was taken
    found = []
    for t in range(len(points)):
        state = _State(state.mean @ move.T, move @ state.cov @ move.T + noise)
        some_refused = torch.zeros_like(refused, dtype=torch.bool)
        for step in range(steps):
            measured = measure(t, step, state.mean[:, :3])
            state, taken = _updated(state, measured, settings.noise)
            some_refused |= measured.known & ~taken
        refused = torch.where(some_refused, refused + 1, 0)
        lost = (refused > _PATIENCE * fps) | state.mean.isnan().any(-1)
        begins = lost & points[t].isfinite().all(-1)
        at_rest = torch.cat([points[t], torch.zeros_like(points[t])], -1)
        state = _State(torch.where(begins[:, None], at_rest, state.mean),
                       torch.where(begins[:, None, None], fresh, state.cov))  # fmt: skip
        refused = torch.where(begins, 0, refused)
        found.append((state.mean[:, :3], state.cov[:, :3, :3]))
    joints, covariance = (torch.stack(values) for values in zip(*found, strict=True))
    return Filtered(joints, covariance)


def _motion(fps: float, acceleration: float, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return the transition and the covariance of its noise for one frame."""
    dt = 1 / fps
    eye = torch.eye(3, dtype=dtype)
    move = torch.tensor([[1.0, dt], [0.0, 1.0]], dtype=dtype)
    noise = torch.tensor([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], dtype=dtype)
    return torch.kron(move, eye), torch.kron(acceleration * noise, eye)


def _updated(
    state: _State, measured: _Measurement, noise: float
) -> tuple[_State, Bool[Tensor, " J"]]:
    """Return the state after a measurement, and which joints had one within the gate."""
    mean, cov = state
    dim = measured.off.shape[-1]
    cross = cov[:, :, :3] @ measured.slope.mT
    expected = measured.slope @ cross[:, :3] + noise**2 * torch.eye(dim, dtype=mean.dtype)
    gain = torch.linalg.solve(expected, cross.mT).mT
    off = measured.off[..., None]
    distance = (off * torch.linalg.solve(expected, off)).sum((-2, -1))
    taken = measured.known & (distance < _GATE[dim])
    mean = torch.where(taken[:, None], mean + (gain @ off)[..., 0], mean)
    cov = torch.where(taken[:, None, None], cov - gain @ cross.mT, cov)
    return _State(mean, (cov + cov.mT) / 2), taken
