"""A small mixture with measurements, for filters over it."""

import numpy as np

from tests.filters.oracles import paper_transition, random_covariance, random_mixture, tensor
from torchpose.filters import MixtureKalmanFilter
from torchpose.priors import GaussianMixture

DIM, OBSERVED = 4, [0, 2]


class Problem:
    """A small mixture, its noise, and measurements with gaps."""

    def __init__(self, seed=0, n_components=3, n_frames=6, batch=1, missing=0.3, spread=2.0):
        rng = np.random.default_rng(seed)
        self.weights, self.means, self.covs = random_mixture(rng, n_components, DIM, spread)
        self.process = np.diag(rng.uniform(0.2, 1.0, DIM))
        self.noise = random_covariance(rng, 2, 0.5)
        self.z = rng.standard_normal((batch, n_frames, 2)) * 1.5
        self.mask = rng.random((batch, n_frames, 2)) > missing

    def mixture(self):
        return GaussianMixture(tensor(self.weights), tensor(self.means), tensor(self.covs))

    def filter(self, **options):
        return MixtureKalmanFilter(
            self.mixture(), tensor(self.process), tensor(self.noise), OBSERVED, **options
        )

    def models(self):
        """(F, b, N) of each component."""
        return [
            paper_transition(m, c, self.process) for m, c in zip(self.means, self.covs, strict=True)
        ]
