"""Tell where a video cuts to another scene, by small pictures of its frames."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchpose._core.images import Image

_SIZE, _TWICE = (32, 24), (64, 48)  # width and height of a pattern, and of what it is averaged from
_AROUND = 7  # pixels of a pattern over which its mean is taken away
_DARKEST = 16.0  # grey levels that are added, so that noise of dark pixels counts little
_SHIFT = (3, 4)  # rows and columns by which a pattern may have moved from frame to frame
_BLANK = 0.03  # deviation of a pattern below which the image shows nothing
_LEAST, _CLEAR = 0.4, 0.65  # change from which on a frame is a cut, after rest and after motion
_TIMES, _ALWAYS = 4.0, 1.5  # factors of the usual change that it exceeds: up to `_CLEAR`, always
_MEMORY = 0.5  # seconds in which the usual change halves
_LOGARITHM = np.log(np.arange(256) + _DARKEST).astype(np.float32)

Pattern = NDArray[np.float32]


class SceneState(NamedTuple):
    """Holds what is known after a frame.

    Attributes:
        pattern: of the last frame, None before the first. usual: the change that is usual.
        cut: the change at the last frame if that is the first of another scene, else 0.
    """

    pattern: Pattern | None
    usual: float
    cut: float = 0.0

    @property
    def blank(self) -> bool:
        """Return whether the last frame showed nothing, as black ones do."""
        return self.pattern is not None and _is_blank(self.pattern)


class SceneCuts:
    """Tells in which frames another scene begins.

    A pattern is the logarithm of a small picture less its local mean, which light that changes leaves as
    it is, but for a constant. The change from frame to frame is one less the largest correlation c of two
    patterns over shifts of up to an eighth of the image, which a camera that shakes causes:

        change_t = 1 - max_s c(pattern_t, pattern_{t-1} shifted by s)

    A frame is the first of another scene if its change exceeds four times the largest one of the last
    moments, bounded to 0.4 to 0.65, and one and a half times that one, which noise in the dark does not. The
    change of a cut counts among these in the next frame alone, so that scenes may be short.
    An image that shows nothing, such as black ones between scenes, ends a scene as well; the next one
    begins unnoticed, since nothing is known then.

    Args:
        fps: frames per second.
    """

    def __init__(self, fps: float) -> None:
        self._decay = 0.5 ** (1 / (_MEMORY * fps))

    def init(self) -> SceneState:
        """Return the state before the first frame."""
        return SceneState(None, 0.0)

    def step(self, state: SceneState, image: Image) -> tuple[SceneState, bool]:
        """Return the next state, and whether a scene ends before this frame, RGB, uint8 [H, W, 3]."""
        pattern, before = _pattern(image), state.pattern
        if before is None or _is_blank(before):
            return SceneState(pattern, 0.0), False
        if _is_blank(pattern):
            return SceneState(pattern, 0.0), True
        change, usual = _change(before, pattern), max(state.usual, state.cut)
        if change > max(min(max(_TIMES * usual, _LEAST), _CLEAR), _ALWAYS * usual):
            return SceneState(pattern, self._decay * state.usual, change), True
        return SceneState(pattern, max(change, self._decay * state.usual)), False


def _pattern(image: Image) -> Pattern:
    import cv2

    small = cv2.resize(image, _TWICE, interpolation=cv2.INTER_LINEAR)
    small = cv2.resize(small, _SIZE, interpolation=cv2.INTER_AREA)
    light = cv2.LUT(small, _LOGARITHM)
    return np.asarray(light - cv2.blur(light, (_AROUND, _AROUND)), np.float32)


def _is_blank(pattern: Pattern) -> bool:
    return float(pattern.std()) < _BLANK


def _change(before: Pattern, after: Pattern) -> float:
    import cv2

    rows, columns = _SHIFT
    inner = np.ascontiguousarray(after[rows:-rows, columns:-columns])
    return 1.0 - float(cv2.matchTemplate(before, inner, cv2.TM_CCOEFF_NORMED).max())
