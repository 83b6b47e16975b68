"""A point of a mixture's state that is probably outside, against weighted draws of the posterior."""

import numpy as np
import pytest
import torch

from tests.filters.oracles import random_covariance, random_mixture, tensor
from torchpose.filters import FixedTrackFilter
from torchpose.filters._outside_points import OutsidePoint, with_outside_point
from torchpose.math._half_planes import log_outside
from torchpose.priors import GaussianMixture

DIM, OBSERVED, N_FRAMES = 4, [2, 3], 3
PLANE = torch.tensor([[0.3, 2.0, -1.5]], dtype=torch.float64)


def problem(medians=()):
    rng = np.random.default_rng(3)
    mixture = GaussianMixture(*map(tensor, random_mixture(rng, 3, DIM, 2.0)))
    noise = tensor(random_covariance(rng, 2, 0.5))
    model = FixedTrackFilter(
        mixture, torch.ones(DIM, dtype=torch.float64), noise, OBSERVED, transition="ou", gamma=0.0,
        weighting="frame", medians=medians,
    )  # fmt: skip
    z = tensor(rng.standard_normal((1, N_FRAMES, 2)))
    mask = torch.ones_like(z, dtype=torch.bool)
    mask[0, 1] = False
    return mixture, noise, model, z, mask


def evidence(log_inside):
    planes = PLANE.expand(1, N_FRAMES, 1, 3)
    return OutsidePoint(torch.arange(2), planes, torch.tensor([log_inside], dtype=torch.float64))


def conditioned(model, z, mask, point, cov=None):
    out = model(z, mask, cov, return_cov=True)
    return out, with_outside_point(model, out, model.check(z, mask, cov, None, None), point)


def drawn(mixture, noise, z, log_inside, count=400_000):
    """Return log mean likelihood, mean and covariance of draws of the prior that are weighed by both."""
    generator = torch.Generator().manual_seed(0)
    weights, means, covs = mixture.parameters_tuple()
    which = torch.multinomial(weights, count, True, generator=generator)
    white = torch.randn(count, DIM, generator=generator, dtype=torch.float64)
    x = means[which] + (torch.linalg.cholesky(covs)[which] @ white[..., None])[..., 0]
    logs = torch.zeros(count, dtype=torch.float64)
    if z is not None:
        off = z - x[:, OBSERVED]
        logs = -0.5 * (off * torch.linalg.solve(noise, off.mT).mT).sum(-1)
    share = torch.softmax(logs, 0)
    told = log_outside(x[:, :2] @ PLANE[:, :2].mT + PLANE[:, 2], log_inside)
    mass = (share * told.exp()).sum().log()
    share = torch.softmax(logs + told, 0)
    mean = share @ x
    return mass, mean, (share[:, None] * (x - mean)).mT @ (x - mean)


@pytest.mark.parametrize("frame", [0, 1])
def test_estimates_are_those_of_the_posterior(frame):
    """Of a frame with measurements, and of one without any."""
    mixture, noise, model, z, mask = problem()
    point = evidence([-3.0] * N_FRAMES)
    before, after = conditioned(model, z, mask, point)
    mass, mean, cov = drawn(
        mixture, noise, z[0, frame] if mask[0, frame].all() else None, torch.tensor(-3.0).double()
    )
    assert float((before.mean[0, frame] - mean).norm()) > 0.1
    torch.testing.assert_close(after.mean[0, frame], mean, rtol=0, atol=0.02)
    torch.testing.assert_close(after.cov[0, frame], cov, rtol=0, atol=0.05)
    gained = after.log_evidence[0, frame] - before.log_evidence[0, frame]
    torch.testing.assert_close(gained, mass, rtol=0, atol=0.01)


def test_frames_without_evidence_keep_every_number():
    _, _, model, z, mask = problem()
    before, after = conditioned(model, z, mask, evidence([0.0, -3.0, 0.0]))
    for name in ("mean", "cov", "log_weights", "log_evidence"):
        old, new = (getattr(out, name)[0] for out in (before, after))
        assert torch.equal(new[[0, 2]], old[[0, 2]])
        assert not torch.equal(new[1], old[1])


@pytest.mark.parametrize("medians", [(), (1,)])
def test_noise_of_every_frame_gives_the_numbers_of_shared_noise(medians):
    """And evidence that says nothing leaves medians where the filter has them."""
    _, noise, model, z, mask = problem(medians)
    point = evidence([-3.0, -1.0, -1e-9])
    before, shared = conditioned(model, z, mask, point)
    _, own = conditioned(model, z, mask, point, noise.expand(1, N_FRAMES, 2, 2))
    for name in ("mean", "cov", "log_weights"):
        torch.testing.assert_close(getattr(own, name), getattr(shared, name))
    torch.testing.assert_close(shared.mean[0, 2], before.mean[0, 2], rtol=0, atol=1e-6)
    torch.testing.assert_close(shared.cov[0, 2], before.cov[0, 2], rtol=0, atol=1e-6)
