import torch

from torchpose.camera import PinholeCamera, lift, map_pixels, project
from torchpose.math import euler_to_matrix

camera = PinholeCamera(fx=525, fy=525, cx=319.5, cy=239.5, width=640, height=480)
R = euler_to_matrix(torch.tensor([0.02, -0.05, 0.03], dtype=torch.float64), order="zxy")
t = torch.tensor([0.05, -0.2, 2.0], dtype=torch.float64)

points = torch.randn(8, 3, dtype=torch.float64) * 0.3  # body axes, metres
uvl = project(points, camera.matrix, R, t)  # pixels, pixels, metres of depth
back = lift(uvl, camera.matrix, R, t)
print(torch.allclose(back, points))
# > True

half = PinholeCamera.from_image_size(320, 240)  # nothing known but the size
print(map_pixels(torch.tensor([[319.5, 239.5]]), camera.matrix, half.matrix))
# > tensor([[159.5000, 119.5000]])

camera.save("camera.toml")
print(PinholeCamera.load("camera.toml"))
# > PinholeCamera(fx=525, fy=525, cx=319.5, cy=239.5, width=640, height=480, name='camera')
