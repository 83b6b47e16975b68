import torch
from torch import nn

import torchpose
from torchpose.filters import MixtureKalmanFilter
from torchpose.priors import GaussianMixture

prior = GaussianMixture(
    weights=torch.tensor([0.5, 0.5]),
    means=torch.tensor([[0.0, 0.0], [4.0, 4.0]]),
    covariances=torch.tensor([[1.0, 0.8], [0.8, 1.0]]).expand(2, 2, 2),
)
tracker = MixtureKalmanFilter(prior, torch.full((2,), 0.1), torch.full((1,), 0.05), observed=[0])
z = 4 + 0.2 * torch.randn(3, 20, 1, dtype=torch.float64)  # three sequences of twenty frames
expected = tracker(z).mean


class Step(nn.Module):
    def __init__(self, tracker):
        super().__init__()
        self.tracker = tracker

    def forward(self, state, z):
        state, out = self.tracker.step(state, z)
        return state, out.mean


with torchpose.without_value_checks():  # every element gets covariances of its own
    state, _ = tracker.step(tracker.init(3), z[:, 0])

program = torch.export.export(Step(tracker), (state, z[:, 1])).module()
for t in range(1, 20):
    state, mean = program(state._replace(time=1), z[:, t])
print((mean - expected[:, -1]).abs().max() < 1e-12)
# > tensor(True)


def estimates(z):  # of one frame, from the first state
    return tracker.step(tracker.init(3), z)[1].mean


with torchpose.without_value_checks():
    many = torch.func.vmap(estimates)(z.transpose(0, 1))  # twenty frames side by side
print(many.shape)
# > torch.Size([20, 3, 2])
