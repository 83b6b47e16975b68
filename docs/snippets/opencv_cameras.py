import cv2
import numpy as np

from torchpose.camera import PinholeCamera, load_cameras, save_cameras

# What cv2.calibrateCamera and cv2.solvePnP found for each camera; translations in metres.
K = np.array([[900.0, 0.0, 639.5], [0.0, 905.0, 359.5], [0.0, 0.0, 1.0]])
distortions = np.array([[-0.1, 0.02, 0.0, 0.0, 0.0]])
R = np.diag([1.0, -1.0, -1.0])  # a matrix, where it is no vector of three numbers
found = {"left": (K, distortions, cv2.Rodrigues(R)[0], np.array([[0.0], [0.9], [3.0]]))}

cameras = [
    PinholeCamera(
        K[0, 0], K[1, 1], K[0, 2], K[1, 2], 1280, 720, name, distortions=d.ravel().tolist(),
        rotation=rotation.ravel().tolist(), translation=translation.ravel().tolist(),
    )
    for name, (K, d, rotation, translation) in found.items()
]  # fmt: skip
save_cameras(cameras, "cameras.toml")
print(load_cameras("cameras.toml")["left"])
# > PinholeCamera(fx=900, fy=905, cx=639.5, cy=359.5, width=1280, height=720, name='left')
