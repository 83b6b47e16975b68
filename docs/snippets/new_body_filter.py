import torch

from torchpose.body import BODY_15, Body
from torchpose.whole_body import SilhouetteParticleFilter
from torchpose.whole_body.filters.body_particles import reweight


class SwingingParticleFilter(SilhouetteParticleFilter):
    """Particles that go on as they moved: half of a particle's last step, and noise."""

    def first_memory(self, particles):
        return torch.zeros_like(particles)

    def move(self, state, frame, generator):
        carried = self.body.perturb(state.particles, 0.5 * state.memory)
        moved = self.diffuse(carried, self.step_std, generator)
        out = reweight(moved, state.log_weights + self.log_limits(moved), frame.score(moved))
        return out._replace(memory=self.body.difference(moved, state.particles))


body = Body.of_height(BODY_15, 1.75)
wrist = BODY_15.joint("left_wrist")
frames = torch.tensor([[0.2, 0.8, 0.1], [0.2, 0.82, 0.15], [torch.nan] * 3], dtype=torch.float64)


def likelihood(states, frame):  # of the left wrist, measured to a centimetre
    apart = body.joints(states)[..., wrist, :] - frame[:, None]
    return -0.5 * (apart / 0.01).square().sum(-1)


tracker = SwingingParticleFilter(body, 500, likelihood=likelihood)
start = torch.zeros(body.dim, dtype=torch.float64)
track = tracker(frames, None, start, torch.Generator().manual_seed(0))
print(track.mean.shape, track.coasting.tolist())
