"""Changed clips keep track of nose and size, and a quick run finds the person."""

import numpy as np
import pytest

pytest.importorskip("cv2")
pytest.importorskip("matplotlib")

from benchmarks.video_faces import Frame, large, lit, small, smaller, turned
from tests.data import data_with


def dot():
    """A grey frame with a bright dot for a nose."""
    image = np.full((480, 640, 3), 60, np.uint8)
    image[160:169, 400:409] = 255
    return Frame(image, np.array([404.0, 164.0]), 100.0)


@pytest.mark.parametrize(
    ("change", "size"),
    [(small(40), 40), (large(0.4, 640, 480), 192), (large(0.6, 720, 1280), 432), (turned(35), 100)],
)
def test_nose_and_size_follow_the_picture(change, size):
    frame = change(dot())
    rows, columns = np.nonzero(frame.image.min(-1) > 250)
    assert frame.size == pytest.approx(size, rel=1e-3)
    np.testing.assert_allclose(frame.nose, [columns.mean(), rows.mean()], atol=0.02 * size + 0.5)


def test_light_is_multiplied_raised_and_tinted():
    frame = lit(0.5, 2.0, (1.0, 0.5, 0.0))(dot())
    assert frame.image[164, 404].tolist() == [64, 16, 0]


def test_large_frames_are_made_smaller_as_the_measurer_does():
    frame = smaller(Frame(np.zeros((1080, 1920, 3), np.uint8), np.array([960.0, 540.0]), 200.0))
    assert frame.image.shape == (540, 960, 3)
    assert (frame.nose.tolist(), frame.size) == ([480.0, 270.0], 100.0)


def test_a_quick_run_finds_the_person(run_here):
    folder = data_with("video_asl")
    printed = run_here("video_faces", "--quick", "--data", str(folder), "--only", "none")
    row = next(line.split() for line in printed.splitlines() if line.startswith("none"))
    assert float(row[1]) > 0.8 and float(row[3]) == 0
