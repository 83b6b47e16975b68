import math

import torch

from torchpose import BodyTracker, PinholeCamera
from torchpose.body import BODY_15, Body
from torchpose.camera import CameraRig

# A phone that looks down by 15 degrees, and somebody who stands 3.5 m in front of it, 0.8 m below.
camera = PinholeCamera(1600, 1600, 539.5, 959.5, 1080, 1920)
states = torch.zeros(20, 36, dtype=torch.float64)
states[:, 1:3] = torch.tensor([-0.8, -3.5])
states[:, 4] = 0.5  # radians to the side
held = CameraRig([camera.tilted(math.radians(-15)).in_level_world()])
keypoints = held(Body.of_height(BODY_15, 1.75).joints(states)).pixels

tracker = BodyTracker([camera.in_level_world()], "kalman", fps=30.0)
tilt = tracker.find_tilt([tracker(keypoints=keypoints, names=BODY_15.names)])
print(abs(tilt.pitch - math.radians(-15)) < 2 * tilt.pitch_std)  # of nobody who stands it is None
# > True

camera = camera.tilted(tilt.pitch, tilt.roll).in_level_world()
track = BodyTracker([camera], "kalman", fps=30.0, up="y")(keypoints=keypoints, names=BODY_15.names)
trunk = track.joints3d[-1, BODY_15.joint("neck")] - track.joints3d[-1, BODY_15.joint("pelvis")]
print(bool(trunk[1] > 0.98 * trunk.norm()))  # upright
# > True
