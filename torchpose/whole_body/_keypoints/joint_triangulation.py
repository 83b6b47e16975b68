"""Triangulate joints by the cameras that agree on them."""

from itertools import combinations
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame, RigMaps, see

_AGREE = 6.0  # standard deviations of the noise within which a camera agrees


class Agreed(NamedTuple):
    """Holds the keypoints [B, C, J] that agree on joints, and joints [B, J, 3] by all of these."""

    chosen: Tensor
    joints: Tensor


def triangulate(maps: RigMaps, frame: KeypointFrame) -> Float[Tensor, "B J 3"]:
    """Return joints by the cameras that agree, NaN where no two do.

    The pair of cameras that most others agree with decides; all that agree then count, by linear least
    squares of u (M p + m)_3 = (M p + m)_12.
    """
    chosen, joints = agreeing(maps, frame)
    return torch.where((chosen.sum(1) >= 2)[..., None], joints, torch.nan)


def agreeing(maps: RigMaps, frame: KeypointFrame) -> Agreed:
    """Return the keypoints of the cameras that agree on a joint, and where they have it.

    Args:
        maps: the cameras. frame: the keypoints.
    """
    normal, right = _normal_equations(maps, frame)
    there = frame.there
    best = torch.full_like(frame.variance[:, 0], -1.0)
    chosen = torch.zeros_like(there)
    for a, b in combinations(range(len(maps.shift)), 2):
        both = (there[:, a] & there[:, b])[..., None]
        pair = normal[:, a] + normal[:, b], right[:, a] + right[:, b]
        seen = see(maps, _solved(both[..., None] * pair[0], both * pair[1]))
        off = seen.pixels - frame.pixels
        error = (off * off).sum(-1) / frame.noise(seen.by_joint)
        agree = there & seen.in_front & (error < _AGREE**2)
        misfit = torch.where(agree, error, 0.0) / _AGREE**2 / len(maps.shift)
        score = (agree.to(error) - misfit).sum(1)
        score = torch.where(agree[:, a] & agree[:, b], score, -1.0)
        chosen = torch.where((score > best)[:, None], agree, chosen)
        best = torch.maximum(best, score)
    return Agreed(chosen, _by_some(normal, right, chosen))


def agreement(maps: RigMaps, frame: KeypointFrame) -> Float[Tensor, ""]:
    """Return how well cameras agree on joints, from 0 to 1.

    It is the mean of 1 - e^2 / 36 over all keypoints of joints that two cameras see or more. e is the
    distance from the joint of all that agree, in standard deviations of the noise. Of those that do not
    agree 0 counts.

    Args:
        maps: the cameras. frame: the keypoints.
    """
    good, count = agreement_of_each(maps, frame)
    return good.sum() / count.sum().clamp_min(1)


def agreement_of_each(
    maps: RigMaps, frame: KeypointFrame
) -> tuple[Float[Tensor, " B"], Int[Tensor, " B"]]:
    """Return the sums of `agreement` of each element of the batch, and the numbers of its keypoints."""
    chosen, joints = agreeing(maps, frame)
    seen = see(maps, joints)
    error = (seen.pixels - frame.pixels).square().sum(-1) / frame.noise(seen.by_joint)
    good = torch.where(chosen, (1 - error / _AGREE**2).clamp_min(0), 0.0)
    return torch.where(frame.shared, good, 0.0).sum((1, 2)), frame.shared.sum((1, 2))


def triangulate_all(
    maps: RigMaps, frame: KeypointFrame, use: Bool[Tensor, "B C J"]
) -> Float[Tensor, "B J 3"]:
    """Return joints by all keypoints that are to be used, whether or not they agree.

    Args:
        maps: the cameras. frame: the keypoints. use: which of them count.
    """
    return _by_some(*_normal_equations(maps, frame), use)


def triangulate_without(
    maps: RigMaps, frame: KeypointFrame, left_out: Bool[Tensor, "B C"]
) -> Float[Tensor, "B J 3"]:
    """Return joints by the cameras that are not left out, or by all where too few of these see them.

    Args:
        maps: the cameras. frame: the keypoints. left_out: which cameras.
    """
    use = frame.there & ~left_out[..., None]
    enough = use.sum(1, keepdim=True) >= 2
    return triangulate_all(maps, frame, torch.where(enough, use, frame.there))


def _normal_equations(
    maps: RigMaps, frame: KeypointFrame
) -> tuple[Float[Tensor, "B C J 3 3"], Float[Tensor, "B C J 3"]]:
    """Return what each camera adds to the normal equations of the joints."""
    rows = maps.matrix[:, None, 2:] * frame.pixels[..., None] - maps.matrix[:, None, :2]
    right = maps.shift[:, None, :2] - maps.shift[:, None, 2:] * frame.pixels
    size = torch.linalg.vector_norm(maps.matrix[:, 2], dim=-1)[:, None, None]
    rows, right = rows / size[..., None], right / size
    return rows.mT @ rows, (rows.mT @ right[..., None]).squeeze(-1)


def _by_some(
    normal: Float[Tensor, "B C J 3 3"], right: Float[Tensor, "B C J 3"], use: Bool[Tensor, "B C J"]
) -> Float[Tensor, "B J 3"]:
    """Return joints by what some keypoints add to their normal equations."""
    count = use.to(right)[..., None]
    return _solved((count[..., None] * normal).sum(1), (count * right).sum(1))


def _solved(
    normal: Float[Tensor, "B J 3 3"], right: Float[Tensor, "B J 3"]
) -> Float[Tensor, "B J 3"]:
    """Return the joints of least squares."""
    return torch.linalg.solve(
        normal + 1e-9 * torch.eye(3, dtype=normal.dtype, device=normal.device), right
    )
