"""Triangulate joints by the cameras that agree on them."""

from itertools import combinations

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps, see

_AGREE = 6.0  # standard deviations of the noise within which a camera agrees


def triangulate(maps: RigMaps, frame: KeypointFrame) -> Float[Tensor, "B J 3"]:
    """Return joints by the cameras that agree, NaN where no two do.

    The pair of cameras that most others agree with decides; all that agree then count, by linear least
    squares of u (M p + m)_3 = (M p + m)_12.
    """
    rows = maps.matrix[:, None, 2:] * frame.pixels[..., None] - maps.matrix[:, None, :2]
    right = maps.shift[:, None, :2] - maps.shift[:, None, 2:] * frame.pixels
    size = maps.matrix[:, 2].norm(dim=-1)[:, None, None]
    rows, right = rows / size[..., None], right / size
    there = frame.inlier > 0

    def solve(use: Tensor) -> Tensor:
        scaled = rows * use.to(rows)[..., None, None]
        normal = (scaled.mT @ rows).sum(1) + 1e-9 * torch.eye(3).to(rows)
        return torch.linalg.solve(normal, (scaled.mT @ right[..., None]).sum(1)).squeeze(-1)

    best = torch.full_like(rows[:, 0, :, 0, 0], -1.0)
    chosen = torch.zeros_like(there)
    for pair in combinations(range(len(maps.shift)), 2):
        use = torch.zeros_like(there)
        use[:, list(pair)] = there[:, list(pair)].all(1, keepdim=True)
        seen = see(maps, solve(use))
        variance = frame.variance + frame.relative * seen.by_joint.square().sum((-2, -1)) / 2
        error = (seen.pixels - frame.pixels).square().sum(-1) / variance
        agree = there & seen.in_front & (error < _AGREE**2)
        score = (
            agree.to(error) - torch.where(agree, error, 0.0) / _AGREE**2 / len(maps.shift)
        ).sum(1)
        score = torch.where((agree & use).sum(1) == 2, score, -1.0)
        chosen = torch.where((score > best)[:, None], agree, chosen)
        best = torch.maximum(best, score)
    return torch.where((chosen.sum(1) >= 2)[..., None], solve(chosen), torch.nan)
