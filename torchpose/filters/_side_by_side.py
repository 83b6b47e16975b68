"""Run filters that measure the same dimensions side by side, in as many operations as one of them."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchpose.filters._mkf import MixtureKalmanFilter
from torchpose.filters._weights import WeightRule


class SideBySide(nn.Module):
    """Filters without memory of equal settings, whose mixtures and noise have a leading axis of A filters.

    Args:
        filters: A filters of the same dimensions, of which only mixtures and R differ.
        rules: the rules of their weights.

    Attributes:
        filters: the filters. weight_rule: theirs, with log pi [A, 1, K].
        means, covariances: of their components, [A, K, D] and [A, K, D, D].
        noise: R of each filter, [A, Z, Z]. observed, dtype: as every filter has them.
    """

    def __init__(self, filters: Sequence[MixtureKalmanFilter], rules: Sequence[WeightRule]) -> None:
        super().__init__()
        self.filters = tuple(filters)
        self.dtype, self.observed = filters[0].dtype, filters[0].observed
        self.log_prior = stacked([rule.log_prior for rule in rules])[:, None]
        self.weight_rule = rules[0]._replace(log_prior=self.log_prior)
        self.means = stacked([own.means for own in filters])
        self.covariances = stacked([own.covariances for own in filters])
        self.noise = stacked([own.own_noise() for own in filters])


def stacked(parts: Sequence[Tensor]) -> Tensor:
    """Return tensors along a new first axis, a single one without a copy."""
    return parts[0][None] if len(parts) == 1 else torch.stack([*parts])
