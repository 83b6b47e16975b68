import torch

from torchpose.filters import MixtureKalmanFilter
from torchpose.priors import GaussianMixture

torch.manual_seed(0)
prior = GaussianMixture(
    weights=torch.tensor([0.5, 0.5]),
    means=torch.tensor([[0.0, 0.0], [4.0, 4.0]]),
    covariances=torch.tensor([[1.0, 0.8], [0.8, 1.0]]).expand(2, 2, 2),
)
tracker = MixtureKalmanFilter(
    prior,
    process_cov=torch.tensor([0.1, 0.1]),  # Q, here its diagonal
    measurement_cov=torch.tensor([0.05]),  # R
    observed=[0],  # dimension 0 is measured, dimension 1 never
)

z = 4 + 0.2 * torch.randn(3, 60, 1)  # three sequences of sixty frames
mask = torch.ones(3, 60, 1, dtype=torch.bool)
mask[1, 20:50] = False  # the second one has a gap
out = tracker(z, mask, lengths=torch.tensor([60, 60, 45]), return_cov=True)

print(out.mean.shape, out.log_weights.shape, out.cov.shape)
# > torch.Size([3, 60, 2]) torch.Size([3, 60, 2]) torch.Size([3, 60, 2, 2])
print(out.mean[0, -1, 1] > 3)  # the hidden dimension follows the measured one
# > tensor(True)
print(out.cov[1, 45, 0, 0] > out.cov[0, 45, 0, 0])  # and is less certain in the gap
# > tensor(True)
print(out.log_evidence[1, 20:50].abs().sum())  # nothing measured, nothing learnt
# > tensor(0., dtype=torch.float64)
