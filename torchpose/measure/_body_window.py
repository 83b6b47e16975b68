"""Cut windows about persons in units of their faces, and scale frames to their faces.

Hands are searched for in a window that goes with the person. A face height B is always ten cells, so
the cost of a frame does not depend on its size, and constants hold for every distance. A window stays
in place while the face is near its anchor, so that what rests in the image rests in the window.
Coordinates of a window are in B from its anchor. Coordinates of a map of the window are in its cells,
the centre of the first cell being 0."""

from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import NDArray
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose._core.images import Image
from torchpose._core.module_state import outside_inference
from torchpose.errors import InputError
from torchpose.measure._brightness import brightened, gain_to, quantile_of_bytes
from torchpose.measure._skin import SkinModel

CELL = 0.1  # side of a cell, in B
CELLS = (88, 96)  # rows and columns of cells
EVIDENCE, COLOURS = 2, 4  # pixels of the finer maps for each cell
_LEFT, _TOP = -0.5 * CELLS[1] * CELL, -3.2  # edges, in B from the anchor
_STEP = 12  # a window's columns are a multiple of this, so that its rows are whole pixels too
_DARK = 80.0  # brightness of the brightest parts of a window that needs no gain
_FACE_PART = tuple(  # every fourth pixel of the face in a window
    slice(round((middle - 0.5) / CELL * COLOURS), round((middle + 0.5) / CELL * COLOURS), COLOURS)
    for middle in (-_TOP, -_LEFT)
)
_FINEST = 3  # up to this many pixels to one are averaged; of more, some are left out


def place_windows(faces: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Return anchors (x, y, B) near faces, such that the window consists of whole pixels.

    The place differs from the face's by less than 1 % of B, the size by about 2 %. A window of whole
    pixels is quicker to cut than one between the pixels.
    """
    check_shape("faces", faces, ["N", 3])
    if not bool((torch.isfinite(faces).all(1) & (faces[:, 2] > 0)).all()):
        raise InputError(f"faces must be finite and of positive size, got {faces.tolist()}")
    faces = faces.double()
    step = _pixels_to_one(faces[:, 2])
    columns = (CELLS[1] * CELL * faces[:, 2] / step / _STEP).round().clamp_min(1) * _STEP
    size = columns * step / (CELLS[1] * CELL)
    corner = faces[:, :2] + size[:, None] * faces.new_tensor([_LEFT, _TOP]) + 0.5
    corner = (corner / step[:, None]).round() * step[:, None] - 0.5
    return torch.cat([corner - size[:, None] * faces.new_tensor([_LEFT, _TOP]), size[:, None]], 1)


def follow_faces(
    anchors: Float[Tensor, "N 3"],
    faces: Float[Tensor, "N 3"],
    stray: float = 0.5,
    rescale: float = 1.15,
) -> tuple[Float[Tensor, "N 3"], Bool[Tensor, " N"]]:
    """Return the anchors for the next frame: unchanged unless the face has moved too far.

    Args:
        anchors: (x, y, B) of the windows, pixels. faces: (x, y, B), pixels.
        stray: how far a face may be from its anchor, in B.
        rescale: largest ratio of the sizes of face and window.

    Returns:
        Anchors, and which ones were moved.
    """
    size = anchors[:, 2]
    far = (faces[:, :2] - anchors[:, :2]).abs().amax(1) > stray * size
    moved = far | ((faces[:, 2] / size).log().abs() > float(np.log(rescale)))
    if not bool(moved.any()):
        return anchors, moved
    placed = place_windows(faces).to(anchors)
    return torch.where(moved[:, None], placed, anchors), moved


def cut_windows(image: Image, anchors: Float[Tensor, "N 3"]) -> list[NDArray[np.uint8]]:
    """Return the image in each window, [352, 384] (or with channels), four pixels for a cell.

    OpenCV cuts and resizes, one person at a time: parts of an image of different sizes are no tensor.
    The image is averaged over whole blocks of pixels, then resized by bilinear interpolation. Its border is
    repeated beyond it.

    Args:
        image: [H, W] or [H, W, C]. anchors: from `place_windows`.
    """
    import cv2

    rows, columns = CELLS
    steps = _pixels_to_one(anchors[:, 2]).int().tolist()
    cut: list[NDArray[np.uint8]] = []
    for (x, y, size), step in zip(anchors.tolist(), steps, strict=True):
        width = round(columns * CELL * size / step)
        height = width * rows // columns
        left = round((x + _LEFT * size + 0.5) / step)
        top = round((y + _TOP * size + 0.5) / step)
        part, beyond = _blocks(image, left, top, width, height, step)
        whole = cv2.copyMakeBorder(part, *beyond, cv2.BORDER_REPLICATE) if any(beyond) else part
        target = (columns * COLOURS, rows * COLOURS)
        cut.append(cv2.resize(whole, target, interpolation=cv2.INTER_LINEAR))  # type: ignore[arg-type]
    return cut


def cut_colours(
    frame: Image, anchors: Float[Tensor, "N 3"], part: tuple[slice, slice]
) -> tuple[
    UInt8[Tensor, "N 3 h w"],
    Float[Tensor, "N 3 h w"],
    UInt8[Tensor, "N 3 p q"],
    Float[Tensor, " N"],
]:
    """Return the windows in Lab, bytes [N, 3, 176, 192], the same smoothed, a finer part [N, 3, p, q], gains.

    By OpenCV, for one person after the other, as in `cut_windows`. The colours of a pixel of the first lie
    side by side, as the network reads them fastest. A window that is dark, its face
    included, is multiplied by its gain [N], which is 1 for all others.

    Args:
        frame: RGB [H, W, 3]. anchors: from `place_windows`.
        part: rows and columns of the finer part, four pixels for a cell.
    """
    import cv2

    height, width = CELLS[0] * EVIDENCE, CELLS[1] * EVIDENCE
    labs = np.empty((len(anchors), height, width, 3), np.uint8)
    smooth = np.empty((len(anchors), 3, height, width), np.float32)
    parts = np.empty((*smooth.shape[:2], *(side.stop - side.start for side in part)), np.uint8)
    gains = np.ones(len(anchors))
    for n, window in enumerate(cut_windows(frame, anchors)):
        gains[n] = gain_to(_DARK, _brightest(window))
        window = brightened(window, gains[n])
        small = cv2.resize(window, (width, height), interpolation=cv2.INTER_AREA)
        cv2.cvtColor(small, cv2.COLOR_RGB2LAB, dst=labs[n])
        cv2.split(cv2.GaussianBlur(labs[n].astype(np.float32), (0, 0), 0.8), [*smooth[n]])
        cv2.split(cv2.cvtColor(window[part], cv2.COLOR_RGB2LAB), [*parts[n]])
    lab = torch.from_numpy(labs).permute(0, 3, 1, 2)
    return lab, torch.from_numpy(smooth), torch.from_numpy(parts), torch.from_numpy(gains)


def _brightest(window: Image) -> float:
    """Return the brightness of the brightest parts of a window, or of its face if that is brighter."""
    face = quantile_of_bytes(window[_FACE_PART], 0.9)
    return face if face >= _DARK else max(face, quantile_of_bytes(window[::8, ::8], 0.98))


def cut_mask(mask: Image, anchors: Float[Tensor, "N 3"]) -> Float[Tensor, "N h w"]:
    """Return the windows of a mask of 0 and 255, as shares [N, 176, 192].

    Args:
        mask: [H, W]. anchors: from `place_windows`.
    """
    return halve(torch.from_numpy(np.stack(cut_windows(mask, anchors))).float()) / 255


def halve(maps: Float[Tensor, "*batch h w"]) -> Float[Tensor, "*batch r c"]:
    """Return the means of two by two cells."""
    maps = maps[..., ::2, :] + maps[..., 1::2, :]
    return (maps[..., ::2] + maps[..., 1::2]) / 4


def _pixels_to_one(size: Tensor) -> Tensor:
    """Return the pixels of the image, along a side, that become about one of the window."""
    step = (size * CELL / COLOURS).round().clamp_min(1)
    return torch.where(step > _FINEST, 2 * (step / 2).round(), step)


def _blocks(
    image: Image, left: int, top: int, width: int, height: int, step: int
) -> tuple[Image, tuple[int, int, int, int]]:
    """Return the part of a smaller image that exists, and how much is missing above, below, left, right."""
    import cv2

    rows, columns = max(1, image.shape[0] // step), max(1, image.shape[1] // step)
    x0, x1 = (min(max(x, 0), columns) for x in (left, left + width))
    y0, y1 = (min(max(y, 0), rows) for y in (top, top + height))
    if x0 == x1:  # the window does not touch the image: the nearest column stands for it
        x0, x1 = min(x0, columns - 1), min(x0, columns - 1) + 1
    if y0 == y1:
        y0, y1 = min(y0, rows - 1), min(y0, rows - 1) + 1
    part = image[y0 * step : y1 * step, x0 * step : x1 * step]
    if step > _FINEST:
        some = (2 * (x1 - x0), 2 * (y1 - y0))
        part = cv2.resize(part, some, interpolation=cv2.INTER_NEAREST)  # type: ignore[assignment]
    if step > 1:
        part = cv2.resize(part, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    above, before = max(0, y0 - top), max(0, x0 - left)
    above, before = min(above, height - 1), min(before, width - 1)
    return part, (above, height - above - (y1 - y0), before, width - before - (x1 - x0))


def inside_image(
    anchors: Float[Tensor, "N 3"], width: int, height: int, per_cell: int = 1
) -> Float[Tensor, "N h w"]:
    """Return the share of each cell (or of its finer pixels) that lies in the image.

    Args:
        anchors: (x, y, B), pixels. width, height: of the image. per_cell: finer pixels to a cell.
    """
    return _inside(tuple(anchors.flatten().tolist()), width, height, per_cell)


@lru_cache(maxsize=16)
@outside_inference()
def _inside(anchors: tuple[float, ...], width: int, height: int, per_cell: int) -> Tensor:
    """Return `inside_image` of flat anchors; cached, since windows mostly stay in place."""
    place, share = torch.tensor(anchors, dtype=torch.float64).view(-1, 3), []
    sizes = ((CELLS[0], _TOP, 1, height), (CELLS[1], _LEFT, 0, width))
    for count, first, axis, pixels in sizes:
        edge = torch.arange(count * per_cell + 1, dtype=torch.float32) * (CELL / per_cell) + first
        at = place[:, axis, None] + edge * place[:, 2:] + 0.5
        at = at.clamp(0, pixels)
        share.append((at.diff(dim=1) / (place[:, 2:] * CELL / per_cell)).clamp_max(1))
    return (share[0][:, :, None] * share[1][:, None]).float()


@cache
@outside_inference()
def cell_centres(per_cell: int = 1) -> Float[Tensor, "h w 2"]:
    """Return the places (x, y) of the cells (or of their finer pixels), in B from the anchor."""
    rows, columns = CELLS[0] * per_cell, CELLS[1] * per_cell
    x = _LEFT + (torch.arange(columns, dtype=torch.float32) + 0.5) * (CELL / per_cell)
    y = _TOP + (torch.arange(rows, dtype=torch.float32) + 0.5) * (CELL / per_cell)
    return torch.stack(torch.broadcast_tensors(x, y[:, None]), -1).contiguous()


def part_of_window(
    low: Float[Tensor, "N 2"], high: Float[Tensor, "N 2"], per_cell: int
) -> tuple[slice, slice]:
    """Return the rows and columns of maps of a window that hold all boxes, as far as they lie in it.

    Args:
        low, high: corners (x, y) of the boxes, in B from the anchors.
        per_cell: pixels of the maps for each cell.
    """
    first, per_b = low.new_tensor([_LEFT, _TOP]), per_cell / CELL
    start = ((low.amin(0) - first) * per_b).floor().int().clamp_min(0).tolist()
    stop = ((high.amax(0) - first) * per_b).ceil().int().clamp_min(0).tolist()
    columns, rows = (slice(*ends) for ends in zip(start, stop, strict=True))
    return rows, columns


@cache
@outside_inference()
def cell_axes() -> tuple[Float[Tensor, " c"], Float[Tensor, " r"]]:
    """Return the places of the columns and rows of cells, in B from the anchor."""
    places = cell_centres()
    return places[0, :, 0].contiguous(), places[:, 0, 1].contiguous()


def pixels_to_cells(
    points: Float[Tensor, "N K 2"], anchors: Float[Tensor, "N 3"]
) -> Float[Tensor, "N K 2"]:
    """Convert places in the image to places in cells, the first cell's centre being 0."""
    first = points.new_tensor([_LEFT, _TOP]) + CELL / 2
    return ((points - anchors[:, None, :2]) / anchors[:, None, 2:] - first) / CELL


def cells_to_pixels(
    places: Float[Tensor, "N K 2"], anchors: Float[Tensor, "N 3"]
) -> Float[Tensor, "N K 2"]:
    """Convert places in cells to places in the image."""
    first = places.new_tensor([_LEFT, _TOP]) + CELL / 2
    return anchors[:, None, :2] + (places * CELL + first) * anchors[:, None, 2:]


def faces_in_window(
    faces: Float[Tensor, "N 3"], anchors: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3"]:
    """Return the faces (x, y, size), pixels, in B from the anchors of their windows."""
    return (torch.cat([faces[:, :2] - anchors[:, :2], faces[:, 2:]], 1) / anchors[:, 2:]).float()


def faces_in_evidence(
    faces: Float[Tensor, "N 3"], anchors: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3"]:
    """Return the faces (x, y, B) in pixels of the finer maps, the first pixel's centre being 0."""
    at = pixels_to_cells(faces[:, None, :2], anchors)[:, 0]
    size = faces[:, 2:] / (anchors[:, 2:] * CELL)
    return torch.cat([(at + 0.5) * EVIDENCE - 0.5, size * EVIDENCE], 1).float()


def move_maps(
    maps: Float[Tensor, "N C h w"],
    old: Float[Tensor, "N 3"],
    new: Float[Tensor, "N 3"],
    replicate: bool = False,
) -> Float[Tensor, "N C h w"]:
    """Return maps of the old windows as maps of the new ones; zero (or the border) outside of the old."""
    per_cell = maps.shape[-2] // CELLS[0]
    middle = maps.new_tensor([0.0, _TOP + 0.5 * CELLS[0] * CELL])
    half = maps.new_tensor([-_LEFT, 0.5 * CELLS[0] * CELL])
    at = cell_centres(per_cell).to(maps)
    scale = (new[:, 2] / old[:, 2]).to(maps)[:, None, None, None]
    shift = ((new[:, :2] - old[:, :2]) / old[:, 2:]).to(maps)[:, None, None]
    grid = (at * scale + shift - middle) / half
    padding = "border" if replicate else "zeros"
    return torch.nn.functional.grid_sample(
        maps, grid, mode="bilinear", padding_mode=padding, align_corners=False
    )


_FACE_PIXELS = 19.0  # size of a face: a window on a hand is then some 15 pixels wide
_LARGEST_SIDE = 640
# Lengths in sizes of the face.
_FACE = (0.65, -0.1, 0.9)  # half the width, centre and half the height of the ellipse taken out
_NECK = (0.4, 1.1)  # half the width, bottom


class ScaledFrame(NamedTuple):
    """Holds the scaled frame in which hands are searched for.

    Attributes:
        bins: number of each pixel's colour (`SkinModel.byte_bins`).
        usable: which pixels may show a hand: neither face, neck nor background.
        faces: (x, y) and size of all N faces, pixels of this image.
        scale: pixels of this image for one of the frame, across and down.
    """

    bins: Int[Tensor, "H W"]
    usable: Bool[Tensor, "H W"]
    faces: Float[Tensor, "N 3"]
    scale: Float[Tensor, " 2"]

    def from_frame(self, points: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Return the points (x, y) of the frame in pixels of this image."""
        # a pixel's centre has whole coordinates, its corner half of one less
        return (points + 0.5) * self.scale - 0.5

    def to_frame(self, points: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Return the points (x, y) of this image in pixels of the frame."""
        return (points + 0.5) / self.scale - 0.5


def scales_of_faces(faces: Float[Tensor, "N 3"], frame: Image) -> Int[Tensor, " N"]:
    """Return the pixels of the frame for one of the image in which each face has a size of some 19 pixels."""
    least = max(frame.shape[:2]) / _LARGEST_SIDE
    return (faces[:, 2] / _FACE_PIXELS).clamp_min(least).round().clamp_min(1).long()


def scale_frame(
    frame: Image,
    foreground: Image | None,
    faces: Float[Tensor, "N 3"],
    divisor: int,
    skin: SkinModel,
) -> ScaledFrame:
    """Return the frame scaled down by a divisor, with the pixels that may show hands.

    Args:
        frame: RGB [H, W, 3]. foreground: [H, W], 0 where there is background; None is foreground
            everywhere. faces: (x, y) and size of all faces, pixels of the frame.
        divisor: one of `scales_of_faces`. skin: the model whose bins are taken.
    """
    height, width = (max(round(n * (1 / divisor)), 1) for n in frame.shape[:2])
    scale = faces.new_tensor([width / frame.shape[1], height / frame.shape[0]])
    places = torch.cat([(faces[:, :2] + 0.5) * scale - 0.5, faces[:, 2:] * scale.mean()], 1)
    usable = _not_head(places, (height, width))
    if foreground is not None:
        usable = usable & torch.from_numpy(_resized(foreground, height, width) > 0)
    return ScaledFrame(_bins(skin, _resized(frame, height, width)), usable, places, scale)


def _bins(skin: SkinModel, image: Image) -> Tensor:
    import cv2

    lab = torch.from_numpy(cv2.cvtColor(image, cv2.COLOR_RGB2Lab)).permute(2, 0, 1)[None]
    return skin.byte_bins(lab)[0]


def _resized(image: Image, height: int, width: int) -> Image:
    import cv2

    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)


def _not_head(faces: Tensor, shape: tuple[int, int]) -> Tensor:
    """Return a mask that is False on the faces and necks of all persons, [H, W]."""
    x, y, size = faces[:, :, None, None].unbind(1)
    across = ((torch.arange(shape[1]).to(faces) - x) / size).abs()
    down = (torch.arange(shape[0]).to(faces)[:, None] - y) / size
    head = ((across / _FACE[0]).square() + ((down - _FACE[1]) / _FACE[2]).square() < 1).any(0)
    neck = ((across < _NECK[0]) & (down > 0) & (down < _NECK[1])).any(0)
    return ~(head | neck)
