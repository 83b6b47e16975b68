"""Room, noise and flicker."""

import numpy as np
import pytest

from torchpose.demo._rendering import Scene
from torchpose.demo._rendering.scene import Sensor, room
from torchpose.errors import InputError


def grey(level: int) -> np.ndarray:
    return np.full((240, 320, 3), level, np.uint8)


@pytest.mark.parametrize("level", [40, 128, 200])
def test_noise_grows_with_the_root_of_the_brightness(level):
    sensor = Sensor(320, 240, Scene(noise=3.0), seed=1, fps=30)
    image = sensor(grey(level), 0)
    expected = 3 * np.sqrt((level + 20) / 148)
    assert image.std() == pytest.approx(expected, rel=0.04)
    assert image.mean() == pytest.approx(level, abs=0.1)


def test_noise_of_two_frames_has_nothing_in_common():
    sensor = Sensor(320, 240, Scene(noise=4.0), seed=1, fps=30)
    noise = [sensor(grey(128), i).astype(float).ravel() - 128 for i in range(4)]
    correlation = np.corrcoef(noise) - np.eye(4)
    assert np.abs(correlation).max() < 0.03


def test_flicker_is_as_strong_as_asked_for():
    sensor = Sensor(64, 48, Scene(noise=0, flicker=0.05), seed=2, fps=30)
    means = [sensor(grey(120)[:48, :64], i).mean() / 120 for i in range(1200)]
    assert np.std(means) == pytest.approx(0.05, rel=0.25)
    assert np.mean(means) == pytest.approx(1, abs=0.01)
    assert np.abs(np.diff(means)).max() < 0.03  # slow


def test_clutter_has_edges_and_something_of_the_colour_of_skin():
    bare, full = (room(640, 480, Scene(clutter=c), seed=0) for c in (False, True))
    assert np.abs(np.diff(bare.mean(-1), axis=1)).max() < 8
    assert np.abs(np.diff(full.mean(-1), axis=1)).max() > 40
    red, green, blue = full.transpose(2, 0, 1)
    skin = (red - blue > 40) & (red > 150) & (green > blue)
    assert 0.01 < skin.mean() < 0.1
    assert not np.array_equal(full, room(640, 480, Scene(), seed=1))


def test_a_scene_that_makes_no_sense_is_refused():
    with pytest.raises(InputError, match="exposure in"):
        Scene(exposure=2)
    with pytest.raises(InputError, match="noise in"):
        Scene(noise=float("nan"))
