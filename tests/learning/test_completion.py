"""Mixtures of some dimensions made whole: one maximisation step with their responsibilities."""

import pytest
import torch

from tests.priors.mixtures import random_mixture
from torchpose.errors import InputError
from torchpose.learning._samplers import TensorSource, all_samples
from torchpose.learning._streamed_em import ColumnsSource, complete_mixture
from torchpose.priors import GaussianMixture


def test_the_other_dimensions_follow_the_responsibilities():
    states = random_mixture(3, 4).sample((400,), torch.Generator().manual_seed(0))
    weight = torch.rand(400, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    columns = [2, 0]
    part = GaussianMixture.fit(states[:, columns], 3, max_iter=5)
    whole = complete_mixture(part, TensorSource(states, weight), columns)
    share = part.component_log_prob(states[:, columns]).softmax(1) * weight[:, None]
    for k in range(3):
        own = share[:, k] / share[:, k].sum()
        mean = own @ states
        torch.testing.assert_close(whole.means[k], mean, rtol=1e-9, atol=1e-9)
        cov = (states - mean).T @ torch.diag(own) @ (states - mean)
        floor = torch.diag(1e-6 * states.var(0))
        torch.testing.assert_close(whole.covariances[k], cov + floor, rtol=1e-9, atol=1e-9)


def test_some_dimensions_of_a_source_come_block_by_block():
    states = random_mixture(2, 5).sample((5000,), torch.Generator().manual_seed(0))
    source = ColumnsSource(TensorSource(states), [4, 1])
    assert (source.dim, source.n_samples, source.n_blocks, source.fresh) == (2, 5000, 2, False)
    torch.testing.assert_close(all_samples(source).states, states[:, [4, 1]])


def test_a_mixture_over_other_dimensions_is_refused():
    states = torch.zeros(10, 3, dtype=torch.float64)
    with pytest.raises(InputError, match="2 dimensions that decide, got 3"):
        complete_mixture(random_mixture(2, 3), TensorSource(states), [0, 1])
