import torch

from torchpose.priors import GaussianMixture

generator = torch.Generator().manual_seed(0)
truth = GaussianMixture(
    weights=torch.tensor([0.3, 0.7], dtype=torch.float64),
    means=torch.tensor([[-2.0, 0.0], [2.0, 1.0]], dtype=torch.float64),
    covariances=torch.eye(2, dtype=torch.float64).expand(2, 2, 2),
)
x = truth.sample((5000,), generator=generator)
fitted = GaussianMixture.fit(x, n_components=2, seed=0)
print(fitted.weights.sort().values.round(decimals=1))
# > tensor([0.3000, 0.7000], dtype=torch.float64)

# what is known about the second dimension once the first was measured
given = fitted.condition([0], torch.tensor([2.0], dtype=torch.float64))
print(given.log_weights.exp().max() > 0.99)
# > tensor(True)
