import math

import torch

from torchpose.body import BODY_15, Body
from torchpose.camera import PinholeCamera
from torchpose.learning import fit_action_space
from torchpose.priors import state_postures
from torchpose.whole_body import ConstrainedParticleFilter, constant_velocity_std, render

body = Body.of_height(BODY_15, 1.75)
torso, thigh = 3 + 3 * body.skeleton.part("torso"), 3 + 3 * body.skeleton.part("left_thigh")


def bend(depth, sway):  # stand-ins for recordings: states [T, D] of somebody who bends over
    phase = torch.linspace(0, math.pi, 30, dtype=torch.float64).sin()
    states = torch.zeros(30, body.dim, dtype=torch.float64)
    states[:, torso], states[:, thigh] = depth * phase, sway * phase.square()
    return states


recorded = [bend(0.4 + 0.05 * i, 0.03 * (-1) ** i) for i in range(6)]
action = fit_action_space(
    [state_postures(body, states) for states in recorded], 2, name="bend", fps=30
)

camera = PinholeCamera(150, 150, 79.5, 59.5, 160, 120, rotation=(2.2214, 0, 2.2214),
                       translation=(0, 0, 3.2))  # fmt: skip
states = bend(0.52, 0.01)[5:13]
silhouettes = render(body, states[1:], camera, 120, 160)  # bool [T, 1, H, W]

tracker = ConstrainedParticleFilter(
    body, action, 200, likelihood="overlap", sharpness=30.0,
    process_cov=constant_velocity_std(body, recorded, floor=0.005).square(),
)  # fmt: skip
track = tracker(silhouettes, camera, states[0], generator=torch.Generator().manual_seed(0))
print(track.mean.shape, track.details["acceptance"])  # [T, D], share of first draws accepted
