"""Frames of a recording that another process looks at."""

import sys
import time
from contextlib import closing

import numpy as np
import pytest
import torch

from torchpose import VideoTracker, load_prior
from torchpose.demo import demo_camera, performer
from torchpose.errors import InputError, TorchposeError
from torchpose.measure._face_detector import HaarFaceDetector
from torchpose.video import _other_process
from torchpose.video._measurers import look_ahead
from torchpose.video._other_process import OtherProcess

pytest.importorskip("matplotlib", reason="the performer's face comes from matplotlib")
pytestmark = pytest.mark.skipif(
    sys.platform == "win32", reason="processes there cannot inherit descriptors of memory"
)
N_FRAMES = 24


@pytest.fixture(scope="module")
def images():
    from torchpose.demo._rendering import Scene, render_performance

    performance = performer(N_FRAMES, distance=1.6)
    return list(render_performance([performance], demo_camera(), scene=Scene(clutter=False)))


@pytest.fixture(scope="module")
def tracker():
    return VideoTracker(load_prior("kinect-upper-body-small"), demo_camera())


def until_ready(other):
    """The process once it has started, which takes a few seconds."""
    end = time.monotonic() + 120
    while not other.ready and time.monotonic() < end:
        time.sleep(0.02)
    assert other.ready
    return other


class Waiting(list):
    """Frames, of which the fourth and the later ones come once the process has started."""

    def __iter__(self):
        for place, image in enumerate(super().__iter__()):
            if place == 3:
                until_ready(self.other)
            yield image


@pytest.fixture
def started(monkeypatch):
    """A list of the processes that a test starts, at the first frame."""
    processes = []

    class Noted(OtherProcess):
        def __init__(self, measurer):
            super().__init__(measurer)
            processes.append(self)
            Waiting.other = self

    monkeypatch.setattr(_other_process, "OtherProcess", Noted)
    monkeypatch.setattr(_other_process, "LONG", N_FRAMES)
    monkeypatch.setattr("torchpose.video._video_tracker.cores", lambda: 2)
    return processes


def order(tensor):
    """Dimensions in the order of memory; those with one element have no place in it."""
    return sorted((d for d in range(tensor.ndim) if tensor.shape[d] > 1), key=tensor.stride)


def parts(value):
    return [value] if not isinstance(value, tuple) else [p for v in value for p in parts(v)]


@pytest.mark.slow
def test_it_shows_the_same_and_tells_what_fails(tracker, images):
    """All of a view to the last bit, with the order of its elements; then an image of another kind."""
    measurer, state = tracker._measurer, tracker.init().measurer
    numbered = [(image, 0) for image in images]
    here = list(look_ahead(measurer, state, iter(numbered)))
    wrong = [*numbered[3:], (np.zeros((4, 4), np.uint8), 0)]
    with (
        closing(OtherProcess(measurer)) as other,
        closing(until_ready(other).look(here[2].view.after, wrong)) as found,
    ):
        for mine in here[3:]:
            its = next(found)
            assert its.image is mine.image and its.view.after is None
            pairs = zip(parts(its.view[1:]), parts(mine.view[1:]), strict=True)
            for one, two in pairs:
                if isinstance(two, torch.Tensor):
                    assert torch.equal(one, two) and order(one) == order(two)
                else:
                    assert one == two
        assert int(here[-1].view.hands.identity) == 0
        with pytest.raises(InputError, match="a frame"):
            next(found)


@pytest.mark.slow
def test_poses_are_the_same(tracker, images, started):
    alone = tracker(images)
    (person,) = tracker(Waiting(images), n_frames=N_FRAMES, workers=1)
    assert len(started) == 1 and started[0].ready and started[0]._process.poll() is not None
    torch.testing.assert_close(person.track.joints3d, alone[0].track.joints3d, rtol=0, atol=0)
    torch.testing.assert_close(person.keypoints, alone[0].keypoints, rtol=0, atol=0, equal_nan=True)


def test_a_process_that_ends_is_told(tracker, images, started):
    def dying():
        for place, image in enumerate(Waiting(images)):
            if place == 10:
                started[0]._end()
            yield image

    with pytest.raises(TorchposeError, match="workers=0"):
        tracker(dying(), n_frames=N_FRAMES, workers=1)


def test_what_cannot_be_sent_stays_here(images, started):
    class Local(HaarFaceDetector):  # of a function: pickle does not find it
        pass

    own = VideoTracker(load_prior("kinect-upper-body-small"), demo_camera(), face_detector=Local())
    assert len(own(images, n_frames=N_FRAMES, workers=1)) == 1
    assert len(started) == 1 and not started[0].ready


def test_a_short_recording_starts_none(tracker, images, started):
    tracker(images[:-1], n_frames=N_FRAMES - 1, workers=1)
    tracker(images[:5], workers=1)
    assert not started


@pytest.mark.parametrize("wrong", [-1, 2, 0.5])
def test_another_number_is_refused(tracker, images, wrong):
    with pytest.raises(InputError, match="workers must be 0 or 1"):
        tracker(images, workers=wrong)
