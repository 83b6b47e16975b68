"""The constant-velocity filter against the dense Gaussian over a whole sequence."""

import pytest
import torch

from torchpose.errors import InputError, ShapeError
from torchpose.filters._constant_velocity import ConstantVelocityFilter

RATIO, FPS = 2e3, 30.0


def dense_estimates(z: torch.Tensor, upto: list[int]) -> torch.Tensor:
    """E[x_t | z_0..z_upto(t)] from the joint Gaussian of all positions and velocities, r = 1."""
    n, dt = len(z), 1 / FPS
    matrix = torch.tensor([[1.0, dt], [0.0, 1.0]], dtype=torch.float64)
    noise = RATIO * torch.tensor([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], dtype=torch.float64)
    mean = torch.zeros(2 * n).double()
    cov = torch.zeros(2 * n, 2 * n).double()
    now = torch.tensor([z[0], 0.0], dtype=torch.float64)
    spread = torch.diag(torch.tensor([1.0, 100.0], dtype=torch.float64))
    for t in range(n):
        if t:
            now, spread = matrix @ now, matrix @ spread @ matrix.T + noise
        mean[2 * t : 2 * t + 2], block = now, spread
        cov[2 * t : 2 * t + 2, 2 * t : 2 * t + 2] = block
        for later in range(t + 1, n):
            block = matrix @ block
            cov[2 * later : 2 * later + 2, 2 * t : 2 * t + 2] = block
            cov[2 * t : 2 * t + 2, 2 * later : 2 * later + 2] = block.T
    estimates = []
    for t, last in enumerate(upto):
        seen = 2 * torch.arange(last + 1)
        innovation = cov[seen][:, seen] + torch.eye(last + 1)
        weights = torch.linalg.solve(innovation, cov[seen, 2 * t])
        estimates.append(mean[2 * t] + weights @ (z[seen // 2] - mean[seen]))
    return torch.stack(estimates)


@pytest.fixture
def noisy() -> torch.Tensor:
    return torch.randn(3, 40, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_filter_is_the_conditional_mean(noisy: torch.Tensor) -> None:
    expected = dense_estimates(noisy[1, :, 0], list(range(40)))
    found = ConstantVelocityFilter(RATIO, FPS)(noisy)[1, :, 0]
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("lag", [0, 1, 7, 39, None])
def test_smoother_is_the_conditional_mean(noisy: torch.Tensor, lag: int | None) -> None:
    length = 31
    reach = length if lag is None else lag
    upto = [min(t + reach, length - 1) for t in range(length)]
    expected = dense_estimates(noisy[2, :length, 1], upto)
    lengths = torch.tensor([40, 12, length])
    found = ConstantVelocityFilter(RATIO, FPS).smooth(noisy, lengths=lengths, lag=lag)[
        2, :length, 1
    ]
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


def test_steps_are_the_frames_of_forward(noisy: torch.Tensor) -> None:
    model = ConstantVelocityFilter(RATIO, FPS)
    state, online = model.init(noisy[:, 0]), []
    for frame in noisy.unbind(1):
        state, estimate = model.step(state, frame)
        online.append(estimate)
    assert torch.equal(torch.stack(online, 1), model(noisy))


def test_what_comes_after_a_sequence_changes_nothing(noisy: torch.Tensor) -> None:
    model, lengths = ConstantVelocityFilter(RATIO, FPS), torch.tensor([40, 12, 31])
    spoilt = noisy.clone()
    spoilt[1, 12:] = 1e6
    found = model.smooth(spoilt, lengths=lengths)[1, :12]
    torch.testing.assert_close(found, model.smooth(noisy[1:2, :12])[0])


def test_takes_noise_out_of_a_smooth_movement() -> None:
    times = torch.arange(300, dtype=torch.float64) / FPS
    truth = torch.sin(2 * times)[None, :, None]
    noise = 0.05 * torch.randn(1, 300, 1, generator=torch.Generator().manual_seed(1)).double()
    model = ConstantVelocityFilter(RATIO, FPS)
    raw = (noise.square().mean()).sqrt()
    filtered = (model(truth + noise) - truth).square().mean().sqrt()
    smoothed = (model.smooth(truth + noise) - truth).square().mean().sqrt()
    assert smoothed < 0.7 * filtered < 0.7 * raw


def test_bad_settings_are_refused(noisy: torch.Tensor) -> None:
    for ratio, fps in ((0.0, 30.0), (1e3, float("nan")), (float("inf"), 30.0)):
        with pytest.raises(InputError, match="positive"):
            ConstantVelocityFilter(ratio, fps)
    with pytest.raises(InputError, match="lag"):
        ConstantVelocityFilter(RATIO, FPS).smooth(noisy, lag=-1)
    with pytest.raises(ShapeError):
        ConstantVelocityFilter(RATIO, FPS)(noisy[0])
