"""Measure head and neck from the face (BL section 5), and detect hands in front of faces."""

from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from torchpose._core.checks import check_shape
from torchpose._core.module_state import outside_inference
from torchpose.errors import InputError
from torchpose.measure._body_window import CELL, COLOURS, EVIDENCE, cell_centres, faces_in_window

_ROWS, _COLUMNS = 104, 72  # of the remembered patch: head and neck
_HALF_WIDTH, _TOP, _HEIGHT = 1.0, -1.0, 2.6  # of the patch, in B from the face's centre
_SEARCH = 8  # pixels of the patch to each side
_MODEL, _INNER = (slice(4, 58), slice(2, 70)), (slice(12, 50, 2), slice(10, 62, 2))
_WHOLE = (slice(None), slice(None))
_EYES = (slice(14, 56, 2), slice(18, 56, 2))
_BLUR = 13  # pixels of the patch: about a third of a face, half a hand
_LEAST_MATCH = 0.6
_FIRST = 7  # frames that are averaged with equal weights
_HAND = 0.2  # probability of a hand above which the average adapts slowly
# Ellipse of the head, and rectangle of the neck, in B from the face's centre.
_HEAD_AXES, _HEAD_DOWN, _NECK, _SOFT = (0.575, 0.8), -0.05, (0.42, 0.4, 1.05), 0.06
_PART_ROWS, _PART_COLUMNS = slice(8, 62), slice(24, 72)  # cells of the window where a head can be


class FaceOffsets(NamedTuple):
    """Holds the offsets of head and neck below the centre of the face, in sizes B of its bounding box.

    head = centre + B (0, a) + N(0, B^2 s_a^2),   neck = centre + B (0, b) + N(0, B^2 s_b^2)

    Attributes:
        head, neck: a and b. head_std, neck_std: (across, down), s_a and s_b.
    """

    head: float
    neck: float
    head_std: tuple[float, float]
    neck_std: tuple[float, float]


# Silhouettes of eight persons and their Kinect skeletons put the head joint 0.47 of the way from the
# crown to the narrowest part of the neck, and the neck joint 0.89 of it further down; faces of three
# persons put crown and neck at -0.71 and 0.55 B. That gives a = -0.12 and b = 1.01. In webcam clips,
# with elbows measured by persons' fits that left them out, elbows and shoulders are nearest to
# MediaPipe's at b = 0.9 or less; 3D errors of rendered performers are least at 1.0.
FACE_OFFSETS = FaceOffsets(-0.2, 0.95, (0.05, 0.08), (0.07, 0.12))
# Where no network measures elbows, a lower neck is better on signers and rendered performers, and worse
# on other people in close-ups.
WITHOUT_ELBOWS = FACE_OFFSETS._replace(neck=1.0)


class HeadNeck(nn.Module):
    """Measures head and neck from the face, with covariances.

    Args:
        offsets: of the prior's head and neck from the centre of the detector's bounding box.

    Raises:
        InputError: standard deviations that are not positive.

    Reference:
        Burke & Lasenby, section 5.1: the face gives the head. Their sign-language tracker puts the
        neck 45 pixels below it.

    Example:
        >>> import torch
        >>> points, covariance = HeadNeck()(torch.tensor([[320.0, 100.0, 80.0]]))
        >>> points[0].tolist()
        [[320.0, 84.0], [320.0, 176.0]]
    """

    def __init__(self, offsets: FaceOffsets = FACE_OFFSETS) -> None:
        super().__init__()
        stds = (offsets.head_std, offsets.neck_std)
        if not all(std > 0 for pair in stds for std in pair):
            raise InputError(f"standard deviations of the offsets must be positive, got {stds}")
        down = torch.tensor([[0.0, offsets.head], [0.0, offsets.neck]], dtype=torch.float64)
        self.register_buffer("offset", down)
        self.register_buffer("std", torch.tensor(stds, dtype=torch.float64))

    offset: Tensor
    std: Tensor

    def forward(
        self, faces: Float[Tensor, "N 3"], face_cov: Float[Tensor, "N 3 3"] | None = None
    ) -> tuple[Float[Tensor, "N 2 2"], Float[Tensor, "N 2 2 2"]]:
        """Return the head and neck, in this order, and their covariances, pixels.

        Args:
            faces: centre (x, y) and size B, pixels. face_cov: their covariance.

        Returns:
            Head and neck [N, 2, 2], pixels, and their covariances [N, 2, 2, 2], squared pixels.

        Raises:
            ShapeError: faces of another shape.
        """
        check_shape("faces", faces, ["N", 3])
        faces = faces.to(self.offset)
        centre, size = faces[:, None, :2], faces[:, None, 2:]
        cov = torch.diag_embed((size * self.std).square())
        if face_cov is not None:
            slope = torch.eye(2, 3).to(faces).repeat(2, 1, 1)
            slope[:, :, 2] = self.offset
            cov = cov + slope @ face_cov.to(faces)[:, None] @ slope.mT
        return centre + size * self.offset, cov

    if TYPE_CHECKING:  # nn.Module has Any
        __call__ = forward


def head_part(per_cell: int) -> tuple[slice, slice]:
    """Return the rows and columns of a map of the window in which head and neck lie."""
    return tuple(  # type: ignore[return-value]
        slice(part.start * per_cell, part.stop * per_cell) for part in (_PART_ROWS, _PART_COLUMNS)
    )


class FaceMemoryState(NamedTuple):
    """Holds the remembered faces of N persons.

    Attributes:
        mean: Lab in bytes, averaged [N, 3, 104, 72]. deviation: averaged difference [N, 104, 72].
        frames: seen so far [N].
    """

    mean: Float[Tensor, "N 3 104 72"]
    deviation: Float[Tensor, "N 104 72"]
    frames: Int[Tensor, " N"]


class FaceMemory(nn.Module):
    """Computes the change of head and neck against their average appearance.

        d = blur |Lab - mean|_1,   change = clip((d - (k s + f + m median_eyes d)) / scale, 0, 1)

    The patch is first aligned with the remembered upper half of the face by normalised correlation.
    Mean and deviation s adapt slowly, and more slowly where a hand is probable. The median over the
    eyes removes changes of the whole face, such as motion or illumination.

    Args:
        deviations: k. floor: f. median: m. scale: of the change; all in steps of Lab in bytes.
        align: whether to align the patch. remember: if not, head and neck always count as unchanged.
        rate: frames at 30 per second that pass in one step.
    """

    def __init__(
        self,
        deviations: float = 1.5,
        floor: float = 2.0,
        median: float = 0.1,
        scale: float = 4.0,
        align: bool = True,
        rate: float = 1.0,
        remember: bool = True,
    ) -> None:
        super().__init__()
        self.deviations, self.floor, self.median, self.scale = deviations, floor, median, scale
        self.align, self.rate, self.remember = align, rate, remember
        self.register_buffer(
            "channel_weights", torch.tensor([0.5, 1.0, 1.0], dtype=torch.float32).view(3, 1, 1)
        )
        self.register_buffer("blur_rows", _box(_ROWS, _BLUR))
        self.register_buffer("blur_columns", _box(_COLUMNS, _BLUR).T.contiguous())
        self.register_buffer(
            "pixel",
            torch.tensor([2 * _HALF_WIDTH / _COLUMNS, _HEIGHT / _ROWS], dtype=torch.float32),
        )

    channel_weights: Tensor
    blur_rows: Tensor
    blur_columns: Tensor
    pixel: Tensor

    def init(self, persons: int) -> FaceMemoryState:
        """Return the state before the first frame."""
        zero = self.blur_rows.new_zeros(persons)
        return FaceMemoryState(
            zero.view(-1, 1, 1, 1).repeat(1, 3, _ROWS, _COLUMNS),
            zero.view(-1, 1, 1).repeat(1, _ROWS, _COLUMNS) + 2,
            zero.long(),
        )

    def step(
        self,
        state: FaceMemoryState,
        lab: UInt8[Tensor, "N 3 h w"],
        faces: Float[Tensor, "N 3"],
        anchors: Float[Tensor, "N 3"],
        hands: Float[Tensor, "N r c"],
    ) -> tuple[FaceMemoryState, Float[Tensor, "N R C"]]:
        """Compare a frame with the remembered faces, and update these.

        Args:
            state: from `init` or the step before.
            lab: `head_part` of the windows, bytes as OpenCV has them [N, 3, 216, 192].
            faces: (x, y, B), pixels, B steady. anchors: of the windows, pixels.
            hands: probability that a cell belongs to a hand [N, 88, 96].

        Returns:
            The next state, and a mask at every pixel of evidence of `head_part` [N, 108, 96]: one on
            head and neck, zero elsewhere and where they have changed.
        """
        rows, columns = head_part(COLOURS)
        check_shape(
            "lab", lab, [len(faces), 3, rows.stop - rows.start, columns.stop - columns.start]
        )
        new = state.frames == 0
        at = faces_in_window(faces, anchors)
        if not self.remember:
            return state, _to_window(head_mask().expand(len(at), -1, -1), at)
        near = lab.to(at)
        if self.align:
            inner = _sample(near[:, :1], at, _INNER)[:, 0]
            shift = _best_shift(state.mean[:, 0], inner).masked_fill_(new[:, None], 0)
            at = torch.cat([at[:, :2] + shift * self.pixel * at[:, 2:], at[:, 2:]], 1)
        patch = _sample(near, at)
        mean = state.mean
        if bool(new.any()):
            mean = torch.where(new[:, None, None, None], patch, mean)
        error = patch - mean
        difference = (error.abs() * self.channel_weights).sum(1)
        difference = self.blur_rows @ difference @ self.blur_columns
        eyes = difference[:, _EYES[0], _EYES[1]].flatten(1).median(1).values[:, None, None]
        usual = self.deviations * state.deviation + self.floor + self.median * eyes
        change = ((difference - usual) / self.scale).clamp_(0, 1)
        in_front = _sample(hands[:, None, _PART_ROWS, _PART_COLUMNS], at) > _HAND
        state = self._learn(state._replace(mean=mean), error, difference, in_front)
        return state, _to_window(head_mask() * (1 - change), at)

    def _learn(
        self, state: FaceMemoryState, error: Tensor, difference: Tensor, in_front: Tensor
    ) -> FaceMemoryState:
        frames = state.frames + 1
        limit = torch.where(in_front, error.new_tensor(0.05 * self.rate), 0.15 * self.rate)
        step = torch.minimum(torch.maximum(error, -limit), limit)
        if bool((frames <= _FIRST).any()):
            share = torch.where(in_front, 0.004, 1 / (frames.to(error) + 1)[:, None, None, None])
            step = torch.where((frames <= _FIRST)[:, None, None, None], share * error, step)
        excess = (difference - state.deviation).clamp_(-0.2, 0.2)
        deviation = state.deviation.add(excess, alpha=0.05 * self.rate)
        return state._replace(mean=state.mean + step, deviation=deviation, frames=frames)


@cache
@outside_inference()
def head_mask() -> Float[Tensor, "104 72"]:
    """Return a map over the patch that is one on head and neck and zero elsewhere, with soft edges."""
    x, y = _patch_places().unbind(-1)
    half_x, half_y = _HEAD_AXES
    radius = ((x / half_x).square() + ((y - _HEAD_DOWN) / half_y).square()).sqrt()
    head = 0.5 + (1 - radius) * (0.5 * (half_x + half_y) / (2 * _SOFT))
    half, top, bottom = _NECK
    across = (0.5 + (half - x.abs()) / (2 * _SOFT)).clamp(0, 1)
    down = (0.5 + torch.minimum(y - top, bottom - y) / (2 * _SOFT)).clamp(0, 1)
    return torch.maximum(head.clamp(0, 1), down * across)


def _box(size: int, width: int) -> Tensor:
    """Return the matrix of a mean over `width` neighbours; beyond the ends the row is mirrored."""
    place = torch.arange(size)[:, None] + torch.arange(width) - width // 2
    place = place.abs()
    place = torch.where(place >= size, 2 * (size - 1) - place, place)
    ones = torch.ones(size, width, dtype=torch.float32)
    return ones.new_zeros(size, size).scatter_add_(1, place, ones) / width


@cache
@outside_inference()
def _patch_places() -> Tensor:
    x = (torch.arange(_COLUMNS, dtype=torch.float32) + 0.5) * (
        2 * _HALF_WIDTH / _COLUMNS
    ) - _HALF_WIDTH
    y = (torch.arange(_ROWS, dtype=torch.float32) + 0.5) * (_HEIGHT / _ROWS) + _TOP
    return torch.stack(torch.broadcast_tensors(x, y[:, None]), -1).contiguous()


def _sample(part: Tensor, at: Tensor, places: tuple[slice, slice] = _WHOLE) -> Tensor:
    """Return the patch of head and neck, or some of its pixels, from `head_part` of a map."""
    (x, y), middle, half = _part_grid()
    across, down = ((at[:, :2] - middle) / half)[..., None].unbind(1)
    x = x[places[1]] * at[:, 2:] + across
    y = y[places[0]] * at[:, 2:] + down
    grid = _pairs(x, y)
    return nn.functional.grid_sample(part, grid, padding_mode="border", align_corners=False)


def _pairs(x: Float[Tensor, "N w"], y: Float[Tensor, "N h"]) -> Float[Tensor, "N h w 2"]:
    """Return the places with these coordinates of columns and rows."""
    grid = x.new_empty(len(x), y.shape[1], x.shape[1], 2)
    grid[..., 0], grid[..., 1] = x[:, None], y[:, :, None]
    return grid


@cache
@outside_inference()
def _part_grid() -> tuple[tuple[Tensor, Tensor], Tensor, Tensor]:
    """Return the columns and rows of the patch in halves of `head_part`, its middle, and these halves."""
    part = cell_centres()[_PART_ROWS, _PART_COLUMNS]
    half = (part[-1, -1] - part[0, 0] + CELL) / 2
    places = _patch_places() / half
    columns, rows = places[0, :, 0].contiguous(), places[:, 0, 1].contiguous()
    return (columns, rows), (part[-1, -1] + part[0, 0]) / 2, half


def _best_shift(model: Tensor, inner: Tensor) -> Tensor:
    """Return the shift of the face from the middle of its patch [N, 2], in pixels of it.

    By normalised correlation at every shift, over every second pixel.

    Args:
        model: the remembered lightness. inner: lightness of the pixels `_INNER` of the patch.
    """
    model = model[:, _MODEL[0], _MODEL[1]]
    model = model - model.mean((1, 2), keepdim=True)  # so that squares lose no digits
    (n, height, width), shifts = inner.shape, 2 * _SEARCH + 1
    per_model, per_row, _ = model.stride()
    windows = model.as_strided(
        (n, height, width, shifts, shifts), (per_model, 2 * per_row, 2, per_row, 1)
    ).reshape(n, height * width, shifts * shifts)
    inner = (inner - inner.mean((1, 2), keepdim=True)).view(n, 1, -1)
    rows, columns = _every_second(height), _every_second(width).mT
    mean, power = rows @ model @ columns, rows @ model.square() @ columns
    variance = (power - mean.square()).flatten(1)
    norm = variance * (height * width) * inner.square().sum(2)
    score, best = ((inner @ windows)[:, 0] * norm.clamp_min(1.0).rsqrt()).max(1)
    shift = _SEARCH - torch.stack([best % shifts, best // shifts], 1)
    return torch.where((score > _LEAST_MATCH)[:, None], shift, 0)


@cache
@outside_inference()
def _every_second(size: int) -> Tensor:
    """Return the matrix of means over `size` places, every second one, from each shift."""
    shift = torch.arange(2 * _SEARCH + 1)[:, None]
    away = torch.arange(2 * _SEARCH + 2 * size)[None] - shift
    return ((away >= 0) & (away < 2 * size) & (away % 2 == 0)).float() / size


def _to_window(patch: Tensor, at: Tensor) -> Tensor:
    (x, y), middle, half = _window_grid()
    across, down = (at[:, :2] / half)[..., None].unbind(1)
    (left, top), size = middle / half, at[:, 2:]
    grid = _pairs((x - across) / size - left, (y - down) / size - top)
    return nn.functional.grid_sample(patch[:, None], grid, align_corners=False)[:, 0]


@cache
@outside_inference()
def _window_grid() -> tuple[tuple[Tensor, Tensor], Tensor, Tensor]:
    """Return the columns and rows of `head_part` in halves of the patch, its middle, and these halves."""
    half = torch.tensor([_HALF_WIDTH, _HEIGHT / 2], dtype=torch.float32)
    places = cell_centres(EVIDENCE)[head_part(EVIDENCE)] / half
    columns, rows = places[0, :, 0].contiguous(), places[:, 0, 1].contiguous()
    return (columns, rows), half.new_tensor([0.0, _TOP + _HEIGHT / 2]), half
