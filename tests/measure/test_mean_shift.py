"""Mean shift against OpenCV's and against sums over pixels."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchpose.errors import InputError, ShapeError
from torchpose.measure._mean_shift import mean_shift

cv2 = pytest.importorskip("cv2")


def blobs(n=6, seed=0, shape=(60, 80), bumps=3):
    """Maps with a few smooth bumps on a little noise, float64 [n, H, W]."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]]
    maps = rng.uniform(0, 0.02, (n, *shape))
    for m in maps:
        for _ in range(bumps):
            cx, cy = rng.uniform(8, shape[1] - 8), rng.uniform(8, shape[0] - 8)
            s = rng.uniform(3, 7)
            m += rng.uniform(0.4, 0.9) * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * s * s))
    return torch.from_numpy(maps.clip(0, 1))


def starts(n, seed=1, shape=(60, 80)):
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.uniform((15, 15), (shape[1] - 15, shape[0] - 15), (n, 2)))


def by_hand(likelihood, centre, size, kernel):
    """Mass, mean and covariance by a sum over all pixels."""
    height, width = likelihood.shape
    total, first, second = 0.0, np.zeros(2), np.zeros((2, 2))
    weights = np.zeros((height, width))
    for v in range(height):
        for u in range(width):
            w = 1.0
            for value, c, s in ((u, centre[0], size[0]), (v, centre[1], size[1])):
                if kernel == "box":
                    w *= max(0.0, min(value + 0.5, c + s / 2) - max(value - 0.5, c - s / 2))
                else:
                    w *= np.exp(-0.5 * ((value - c) / (s / 4)) ** 2)
            weights[v, u] = w * likelihood[v, u]
            total += weights[v, u]
            first += weights[v, u] * np.array([u, v])
    mean = first / total
    for v in range(height):
        for u in range(width):
            d = np.array([u, v]) - mean
            second += weights[v, u] * np.outer(d, d)
    return total, mean, second / total


def test_the_modes_are_those_of_opencv():
    maps = blobs(20, bumps=1)
    peak = torch.tensor([divmod(int(m.argmax()), m.shape[1])[::-1] for m in maps]).double()
    centre = peak + starts(20) / 8 - 5
    side = 21
    found = mean_shift(maps, centre, torch.full_like(centre, side), max_iterations=100)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1)
    for n in range(20):
        corner = [max(int(c), 0) for c in (centre[n] - (side - 1) / 2).round()]
        _, box = cv2.meanShift(maps[n].float().numpy(), (*corner, side, side), stop)
        theirs = np.array(box[:2]) + (np.array(box[2:]) - 1) / 2
        if 0 < box[0] < 80 - side and 0 < box[1] < 60 - side:  # OpenCV keeps windows in the map
            # OpenCV moves by whole pixels and stays where the slope is less than half of one
            np.testing.assert_allclose(found.centre[n], theirs, atol=2.5)
            their_mass = maps[n, box[1] : box[1] + side, box[0] : box[0] + side].sum()
            assert found.mass[n] >= 0.999 * their_mass


@pytest.mark.parametrize("kernel", ["box", "gaussian"])
def test_what_comes_to_rest_is_a_fixed_point_with_the_moments_of_its_window(kernel):
    maps, centre = blobs(4), starts(4)
    size = torch.tensor([[15.0, 12.5], [9.0, 20.0], [14.2, 14.2], [11.0, 7.0]]).double()
    found = mean_shift(maps, centre, size, kernel, max_iterations=2000, tolerance=1e-6)
    assert found.converged.all() and (found.iterations > 1).all()
    for n in range(4):
        mass, mean, cov = by_hand(maps[n].numpy(), found.centre[n].numpy(), size[n].numpy(), kernel)
        np.testing.assert_allclose(found.mass[n], mass, rtol=1e-9)
        np.testing.assert_allclose(found.centre[n], mean, atol=1e-4)
        np.testing.assert_allclose(found.covariance[n], cov, atol=1e-6)


@given(st.floats(5.0, 70.0), st.floats(5.0, 50.0), st.floats(3.0, 30.0), st.floats(3.0, 30.0))
@settings(max_examples=40, deadline=None)
def test_the_gaussian_window_never_goes_downhill(x, y, width, height):
    maps = blobs(1)
    size = torch.tensor([[width, height]]).double()
    centre, before = torch.tensor([[x, y]]).double(), 0.0
    for _ in range(6):
        found = mean_shift(maps, centre, size, "gaussian", max_iterations=1)
        assert float(found.mass) >= before * (1 - 1e-9)
        centre, before = found.centre, float(found.mass)


def test_each_window_stops_on_its_own_and_a_batch_is_its_elements():
    maps, centre = blobs(8), starts(8)
    size = torch.full_like(centre, 14.0)
    together = mean_shift(maps, centre, size)
    assert len(set(together.iterations.tolist())) > 1
    for n in range(8):
        alone = mean_shift(maps[n : n + 1], centre[n : n + 1], size[n : n + 1])
        for a, b in zip(together, alone, strict=True):
            torch.testing.assert_close(a[n], b[0])


def test_a_window_adapts_to_the_blob_as_bradski_has_it():
    maps = torch.zeros(1, 60, 80)
    maps[0, 20:30, 30:40] = 1.0  # 100 pixels: 2 sqrt(100) = 20 wide
    start = torch.tensor([[36.0, 26.0]])
    found = mean_shift(maps, start, torch.tensor([[12.0, 12.0]]), adapt=2.0)
    torch.testing.assert_close(found.size, torch.tensor([[20.0, 20.0]]))
    torch.testing.assert_close(found.centre, torch.tensor([[34.5, 24.5]]))
    bounded = mean_shift(maps, start, torch.tensor([[12.0, 24.0]]), adapt=2.0, size_limits=(0.5, 1))
    torch.testing.assert_close(bounded.size / bounded.size[:, :1], torch.tensor([[1.0, 2.0]]))
    assert bool((bounded.size <= torch.tensor([[12.0, 24.0]])).all())


def test_where_there_is_nothing_the_window_stays():
    maps = torch.zeros(2, 30, 40)
    maps[1, 2:6, 2:6] = 1.0
    centre = torch.tensor([[20.0, 15.0], [200.0, 15.0]])
    found = mean_shift(maps, centre, torch.full((2, 2), 8.0))
    torch.testing.assert_close(found.centre, centre)
    assert not found.converged.any() and not found.mass.any() and not found.covariance.any()


def test_no_windows():
    found = mean_shift(torch.zeros(0, 30, 40), torch.zeros(0, 2), torch.zeros(0, 2))
    assert found.centre.shape == (0, 2) and found.covariance.shape == (0, 2, 2)


def test_bad_input_is_refused():
    maps, centre, size = torch.ones(1, 10, 10), torch.ones(1, 2), torch.full((1, 2), 4.0)
    with pytest.raises(InputError, match="negative"):
        mean_shift(-maps, centre, size)
    with pytest.raises(InputError, match="finite"):
        mean_shift(maps, centre * float("nan"), size)
    with pytest.raises(InputError, match="max_iterations"):
        mean_shift(maps, centre, size, max_iterations=0)
    with pytest.raises(InputError, match="size_limits"):
        mean_shift(maps, centre, size, size_limits=(2.0, 1.0))
    with pytest.raises(ShapeError):
        mean_shift(maps, torch.ones(2, 2), size)
