import torch

import torchpose

prior = torchpose.load_prior("kinect-upper-body")
tracker = torchpose.UpperBodyTracker(prior, camera=prior.camera, fps=30)

state = tracker.init(batch_size=1, names=["head", "neck", "hand_left", "hand_right"])
for t in range(30):  # a hand waves, and is lost for a while
    hand = [420.0, 200.0 + 2 * t] if not 10 < t < 20 else [float("nan")] * 2
    frame = torch.tensor([[[320.0, 130.0], [320.0, 190.0], hand, [220.0, 330.0]]])
    state, pose = tracker.step(state, frame)

print(pose.joints3d.shape, pose.unseen.tolist())
# > torch.Size([1, 8, 3]) [0.0]
