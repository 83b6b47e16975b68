import torch
from torch import Tensor, nn

import torchpose
from torchpose.demo import KEYPOINT_NAMES, demo_camera, noisy_keypoints, performer


class Certainty(nn.Module):
    """What says how sure each keypoint is: here from whether its part of the image is blurred."""

    def __init__(self) -> None:
        super().__init__()
        self.log_std = nn.Linear(1, 1)  # float32, as the rest of a network
        nn.init.zeros_(self.log_std.weight)
        nn.init.constant_(self.log_std.bias, 1.6)  # 5 pixels

    def forward(self, blurred: Tensor) -> Tensor:
        variance = (2 * self.log_std(blurred)).exp()  # [B, T, J, 1]
        return variance[..., None] * torch.eye(2)


prior = torchpose.load_prior("kinect-upper-body-small")
tracker = torchpose.UpperBodyTracker(prior, camera=demo_camera(), method="window-mixture")
generator = torch.Generator().manual_seed(0)


def recording(seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return true joints, keypoints, of which 40 % have errors of 20 pixels, and which these are."""
    truth = performer(20, seed=seed).joints
    blurred = torch.rand(1, 20, 4, 1, generator=generator) < 0.4
    noise = torch.randn(1, 20, 4, 2, generator=generator)
    keypoints = noisy_keypoints(truth, std_px=2.0)[None] + 20 * blurred * noise
    return truth, keypoints, blurred.float()


_, keypoints, blurred = recording(seed=0)  # its true joints are not needed
certainty = Certainty()
optimizer = torch.optim.Adam(certainty.parameters(), lr=0.3)
for _ in range(8):
    optimizer.zero_grad()
    track = tracker(keypoints, names=KEYPOINT_NAMES, covariance=certainty(blurred))
    (-track.log_evidence.mean()).backward()
    optimizer.step()

truth, keypoints, blurred = recording(seed=7)
with torch.inference_mode():
    sharp_std, blurred_std = certainty(torch.tensor([[0.0], [1.0]]))[:, 0, 0].sqrt()
    errors = [
        (tracker(keypoints, names=KEYPOINT_NAMES, covariance=cov).joints3d[0] - truth).norm(dim=-1)
        for cov in (None, certainty(blurred))
    ]
print(bool(sharp_std < 5 < 10 < blurred_std))  # pixels
# > True
print(bool(errors[1].mean() < 0.8 * errors[0].mean()))
# > True
