"""Cameras, played by a fake."""

import math

import cv2
import numpy as np
import pytest

from torchpose.errors import InputError
from torchpose.video import _camera as module
from torchpose.video import open_video
from torchpose.video._camera import CameraSource

WARM_UP = 10


class FakeCapture:
    """Gives `frames` blue images, at its own pace; its clock is the test's."""

    def __init__(self, frames, fps=30.0, opened=True, pace=None, failing=()):
        self.left, self.fps, self.opened = frames, fps, opened
        self.pace, self.failing = pace, set(failing)
        self.reads, self.now, self.released, self.asked = 0, 0.0, 0, {}
        self.size = (48, 64)

    def isOpened(self):
        return self.opened

    def read(self):
        self.reads += 1
        if self.reads in self.failing or self.left == 0:
            return False, None
        self.left -= 1
        self.now += 1 / (self.pace or self.fps)
        image = np.zeros((*self.size, 3), np.uint8)
        image[..., 0] = 200
        return True, image

    def get(self, prop):
        return self.fps if prop == cv2.CAP_PROP_FPS else 0.0

    def set(self, prop, value):
        self.asked[prop] = value
        return True

    def release(self):
        self.released += 1


@pytest.fixture
def camera(monkeypatch):
    """Makes a source on a fake whose clock is the only one."""

    def make(*args, ask=None, **kwargs):
        fake = FakeCapture(*args, **kwargs)
        monkeypatch.setattr(module.time, "perf_counter", lambda: fake.now)
        monkeypatch.setattr(module.time, "monotonic", lambda: math.floor(64 * fake.now + 0.2) / 64)
        monkeypatch.setattr(module.time, "sleep", lambda seconds: None)
        return CameraSource(3, ask, capture=lambda index: fake), fake

    return make


def test_frames_with_the_times_of_the_clock(camera):
    source, fake = camera(WARM_UP + 20)
    assert (source.name, source.fps, source.size) == ("camera 3", 30, (64, 48))
    assert source.n_frames is None
    assert not source.reopenable
    assert source.notes == []
    frames = list(source)
    assert [frame.index for frame in frames] == list(range(20))
    np.testing.assert_allclose([frame.time for frame in frames], np.arange(20) / 30, atol=1e-9)
    assert frames[0].image[0, 0].tolist() == [0, 0, 200]
    assert frames[0].image.flags.c_contiguous
    source.close()
    source.close()
    assert fake.released == 1


def test_unplugged_while_reading(camera):
    source, _ = camera(WARM_UP + 5)
    assert len(list(source)) == 5
    assert "no more frames after 5: unplugged" in source.notes[-1]


def test_a_read_that_fails_now_and_then_is_no_end(camera):
    source, _ = camera(WARM_UP + 20, failing=[13, 17, 18, 19])
    assert len(list(source)) == 20


def test_a_slow_camera(camera):
    source, _ = camera(WARM_UP + 5, fps=30.0, pace=15.0)
    assert source.fps == pytest.approx(15)
    assert "says 30 frames per second and gave 15" in source.notes[0]


@pytest.mark.parametrize("reported", [0.0, -1.0, 1e6])
def test_a_camera_that_does_not_know_its_rate(camera, reported):
    source, _ = camera(WARM_UP + 5, fps=reported, pace=30.0)
    assert source.fps == 30


def test_a_rate_is_asked_for(camera):
    _, fake = camera(WARM_UP + 5)
    assert cv2.CAP_PROP_FPS not in fake.asked
    _, fake = camera(WARM_UP + 5, ask=60.0)
    assert fake.asked[cv2.CAP_PROP_FPS] == 60


def test_of_a_faster_camera_frames_are_left_out(camera):
    source, _ = camera(WARM_UP + 90, ask=12.0)
    assert source.fps == 12
    assert source.notes == [
        "the camera gives 30 frames per second; 12 of them are used, as asked for"
    ]
    times = [frame.time for frame in source]
    np.testing.assert_allclose(times, np.arange(len(times)) / 12, atol=0.5 / 30 + 1e-9)
    assert len(times) == 36 and len(source.notes) == 2


@pytest.mark.parametrize("closed", [False, True])
def test_frames_that_a_slow_reader_misses_are_counted(camera, closed):
    source, fake = camera(WARM_UP + 31)
    for count, frame in enumerate(source):
        assert (frame.index, frame.missed) == (4 * count, 3 if count else 0)
        assert frame.time == pytest.approx(frame.index / 30)
        fake.now += 0.1  # at which the camera's further frames are lost
        if closed and count == 29:
            source.close()
            break
    assert source.notes[0].startswith("camera 3 was read at 7.5 of 30 frames per second")
    assert "--fps 7.1" in source.notes[0]
    assert len(source.notes) == 2 - closed


@pytest.mark.parametrize("fps", [30.0, 60.0])
def test_who_keeps_up_misses_nothing(camera, fps):
    """Also where a clock of the system ticks as seldom as frames come, which on Windows is usual."""
    source, _ = camera(WARM_UP + 90, fps=fps)
    assert [frame.missed for frame in source] == [0] * 90
    assert len(source.notes) == 1  # that it ended


def test_a_pause_is_no_time_in_which_frames_were_missed(camera):
    source, fake = camera(WARM_UP + 20)
    frames = []
    for frame in source:
        frames.append(frame)
        fake.now += 60.0 if len(frames) == 10 else 0.0
    assert [frame.index for frame in frames] == list(range(20))
    assert frames[-1].time > 60 and not any(frame.missed for frame in frames)
    assert source.notes[0].startswith("pauses of more than 1 s between frames of camera 3")


def test_delays_of_single_frames_are_no_missed_ones(camera):
    source, fake = camera(WARM_UP + 60)
    late = 0.6 / 30
    for count, frame in enumerate(source):
        assert (frame.index, frame.missed) == (count, 0)
        fake.now += late if count % 2 else -late


@pytest.mark.parametrize(("pace", "frames"), [(27.0, 100), (33.0, 82)])
def test_a_camera_at_a_rate_of_its_own_keeps_the_time(camera, pace, frames):
    source, _ = camera(WARM_UP + 90, pace=pace)
    assert source.fps == 30
    *_, last = source
    assert last.index + 1 == pytest.approx(frames, abs=2)
    assert last.index / 30 == pytest.approx(last.time, abs=1 / 30)


def test_not_there_in_use_or_silent(camera):
    with pytest.raises(InputError, match="camera 3 cannot be opened"):
        camera(5, opened=False)
    with pytest.raises(InputError, match="gives no frames"):
        camera(0)


def test_what_could_not_be_prepared_is_released():
    fake = FakeCapture(0)
    with pytest.raises(InputError):
        CameraSource(0, capture=lambda index: fake)
    assert fake.released == 1


def test_frames_of_another_size_are_scaled_to_the_first(camera):
    source, fake = camera(WARM_UP + 5)
    next(source)
    fake.size = (24, 32)
    assert [frame.image.shape for frame in source] == 4 * [(48, 64, 3)]
    assert source.notes[0] == "4 frames of camera 3 of another size, scaled to 64x48"


def test_a_driver_that_raises_gives_no_frame(camera, monkeypatch):
    source, fake = camera(WARM_UP + 5)
    next(source)

    def broken():
        raise cv2.error("the device has gone")

    monkeypatch.setattr(fake, "read", broken)
    assert list(source) == []
    assert "no more frames after 1: unplugged" in source.notes[-1]


def test_cannot_be_read_twice(camera):
    with pytest.raises(InputError, match="cannot be read a second time"):
        camera(WARM_UP + 5)[0].reopen()


def test_no_camera_on_this_machine(capfd):
    with pytest.raises(InputError, match="camera 97 cannot be opened"):
        open_video("97")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan")])
def test_impossible_settings(fps):
    with pytest.raises(InputError, match="fps must be positive"):
        CameraSource(0, fps)
    with pytest.raises(InputError, match="0 or more"):
        CameraSource(-1)
