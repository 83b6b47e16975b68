import torch
from torch import Tensor, nn

from torchpose.filters import FilterOutput, MixtureKalmanFilter
from torchpose.priors import GaussianMixture


class LearntFilter(nn.Module):
    """A mixture Kalman filter whose Q and R are learnt, positive by construction."""

    def __init__(self, prior: GaussianMixture, observed: list[int]) -> None:
        super().__init__()
        self.prior, self.observed = prior, observed
        self.log_process = nn.Parameter(torch.zeros(prior.dim, dtype=torch.float64))
        self.log_measurement = nn.Parameter(torch.zeros(len(observed), dtype=torch.float64))

    def forward(self, z: Tensor, lengths: Tensor | None = None) -> FilterOutput:
        process, measurement = self.log_process.exp(), self.log_measurement.exp()
        model = MixtureKalmanFilter(self.prior, process, measurement, self.observed)
        return model(z, lengths=lengths)


generator = torch.Generator().manual_seed(0)
prior = GaussianMixture(
    torch.tensor([0.5, 0.5], dtype=torch.float64),
    torch.tensor([[0.0, 0.0], [6.0, 6.0]], dtype=torch.float64),
    4 * torch.eye(2, dtype=torch.float64).expand(2, 2, 2),
)
walk = 0.1 * torch.randn(16, 40, 2, generator=generator, dtype=torch.float64)
z = walk.cumsum(1) + 0.5 * torch.randn(16, 40, 2, generator=generator, dtype=torch.float64)

model = LearntFilter(prior, observed=[0, 1])
optimizer = torch.optim.Adam(model.parameters(), lr=0.2)
for _ in range(20):
    optimizer.zero_grad()
    loss = -model(z).log_evidence.mean()
    loss.backward()
    optimizer.step()
learnt = model.log_measurement.detach().exp().sqrt()
print(bool(((learnt - 0.5).abs() < 0.1).all()))  # the noise that was put in
# > True

# a checkpoint holds the model and the optimizer's moments, as of any module
torch.save({"model": model.state_dict(), "optimizer": optimizer.state_dict()}, "checkpoint.pt")
again = LearntFilter(prior, observed=[0, 1])
checkpoint = torch.load("checkpoint.pt", weights_only=True)
again.load_state_dict(checkpoint["model"])

with torch.inference_mode():
    print(torch.equal(again(z).mean, model(z).mean))
# > True
