"""Find the body in the image, and place a virtual camera that sees it where the prior expects it.

A prior over windows has bodies in one place, between the distances of its training views. The
position and scale of a body follow from head and neck in the last second. Hands of other frames are
moved along with the body. The camera is turned, and zoomed where the body is much nearer or farther,
until body and prior agree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.module_state import index_tensor, outside_inference
from torchpose.camera._projection import homogeneous_pixels, pixel_rays, turn_homography
from torchpose.skeleton._joint_sets import UPPER_BODY

MEMORY = 1.0
"""Seconds of the past that tell where head and neck are."""

ANCHORS = slice(UPPER_BODY.index("head"), UPPER_BODY.index("neck") + 1)
"""Rows of head and neck among the eight joints."""

# Chosen on training persons who stand and who walk in a circle, see the benchmarks page.
_NECK_ACCELERATION, _NECK_SPEED = 0.5, 1.0  # m/s after one second, and m/s at its start
_HEIGHT_ACCELERATION, _HEIGHT_SPEED = 0.002, 0.01
_NODDING = 0.046  # metres: the head moves against the neck without the body coming nearer
_NECK_SPREAD, _HEIGHT_SPREAD = 1.0, 0.05  # metres, where nothing is measured
# Log of how much farther (nearer) than usual the body seems: below the first the prior's own views
# do, from the second on the body is brought to the usual distance altogether. Persons whose necks
# are long only seem nearer.
_FARTHER, _NEARER = (0.15, 0.25), (0.3, 0.5)
_REACH = 0.8  # metres from the neck to a hand, at most
_BESIDE = 0.05  # radians beside the usual place, up to which the camera is not turned
_LARGEST_ZOOM = 6.0
_LEAST_DEPTH = 1e-3  # behind a camera is only what was far beside the image: it is kept finite
_FRAMES_AT_A_TIME, _NUMBERS_AT_A_TIME = 4096, 1 << 24


class PathModel(NamedTuple):
    """Models head and neck of a body about which nothing is known, in the prior's pixels.

    Attributes:
        neck: mean place [2]. height: mean of head minus neck [2]. variance: R of head and neck [2],
            pixels squared. scale: pixels per metre at the mean distance.
    """

    neck: Tensor
    height: Tensor
    variance: Tensor
    scale: float


class BodyPath(NamedTuple):
    """Holds the estimated neck, and head minus neck, at t - lag for each of S lags, [B, T, S, 2], pixels."""

    lags: tuple[int, ...]
    neck: Tensor
    height: Tensor

    def at(self, lag: int) -> tuple[Tensor, Tensor]:
        """Return the neck and height at one lag, [B, T, 2]."""
        i = self.lags.index(lag)
        return self.neck[:, :, i], self.height[:, :, i]

    def carried(
        self, uv: Float[Tensor, "B T H 2"], lags: Sequence[int]
    ) -> Float[Tensor, "B T H 2"]:
        """Map pixels from H lags ago to the body's current position.

        They move along with the neck, and away from it as the body comes nearer:
            u' = n_t + (u - n_{t-lag}) |h_t| / |h_{t-lag}|
        """
        now = self.lags.index(0)
        then = index_tensor(tuple(self.lags.index(lag) for lag in lags), uv.device)
        size = torch.linalg.vector_norm(self.height, dim=-1, keepdim=True)
        ratio = size[:, :, now : now + 1] / size.index_select(2, then).clamp_min(1e-6)
        offset = (uv - self.neck.index_select(2, then)) * ratio.clamp(0.5, 2.0)
        return self.neck[:, :, now : now + 1] + offset


class BodyView(NamedTuple):
    """Holds a virtual camera for each frame.

    Attributes:
        rotation: from the axes of the camera to those of the virtual one [B, T, 3, 3].
        zoom: how much larger it sees the body, [B, T].
        centre: the pixel that it zooms about, which is that of the neck, [B, T, 2].
    """

    rotation: Tensor
    zoom: Tensor
    centre: Tensor


def body_path(
    uv: Float[Tensor, "B T 8 2"],
    mask: Bool[Tensor, "B T 8"],
    lags: tuple[int, ...],
    ahead: int,
    fps: float,
    model: PathModel,
    start: int = 0,
    variance: Float[Tensor, "B T 2"] | None = None,
    regression: Regression | None = None,
) -> BodyPath:
    """Return the neck and head at t - lag, by regression on the measurements from a second ago to `ahead`.

    The neck moves with a velocity that is a random walk, and so, much more slowly, does the height
    of the head above it; the head nods besides:
        neck = n(t) + noise,  head = n(t) + h(t) + nodding + noise.
    Given its last second this is what a Kalman smoother says, as one weighted sum of the measured
    pixels, whose weights are the same wherever the same joints were measured.

    Args:
        uv, mask: the eight joints. lags: S lags in frames, positive is the past. ahead: number of
            later frames that may be used. fps: frame rate. model: prior knowledge of head and neck.
        start: first frame that is wanted; those before it are its past. Returned are T - start.
        variance: R of head and neck, pixels squared, if it is not that of `model` throughout.
        regression: the result of `path_regression` for these, if it is known.
    """
    past = memory_frames(lags, fps)
    if regression is None:
        regression = path_regression(lags, ahead, fps, model, uv)
    usual = torch.stack([model.neck + model.height, model.neck])
    known = mask[:, :, ANCHORS, None]
    anchors = torch.where(known, uv[:, :, ANCHORS] - usual, 0.0)
    known = known.to(uv)
    more = torch.zeros_like(known) if variance is None else (variance - model.variance)[..., None]
    frames = torch.cat([anchors, known, more * known], -1)
    frames = torch.nn.functional.pad(frames, (0, 0, 0, 0, past - start, ahead))
    batch, n_frames, width = uv.shape[0], uv.shape[1] - start, past + ahead + 1
    most = _FRAMES_AT_A_TIME if variance is None else _FRAMES_AT_A_TIME // 8
    most = min(most, _NUMBERS_AT_A_TIME // (2 * width) ** 2)  # a covariance for each pattern
    step = max(1, most // batch)
    parts = []
    for first in range(0, n_frames, step):
        span = slice(first, min(first + step, n_frames) + width - 1)
        part = frames[:, span].unfold(1, width, 1).movedim(-1, 2).flatten(2, 3)
        weights = regression.of_frames(part[..., 2] > 0, part[..., 3], variance is None)
        parts.append(weights @ part[..., :2])
    neck, height = torch.cat(parts, 1).chunk(2, 2)
    return BodyPath(lags, neck + model.neck, height + model.height)


def memory_frames(lags: tuple[int, ...], fps: float) -> int:
    """Return the number of past frames that `body_path` and windows with these lags need."""
    return max(round(MEMORY * fps), *lags)


class Regression(NamedTuple):
    """Holds the covariances of the measured pixels [N, N], and of the wanted values with them [2 S, N].

    Attributes:
        kept: the weights of the latest pattern that all frames had, which those of live streams have again.
    """

    measured: Tensor
    wanted: Tensor
    kept: dict[tuple[bool, ...], Tensor]

    def of_frames(
        self, known: Bool[Tensor, "B T N"], more: Float[Tensor, "B T N"], alike: bool
    ) -> Float[Tensor, "B1 T1 Q N"]:
        """Return the weights for every frame's measured pixels; [1, 1, Q, N] if they are all the same.

        Args:
            known: which pixels are measured. more: their variance beyond the usual one.
            alike: whether that is zero throughout.
        """
        if not alike:
            return self.weights(known.flatten(0, 1), more.flatten(0, 1)).unflatten(
                0, known.shape[:2]
            )
        patterns, row = _distinct(known.flatten(0, 1))
        usual = torch.zeros_like(patterns, dtype=more.dtype)
        if row is not None:
            return self.weights(patterns, usual)[row].unflatten(0, known.shape[:2])
        key = tuple(patterns[0].tolist())
        weights = self.kept.get(key)
        if weights is None:
            with outside_inference():
                weights = self.weights(patterns, usual)
            self.kept.clear()
            self.kept[key] = weights
        return weights[None]

    def weights(
        self, known: Bool[Tensor, "P N"], more: Float[Tensor, "P N"]
    ) -> Float[Tensor, "P Q N"]:
        """Return the weights of the measured pixels where only some are known; zero for the others."""
        both = known[:, :, None] & known[:, None, :]
        eye = torch.eye(len(self.measured), dtype=self.measured.dtype, device=known.device)
        cov = torch.where(both, self.measured, eye) + torch.diag_embed(more)
        wanted = (self.wanted * known[:, None]).mT
        return torch.cholesky_solve(wanted, torch.linalg.cholesky(cov)).mT


def path_regression(
    lags: tuple[int, ...], ahead: int, fps: float, model: PathModel, like: Tensor
) -> Regression:
    """Return the covariances that `body_path` needs; they depend on no measured pixel."""
    frames = torch.arange(-memory_frames(lags, fps), ahead + 1)
    times = torch.cat([frames, -torch.tensor(lags)]).to(like) / fps
    pixels = model.scale
    neck = _walk(times, _NECK_SPREAD * pixels, _NECK_SPEED * pixels, _NECK_ACCELERATION * pixels)
    height = _walk(
        times, _HEIGHT_SPREAD * pixels, _HEIGHT_SPEED * pixels, _HEIGHT_ACCELERATION * pixels
    )
    n = len(frames)
    # Frames come with head and neck beside each other, as the measured pixels do.
    is_head = like.new_tensor([1.0, 0.0]).repeat(n)
    of_frame = torch.arange(n).repeat_interleave(2)
    noise = model.variance.to(like) + like.new_tensor([(_NODDING * pixels) ** 2, 0.0])
    measured = neck[of_frame[:, None], of_frame] + torch.diag(noise.repeat(n))
    measured = measured + height[of_frame[:, None], of_frame] * is_head * is_head[:, None]
    wanted = torch.cat([neck[n:, of_frame], height[n:, of_frame] * is_head])
    return Regression(measured, wanted, {})


def _walk(times: Tensor, spread: float, speed: float, acceleration: float) -> Tensor:
    """Return the covariance of positions whose velocity is a random walk from the first of the times on."""
    since = times - times.min()
    first = torch.minimum(since[:, None], since)
    last = torch.maximum(since[:, None], since)
    walk = first.square() * (3 * last - first) / 6
    return spread**2 + speed**2 * since[:, None] * since + acceleration**2 * walk


def _distinct(patterns: Bool[Tensor, "F N"]) -> tuple[Bool[Tensor, "P N"], Tensor | None]:
    """Return the distinct rows, and the index of each row among them; None if all rows are the same."""
    if bool((patterns == patterns[:1]).all()):
        return patterns[:1], None
    pieces = patterns.split(62, 1)  # as many bits as fit into a whole number
    codes = [(p * 2 ** torch.arange(p.shape[1], device=p.device)).sum(1) for p in pieces]
    distinct, row = torch.unique(torch.stack(codes, 1), dim=0, return_inverse=True)
    first = torch.zeros(len(distinct), dtype=torch.long, device=row.device)
    first[row] = torch.arange(len(row), device=row.device)
    return patterns[first], row


def view_body(
    neck: Float[Tensor, "*batch 2"],
    height: Float[Tensor, "*batch 2"],
    model: PathModel,
    matrix: Float[Tensor, "3 3"],
    reach: Float[Tensor, "*batch"] | None = None,
) -> BodyView:
    """Return the virtual camera that sees this neck where the prior has it, and a far body larger.

    The rotation is exact whatever the body does, since a camera that turns about its centre sees no
    other side of it. The zoom takes the head's height above the neck as a measure of distance,
    which it is to about a tenth; it is meant for bodies far outside of the prior's views. A person
    who bends forward seems far as well, but has hands that a far person could not have: the zoom
    leaves them within an arm's reach.

    Args:
        neck, height: pixels, see `BodyPath`. model: expectation of the prior. matrix: K of the pixels.
        reach: how far from the neck a hand is measured, pixels; 0 (or None) where none is.
    """
    offset = neck - model.neck.to(neck)
    aside = torch.linalg.vector_norm(offset, dim=-1, keepdim=True)
    room = _BESIDE * matrix[0, 0] / aside.clamp_min(1e-6)
    target = model.neck.to(neck) + offset * room.clamp_max(1.0)
    wanted, current = axes_along(pixel_rays(torch.stack([target, neck]), matrix))
    rotation = wanted @ current.mT
    seen = torch.linalg.vector_norm(height, dim=-1).clamp_min(1e-6)
    farther = (model.height.to(height).norm() / seen).log()
    excess = _excess(farther, *_FARTHER) - _excess(-farther, *_NEARER)
    zoom = excess.clamp_max(math.log(_LARGEST_ZOOM)).exp()
    if reach is not None:
        within = _REACH * model.scale / reach.clamp_min(1e-6)
        zoom = torch.minimum(zoom, within.clamp_min(1.0))
    return BodyView(rotation, zoom, target)


def _excess(value: Tensor, low: float, high: float) -> Tensor:
    """Return zero below `low`, the value itself above `high`, and a line between."""
    line = (value - low).clamp_min(0.0) * (high / (high - low))
    return torch.minimum(line, value.clamp_min(0.0))


def axes_along(ray: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the axes with z along a ray and x level, as columns."""
    z = torch.nn.functional.normalize(ray, dim=-1)
    across = torch.linalg.cross(_down(z.dtype, z.device).expand_as(z), z)
    x = torch.nn.functional.normalize(across, dim=-1)
    return torch.stack([x, torch.linalg.cross(z, x), z], -1)


@cache
def _down(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "3"]:
    with outside_inference():
        return torch.tensor([0.0, 1.0, 0.0], dtype=dtype, device=device)


def to_view(
    uv: Float[Tensor, "B T J 2"], view: BodyView, matrix: Float[Tensor, "3 3"]
) -> tuple[Float[Tensor, "B T J 2"], Float[Tensor, "B T J"]]:
    """Return the pixels of the camera as the virtual camera sees them, and the log of a pixel's area there.

    That of a turn about the camera's centre is the inverse cube of the homogeneous coordinate that it
    divides by.
    """
    centre, zoom = view.centre[..., None, :], view.zoom[..., None]
    seen = homogeneous_pixels(uv) @ turn_homography(view.rotation, matrix).mT
    level, depth = seen.split([2, 1], -1)
    depth = depth.clamp_min(_LEAST_DEPTH)
    area = 2 * zoom.log() - 3 * depth[..., 0].log()
    return centre + (level / depth - centre) * zoom[..., None], area


def from_view(
    uv: Float[Tensor, "B T J 2"], view: BodyView, matrix: Float[Tensor, "3 3"]
) -> tuple[Float[Tensor, "B T J 2"], Float[Tensor, "B T J 2 2"]]:
    """Return the pixels of the virtual camera as the camera sees them, and the derivative of this map."""
    homography = turn_homography(view.rotation.mT, matrix)
    seen = homogeneous_pixels(_shrunk(uv, view)) @ homography.mT
    level, depth = seen.split([2, 1], -1)
    top, bottom = homography[:, :, None, :, :2].split([2, 1], -2)
    slopes = top - (level / depth)[..., None] * bottom
    pixels = level / depth.clamp_min(_LEAST_DEPTH)
    return pixels, slopes / (depth * view.zoom[..., None, None])[..., None]


def planes_in_view(
    planes: Float[Tensor, "P 3"], view: BodyView, matrix: Float[Tensor, "3 3"]
) -> Float[Tensor, "B T P 3"]:
    """Return half-planes of the camera's pixels, a (u, v) + b > 0, in those of the virtual camera.

    Args:
        planes: (a, b). view: the virtual camera. matrix: K.
    """
    turned = planes @ turn_homography(view.rotation.mT, matrix)
    slope = turned[..., :2] / view.zoom[..., None, None]
    shift = (turned[..., :2] * view.centre[..., None, :]).sum(-1)
    zoomed = (slope * view.centre[..., None, :]).sum(-1)
    return torch.cat([slope, (turned[..., 2] + shift - zoomed)[..., None]], -1)


def _shrunk(uv: Tensor, view: BodyView) -> Tensor:
    """Return pixels of the virtual camera without its zoom."""
    centre = view.centre[..., None, :]
    return centre + (uv - centre) / view.zoom[..., None, None]
