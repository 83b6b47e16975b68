"""Foreground of drawn scenes whose background is known."""

import copy
import pickle

import numpy as np
import pytest
import torch

from torchpose.errors import InputError, ShapeError
from torchpose.measure._background import BackgroundModel, person_region

cv2 = pytest.importorskip("cv2")

FACE = torch.tensor([[80.0, 40.0, 16.0]])
NOBODY = torch.zeros(0, 3)
H, W = 120, 200


def scene(seed=0):
    """A textured background, RGB [120, 200, 3]."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(90, 220, (12, 20, 3)).astype(np.uint8)
    return cv2.resize(coarse, (W, H), interpolation=cv2.INTER_CUBIC)


def body(x=80):
    """Mask of a person: head and torso."""
    mask = np.zeros((H, W), np.uint8)
    cv2.ellipse(mask, (x, 40), (8, 11), 0, 0, 360, 255, -1)
    cv2.rectangle(mask, (x - 16, 54), (x + 16, H), 255, -1)
    return mask > 0


def disc(x, y, radius=8):
    v, u = np.mgrid[:H, :W]
    return np.hypot(u - x, v - y) <= radius


def shot(back, parts, t):
    """The background with coloured parts in front of it, and noise."""
    image = back.astype(np.float64)
    for mask, colour in parts:
        image = np.where(mask[..., None], np.array(colour, float), image)
    return (
        (image + np.random.default_rng(t).normal(0, 2, image.shape)).clip(0, 255).astype(np.uint8)
    )


CLOTH, SKIN = (30, 40, 60), (250, 50, 30)


def test_a_person_who_stands_still_is_never_absorbed_and_a_moving_disc_is_found():
    back, model = scene(), BackgroundModel()
    inside = missed = false = 0
    for t in range(300):
        ball = disc(20 + (t - 30) % 160, 20) if t >= 30 else np.zeros((H, W), bool)
        mask = model.step(shot(back, [(body(), CLOTH), (ball, SKIN)], t), FACE) > 0
        assert mask.shape == (H, W)
        inside += (mask & body()).sum() / body().sum()
        if t >= 30:
            missed += (~mask & ball).sum() / ball.sum()
            far = ~person_region(FACE, H, W) & ~cv2.dilate(
                ball.astype(np.uint8), np.ones((9, 9))
            ).astype(bool)
            false += (mask & far).sum() / far.sum()
    assert inside / 300 > 0.99
    assert missed / 270 < 0.1 and false / 270 < 0.01


def test_the_plain_mixture_absorbs_the_person():
    """What the additions are for."""
    back, plain = scene(), cv2.createBackgroundSubtractorMOG2(100, 16, False)
    for t in range(300):
        mask = plain.apply(shot(back, [(body(), CLOTH)], t)) > 0
    assert (mask & body()).sum() / body().sum() < 0.1


def test_what_a_person_leaves_becomes_background_and_the_person_is_seen_on_the_way():
    back, model = scene(), BackgroundModel(history=100, settle=20)
    for t in range(200):
        x = 80 + min(max(t - 20, 0), 70)
        face = torch.tensor([[float(x), 40.0, 16.0]])
        mask = model.step(shot(back, [(body(x), CLOTH)], t), face) > 0
        assert (mask & body(x)).sum() / body(x).sum() > 0.9
    left = body(80) & ~person_region(face, H, W)
    assert (mask & left).sum() / left.sum() < 0.1
    came_back = model.step(shot(back, [(body(150), CLOTH), (disc(80, 80), SKIN)], 999), face) > 0
    assert (came_back & disc(80, 80)).sum() / disc(80, 80).sum() > 0.8


def test_nothing_is_learnt_before_the_first_face():
    back, model = scene(), BackgroundModel(wait=10)
    for t in range(5):
        mask = model.step(shot(back, [(body(), CLOTH)], t), NOBODY)
        assert (mask == 255).all()
    for t in range(20):
        mask = model.step(shot(back, [(body(), CLOTH)], t), FACE) > 0
    assert mask[body()].all() and mask[:, 180:].mean() < 0.02


def test_an_empty_scene_is_learnt_and_who_comes_is_cut_out():
    back, model = scene(), BackgroundModel(wait=5)
    for t in range(40):
        model.step(shot(back, [], t), NOBODY)
    for t in range(100):
        mask = model.step(shot(back, [(body(), CLOTH)], t), FACE) > 0
    union = (mask | body()).sum()
    assert (mask & body()).sum() / union > 0.9


def test_reset_and_sizes():
    model = BackgroundModel(wait=1)
    large = np.full((480, 640, 3), 100, np.uint8)
    for _ in range(5):
        mask = model.step(large, torch.tensor([[320.0, 100.0, 60.0]]))
    assert mask.shape == (480, 640) and mask.dtype == np.uint8 and set(np.unique(mask)) == {0, 255}
    with pytest.raises(InputError, match="reset"):
        model.step(large[:100], FACE)
    model.reset()
    assert (model.step(large[:100], NOBODY) == 255).all()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_a_copy_begins_anew_with_the_same_settings(copied):
    model, frames = BackgroundModel(history=50, settle=9, wait=1), [scene(t) for t in range(6)]
    expected = [model.step(frame, FACE) for frame in frames]
    other = copied(model)
    assert (other.history, other.settle, other.wait) == (50, 9, 1)
    assert all(map(np.array_equal, [other.step(frame, FACE) for frame in frames], expected))


def test_the_region_is_about_the_face_and_below_it():
    region = person_region(FACE, H, W)
    assert (
        region[40, 80] and region[110, 80 + 40] and not region[40, 80 + 40] and not region[10].any()
    )
    np.testing.assert_array_equal(
        person_region(torch.cat([FACE, FACE + torch.tensor([[90.0, 0, 0]])]), H, W),
        region | person_region(FACE + torch.tensor([[90.0, 0, 0]]), H, W),
    )
    assert not person_region(NOBODY, H, W).any()


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="history"):
        BackgroundModel(history=0)
    model = BackgroundModel()
    with pytest.raises(InputError, match="RGB"):
        model.step(np.zeros((10, 10), np.uint8), FACE)
    with pytest.raises(ShapeError, match="faces"):
        model.step(np.zeros((10, 10, 3), np.uint8), torch.zeros(1, 2))
