"""Geometric medians against a search by brute force, and as estimates of the filter."""

import pytest
import torch

from tests.priors.mixtures import random_mixture
from torchpose import without_value_checks
from torchpose.filters import MixtureKalmanFilter
from torchpose.math._geometric_median import geometric_median


def problem(n=5, m=7, p=2):
    g = torch.Generator().manual_seed(0)
    weights = torch.rand(n, m, generator=g, dtype=torch.float64)
    means = torch.randn(n, m, p, 3, generator=g, dtype=torch.float64)
    spread = 0.05 + torch.rand(m, p, generator=g, dtype=torch.float64)
    return weights / weights.sum(1, keepdim=True), means, spread


def expected_distance(x, weights, means, spread):
    distance = ((means - x[:, None]).square().sum(-1) + spread).sqrt()
    return (weights[..., None] * distance).sum(1)


def test_no_point_nearby_is_expected_to_be_nearer():
    weights, means, spread = problem()
    start = (weights[..., None, None] * means).sum(1)
    found = geometric_median(weights, means, spread, start)
    least = expected_distance(found, weights, means, spread)
    assert (least <= expected_distance(start, weights, means, spread) + 1e-12).all()
    g = torch.Generator().manual_seed(1)
    for _ in range(50):
        step = 0.1 * torch.randn(found.shape, generator=g, dtype=torch.float64)
        assert (least <= expected_distance(found + step, weights, means, spread) + 1e-3).all()


def test_of_two_answers_it_is_the_likelier_and_not_between():
    weights = torch.tensor([[0.7, 0.3]], dtype=torch.float64)
    means = torch.tensor([[[[0.0, 0, 0]], [[1.0, 0, 0]]]], dtype=torch.float64)
    spread = torch.full((2, 1), 1e-4, dtype=torch.float64)
    start = (weights[..., None, None] * means).sum(1)
    found = geometric_median(weights, means, spread, start)
    assert abs(float(found[0, 0, 0])) < 0.05 < float(start[0, 0, 0])


def memoryless(**options):
    mixture = random_mixture(4, 5)
    return MixtureKalmanFilter(
        mixture, torch.ones(5), torch.full((2,), 0.1), [0, 1], transition="ou", gamma=0.0,
        weighting="frame", **options,
    )  # fmt: skip


def test_the_filter_estimates_medians_of_some_points_and_means_of_the_rest():
    z = torch.randn(2, 6, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    plain, model = memoryless(), memoryless(medians=[2])
    mean, median = plain(z, return_cov=True), model(z, return_cov=True)
    torch.testing.assert_close(median.mean[..., :2], mean.mean[..., :2])
    off = (mean.mean - median.mean)[..., None]
    assert float(off[..., 2:, 0].norm(dim=-1).max()) > 1e-3
    torch.testing.assert_close(median.cov, mean.cov + off @ off.mT)
    torch.testing.assert_close(median.log_weights, mean.log_weights)
    assert "medians" not in model.state_dict()


@pytest.mark.parametrize("frames", [1, 6])
def test_a_frame_by_itself_gives_the_same(frames):
    z = torch.randn(1, frames, 2, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    model = memoryless(medians=[2])
    state, out = model.init(1), model(z, return_cov=True)
    for t in range(frames):
        state, step = model.step(state, z[:, t], return_cov=True)
        torch.testing.assert_close(step.mean, out.mean[:, t])


def test_derivatives_are_the_same_in_every_way_to_take_them():
    weights, means, spread = problem(n=2)
    start = (weights[..., None, None] * means).sum(1)

    def found(means):
        return geometric_median(weights, means, spread, start)

    rows = torch.autograd.functional.jacobian(found, means)
    torch.testing.assert_close(torch.func.jacrev(found)(means), rows, rtol=1e-12, atol=1e-12)
    with without_value_checks():
        torch.testing.assert_close(torch.func.jacfwd(found)(means), rows, rtol=1e-12, atol=1e-12)
    assert torch.autograd.gradgradcheck(found, means.requires_grad_())
