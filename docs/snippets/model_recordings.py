import torch
from torch.nn.utils.rnn import pad_sequence

import torchpose
from torchpose.demo import KEYPOINT_NAMES, demo_camera, noisy_keypoints, performer

# 40 recordings of 20 to 59 frames
clip = noisy_keypoints(performer(100, seed=0).joints, std_px=3.0)
recordings = [clip[i : i + 20 + i % 40] for i in range(40)]

prior = torchpose.load_prior("kinect-upper-body-small")
tracker = torchpose.UpperBodyTracker(prior, camera=demo_camera(), method="window-mixture")

poses: dict[int, torch.Tensor] = {}
order = sorted(range(len(recordings)), key=lambda i: len(recordings[i]))
for start in range(0, len(order), 20):
    batch = order[start : start + 20]  # of similar lengths, so that little is padding
    lengths = torch.tensor([len(recordings[i]) for i in batch])
    padded = pad_sequence([recordings[i] for i in batch], batch_first=True)
    with torch.inference_mode():
        track = tracker(padded, names=KEYPOINT_NAMES, lengths=lengths)
    for row, i in enumerate(batch):
        poses[i] = track.sequence(row).joints3d[0].clone()  # its own frames alone

print(len(poses), poses[7].shape)
# > 40 torch.Size([27, 8, 3])
with torch.inference_mode():
    alone = tracker(recordings[7][None], names=KEYPOINT_NAMES)
print(torch.allclose(poses[7], alone.joints3d[0]))
# > True
