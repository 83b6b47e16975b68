"""Measure silhouettes of one person in the synchronised videos of calibrated cameras."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from numpy.typing import NDArray
from torch import Tensor

from torchpose._core.checks import check_rgb
from torchpose._core.images import Image
from torchpose.camera._choice import is_padded
from torchpose.camera._lens import undistortion_maps
from torchpose.camera._pinhole import PinholeCamera
from torchpose.camera._projection import intrinsics, scale_matrix
from torchpose.errors import CameraError, InputError
from torchpose.measure._brightness_background import BrightnessBackground, PixelKind
from torchpose.video._source_interface import VideoFrame, VideoSource

_PART = 0.03  # of the largest piece: smaller ones are no part of the person
_HOLE = 0.02  # of the silhouette: larger holes are real, such as between arm and body
_STILL, _SAME = 0.9, 18  # share of the frames, and grey levels, of a static pixel
_ENLARGED = 4  # times the height of the images, at most
_LEARNING_FRAMES = 120  # spread over the video


class SilhouetteView(NamedTuple):
    """Holds the mapping of a camera's images to silhouettes of a common size.

    Attributes:
        camera: the camera of the silhouettes, without distortion. size: (width, height) of a frame of the
            video.
        padding: columns at the right and rows below that the calibrated image has and the video lacks.
        inner: (width, height) of the image in the silhouette; the rest is empty.
        source: the camera as calibrated.
    """

    camera: PinholeCamera
    size: tuple[int, int]
    padding: tuple[int, int]
    inner: tuple[int, int]
    source: PinholeCamera


def fit_view(
    camera: PinholeCamera, size: tuple[int, int], height: int, width: int
) -> SilhouetteView:
    """Return a camera scaled so that its image fits into height x width; pixel centres are integers.

    Args:
        camera: calibrated for `size`, or for that with up to 15 columns and rows more at the right
            and below, as codecs store them.
        size: (width, height) of the video, pixels. height, width: of the silhouettes.

    Raises:
        CameraError: the calibration is for images of another size.

    >>> view = fit_view(PinholeCamera(1000, 1000, 499.5, 499.5, 1000, 1000), (1000, 1000), 120, 160)
    >>> view.inner, [round(float(x), 2) for x in view.camera.matrix[0]]
    ((120, 120), [120.0, 0.0, 59.5])
    """
    calibrated = size if camera.image_size is None else camera.image_size
    padding = (calibrated[0] - size[0], calibrated[1] - size[1])
    if not is_padded(calibrated, size):
        raise CameraError(
            f"camera {camera.name!r} is calibrated for {calibrated[0]} x {calibrated[1]} pixels, and "
            f"its video has {size[0]} x {size[1]}: calibrate at the size of the video, or give a "
            "camera file whose matrix and size are scaled to it"
        )
    scale = min(width / calibrated[0], height / calibrated[1])
    inner = (min(width, round(calibrated[0] * scale)), min(height, round(calibrated[1] * scale)))
    x, y = inner[0] / calibrated[0], inner[1] / calibrated[1]
    fx, fy, skew, cx, cy = map(float, intrinsics(scale_matrix(camera.matrix, x, y)))
    scaled = PinholeCamera(
        fx, fy, cx, cy, width, height, camera.name, skew=skew,
        rotation=camera.rotation.tolist(), translation=camera.translation.tolist(),
    )  # fmt: skip
    return SilhouetteView(scaled, size, padding, inner, camera)


def fit_views(
    cameras: Sequence[PinholeCamera], sizes: Sequence[tuple[int, int]], rows: int
) -> list[SilhouetteView]:
    """Return `fit_view` of each camera, in images of `rows` rows that are wide enough for all.

    Raises:
        CameraError: as `fit_view`. InputError: many more rows than the images have.
    """
    shapes = [camera.image_size or size for camera, size in zip(cameras, sizes, strict=True)]
    tallest = max(height for _, height in shapes)
    if rows > _ENLARGED * tallest:
        raise InputError(
            f"silhouettes of {rows} rows take long, and tell no more than the images of {tallest} rows; give "
            f"rows (--rows) of {tallest} at most"
        )
    width = max(round(w * rows / h) for w, h in shapes)
    return [
        fit_view(camera, size, rows, width) for camera, size in zip(cameras, sizes, strict=True)
    ]


def clean_silhouette(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a foreground mask of one person without specks and small holes.

    A median filter removes single pixels, and a closing joins pieces that are a pixel apart. Pieces of
    less than 3 % of the largest one are removed. Small holes are filled.

    Args:
        mask: True on the foreground [H, W].
    """
    import cv2

    smooth = cv2.medianBlur(mask.astype(np.uint8), 3)
    closed = cv2.morphologyEx(smooth, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    kept = _pieces(np.asarray(closed, np.uint8), _PART)
    area = int(kept.sum())
    holes = _areas(1 - kept)
    fill = np.flatnonzero(holes.areas < _HOLE * area)
    return np.asarray((kept > 0) | np.isin(holes.labels, fill[fill > 0]))


class _Areas(NamedTuple):
    labels: NDArray[np.int32]
    areas: NDArray[np.int64]


def _areas(mask: NDArray[np.uint8]) -> _Areas:
    """Return the connected pieces by number, 0 outside of them, and their pixel counts."""
    import cv2

    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    areas = stats[:, cv2.CC_STAT_AREA].astype(np.int64)
    return _Areas(np.asarray(labels, np.int32), areas)


def _pieces(mask: NDArray[np.uint8], share: float) -> NDArray[np.uint8]:
    pieces = _areas(mask)
    if len(pieces.areas) < 2:
        return np.zeros_like(mask)
    kept = np.flatnonzero(pieces.areas >= share * pieces.areas[1:].max())
    return np.isin(pieces.labels, kept[kept > 0]).astype(np.uint8)


class SilhouetteMeasurer:
    """Measures silhouettes of one camera: undistorts, scales, subtracts the background, cleans.

    Args:
        view: from `fit_view`.
        empty: RGB frames of the empty scene [N, H, W, 3], uint8, with or without the padding; then
            the background is a `BrightnessBackground`, which detects shadows. None takes `frames`.
        frames: RGB frames spread over the video itself. With `empty`, pixels that are static in nine
            of ten of them show an object that was moved since the scene was empty, and count as
            background. Without `empty`, OpenCV's MOG2 learns the background from them, and a person
            who does not move becomes background.

    Raises:
        InputError: neither. ShapeError, InputError: frames of another size or kind.
    """

    def __init__(
        self,
        view: SilhouetteView,
        empty: Iterable[Image] | None = None,
        frames: Iterable[Image] | None = None,
    ) -> None:
        self.view = view
        self._maps = _undistortion(view)
        # one by one, since frames are large and only scaled ones are kept
        without = [
            self._prepare(frame, "pictures of the empty scene")
            for frame in (() if empty is None else empty)
        ]
        shown = [self._prepare(frame) for frame in (() if frames is None else frames)]
        if not without and not shown:
            raise InputError("give frames of the empty scene, or frames of the video itself")
        self._background: BrightnessBackground | None = None
        self._moved: _Moved | None = None
        if without:
            self._background = BrightnessBackground().fit(_stack(without))
            if shown:
                self._moved = _find_moved(_stack(shown))
        else:
            self._mixture = _learn(shown)

    def __call__(self, frame: Image) -> NDArray[np.bool_]:
        """Return the silhouette in a frame: bool, of the size of the view's camera [height, width].

        Args:
            frame: RGB, of the size of the video.
        """
        small = self._prepare(frame)
        width, height = self.view.camera.image_size or self.view.inner
        found = np.zeros((int(height), int(width)), dtype=bool)
        found[: small.shape[0], : small.shape[1]] = clean_silhouette(self._foreground(small))
        return found

    def _foreground(self, small: Image) -> NDArray[np.bool_]:
        if self._background is not None:
            image = _tensor(small)
            found = self._background(image) == PixelKind.FOREGROUND
            if self._moved is not None:
                found &= ~(self._moved.still & _is_near(image, self._moved.colour))
            return found.numpy()
        return np.asarray(self._mixture.apply(small, None, 0.0) == 255)

    def _prepare(self, frame: Image, what: str = "frames") -> Image:
        """Return a frame padded, undistorted and scaled; `what` it is of, for messages."""
        import cv2

        check_rgb("frame", frame, empty=False)
        (width, height), (right, below) = self.view.size, self.view.padding
        whole: Any = frame
        if frame.shape[1::-1] == (width, height):
            whole = cv2.copyMakeBorder(frame, 0, below, 0, right, cv2.BORDER_REPLICATE)
        elif frame.shape[1::-1] != (width + right, height + below):
            raise InputError(
                f"{what} of camera {self.view.camera.name!r} must have {width} x {height} pixels as its "
                f"video, got {frame.shape[1]} x {frame.shape[0]}"
            )
        if self._maps is not None:
            whole = cv2.remap(whole, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(cv2.resize(whole, self.view.inner, interpolation=cv2.INTER_AREA))


def _tensor(image: Image) -> UInt8[Tensor, "3 H W"]:
    return torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)


def _stack(images: Sequence[Image]) -> UInt8[Tensor, "N 3 H W"]:
    return torch.stack([_tensor(image) for image in images])


def _learn(images: Sequence[Image]) -> Any:
    """Return OpenCV's MOG2 with the background of all the images."""
    import cv2

    mixture = cv2.createBackgroundSubtractorMOG2(len(images), 16.0, True)
    for image in images:
        mixture.apply(image, None, 1 / len(images))
    return mixture


class _Moved(NamedTuple):
    """Holds the median colours of a video [3, H, W], and where it is static [H, W]."""

    colour: Tensor
    still: Tensor


def _find_moved(frames: UInt8[Tensor, "N 3 H W"]) -> _Moved:
    colour = frames.median(0).values
    return _Moved(colour, _is_near(frames, colour).double().mean(0) >= _STILL)


def _is_near(images: Tensor, colour: Tensor) -> Tensor:
    return (images.int() - colour.int()).abs().amax(-3) <= _SAME


def _undistortion(view: SilhouetteView) -> tuple[np.ndarray, np.ndarray] | None:
    """Return `undistortion_maps` of the image with its padding."""
    camera = view.source
    size = (view.size[0] + view.padding[0], view.size[1] + view.padding[1])
    return undistortion_maps(camera.matrix, camera.distortions, camera.fisheye, size)


def learning_frames(source: VideoSource) -> Iterator[Image]:
    """Return some frames spread over a video, to learn its background."""
    count = source.n_frames or _LEARNING_FRAMES
    stride = max(1, count // _LEARNING_FRAMES)
    spread = (frame.image for frame in source if frame.index % stride == 0)
    return islice(spread, 2 * _LEARNING_FRAMES)


def read_empty_scene(path: str | Path) -> list[Image]:
    """Return frames of the empty scene, from a picture, a folder of pictures or a video.

    Raises:
        InputError: no such file. FileFormatError: neither a picture nor a video.
    """
    import cv2

    from torchpose.video._source import open_video

    if Path(path).is_file():
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if picture is not None:
            return [np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)]
    with open_video(str(path)) as source:
        return list(learning_frames(source))


def frames_in_step(
    sources: Sequence[VideoSource], delays: Sequence[int]
) -> Iterator[tuple[VideoFrame, ...]]:
    """Yield the frames of all videos together, until the first video ends.

    Args:
        delays: frames to skip at the beginning of each video.
    """
    skip_frames(sources, delays)
    yield from zip(*sources, strict=False)


def skip_frames(sources: Sequence[VideoSource], delays: Sequence[int]) -> None:
    """Read as many frames at the beginning of each video as its delay says."""
    for source, delay in zip(sources, delays, strict=True):
        for _ in range(delay):
            next(source, None)


def read_silhouettes(
    sources: Sequence[VideoSource],
    measurers: Sequence[Callable[[Image], NDArray[np.bool_]]],
    delays: Sequence[int] | None = None,
) -> Iterator[Bool[Tensor, "C H W"]]:
    """Yield the silhouettes of all cameras, frame by frame, until the first video ends.

    Args:
        sources: one video per camera, of one frame rate.
        measurers: one per camera, such as a `SilhouetteMeasurer`.
        delays: frames to skip at the beginning of each video.

    Yields:
        Bool [C, H, W] for each frame, True on the person.

    Raises:
        InputError: numbers that do not match, or videos of different frame rates.
    """
    starts = [0] * len(sources) if delays is None else list(delays)
    if not len(sources) == len(measurers) == len(starts) or not sources or min(starts) < 0:
        raise InputError(
            f"expected as many videos, measurers and delays of 0 or more, got {len(sources)}, "
            f"{len(measurers)} and {starts}"
        )
    rates = {round(source.fps, 3) for source in sources}
    if len(rates) > 1:
        raise InputError(
            f"videos must have one frame rate, got {sorted(rates)}; open them with a common fps (--fps)"
        )
    for frames in frames_in_step(sources, starts):
        masks = [m(frame.image) for m, frame in zip(measurers, frames, strict=True)]
        yield torch.from_numpy(np.stack(masks))
