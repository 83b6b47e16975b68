"""Detect foreground against a static background, and motion between frames."""

import threading
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import NDArray
from torch import Tensor, nn

from torchpose._core.checks import check_rgb, check_shape
from torchpose._core.images import Image
from torchpose.errors import InputError
from torchpose.measure._body_window import CELLS, EVIDENCE, move_maps

_LARGEST = (320, 240)  # width and height at which the model works
# A person's region, in sizes of the face from its centre: (half the width, height).
_TOP, _WIDEST = (1.0, -1.2), (2.8, 2.0)  # and so wide from there to the bottom of the image
_BODY = (1.4, 1.2)  # the same for head and torso alone
_ANOTHER, _SAME = 30, 16  # grey levels between what is something else, and within what is at rest
_UNKNOWN = (255, 0, 255)  # colour for unknown background
# Differences from the last frame and from the median, steps of Lab: noise up to the first, range above it.
_DIFFERENCE, _UNUSUAL = (2.0, 20.0), (4.0, 30.0)
_OF_THREAD = threading.local()


def person_region(
    faces: Float[Tensor, "N 3"],
    height: int,
    width: int,
    scale: float = 1.0,
    widest: tuple[float, float] = _WIDEST,
) -> NDArray[np.bool_]:
    """Return a mask of the regions in which the bodies below these faces may be, bool [height, width].

    The region of a person is a trapezoid that is wider than the body.

    Args:
        faces: centre (x, y) and size, pixels. scale: pixels of the result for one of theirs.
        widest: half the width below the shoulders, and the height from which it is reached, in
            sizes of the face from its centre.
    """
    region = np.zeros((height, width), dtype=bool)
    if not len(faces):
        return region
    x, y, size = (scale * faces.detach().cpu().double().numpy()).T[..., None, None]
    across = np.abs(np.arange(width) - x) / size
    down = (np.arange(height)[:, None] - y) / size
    slope = (widest[0] - _TOP[0]) / (widest[1] - _TOP[1])
    half = np.minimum(_TOP[0] + slope * (down - _TOP[1]), widest[0])
    return np.asarray(((down > _TOP[1]) & (across < half)).any(0))


class BackgroundModel:
    """Detects foreground by OpenCV's MOG2, for a static camera and persons present from the first frame.

    MOG2, a mixture of Gaussians per pixel, learns whatever stays in place as background, also a
    person who stands still. Three rules prevent that:

    - The background in the persons' regions of the first frame is unknown. A pixel there counts as
      foreground until it has shown another colour at rest for `settle` frames, for longer than the
      first colour, and outside of head and torso. That colour then becomes its background.
    - Foreground in a person's region is not learnt: MOG2 is given its own background there.
    - Nothing is learnt before the first face. After `wait` frames without a face the scene counts as
      empty.

    The state is kept inside, because OpenCV keeps its own: use one object for each video, in the
    order of its frames, or call `reset`. A copy, pickled or not, begins anew.

    Args:
        history: frames over which MOG2 learns. threshold: squared distance to a Gaussian, in
            variances, up to which a pixel is background.
        settle: frames; see above. wait: frames; see above, and how long a region is kept when its
            face is lost.
        shadows: whether shadows are detected, and counted as background. Skin in front of a
            brighter wall may be classified as shadow.

    Raises:
        InputError: settings out of range.

    Reference:
        Z. Zivkovic (2004), as cited by Burke & Lasenby, section 5.2. The rules for persons in
        view are an addition.

    Example:
        >>> import numpy as np, torch
        >>> from torchpose.measure._background import BackgroundModel
        >>> model, frame = BackgroundModel(), np.full((120, 160, 3), 90, np.uint8)
        >>> face = torch.tensor([[130.0, 20.0, 10.0]])
        >>> for _ in range(20):
        ...     mask = model.step(frame, face)
        >>> frame[50:70, 40:60] = 200  # something appears
        >>> mask = model.step(frame, face)
        >>> int(mask[60, 50]), int(mask[60, 20]), int(mask[60, 130])
        (255, 0, 255)
    """

    def __init__(
        self,
        history: int = 500,
        threshold: float = 16.0,
        settle: int = 60,
        wait: int = 30,
        shadows: bool = False,
    ) -> None:
        if min(history, settle, wait) < 1 or not threshold > 0:
            raise InputError(
                "history, settle and wait must be at least 1 and threshold positive, got "
                f"{history}, {settle}, {wait} and {threshold}"
            )
        self.history, self.threshold, self.settle = history, threshold, settle
        self.wait, self.shadows = wait, shadows
        self.reset()

    def __reduce__(self) -> tuple[type[Self], tuple[Any, ...]]:
        # OpenCV's model can be neither copied nor pickled
        return type(self), (self.history, self.threshold, self.settle, self.wait, self.shadows)

    def reset(self) -> None:
        """Reset the state, for another video."""
        import cv2

        self._mixture = cv2.createBackgroundSubtractorMOG2(
            self.history, self.threshold, self.shadows
        )
        self._learnt = 0  # frames
        self._faceless = 0  # frames in a row without a face
        self._region: Any = None
        self._shape: tuple[int, ...] | None = None
        self.next_frame: int | None = None

    def step_in_order(self, number: int, frame: Image, faces: Float[Tensor, "N 3"]) -> Image:
        """Return `step` of a frame, which must follow the one before; the first may have any number.

        Raises:
            InputError: another frame, as of a second stream.
        """
        if self.next_frame not in (None, number):
            raise InputError(
                f"background=True keeps the background of one stream, whose next frame is {self.next_frame}, "
                f"got frame {number}; make a tracker for each stream, and track each frame once"
            )
        self.next_frame = number + 1
        return self.step(frame, faces)

    def step(self, frame: Image, faces: Float[Tensor, "N 3"]) -> Image:
        """Return the foreground of the next frame: uint8 [H, W], 255 on the foreground, 0 elsewhere.

        Args:
            frame: RGB, [H, W, 3], uint8. faces: centre (x, y) and size, pixels.

        Raises:
            InputError: another kind of image, or another size than before.
        """
        import cv2

        self._check(frame, faces)
        height, width = frame.shape[:2]
        scale = min(1.0, _LARGEST[0] / width, _LARGEST[1] / height)
        size = (max(round(width * scale), 1), max(round(height * scale), 1))
        small = np.asarray(cv2.resize(frame, size, interpolation=cv2.INTER_AREA), np.uint8)
        self._faceless = 0 if len(faces) else self._faceless + 1
        if not self._learnt and self._faceless and self._faceless <= self.wait:
            return np.full((height, width), 255, np.uint8)
        if len(faces) or self._region is None or self._faceless > self.wait:
            self._region = person_region(faces, size[1], size[0], scale)
            self._body = person_region(faces, size[1], size[0], scale, _BODY)
        if not self._learnt:
            self._start(small)
        found = cv2.medianBlur(self._apply(small), 5)
        return np.asarray(cv2.resize(found, (width, height), interpolation=cv2.INTER_NEAREST))

    def _start(self, small: Image) -> None:
        self._unknown = self._region.copy()
        self._first, self._candidate = small.copy(), small.copy()
        self._rest = np.zeros(small.shape[:2], np.int16)  # frames at rest
        self._before = np.zeros(small.shape[:2], np.int16)  # frames with what was there first
        self._taught = np.zeros(small.shape[:2], np.int16)  # frames that are left to be taught
        self._learn(small, np.zeros(small.shape[:2], bool))

    def _apply(self, small: Image) -> Image:
        self._uncover(small)
        taught = self._taught > 0
        foreground = self._mixture.apply(small, None, 0.0) == 255
        if taught.any():
            foreground[taught] = _distance(small, self._candidate)[taught] > _ANOTHER
        foreground |= self._unknown
        self._learn(small, foreground & self._region)
        return foreground.astype(np.uint8) * np.uint8(255)

    def _uncover(self, small: Image) -> None:
        """Mark the pixels that the person has left, whose present colour is the background."""
        if not self._unknown.any():
            return
        still = _distance(small, self._candidate) <= _SAME
        other = _distance(small, self._first) > _ANOTHER
        _paste(small, ~still & self._unknown, self._candidate)
        self._rest = (self._rest + 1) * (still & other)
        self._before += ~other
        uncovered = self._unknown & ~self._body
        uncovered &= self._rest >= np.maximum(self.settle, self._before)
        self._unknown &= ~uncovered
        # MOG2 takes a colour for background when it has a tenth of the weight
        self._taught[uncovered] = max(self.history // 4, 8)

    def _learn(self, small: Image, blocked: NDArray[np.bool_]) -> None:
        """Update the mixture with the frame, in blocked pixels with its own background."""
        shown = small.copy()
        taught = self._taught > 0
        if self._learnt and blocked.any():
            believed = np.asarray(self._mixture.getBackgroundImage(), np.uint8)
            _paste(believed, blocked, shown)
        if taught.any():
            _paste(self._candidate, taught, shown)
            self._taught -= taught
        _paste(np.full_like(small, _UNKNOWN), self._unknown, shown)
        self._learnt += 1
        # slowly from the start, so that what moves in the first frames is not learnt
        rate = 1 / self.history if self._learnt > 1 else 1.0
        self._mixture.apply(shown, None, rate)

    def _check(self, frame: Image, faces: Tensor) -> None:
        check_rgb("frame", frame, empty=False)
        check_shape("faces", faces, ["N", 3])
        if self._shape not in (None, frame.shape):
            raise InputError(
                f"frame must have the size of those before, {self._shape}, got {frame.shape}; "
                "call reset for another video"
            )
        self._shape = frame.shape


def _distance(a: Image, b: Image) -> Image:
    """Return the largest difference over the channels."""
    import cv2

    channels = cv2.split(cv2.absdiff(a, b))
    return np.asarray(cv2.max(cv2.max(channels[0], channels[1]), channels[2]))


def _paste(source: Image, where: NDArray[np.bool_], target: Image) -> None:
    """Copy pixels into `target`; a masked copy by NumPy takes ten times as long."""
    import cv2

    cv2.copyTo(source, where.view(np.uint8), target)


class MotionState(NamedTuple):
    """Holds the last frame of N persons.

    Attributes:
        last, median: Lab in bytes [N, 3, 176, 192], smoothed. grey: [N, 176, 192].
        flow: from the last frame back to the one before, pixels of `grey` [N, 176, 192, 2].
        frames: seen so far [N].
    """

    last: Float[Tensor, "N 3 h w"]
    median: Float[Tensor, "N 3 h w"]
    grey: UInt8[Tensor, "N H W"]
    flow: Float[Tensor, "N H W 2"]
    frames: Int[Tensor, " N"]


class Motion(nn.Module):
    """Computes difference from the last frame, difference from the running median, and optical flow.

        moving = clip((|x_t - x_{t-1}|_w - 2) / 20, 0, 1),   m_t = m_{t-1} + clip(x_t - m_{t-1}, +-s)

    m_t is the running median. The difference from it replaces a background model: a hand that has been
    at rest for a second still differs.

    Args:
        step: s, in steps of Lab in bytes per frame at 30 frames per second.
        rate: frames at 30 per second that pass in one step. flow: whether to compute it.
    """

    def __init__(self, step: float = 0.7, rate: float = 1.0, flow: bool = True) -> None:
        super().__init__()
        self.limit, self.with_flow = step * rate, flow
        self.register_buffer("channel_weights", torch.tensor([0.6, 1.0, 1.0], dtype=torch.float32))

    channel_weights: Tensor

    def init(self, persons: int) -> MotionState:
        """Return the state before the first frame."""
        rows, columns = CELLS
        small = torch.zeros(persons, 3, rows * EVIDENCE, columns * EVIDENCE, dtype=torch.float32)
        grey = torch.zeros(persons, rows * EVIDENCE, columns * EVIDENCE, dtype=torch.uint8)
        flow = torch.zeros(*grey.shape, 2, dtype=torch.float32)
        return MotionState(small, small, grey, flow, torch.zeros(persons, dtype=torch.long))

    def move(
        self,
        state: MotionState,
        old: Float[Tensor, "N 3"],
        new: Float[Tensor, "N 3"],
        moved: Bool[Tensor, " N"],
    ) -> MotionState:
        """Return the state for windows that have moved, by interpolation."""
        if not bool(moved.any()):
            return state
        old, new = old[moved], new[moved]
        small = torch.cat([state.last[moved], state.median[moved]], 1)
        small = move_maps(small, old, new, replicate=True)
        grey = move_maps(state.grey[moved][:, None].float(), old, new, replicate=True)
        scale = (old[:, 2] / new[:, 2]).to(state.flow)[:, None, None, None]
        flow = move_maps(state.flow[moved].permute(0, 3, 1, 2), old, new) * scale
        last, median, greys, flows = (
            x.clone() for x in (state.last, state.median, state.grey, state.flow)
        )
        last[moved], median[moved] = small[:, :3], small[:, 3:]
        greys[moved] = grey[:, 0].round().to(torch.uint8)
        flows[moved] = flow.permute(0, 2, 3, 1)
        return state._replace(last=last, median=median, grey=greys, flow=flows)

    def step(
        self, state: MotionState, small: Float[Tensor, "N 3 h w"], grey: UInt8[Tensor, "N H W"]
    ) -> tuple[
        MotionState, Float[Tensor, "N h w"], Float[Tensor, "N h w"], Float[Tensor, "N r c 2"]
    ]:
        """Compare the next frame with the frames before.

        Args:
            state: from `init` or the step before. small: windows in Lab, smoothed [N, 3, 176, 192].
            grey: windows [N, 176, 192], lightness in bytes.

        Returns:
            The next state; difference from the last frame and from the median [N, 176, 192], 0 to 1;
            flow from this frame back to the last one, in cells [N, 88, 96, 2].
        """
        new, last, median = state.frames == 0, state.last, state.median
        if bool(new.any()):
            new = new[:, None, None, None]
            last, median = torch.where(new, small, last), torch.where(new, small, median)
        median = (small - median).clamp_(-self.limit, self.limit).add_(median)
        moving = self._difference(small, last, *_DIFFERENCE)
        unusual = self._difference(small, median, *_UNUSUAL)
        flow, cells = state.flow, small.new_zeros(len(small), *CELLS, 2)
        if self.with_flow and len(small):
            flow, cells = dense_flow(grey, state.grey, state.flow, state.frames > 0)
        return MotionState(small, median, grey, flow, state.frames + 1), moving, unusual, cells

    def _difference(self, small: Tensor, other: Tensor, noise: float, most: float) -> Tensor:
        away = (small - other).abs_().flatten(2)
        weighted = (self.channel_weights @ away).view(-1, *small.shape[2:])
        return weighted.sub_(noise).div_(most).clamp_(0, 1)


def dense_flow(
    grey: UInt8[Tensor, "N H W"],
    before: UInt8[Tensor, "N H W"],
    start: Float[Tensor, "N H W 2"],
    known: Bool[Tensor, " N"],
) -> tuple[Float[Tensor, "N H W 2"], Float[Tensor, "N r c 2"]]:
    """Return the optical flow from `grey` back to `before` (DIS), in pixels, and its means, in cells.

    OpenCV's algorithm takes one pair of images at a time, hence the loop; persons without a frame
    before (`known`) get zeros.

    Reference:
        T. Kroeger, R. Timofte, D. Dai, L. Van Gool, Fast optical flow using dense inverse search,
        2016, https://doi.org/10.1007/978-3-319-46493-0_29
    """
    import cv2

    method = _method()
    flow = np.zeros(start.shape, np.float32)
    cells = np.zeros((len(grey), *CELLS, 2), np.float32)
    for n in torch.nonzero(known)[:, 0].tolist():
        flow[n] = start[n].numpy()
        method.calc(grey[n].numpy(), before[n].numpy(), flow[n])
        cv2.resize(flow[n], CELLS[::-1], dst=cells[n], interpolation=cv2.INTER_AREA)
    return torch.from_numpy(flow), torch.from_numpy(cells).div_(EVIDENCE)


def _method() -> Any:
    """Return OpenCV's DIS at half the resolution, made once in a thread: making it takes longer than a frame.

    It has buffers that calls in several threads would share.
    """
    import cv2

    if not hasattr(_OF_THREAD, "flow"):
        method = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)  # type: ignore[attr-defined]
        method.setFinestScale(1)
        _OF_THREAD.flow = method
    return _OF_THREAD.flow
