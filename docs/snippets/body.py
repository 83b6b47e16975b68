import torch

from torchpose.body import BODY_15, Body
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.whole_body import AnnealedParticleFilter, render

body = Body.of_height(BODY_15, 1.75)
front = PinholeCamera(150, 150, 79.5, 59.5, 160, 120, "front", rotation=(torch.pi, 0, 0),
                      translation=(0, 0, 3))  # fmt: skip
side = PinholeCamera(150, 150, 79.5, 59.5, 160, 120, "side", rotation=(2.2214, 0, 2.2214),
                     translation=(0, 0, 3.2))  # fmt: skip
rig = CameraRig([front, side])

standing = torch.zeros(body.dim, dtype=torch.float64)  # y up, arms hanging
silhouettes = render(body, standing.expand(5, -1), rig, 120, 160)  # bool [T, C, H, W]
tracker = AnnealedParticleFilter(body, 100, n_layers=5)
track = tracker(silhouettes, rig, standing, torch.Generator().manual_seed(0))
print(body.joints(track.mean).shape, track.std.shape)  # [T, 15, 3] metres, [T, D]
