"""A walk animated by hand: joint angles of textbooks over the gait cycle, on a body of its own.

It is neither recorded nor drawn from a learnt model, so that a tracker with a manifold of recorded walks
meets somebody whom the manifold does not know.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body.kinematics import Body
from torchpose.body.skeleton import BODY_15
from torchpose.errors import InputError

__all__ = ["Walk", "gait_angles", "walk"]

# Flexion in degrees at shares of the cycle from one heel strike to the next of the same foot, after the
# normal curves in textbooks of gait analysis (loading, mid stance, push-off, swing). Knees are 8 degrees
# more bent: between joints of motion capture they are never quite straight.
_HIP = ((0.0, 31.0), (0.12, 26.0), (0.3, 7.0), (0.5, -8.0), (0.62, 0.0), (0.75, 22.0), (0.87, 33.0))
_KNEE = ((0.0, 13.0), (0.14, 26.0), (0.38, 14.0), (0.5, 19.0), (0.62, 47.0), (0.72, 67.0),
         (0.86, 34.0), (0.96, 11.0))  # fmt: skip
_SHOULDER = ((0.0, -20.0), (0.25, -6.0), (0.5, 15.0), (0.75, -2.0))
_ELBOW = ((0.0, 14.0), (0.5, 38.0))
_LEAN, _TURN, _TILT = 4.0, 4.0, 3.0  # degrees: the trunk forwards, the pelvis round and to the side
_COUNTER = 7.0  # of the shoulders against the pelvis
_AWAY, _IN = 6.0, 3.0  # of the arms from the trunk, of the legs: steps are a hand wide
_ANKLE = 0.08  # metres above the floor
_SOFT = 0.008  # metres, over which the weight goes from foot to foot


class Walk(NamedTuple):
    """Somebody who walks.

    Attributes:
        body: who. states: [T, 36] of the body. joints: [T, 15, 3], metres, y up, the floor at 0.
        fps: frames per second.
    """

    body: Body
    states: Tensor
    joints: Tensor
    fps: float


def gait_angles(phase: Float[Tensor, " T"]) -> dict[str, Float[Tensor, " T"]]:
    """Return the flexion of hip, knee, shoulder and elbow of one side, radians.

    Args:
        phase: share of the cycle since this side's heel strike; whole numbers count for nothing.
    """
    curves = {"hip": _HIP, "knee": _KNEE, "shoulder": _SHOULDER, "elbow": _ELBOW}
    return {name: torch.deg2rad(_curve(phase, keys)) for name, keys in curves.items()}


def walk(
    seconds: float = 3.0,
    fps: float = 60.0,
    height: float = 1.8,
    seed: int = 0,
    cadence: float = 0.92,
    stray: float = 25.0,
) -> Walk:
    """A walk past the origin along z, in a bend.

    Args:
        seconds, fps: how long, and frames per second.
        height: metres; of it, the legs have more and trunk and arms less than average.
        seed: of small differences from step to step. cadence: gait cycles (two steps) per second.
        stray: degrees by which the way bends from its start to its end.

    Raises:
        InputError: values that are not positive.

    >>> walk(1.0).joints.shape
    torch.Size([60, 15, 3])
    """
    for name, value in (
        ("seconds", seconds),
        ("fps", fps),
        ("height", height),
        ("cadence", cadence),
    ):
        if not 0 < value < math.inf:
            raise InputError(f"{name} must be positive, got {value:g}")
    body = _walker(height)
    t = torch.arange(max(2, round(seconds * fps)), dtype=torch.float64) / fps
    generator = torch.Generator().manual_seed(seed)
    rate, shift = torch.rand(2, 4, generator=generator, dtype=torch.float64)
    wander = torch.sin(2 * math.pi * ((0.15 + 0.3 * rate) * t[:, None] + shift))  # [T, 4]
    phase = cadence * t + 0.01 * wander[:, 0]
    states = torch.zeros(len(t), body.dim, dtype=torch.float64)
    states[:, 6:] = _parts(phase, wander)
    middle = t - t[-1] / 2
    heading = math.radians(stray) * middle / t[-1] + math.radians(1.5) * wander[:, 3]
    turn = math.radians(_TURN) * torch.cos(2 * math.pi * phase)
    tilt = math.radians(_TILT) * torch.sin(2 * math.pi * phase)
    states[:, 3:6] = _about_two_axes(heading + turn, tilt)
    return _on_the_floor(body, states, heading, fps)


def _walker(height: float) -> Body:
    """Somebody of other proportions than the average."""
    lengths = BODY_15.standard_lengths(height)
    factors = {
        "knee": 1.04,
        "ankle": 1.03,
        "elbow": 0.95,
        "wrist": 0.96,
        "shoulder": 1.06,
        "neck": 0.96,
    }
    for i, name in enumerate(BODY_15.names):
        lengths[i] *= factors.get(name.rpartition("_")[2], 1.0)
    return Body(BODY_15, lengths, BODY_15.standard_radii(height))


def _parts(phase: Tensor, wander: Tensor) -> Float[Tensor, "T 30"]:
    """Return the relative rotations of all parts but the pelvis, as quaternion vectors."""
    vectors = torch.zeros(len(phase), len(BODY_15.parts), 3, dtype=torch.float64)

    def bend(part: str, flexion: Tensor, sideways: float = 0.0) -> None:
        """Turn a part about x; positive takes what hangs down backwards."""
        vectors[:, BODY_15.part(part), 0] = torch.sin(flexion / 2)
        vectors[:, BODY_15.part(part), 2] = math.sin(math.radians(sideways) / 2)

    for side, sign, late in (("left", 1.0, 0.0), ("right", -1.0, 0.5)):
        angles = gait_angles(phase + late)
        swing = 1 + 0.06 * wander[:, 1 if side == "left" else 2]
        bend(f"{side}_thigh", -angles["hip"], -sign * _IN)
        bend(f"{side}_shank", angles["knee"])
        bend(f"{side}_upper_arm", -swing * angles["shoulder"], sign * _AWAY)
        bend(f"{side}_forearm", -swing * angles["elbow"])
    torso = BODY_15.part("torso")
    vectors[:, torso, 0] = math.sin(math.radians(_LEAN) / 2)
    # the shoulders turn against the pelvis
    vectors[:, torso, 1] = torch.sin(-math.radians(_COUNTER) * torch.cos(2 * math.pi * phase) / 2)
    vectors[:, BODY_15.part("head"), 0] = math.sin(-math.radians(_LEAN) / 2)
    return vectors[:, 1:].flatten(1)


def _about_two_axes(heading: Tensor, tilt: Tensor) -> Float[Tensor, "T 3"]:
    """Return the quaternion vector of a turn about y, then to the side about the body's own z."""
    (a, b), (c, d) = ((torch.sin(x / 2), torch.cos(x / 2)) for x in (heading, tilt))
    return torch.stack([a * c, a * d, b * c], -1)


def _on_the_floor(body: Body, states: Tensor, heading: Tensor, fps: float) -> Walk:
    """Put the foot that carries on the floor, and go on as fast as it is left behind."""
    ankles = body.joints(states)[:, [BODY_15.joint(f"{s}_ankle") for s in ("left", "right")]]
    share = torch.softmax(-ankles[..., 1] / _SOFT, -1)  # of the weight on either foot
    states = states.clone()
    states[:, 1] = _ANKLE - (share * ankles[..., 1]).sum(-1)
    left_behind = -(share[1:, :, None] * ankles.diff(dim=0)).sum(1)  # [T - 1, 3]
    ahead = torch.stack([torch.sin(heading), torch.zeros_like(heading), torch.cos(heading)], -1)
    speed = _smooth((left_behind * ahead[1:]).sum(-1), round(0.25 * fps))
    way = torch.cat([torch.zeros(1, 3, dtype=states.dtype), (speed[:, None] * ahead[1:]).cumsum(0)])
    way = way - way[len(way) // 2]
    states[:, [0, 2]] = way[:, [0, 2]]
    return Walk(body, states, body.joints(states), float(fps))


def _smooth(values: Float[Tensor, " T"], width: int) -> Float[Tensor, " T"]:
    """Moving average over an odd number of frames; the ends are repeated."""
    reach = min(width, len(values)) // 2
    padded = torch.cat([values[:1].expand(reach), values, values[-1:].expand(reach)])
    return padded.unfold(0, 2 * reach + 1, 1).mean(-1)


def _curve(
    phase: Float[Tensor, " T"], keys: tuple[tuple[float, float], ...]
) -> Float[Tensor, " T"]:
    """Return a smooth periodic curve through key points, by cubic Hermite pieces."""
    at = torch.tensor([k[0] for k in keys], dtype=phase.dtype)
    value = torch.tensor([k[1] for k in keys], dtype=phase.dtype)
    at = torch.cat([at[-1:] - 1, at, at[:2] + 1])
    value = torch.cat([value[-1:], value, value[:2]])
    slope = (value[2:] - value[:-2]) / (at[2:] - at[:-2])  # at the keys, and at the first one again
    x = phase.remainder(1.0)
    k = (
        torch.searchsorted(at[1:-1].contiguous(), x.contiguous(), right=True).clamp(1, len(keys))
        - 1
    )
    start, end = at[1:-1][k], at[2:][k]
    s, h = (x - start) / (end - start), end - start
    return (
        (2 * s**3 - 3 * s**2 + 1) * value[1:-1][k] + (s**3 - 2 * s**2 + s) * h * slope[k]
        + (3 * s**2 - 2 * s**3) * value[2:][k] + (s**3 - s**2) * h * slope[k + 1]
    )  # fmt: skip
