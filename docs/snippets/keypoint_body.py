import math

import torch

from torchpose import BodyTracker
from torchpose.body import BODY_15, Body
from torchpose.camera import CameraRig, PinholeCamera

# Two cameras at a right angle, 3 m away; CameraRig.load("cameras.toml") reads calibrated ones.
size, turns = (1280, 720), {"front": math.pi, "side": math.pi / 2}
rig = CameraRig([
    PinholeCamera(900, 900, 639.5, 359.5, *size, name, rotation=(0, turn, 0), translation=(0, 0, 3))
    for name, turn in turns.items()
])  # fmt: skip
states = torch.zeros(15, 36, dtype=torch.float64)
states[:, 0] = torch.linspace(0, 0.1, 15)  # metres to the side
states[:, 3] = math.pi  # upright where y points down
truth = Body.of_height(BODY_15, 1.75).joints(states)
keypoints = rig(truth).pixels  # [T, C, J, 2] of a detector
keypoints[5:9, 0, 5] = torch.nan  # one joint is hidden from the first camera

tracker = BodyTracker(rig, "kalman", fps=30)
track = tracker(keypoints=keypoints, names=BODY_15.names, smoothing="full")
print(track.joints3d.shape, bool((track.joints3d - truth).norm(dim=-1).mean() < 0.03))
# > torch.Size([15, 15, 3]) True

state = tracker.init()  # live: one frame after the other
for frame in keypoints:  # [C, J, 2]
    state, pose = tracker.step(state, keypoints=frame, names=BODY_15.names)
print(pose.joints3d.shape, pose.covariance3d.shape)
# > torch.Size([1, 15, 3]) torch.Size([1, 15, 3, 3])
