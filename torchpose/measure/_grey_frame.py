"""Turn the parts of a frame that are looked at into grey, made smaller where the frame is large."""

import math

import numpy as np

from torchpose._core.images import Image
from torchpose.measure._face_detector import Region

_LARGEST_SIDE = 960  # of a grey image, pixels


def grey_scale(frame: Image) -> float:
    """Return the pixels of the grey image of a frame for one of the frame, at most 1."""
    return min(1.0, _LARGEST_SIDE / max(frame.shape[:2]))


class GreyFrame:
    """Computes the grey image of a frame where it is looked at: a known face is a small part of it.

    Args:
        frame: RGB [H, W, 3]; not to be changed meanwhile.

    Attributes:
        shape: rows and columns of the grey image.
    """

    def __init__(self, frame: Image) -> None:
        self._frame, self._scale = frame, grey_scale(frame)
        rows, columns = (round(side * self._scale) for side in frame.shape[:2])
        self.shape = (rows, columns)
        self._grey: Image | None = None

    def at(self, part: Region) -> Image:
        """Return the grey image, which is that of the whole frame in this part, and anything elsewhere.

        The part is widened to places where whole pixels of it are whole pixels of the frame.
        """
        if self._grey is None:
            self._grey = np.zeros(self.shape, np.uint8)
        if part.top < part.bottom and part.left < part.right:
            self._fill(part, self._grey)
        return self._grey

    def _fill(self, part: Region, grey: Image) -> None:
        import cv2

        scale, step = self._scale, 1
        if scale < 1:
            step = _LARGEST_SIDE // math.gcd(_LARGEST_SIDE, max(self._frame.shape[:2]))
        sides = ((part.top, part.bottom), (part.left, part.right))
        ends = [(low // step * step, -(-high // step) * step) for low, high in sides]
        rows, columns = (slice(round(low / scale), round(high / scale)) for low, high in ends)
        own = cv2.cvtColor(self._frame[rows, columns], cv2.COLOR_RGB2GRAY)
        if scale < 1:
            own = cv2.resize(own, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        (top, bottom), (left, right) = ends
        place = grey[top:bottom, left:right]
        # Half a pixel at an end is rounded either way.
        own = own[: place.shape[0], : place.shape[1]]
        place[: own.shape[0], : own.shape[1]] = own
