import torch

from torchpose.filters import BootstrapParticleFilter
from torchpose.priors import GaussianMixture

prior = GaussianMixture(torch.ones(1), torch.zeros(1, 2), torch.eye(2)[None])
tracker = BootstrapParticleFilter(
    prior, torch.ones(2), torch.ones(1), observed=[0], proposal="mixture", n_particles=2000
)
z = torch.linspace(0, 1, 30).reshape(1, 30, 1)
out = tracker(z, generator=torch.Generator().manual_seed(0))
print(out.effective_sample_size.shape)
# > torch.Size([1, 30])
