import torch

from torchpose.body import BODY_15, Body
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.whole_body import bidirectional, count_pixels, render

body = Body.of_height(BODY_15, 1.75)
camera = PinholeCamera(
    150, 150, 79.5, 59.5, 160, 120, rotation=(torch.pi, 0, 0), translation=(0, 0, 3)
)
rig = CameraRig([camera])
standing = torch.zeros(body.dim, dtype=torch.float64)
silhouettes = render(body, standing, rig, 120, 160)  # bool [C, H, W]

states = standing + 0.1 * torch.randn(500, body.dim, dtype=torch.float64)  # [N, D]
counts = count_pixels(body, states, rig, silhouettes)
log_weights = 100 * bidirectional(counts)  # [N]; 100 is the sharpness
print(log_weights.shape)
