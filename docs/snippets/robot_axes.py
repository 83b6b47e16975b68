import torch

import torchpose

prior = torchpose.load_prior("kinect-upper-body")
size = (640, 480)
# world to camera, as camera files have it; here the robot's base, z up, whose camera looks along x from 1.2 m
to_camera = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)
place = torch.tensor([0.1, 0.0, 1.2], dtype=torch.float64)  # of the camera, in the base
camera = torchpose.PinholeCamera(
    525, 525, 319.5, 239.5, *size, rotation=to_camera, translation=-to_camera @ place
)

tracker = torchpose.UpperBodyTracker(prior, camera)
keypoints = torch.tensor([[320.0, 130.0], [320.0, 190.0], [420.0, 240.0], [220.0, 330.0]])
track = tracker(keypoints.expand(1, 5, 4, 2), names=["head", "neck", "hand_left", "hand_right"])

R, t = camera.rotation_matrix, camera.translation
joints = (track.joints3d - t) @ R  # R^T (x - t)
covariance = R.T @ track.covariance3d @ R  # R^T C R; relative to the body, see above
print(joints.shape, covariance.shape)
# > torch.Size([1, 5, 8, 3]) torch.Size([1, 5, 8, 3, 3])
print(bool((joints[..., 3, 2] > joints[..., 4, 2]).all()), bool((joints[..., 0] > 1).all()))
# > True True
