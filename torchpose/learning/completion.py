"""Mixtures that are fitted to some of the dimensions of their states, the others going along.

What an estimate is to be told by and what is wanted most decide which component a state belongs to;
dimensions that would only pull components apart, such as the camera's angles, follow afterwards by one
maximisation step with the components' responsibilities for the others.
"""

from collections.abc import Sequence

import torch

from torchpose.errors import InputError
from torchpose.learning.blocks import usable_block
from torchpose.learning.samplers import Samples, SampleSource
from torchpose.math.gaussian import symmetrise
from torchpose.priors.gaussian_mixture import GaussianMixture

__all__ = ["ColumnsSource", "complete_mixture"]

_FLOOR = 1e-6  # of the variance of each dimension, as in expectation-maximisation
_ROWS = 1024  # states at a time, whose squares are 17 MB


class ColumnsSource:
    """Some dimensions of the states of another source.

    Args:
        source: of whole states. columns: which dimensions, in order.
    """

    def __init__(self, source: SampleSource, columns: Sequence[int]) -> None:
        self.source, self.columns = source, list(columns)

    @property
    def dim(self) -> int:
        """Number of dimensions."""
        return len(self.columns)

    @property
    def n_samples(self) -> int:
        """Number of states in all blocks together."""
        return self.source.n_samples

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return self.source.n_blocks

    @property
    def fresh(self) -> bool:
        """Whether every epoch draws states of its own."""
        return bool(getattr(self.source, "fresh", False))

    def block(self, index: int, epoch: int = 0) -> Samples:
        """The states of a block."""
        samples = self.source.block(index, epoch)
        return samples._replace(states=samples.states[:, self.columns])


@torch.no_grad()
def complete_mixture(
    mixture: GaussianMixture, source: SampleSource, columns: Sequence[int]
) -> GaussianMixture:
    """A mixture of whole states from one of some of their dimensions.

    mu_k = sum_n r_nk x_n / n_k,  Sigma_k = sum_n r_nk (x_n - mu_k)(x_n - mu_k)^T / n_k + floor,

    where r_nk is the share of component k in the given dimensions of state n (BL 53-56).

    Args:
        mixture: over the dimensions `columns`. source: of whole states.

    Raises:
        InputError: another number of dimensions.
    """
    if mixture.dim != len(columns):
        raise InputError(
            f"the mixture must be over the {len(columns)} dimensions that decide, got {mixture.dim}"
        )
    columns = list(columns)
    first = usable_block(source, 0, 0).states
    shift, scale = first.mean(0), first.std(0).clamp_min(1e-9)
    k, dim = mixture.n_components, source.dim
    count = torch.zeros(k, dtype=torch.float64)
    total, squares = torch.zeros(k, dim).double(), torch.zeros(k, dim * dim).double()
    for index in range(source.n_blocks):
        samples = usable_block(source, index, 0)
        for states, weight in zip(*(value.split(_ROWS) for value in samples), strict=True):
            share = mixture.component_log_prob(states[:, columns]).softmax(1) * weight[:, None]
            unit = (states - shift) / scale
            count += share.sum(0)
            total += share.T @ unit
            squares += share.T @ (unit[:, :, None] * unit[:, None]).flatten(1)
    count = count.clamp_min(1e-9)
    means = total / count[:, None]
    covs = squares.unflatten(1, (dim, dim)) / count[:, None, None]
    covs = symmetrise(covs - means[:, :, None] * means[:, None])
    covs = covs + _FLOOR * torch.eye(dim, dtype=torch.float64)
    return GaussianMixture(mixture.weights, means * scale + shift, covs * scale * scale[:, None])
