import torch

from torchpose.filters import MixtureKalmanFilter
from torchpose.priors import GaussianMixture

prior = GaussianMixture(torch.ones(1), torch.zeros(1, 2), torch.eye(2)[None])
tracker = MixtureKalmanFilter(prior, torch.ones(2), torch.ones(1), observed=[0])
z = torch.linspace(0, 1, 30).reshape(1, 30, 1)

state = tracker.init(batch_size=1)
for frame in z.unbind(1):
    state, estimate = tracker.step(state, frame)

print(torch.allclose(estimate.mean, tracker(z).mean[:, -1]))
# > True
smooth = tracker.smooth(z, lag=10)
print(smooth.mean.shape)
# > torch.Size([1, 30, 2])
