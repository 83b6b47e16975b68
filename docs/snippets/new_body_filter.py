import torch

from torchpose.body import BODY_15, Body
from torchpose.camera import PinholeCamera
from torchpose.whole_body import (
    BodyTracker,
    SilhouetteParticleFilter,
    register_body_filter,
    render,
    reweight,
)


class SwingingParticleFilter(SilhouetteParticleFilter):
    """Particles that go on as they moved: half of a particle's last step, and noise."""

    def first_memory(self, particles):
        return torch.zeros_like(particles)

    def move(self, state, frame, generator):
        carried = self.body.perturb(state.particles, 0.5 * state.memory)
        moved = self.diffuse(carried, self.step_std, generator)
        out = reweight(moved, state.log_weights + self.log_limits(moved), frame.score(moved))
        return out._replace(memory=self.body.difference(moved, state.particles))


register_body_filter("swinging", SwingingParticleFilter)

body = Body.of_height(BODY_15, 1.75)
standing = torch.zeros(body.dim, dtype=torch.float64)
camera = PinholeCamera(80, 80, 39.5, 29.5, 80, 60, rotation=(torch.pi, 0, 0), translation=(0, 0, 3))
silhouettes = render(body, standing.expand(4, -1), camera, 60, 80)  # bool [T, 1, H, W]

tracker = BodyTracker(camera, "swinging", body=body, n_particles=100, fps=30.0, leg_swap=0.1)
poses = tracker(silhouettes, standing, generator=torch.Generator().manual_seed(0))
print(poses.method, poses.joints3d.shape, poses.coasting.tolist())
