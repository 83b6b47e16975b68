import math

import torch

from torchpose.body import BODY_15, Body
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.learning import fit_limb_conditionals
from torchpose.priors import in_body_frame
from torchpose.whole_body import RootUncertaintyTracker, render

# recorded states of a person; here legs that walk, in yours `fit_state` of `read_mocap`
person = Body.of_height(BODY_15, 1.75)
phase = torch.arange(90, dtype=torch.float64) * (2 * math.pi / 60)
recorded = torch.zeros(90, person.dim, dtype=torch.float64)
for side, sign in (("left", 1.0), ("right", -1.0)):
    recorded[:, 3 + 3 * BODY_15.part(f"{side}_thigh")] = sign * 0.2 * phase.sin()
    recorded[:, 3 + 3 * BODY_15.part(f"{side}_shank")] = 0.2 + 0.1 * sign * phase.cos()

body, states = in_body_frame([(person, [recorded])])  # rotations against the root, safe centres
conditionals = fit_limb_conditionals(body, states, fps=60.0)  # (DX 3), (DX 14)

cameras = CameraRig(
    [
        PinholeCamera(
            150, 150, 79.5, 59.5, 160, 120, name,
            rotation=(0, angle, 0), translation=(0, 0, 3),
        )
        for name, angle in (("front", 0.0), ("side", math.pi / 2))
    ]
)  # fmt: skip
silhouettes = render(body, states[0][10:14], cameras, 120, 160)  # bool [T, C, H, W]

tracker = RootUncertaintyTracker(body, conditionals, fps=60.0, leg_swap=0.1)
track = tracker(silhouettes, cameras, states[0][9], generator=torch.Generator().manual_seed(0))
print(body.joints(track.mean).shape, track.std.shape)  # [T, 15, 3] and [T, 36]
