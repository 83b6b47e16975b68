"""Find whole frames by which cameras are late, from keypoints alone."""

from itertools import combinations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.camera._rig import CameraRig
from torchpose.math._rotations import cross_matrix
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame

_ROUNDS = 10  # over all cameras, at most
_LEAST_PIXELS = 1.0


def coarse_delays(rig: CameraRig, frames: KeypointFrame, longest: int) -> Int[Tensor, " C"]:
    """Return delays by which keypoints of pairs of cameras best lie on each other's epipolar lines.

    The distances of a pair may have a common offset, which wrong orientations make.

    Args:
        rig: the cameras. frames: keypoints [T, C, J]. longest: delay of a camera against another, frames.
    """
    n = len(rig)
    costs = frames.pixels.new_zeros(n, n, 2 * longest + 1)
    for a, b in combinations(range(n), 2):
        costs[a, b] = _pair_costs(rig, frames, a, b, longest)
        costs[b, a] = costs[a, b].flip(0)
    delays = [0] * n
    known = [0]
    while len(known) < n:  # one after the other, the one that is told best by those before
        rest = [c for c in range(n) if c not in known]
        totals = {c: _totals(costs, delays, known, c, longest) for c in rest}
        best = max(rest, key=lambda c: float(totals[c].median() - totals[c].min()))
        delays[best] = int(totals[best].argmin()) - longest
        known.append(best)
    for _ in range(_ROUNDS):
        before = list(delays)
        for c in range(1, n):
            others = [k for k in range(n) if k != c]
            delays[c] = int(_totals(costs, delays, others, c, longest).argmin()) - longest
        if delays == before:
            break
    return torch.tensor(delays)


def _totals(
    costs: Tensor, delays: list[int], known: list[int], camera: int, longest: int
) -> Float[Tensor, " L"]:
    """Return costs of the delays of a camera, given those of others."""
    found = costs.new_zeros(2 * longest + 1)
    place = torch.arange(2 * longest + 1)
    for k in known:
        found = found + costs[k, camera][(place - delays[k]).clamp(0, 2 * longest)]
    return found


def _pair_costs(
    rig: CameraRig, frames: KeypointFrame, a: int, b: int, longest: int
) -> Float[Tensor, " L"]:
    """Return the costs of a pair for delays of b against a from -longest to longest.

    The cost is the mean of log(1 + e^2 / s^2), with e the distance from epipolar lines and s its size at the
    best delay.
    """
    F = _fundamental(rig, a, b)
    there = frames.there
    found = []
    for delay in range(-longest, longest + 1):
        first, second = _rows(len(there), delay)
        both = there[first, a] & there[second, b]
        p, q = frames.pixels[first, a][both], frames.pixels[second, b][both]
        if not len(p):
            found.append(p.new_zeros(0))
            continue
        p, q = (torch.cat([x, torch.ones_like(x[:, :1])], -1) for x in (p, q))
        lines, back = p @ F.mT, q @ F
        size = (lines[:, :2].square().sum(-1) + back[:, :2].square().sum(-1)).sqrt()
        e = (q * lines).sum(-1) / size
        found.append((e - e.median()).abs())
    if not all(map(len, found)):
        return frames.pixels.new_zeros(2 * longest + 1)
    scale = torch.stack([e.median() for e in found]).min().clamp_min(_LEAST_PIXELS)
    return torch.stack([torch.log1p((e / scale).square()).mean() for e in found])


def _fundamental(rig: CameraRig, a: int, b: int) -> Float[Tensor, "3 3"]:
    """Return F with q^T F p = 0 for pixels p of camera a and q of camera b."""
    R = rig.rotation[b] @ rig.rotation[a].mT
    t = rig.translation[b] - R @ rig.translation[a]
    left = torch.linalg.solve(rig.matrix[b].mT, cross_matrix(t) @ R)
    return torch.linalg.solve(rig.matrix[a].mT, left.mT).mT


def _rows(count: int, delay: int) -> tuple[slice, slice]:
    """Return frames t and t + delay that are both there."""
    return slice(max(0, -delay), count - max(0, delay)), slice(max(0, delay), count + min(0, delay))


def shifted(
    frames: KeypointFrame, delays: Int[Tensor, " C"], beyond: float = 0.0
) -> tuple[KeypointFrame, Int[Tensor, "T C"]]:
    """Return frames with the keypoints of camera c of frame t + delay, and by how much each was shifted.

    Args:
        frames: [T, C, J]. delays: whole frames.
        beyond: factor of the trust in the first and last keypoints, which stand for those before and after.
    """
    rows, places = _places(len(frames.pixels), delays)
    moved = frames.map(lambda value: value[places, torch.arange(len(delays))])
    trust = torch.where(places == rows + delays, 1.0, beyond).to(moved.inlier)
    return moved._replace(inlier=moved.inlier * trust[..., None]), places - rows


def shifted_flags(flags: Bool[Tensor, "T C"], delays: Int[Tensor, " C"]) -> Bool[Tensor, "T C"]:
    """Return flags of camera c of frame t + delay; those of the first and last stand for others beyond."""
    places = _places(len(flags), delays)[1]
    return flags[places, torch.arange(len(delays))]


def _places(count: int, delays: Int[Tensor, " C"]) -> tuple[Int[Tensor, "T 1"], Int[Tensor, "T C"]]:
    """Return frames t, and t + delay within the sequence."""
    rows = torch.arange(count, device=delays.device)[:, None]
    return rows, (rows + delays).clamp(0, count - 1)
