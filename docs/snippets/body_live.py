import torch

from torchpose import BodyTracker
from torchpose.body import BODY_15, Body
from torchpose.camera import PinholeCamera
from torchpose.whole_body import render

camera = PinholeCamera(80, 80, 39.5, 29.5, 80, 60, rotation=(torch.pi, 0, 0), translation=(0, 0, 3))
standing = torch.zeros(36, dtype=torch.float64)
frames = render(Body.of_height(BODY_15, 1.75), standing.expand(4, -1), camera, 60, 80)

tracker = BodyTracker(camera, "sir", height=1.75, n_particles=100, fps=30.0)
state = tracker.init(initial_state=standing, generator=torch.Generator().manual_seed(0))
for frame in frames:  # bool [C, H, W]
    state, pose = tracker.step(state, frame)
    print(pose.first_frame, pose.joints3d.shape)  # [1, 15, 3]
