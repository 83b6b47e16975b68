import numpy as np
import pytest
import torch

from torchpose.errors import InputError, ShapeError
from torchpose.measure._brightness_background import BrightnessBackground, PixelKind


def noisy_scene(n=30, height=24, width=32, seed=0):
    """A scene of coloured stripes with noise that differs from channel to channel."""
    generator = torch.Generator().manual_seed(seed)
    stripes = torch.tensor([[180.0, 90, 60], [60, 140, 200], [120, 120, 120], [200, 190, 40]])
    scene = stripes[torch.arange(width) // 8].T[:, None, :].expand(3, height, width)
    noise = torch.randn(n, 3, height, width, generator=generator) * torch.tensor(
        [4.0, 3.5, 6.0]
    ).view(3, 1, 1)
    return scene, (scene + noise).round().clamp(0, 255).to(torch.uint8)


def test_distortions_are_those_of_the_paper_pixel_by_pixel():
    _, frames = noisy_scene()
    model = BrightnessBackground().fit(frames)
    learnt = frames.double().numpy()
    image = frames[3].clone()
    image[:, 5, 7] = torch.tensor([90, 45, 31], dtype=torch.uint8)
    found = model.distortion(image)
    for i, j in ((5, 7), (0, 0), (20, 30)):
        mean, std = learnt[:, :, i, j].mean(0), learnt[:, :, i, j].std(0, ddof=1)
        std = np.maximum(std, 3.0)

        def distort(colour, mean=mean, std=std):
            alpha = (colour * mean / std**2).sum() / ((mean / std) ** 2).sum()
            return alpha, np.sqrt((((colour - alpha * mean) / std) ** 2).sum())

        own = np.array([distort(c) for c in learnt[:, :, i, j]])
        a = max(np.sqrt(((own[:, 0] - 1) ** 2).mean()), 0.01)
        a = max(a, 0.5 / np.sqrt(((mean / std) ** 2).sum()))
        b = max(np.sqrt((own[:, 1] ** 2).mean()), 1.0)
        alpha, chroma = distort(image[:, i, j].double().numpy())
        assert float(found.brightness[i, j]) == pytest.approx((alpha - 1) / a, abs=2e-3)
        assert float(found.chromaticity[i, j]) == pytest.approx(chroma / b, rel=1e-4)


def test_shadow_highlight_and_person_are_told_apart():
    scene, frames = noisy_scene()
    model = BrightnessBackground().fit(frames)
    image = scene.clone()
    image[:, :6] *= 0.65
    image[:, 6:12] *= 1.25
    image[:, 12:18] = torch.tensor([110.0, 20, 110]).view(3, 1, 1)
    kinds = model(image.round().clamp(0, 255).to(torch.uint8))
    inside = kinds[:, torch.arange(32) % 8 != 0]
    assert (inside[:6] == PixelKind.SHADOW).float().mean() > 0.97
    unsaturated = kinds[6:12, :8]
    assert (unsaturated == PixelKind.HIGHLIGHT).float().mean() > 0.9
    assert (inside[12:18] == PixelKind.FOREGROUND).float().mean() > 0.97
    assert (inside[18:] == PixelKind.BACKGROUND).float().mean() > 0.97


def test_false_alarms_are_rare_on_frames_that_were_not_learnt():
    _, frames = noisy_scene(60)
    kinds = BrightnessBackground().fit(frames[:30])(frames[30:])
    assert (kinds == PixelKind.FOREGROUND).float().mean() < 1e-3


def test_one_frame_is_enough_and_black_walls_are_no_shadows():
    black = torch.zeros(1, 3, 8, 8, dtype=torch.uint8)
    model = BrightnessBackground().fit(black)
    image = black[0].clone()
    image[:, 2:4, 2:4] = 120
    kinds = model(image)
    assert (kinds[2:4, 2:4] == PixelKind.FOREGROUND).all()
    assert (kinds[4:] == PixelKind.BACKGROUND).all()


def test_batches_and_chunks_change_nothing(monkeypatch):
    _, frames = noisy_scene(12)
    one = BrightnessBackground().fit(frames)
    monkeypatch.setattr("torchpose.measure._brightness_background._CHUNK", 1)
    many = BrightnessBackground().fit(frames)
    for name, value in one.state_dict().items():
        torch.testing.assert_close(value, many.state_dict()[name])
    each = torch.stack([one(f) for f in frames[:4]])
    assert torch.equal(one(frames[:4].view(2, 2, 3, 24, 32)).flatten(0, 1), each)


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="must be positive"):
        BrightnessBackground(chromaticity=0)
    model = BrightnessBackground()
    image = torch.zeros(3, 4, 4, dtype=torch.uint8)
    with pytest.raises(InputError, match="fit"):
        model(image)
    with pytest.raises(InputError, match="none"):
        model.fit(torch.zeros(0, 3, 4, 4, dtype=torch.uint8))
    model.fit(image[None])
    with pytest.raises(ShapeError, match="size that was learnt"):
        model(torch.zeros(3, 5, 4, dtype=torch.uint8))
