import math

import torch

from torchpose.body import BODY_15, Body, fit_body, fit_state
from torchpose.learning import fit_gplvm, fit_gplvm_noise
from torchpose.priors import ManifoldInfo

# recordings of one person; here legs that walk, in yours joints [T, 15, 3] of `read_mocap`
body = Body.of_height(BODY_15, 1.75)
phase = torch.arange(90, dtype=torch.float64) * (2 * math.pi / 60)
states = torch.zeros(90, body.dim, dtype=torch.float64)
for side, sign in (("left", 1.0), ("right", -1.0)):
    states[:, 3 + 3 * BODY_15.part(f"{side}_thigh")] = sign * 0.25 * phase.sin()
    states[:, 3 + 3 * BODY_15.part(f"{side}_shank")] = 0.2 + 0.1 * sign * phase.cos()
trials = [body.joints(scale * states) for scale in (1.0, 0.9, 1.1)]

body = fit_body(torch.cat(trials))
poses = [body.relative(fit_state(body, joints)) for joints in trials]
manifold = fit_gplvm(
    [pose[::3] for pose in poses[:-1]],
    validation=poses[-1:],
    info=ManifoldInfo.of_body(body, name="walk"),
)
fit_gplvm_noise(manifold, poses[-1:], fps=60.0)  # the three standard deviations

z = manifold.to_latent(poses[0])  # [T, 2]
mean, variance = manifold.to_pose(z)  # [T, 30] and [T]
print(z.shape, mean.shape, variance.shape)
