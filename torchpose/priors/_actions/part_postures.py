"""Compute relative angles of limbs straight from rotations of parts.

The same numbers as `posture_angles` of the joints, at a tenth of the cost: only the directions of the
twelve bones are turned, components first (x, y and z apart, states last), and no matrix is formed."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from torchpose._core.checks import check_shape
from torchpose.body._kinematics import Body
from torchpose.math._tree_messages import tree_levels
from torchpose.priors._actions.polar_limbs import LIMB_PARENTS, LIMBS_12
from torchpose.priors._actions.postures import angles_of_directions, check_body

Vectors = tuple[Tensor, Tensor, Tensor]  # x, y, z, each [k, n]

_LEAST = 1e-12  # of 1 + cosine, where the smallest rotation is not defined
_CHUNK = 4096  # states at a time, so that what is in between stays in the cache


class _Turn(NamedTuple):
    """Vectors that are turned together, and what turns each: parts, or limbs."""

    vectors: list[int]
    by: list[int]


class PartPostures(nn.Module):
    """Postures of the states of one body.

    Args:
        body: a body with the joints of `BODY_15`.
        dtype: to compute in; in float32 angles are right to a few hundredths of a degree.

    Raises:
        SkeletonError: a body of other joints.

    >>> from torchpose.body._skeleton import BODY_15
    >>> postures = PartPostures(Body.of_height(BODY_15, 1.75))
    >>> postures(torch.zeros(5, 36)).shape
    torch.Size([5, 36])
    """

    bones: Tensor
    centres: Tensor
    hips: Tensor
    straight: Tensor

    def __init__(self, body: Body, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        check_body(body)
        skeleton = body.skeleton
        ends = [skeleton.joint(limb.end) for limb in LIMBS_12]
        parts = [skeleton.part_of[joint] for joint in ends]
        left, right = (body.offsets[skeleton.joint(f"{side}_hip")] for side in ("left", "right"))
        bones = normalize(body.offsets[ends].double(), dim=-1)
        straight = torch.tensor([limb.straight for limb in LIMBS_12])
        buffers = {
            "bones": bones, "centres": body.centre_rotations[1:],
            "hips": _axes_along(left.double() - right.double()), "straight": straight,
        }  # fmt: skip
        for name, value in buffers.items():
            self.register_buffer(name, value.to(bones.device, dtype))
        self._centred = bool(body.centres.any())
        self._dim = body.dim
        above = (-1,) * len(skeleton.parts) if body.frame == "body" else skeleton.part_parents
        self._turns = _turns(parts, above)
        self._carries = _carries()

    def forward(self, states: Float[Tensor, "N D"]) -> Float[Tensor, "N 36"]:
        """Return relative angles, degrees, as `torchpose.priors._actions.postures.state_postures`."""
        check_shape("states", states, ["N", self._dim])
        return self.of_relative(states[:, 6:])

    def of_relative(self, relative: Float[Tensor, "N Q"]) -> Float[Tensor, "N 36"]:
        """Return postures from states without the columns of the root, on which they do not depend."""
        check_shape("relative", relative, ["N", self._dim - 6])
        relative = relative.to(self.bones)
        if len(relative) <= _CHUNK:
            return self._postures(relative)
        return torch.cat([self._postures(part) for part in relative.split(_CHUNK)])

    def _postures(self, relative: Tensor) -> Tensor:
        vectors = relative.T.reshape(relative.shape[1] // 3, 3, len(relative))
        squared = vectors.square().sum(1)
        u = (vectors * squared.clamp_min(1).rsqrt()[:, None]).unbind(1)  # [P - 1, n] each
        w = (1 - squared).clamp_min(0)
        if torch.is_grad_enabled():  # of half turns, as `vector_to_quaternion`
            w = torch.where(w > 0, w, w.detach())
        w = w.sqrt()
        x, y, z = (b[:, None].repeat(1, len(relative)) for b in self.bones.unbind(1))
        for turn in self._turns:
            by = [part - 1 for part in turn.by]
            turned = _rotated([c[by] for c in u], w[by], [c[turn.vectors] for c in (x, y, z)])
            if self._centred:
                turned = _times(self.centres[by], turned)
            x, y, z = _placed((x, y, z), turn.vectors, turned)
        x, y, z = self._in_root_axes(*_times(self.hips[None], (x, y, z)))
        for carry in self._carries:
            straight = self.straight[carry.by].unbind(1)
            seen = [c[carry.by] for c in (x, y, z)]
            back = _carried_back(seen, straight, [c[carry.vectors] for c in (x, y, z)])
            x, y, z = _placed((x, y, z), carry.vectors, back)
        return angles_of_directions(torch.stack([x, y, z], 1).movedim(-1, 0))

    def _in_root_axes(self, x: Tensor, y: Tensor, z: Tensor) -> Vectors:
        """Turn axes with x along the hips to those with y along the spine, at right angles to x."""
        scale = torch.rsqrt(y[:1] * y[:1] + z[:1] * z[:1])
        up, ahead = y[:1] * scale, z[:1] * scale
        return x, y * up + z * ahead, z * up - y * ahead


def _turns(parts: list[int], above: tuple[int, ...]) -> list[_Turn]:
    """Return which bones each level of parts turns, from the outermost parts inwards."""
    chains = []
    for first in parts:
        chain, part = [], first
        while part > 0:
            chain.append(part)
            part = above[part]
        chains.append(chain)
    deepest = max(map(len, chains))
    turns = []
    for depth in range(deepest, 0, -1):
        vectors = [i for i, chain in enumerate(chains) if len(chain) >= depth]
        turns.append(_Turn(vectors, [chains[i][-depth] for i in vectors]))
    return turns


def _carries() -> list[_Turn]:
    """Return which limbs each level of limbs carries, from the root outwards."""
    carries = []
    for level in tree_levels(LIMB_PARENTS, [limb.name for limb in LIMBS_12]):
        pairs = [(i, a) for i in range(len(LIMBS_12)) for a in _ancestors(i) if a in level]
        if pairs:
            carries.append(_Turn([i for i, _ in pairs], [a for _, a in pairs]))
    return carries


def _ancestors(limb: int) -> list[int]:
    found = []
    while LIMB_PARENTS[limb] >= 0:
        limb = LIMB_PARENTS[limb]
        found.append(limb)
    return found


def _axes_along(direction: Tensor) -> Tensor:
    """Return a rotation [3, 3] that turns a direction to the x axis."""
    x = normalize(direction, dim=-1)
    y = normalize(torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]).to(x), x), dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)])


def _cross(a: list[Tensor] | Vectors, b: list[Tensor] | Vectors) -> Vectors:
    (ax, ay, az), (bx, by, bz) = a, b
    return (
        torch.addcmul(ay * bz, az, by, value=-1),
        torch.addcmul(az * bx, ax, bz, value=-1),
        torch.addcmul(ax * by, ay, bx, value=-1),
    )


def _rotated(u: list[Tensor], w: Tensor, x: list[Tensor]) -> Vectors:
    """Return x + 2 w (u x x) + 2 u x (u x x)."""
    once = _cross(u, x)
    twice = _cross(u, once)
    a, b, c = (
        torch.addcmul(t, w, o).mul_(2).add_(p) for p, o, t in zip(x, once, twice, strict=True)
    )
    return a, b, c


def _carried_back(seen: list[Tensor], straight: tuple[Tensor, ...], x: list[Tensor]) -> Vectors:
    """Return x turned by the smallest rotation from `seen` [k, n] to `straight` [k]."""
    s = [c[:, None] for c in straight]
    axis = _cross(seen, s)
    cosine = seen[0] * s[0] + seen[1] * s[1] + seen[2] * s[2]
    inverse = (1 + cosine).clamp_min(_LEAST).reciprocal()
    once = _cross(axis, x)
    twice = _cross(axis, once)
    a, b, c = (torch.addcmul(p, t, inverse).add_(o) for p, o, t in zip(x, once, twice, strict=True))
    return a, b, c


def _times(matrix: Tensor, x: list[Tensor] | Vectors) -> Vectors:
    """Return matrices [k or 1, 3, 3] times vectors."""
    a, b, c = (
        sum(matrix[:, row, column, None] * x[column] for column in range(3)) for row in range(3)
    )
    return a, b, c  # type: ignore[return-value]


def _placed(into: Vectors, rows: list[int], values: Vectors) -> Vectors:
    if len(rows) == len(into[0]) and rows == list(range(len(rows))):
        return values
    for target, value in zip(into, values, strict=True):
        target[rows] = value
    return into
