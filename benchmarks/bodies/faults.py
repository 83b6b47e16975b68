"""Put faults of background subtraction into clean silhouettes.

The faults are those of real recordings: holes where clothes have the background's colour,
for the whole recording; a region that is lost for a while; a shadow on the ground;
ragged borders; salt-and-pepper noise and the usual median filter against it; frames in
which all faults are stronger.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, pad

from torchpose.errors import InputError, ShapeError

__all__ = ["FAULTS", "add_faults"]

FAULTS = ("holes", "missing", "shadow", "edges", "noise", "flicker")
"""Kinds of faults, in the order in which they are put in; flicker makes holes and edges worse."""

# Amounts at severity 1; lengths are shares of the person's height in the image.
_HOLES, _HOLE_SIZE = 0.06, 0.035  # share of the area; blur of the fields that cut them
_MISSING, _MISSING_FRAMES, _MISSING_RADIUS = 0.2, 12.0, (0.06, 0.13)  # share of the frames
_SHADOW_LENGTH, _SHADOW_FLATNESS, _SHADOW_SHEAR = 0.4, 0.2, (0.5, 1.0)
_EDGE_SIZE, _EDGE_STRENGTH = 0.010, 0.35  # blur; noise where the blurred border is 1/2
_NOISE = 0.03  # share of the pixels
_FLICKER, _FLICKER_FACTOR = 0.04, 2.5  # share of the frames; factor on their severity
_MOST = 0.6  # largest share of anything, however severe


class _Scene(NamedTuple):
    """Tensors that belong to the recording as a whole.

    Attributes:
        background, clothes: smooth fields [C, H, W] of unit variance; the first stays in place, the
            second moves with the person.
        shear, flatness: [C], sideways and upward run of the shadow for each pixel of height.
        boxes: [T, C, 4], top, left, height and width of the silhouettes, pixels; 0 if empty.
        height: of the person in the images, pixels; median over frames and cameras.
    """

    background: Tensor
    clothes: Tensor
    shear: Tensor
    flatness: Tensor
    boxes: Tensor
    height: float


class _Regions(NamedTuple):
    """Discs that are lost: centre (y, x) [T, C, 2] and radius [T, C] in pixels, 0 where none is."""

    centre: Tensor
    radius: Tensor


def add_faults(
    silhouettes: Bool[Tensor, "T C H W"],
    severity: float = 1.0,
    generator: torch.Generator | None = None,
    kinds: Sequence[str] = FAULTS,
) -> Bool[Tensor, "T C H W"]:
    """Return silhouettes as background subtraction would have found them.

    Holes lie where a smooth field of the background and one that moves with the person add up to
    more than a threshold, so that they persist and drift. A lost region lies on a thin part of the
    silhouette, follows it, and lasts about a dozen frames. The shadow is the silhouette flattened
    onto the ground at its feet. Borders are those of the blurred silhouette plus noise.

    Args:
        silhouettes: [T, C, H, W], True on the person; frames in order.
        severity: 0 leaves everything as it is, 1 is typical of an indoor scene, 2 is bad.
        generator: source of random numbers, on the CPU; the same seed gives the same faults.
        kinds: which of `FAULTS`.

    Returns:
        [T, C, H, W].

    Raises:
        InputError: a negative severity, or an unknown kind. ShapeError: not four dimensions.
    """
    if silhouettes.ndim != 4:
        raise ShapeError(f"silhouettes must have shape [T, C, H, W], got {list(silhouettes.shape)}")
    if not 0 <= severity < math.inf:
        raise InputError(f"severity must be 0 or more and finite, got {severity}")
    unknown = [kind for kind in kinds if kind not in FAULTS]
    if unknown:
        raise InputError(f"kinds of faults must be among {', '.join(FAULTS)}, got {unknown[0]!r}")
    if severity == 0 or 0 in silhouettes.shape:
        return silhouettes.clone()
    clean = silhouettes.cpu()
    generator = generator or torch.Generator().manual_seed(0)
    scene = _scene(clean, generator)
    regions = _regions(clean, scene, severity, generator)
    dim = torch.rand(len(clean), generator=generator) < min(_FLICKER * severity, _MOST)
    faulty = torch.empty_like(clean)
    for t in range(len(clean)):
        worse = _FLICKER_FACTOR if "flicker" in kinds and bool(dim[t]) else 1.0
        faulty[t] = _frame(clean, t, scene, regions, severity, worse, kinds, generator)
    return faulty.to(silhouettes.device)


def _frame(
    clean: Tensor,
    t: int,
    scene: _Scene,
    regions: _Regions,
    severity: float,
    worse: float,
    kinds: Sequence[str],
    generator: torch.Generator,
) -> Tensor:
    """Return one frame [C, H, W] with faults; it draws the same numbers whatever the kinds are."""
    border = _noise(clean.shape[1:], generator)
    salt = torch.rand(clean.shape[1:], generator=generator)
    mask = clean[t]
    if "holes" in kinds:
        mask = mask & ~_holes(scene, t, severity * worse)
    if "missing" in kinds:
        mask = mask & ~_disc(mask, regions.centre[t], regions.radius[t])
    if "shadow" in kinds:
        mask = mask | _shadow(clean[t], scene, t, severity)
    if "edges" in kinds:
        mask = _ragged(mask, border, _EDGE_SIZE * scene.height, severity * worse)
    if "noise" in kinds:
        mask = _median(mask ^ (salt < min(_NOISE * severity, _MOST)))
    return mask


# --- the kinds of faults --------------------------------------------------------------------------


def _holes(scene: _Scene, t: int, severity: float) -> Tensor:
    """Tell where the sum of both fields is above the quantile that the wanted share has."""
    top, left, height, width = scene.boxes[t].unbind(-1)
    shifts = torch.stack([top + height / 2, left + width / 2], -1).round().long().tolist()
    moved = [field.roll(shift, (0, 1)) for field, shift in zip(scene.clothes, shifts, strict=True)]
    field = (scene.background + torch.stack(moved)) / math.sqrt(2)
    share = torch.tensor(min(_HOLES * severity, _MOST))
    return field > torch.special.ndtri(1 - share)


def _shadow(clean: Tensor, scene: _Scene, t: int, severity: float) -> Tensor:
    """Return the lower part of the silhouette, flattened and turned sideways about the feet.

    A source pixel h above the feet falls `flatness` h above (or below) them and `shear` h beside.
    """
    C, H, W = clean.shape
    top, _, height, _ = (side.view(C, 1, 1) for side in scene.boxes[t].unbind(-1))
    feet = top + height - 1
    shear, flatness = scene.shear.view(C, 1, 1), scene.flatness.view(C, 1, 1)
    above = (feet - torch.arange(H).view(1, H, 1)) / flatness
    y = (feet - above).round().long()
    x = (torch.arange(W).view(1, 1, W) - shear * above).round().long()
    seen = (above >= 0) & (above <= _SHADOW_LENGTH * severity * height) & (height > 0)
    seen = seen & (y >= 0) & (y < H) & (x >= 0) & (x < W)
    source = clean[torch.arange(C).view(C, 1, 1), y.clamp(0, H - 1), x.clamp(0, W - 1)]
    return source & seen & (scene.background < 1.0)  # a dark floor hides part of it


def _ragged(mask: Tensor, noise: Tensor, size: float, severity: float) -> Tensor:
    """Return the mask with a ragged border: blurred, with noise that is strongest there, cut at half."""
    sigma = max(size, 0.7)
    soft = _blur(mask.float(), sigma)
    noise = _unit(_blur(noise, sigma))
    return soft + 4 * soft * (1 - soft) * _EDGE_STRENGTH * severity * noise > 0.5


def _median(mask: Tensor) -> Tensor:
    """Filter by the median of 3 x 3, or 5 x 5 for images of more than 300 rows."""
    size = 3 if mask.shape[-2] <= 300 else 5
    return avg_pool2d(mask.float(), size, 1, size // 2) > 0.5


def _disc(mask: Tensor, centre: Tensor, radius: Tensor) -> Tensor:
    H, W = mask.shape[-2:]
    y, x = centre.unsqueeze(-1).unbind(-2)
    dy = torch.arange(H).view(1, H, 1) - y.unsqueeze(-1)
    dx = torch.arange(W).view(1, 1, W) - x.unsqueeze(-1)
    return dy * dy + dx * dx < (radius * radius).view(-1, 1, 1)


# --- what is drawn once ---------------------------------------------------------------------------


def _scene(clean: Tensor, generator: torch.Generator) -> _Scene:
    boxes = _boxes(clean)
    heights = boxes[..., 2][boxes[..., 2] > 0]
    height = float(heights.median()) if len(heights) else clean.shape[-2] / 2
    shape, sigma = clean.shape[1:], max(_HOLE_SIZE * height, 0.7)
    background, clothes = (_unit(_blur(_noise(shape, generator), sigma)) for _ in range(2))
    draw = torch.rand(4, shape[0], generator=generator)
    low, high = _SHADOW_SHEAR
    shear = (low + (high - low) * draw[0]) * torch.where(draw[1] < 0.5, -1.0, 1.0)
    flatness = _SHADOW_FLATNESS * (0.6 + 0.8 * draw[2]) * torch.where(draw[3] < 0.5, -1.0, 1.0)
    return _Scene(background, clothes, shear, flatness, boxes, height)


def _regions(clean: Tensor, scene: _Scene, severity: float, generator: torch.Generator) -> _Regions:
    """Return lost regions that come and go, each at a place of its own relative to the silhouette's box."""
    T, C = clean.shape[:2]
    share = min(_MISSING * severity, _MOST)
    stop = 1 / _MISSING_FRAMES
    start = stop * share / (1 - share)
    low, high = _MISSING_RADIUS
    centre, radius = torch.zeros(T, C, 2), torch.zeros(T, C)
    draws = torch.rand(T, C, 3, generator=generator)
    for c in range(C):
        place: Tensor | None = None
        for t in range(T):
            switch, where, size = draws[t, c].tolist()
            if place is None and switch < (share if t == 0 else start):
                place = _thin_place(clean[t, c], scene.boxes[t, c], where, low * scene.height)
                extent = (low + (high - low) * size) * scene.height
            elif place is not None and switch < stop:
                place = None
            if place is not None:
                box = scene.boxes[t, c]
                centre[t, c], radius[t, c] = box[:2] + place * box[2:], extent
    return _Regions(centre, radius)


def _thin_place(mask: Tensor, box: Tensor, where: float, size: float) -> Tensor | None:
    """Return a pixel of the thinnest quarter of the mask, on a limb or the head, relative to its box."""
    pixels = mask.nonzero()
    if not len(pixels):
        return None
    thickness = _blur(mask.float().unsqueeze(0), size)[0][mask]
    thinnest = thickness.argsort(stable=True)[: len(pixels) // 4 + 1]
    chosen = pixels[thinnest[int(where * len(thinnest))]]
    return (chosen - box[:2]) / box[2:].clamp_min(1)


def _boxes(clean: Tensor) -> Tensor:
    sides = []
    for other in (-1, -2):
        filled = clean.any(other)
        first = filled.float().argmax(-1)
        last = filled.shape[-1] - 1 - filled.flip(-1).float().argmax(-1)
        sides.append((first, (last - first + 1) * filled.any(-1)))
    (top, height), (left, width) = sides
    return torch.stack([top, left, height, width], -1).float()


def _noise(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    return torch.randn(tuple(shape), generator=generator)


def _unit(fields: Tensor) -> Tensor:
    """Return fields [C, H, W] of unit variance."""
    return fields / fields.std((-2, -1), keepdim=True).clamp_min(1e-6)


def _blur(images: Tensor, sigma: float) -> Tensor:
    """Return images [C, H, W] blurred by a Gaussian, with the border repeated."""
    radius = math.ceil(3 * sigma)
    kernel = torch.exp(-0.5 * (torch.arange(-radius, radius + 1) / sigma) ** 2)
    kernel = (kernel / kernel.sum()).view(1, 1, 1, -1)
    padded = pad(images.unsqueeze(1), (radius,) * 4, mode="replicate")
    return conv2d(conv2d(padded, kernel), kernel.mT).squeeze(1)
