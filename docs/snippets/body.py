import torch

from torchpose import BodyTracker
from torchpose.body import BODY_15, Body
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.whole_body import render

front = PinholeCamera(150, 150, 79.5, 59.5, 160, 120, "front", rotation=(torch.pi, 0, 0),
                      translation=(0, 0, 3))  # fmt: skip
side = PinholeCamera(150, 150, 79.5, 59.5, 160, 120, "side", rotation=(2.2214, 0, 2.2214),
                     translation=(0, 0, 3.2))  # fmt: skip
rig = CameraRig([front, side])

standing = torch.zeros(36, dtype=torch.float64)  # y up, arms hanging
body = Body.of_height(BODY_15, 1.75)
silhouettes = render(body, standing.expand(5, -1), rig, 120, 160)  # bool [T, C, H, W]
tracker = BodyTracker(rig, "apf", height=1.75, n_particles=200, fps=30.0)
poses = tracker(silhouettes, generator=torch.Generator().manual_seed(0))
print(poses.joints3d.shape, poses.covariance3d.shape)  # [T, 15, 3] metres, [T, 15, 3, 3]
