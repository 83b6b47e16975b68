"""Tell whether a video was recorded sideways or upside down, by the faces in some of its frames."""

from itertools import islice

import numpy as np

from torchpose._core.images import Image
from torchpose.measure._face_detector import HaarFaceDetector, resized
from torchpose.video._source_interface import VideoSource

_FRAMES, _APART = 6, 50  # that are looked at, and frames from one to the next
_SIDE = 480  # longer side to which they are scaled, pixels: small false faces disappear
_LEAST = 4  # frames with a face from which a turn is believed
_QUARTERS = (0, 1, 2, 3)  # turns of 90 degrees, clockwise


def turn_to_upright(source: VideoSource) -> int:
    """Return by how many degrees, clockwise, a video has to be turned until faces stand upright.

    A turn of 90, 180 or 270 degrees counts if a face is found in at least four of six frames of the
    first ten seconds or so, and in twice as many as without it; else the answer is 0.

    Args:
        source: at its first frame; is read on.
    """
    detector = HaarFaceDetector()
    frames = islice(source, 0, _FRAMES * _APART, _step(source))
    images = [_small_grey(frame.image) for frame in islice(frames, _FRAMES)]
    found = [
        sum(len(detector(np.ascontiguousarray(np.rot90(image, -turn)))) > 0 for image in images)
        for turn in _QUARTERS
    ]
    best = max(_QUARTERS, key=found.__getitem__)
    return 90 * best if found[best] >= max(_LEAST, 2 * found[0]) else 0


def _step(source: VideoSource) -> int:
    """Return how many frames it is from one that is looked at to the next."""
    return _APART if source.n_frames is None else min(_APART, max(1, source.n_frames // _FRAMES))


def _small_grey(image: Image) -> Image:
    """Return a frame in grey and at most 480 pixels long."""
    import cv2

    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return resized(np.asarray(grey, np.uint8), min(1.0, _SIDE / max(grey.shape)))
