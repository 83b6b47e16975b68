"""Cuts to another scene: found in joined scenes, not in light, motion and noise."""

import numpy as np
import pytest

from torchpose.measure._scene_cuts import SceneCuts

cv2 = pytest.importorskip("cv2")
HEIGHT, WIDTH = 120, 160


def scene(seed):
    """Return a picture of smooth random patches, as large as objects of a room."""
    noise = np.random.default_rng(seed).integers(30, 200, (8, 10, 3)).astype(np.uint8)
    return cv2.resize(noise, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


def lit(image, gain):
    return (image * np.asarray(gain)).clip(0, 255).astype(np.uint8)


def moving(image, n, step=2):
    """Return frames in which somebody walks through the picture."""
    frames = [image.copy() for _ in range(n)]
    for t, frame in enumerate(frames):
        frame[40:, 10 + step * t : 40 + step * t] = (40, 60, 160)
    return frames


def cuts(frames, fps=30.0):
    finder, found = SceneCuts(fps), []
    state = finder.init()
    for t, frame in enumerate(frames):
        state, cut = finder.step(state, frame)
        found += [t] if cut else []
    return found


def test_joined_scenes_are_cut_where_they_were_joined():
    frames = [*moving(scene(0), 20), *moving(scene(1), 30), *moving(scene(2), 10)]
    assert cuts(frames) == [20, 50]


def test_somebody_else_in_the_same_place_is_another_scene():
    one, other = two_in_one_place()
    assert cuts([one] * 10 + [other] * 10) == [10]


def test_scenes_may_be_short():
    one, other = two_in_one_place()
    assert cuts(([one] * 8 + [other] * 8) * 3) == [8, 16, 24, 32, 40]


def two_in_one_place():
    """Return pictures of two persons before the same background."""
    one, other = scene(0), scene(0)
    one[20:, 40:125], other[20:, 40:125] = scene(3)[20:, 40:125], scene(4)[20:, 40:125]
    return one, other


def test_black_ends_a_scene_once():
    dark = [lit(scene(0), 1 - t / 10) for t in range(11)]
    bright = [lit(scene(1), t / 10) for t in range(11)]
    (found,) = cuts([scene(0)] * 5 + dark + bright + [scene(1)] * 5)
    assert 12 <= found <= 15


@pytest.mark.parametrize("gain", [0.3, 0.6, 1.5, (1.2, 1.0, 0.6)])
def test_light_is_no_cut(gain):
    assert (
        cuts([*moving(scene(0), 10), *(lit(frame, gain) for frame in moving(scene(0), 20))]) == []
    )


def test_a_lamp_at_one_side_is_no_cut():
    slope = np.linspace(0.4, 1.4, WIDTH)[None, :, None]
    assert cuts([scene(0)] * 5 + [lit(scene(0), slope)] * 5) == []


def test_a_shaken_camera_is_no_cut():
    rng, wide = np.random.default_rng(0), cv2.resize(scene(0), (200, 150))
    places = rng.integers(0, 9, (30, 2))
    assert cuts([wide[v : v + HEIGHT, u : u + WIDTH] for u, v in places.tolist()]) == []


def test_repeated_frames_and_fast_motion_are_no_cut():
    frames = moving(scene(0), 24, step=4)
    assert cuts([frames[t - t % 3] for t in range(24)]) == []


def test_noise_in_the_dark_is_cut_once_at_most():
    rng = np.random.default_rng(0)
    frames = [lit(scene(0), 0.02) + rng.normal(0, 4, scene(0).shape) for _ in range(40)]
    assert len(cuts([frame.clip(0, 255).astype(np.uint8) for frame in frames])) <= 1


def test_images_of_one_pixel_are_blank():
    assert cuts([np.zeros((1, 1, 3), np.uint8), np.full((1, 1, 3), 255, np.uint8)]) == []
