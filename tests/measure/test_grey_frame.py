"""Parts of frames in grey against the whole frame, made grey and smaller by OpenCV."""

import cv2
import numpy as np
import pytest

from torchpose.measure._face_detector import Region
from torchpose.measure._grey_frame import GreyFrame, grey_scale

SIZES = [(640, 480), (1280, 720), (720, 1280), (1280, 722), (1920, 1080), (1000, 777), (1366, 768)]


def whole(frame):
    """The grey image of a frame, all of it."""
    grey, scale = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), grey_scale(frame)
    if scale == 1:
        return grey
    return cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def noise(width, height):
    return np.random.default_rng(width).integers(0, 256, (height, width, 3), np.uint8)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_a_part_is_what_the_whole_image_has_there(width, height):
    frame = noise(width, height)
    grey, rng = whole(frame), np.random.default_rng(1)
    rows, columns = GreyFrame(frame).shape
    assert grey.shape == (rows, columns)
    last = rows - 1 if height == 722 else rows  # of 541.5 rows the last is half a one
    for _ in range(10):
        left, top = rng.integers(0, columns - 2), rng.integers(0, rows - 2)
        part = Region(left, top, min(left + 130, columns), min(top + 130, last), 1.0, 1.0)
        where = np.s_[part.top : part.bottom, part.left : part.right]
        np.testing.assert_array_equal(GreyFrame(frame).at(part)[where], grey[where])
    everything = Region(0, 0, columns, rows, 1.0, 1.0)
    np.testing.assert_array_equal(GreyFrame(frame).at(everything), grey)


def test_parts_one_after_the_other():
    frame = noise(1280, 720)
    own, grey = GreyFrame(frame), whole(frame)
    for part in ((3, 5, 80, 90), (700, 300, 960, 540), (60, 70, 200, 150), (9, 9, 9, 20)):
        shown = own.at(Region(*part, 1.0, 1.0))
    for left, top, right, bottom in ((3, 5, 80, 90), (700, 300, 960, 540), (60, 70, 200, 150)):
        np.testing.assert_array_equal(shown[top:bottom, left:right], grey[top:bottom, left:right])
    assert not shown[200:280].any()
