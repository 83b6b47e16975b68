import torch
from torch import Tensor, nn

import torchpose
from torchpose.demo import KEYPOINT_NAMES, demo_camera, noisy_keypoints, performer


class FrontEnd(nn.Module):
    """What moves keypoints: here a factor for each keypoint's distance from the neck."""

    def __init__(self) -> None:
        super().__init__()
        self.log_scale = nn.Parameter(torch.zeros(4, 1, dtype=torch.float64))

    def forward(self, keypoints: Tensor) -> Tensor:
        neck = keypoints[..., 1:2, :]
        return neck + self.log_scale.exp() * (keypoints - neck)


prior = torchpose.load_prior("kinect-upper-body-small")
tracker = torchpose.UpperBodyTracker(prior, camera=demo_camera(), method="window-mixture")
tracker.requires_grad_(False)
truth = performer(20, seed=0).joints
keypoints = noisy_keypoints(truth, std_px=3.0)[None]  # unbiased: no factor needs to change


def train(
    n_steps: int, weight_of_evidence: float, weight_of_truth: float
) -> tuple[FrontEnd, float, float]:
    front_end = FrontEnd()
    optimizer = torch.optim.Adam(front_end.parameters(), lr=0.03)
    for _ in range(n_steps):
        optimizer.zero_grad()
        track = tracker(front_end(keypoints), names=KEYPOINT_NAMES)
        evidence = track.log_evidence.sum(-1).mean()  # nats a frame
        error = 100 * (track.joints3d[0] - truth).norm(dim=-1).mean()  # cm
        loss = weight_of_truth * error - weight_of_evidence * evidence
        loss.backward()
        optimizer.step()
    return front_end, float(evidence.detach()), float(error.detach())


_, evidence, error = train(1, 0.0, 0.0)  # as it is
blind, more_evidence, more_error = train(16, 1.0, 0.0)
print(more_evidence > evidence + 0.2, more_error > 1.5 * error)
# > True True
print(bool((blind.log_scale[[0, 2, 3]] < -0.03).all()))  # head and hands drawn to the neck
# > True
_, _, supervised_error = train(16, 0.1, 1.0)
print(supervised_error < error)
# > True
