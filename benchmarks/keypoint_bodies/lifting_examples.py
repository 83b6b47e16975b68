"""Draw what a network that lifts keypoints learns from: recorded bodies in random cameras.

Every piece of a recording gets bones of other lengths and a camera of its own: two fifths about in front of
the person, the others anywhere around, 2.5 to 5.5 m away. Some move their arms as somebody else does, since
recordings have few actions. In some legs or arms are not seen at all: people stand behind tables and at the
border of the image. Every second piece is mirrored. Some sit (`seats`), in front of
cameras that may be nearer and higher, and often behind a desk.

Sets of recordings have a frame rate each, and a network that is told the rate takes it for the set. So
pieces may be taken at rates that are drawn anew for each of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from benchmarks._lifters import draw_pieces
from benchmarks.keypoint_bodies.clips import OTHER, detect, mean_left
from benchmarks.keypoint_bodies.seats import seated
from torchpose._core.checks import INLIER
from torchpose.body import BODY_15
from torchpose.io._mocap import MocapClip
from torchpose.math import euler_to_matrix
from torchpose.priors._lifting_network import lifting_features

__all__ = ["LiftingExamples", "with_arms"]

_SEQUENCES, _FRAMES = 32, 48
_NEAREST, _DEPTHS = 2.5, 3.0  # metres to the middle of a path, and their range
_CLEAR = 2.0  # metres that are left to the camera at least
_LOW, _HEIGHTS = 0.6, 1.6  # metres above the floor, and their range
_AIM = 0.95  # metres above the floor
_TURNS = (8.0, 8.0, 6.0)  # degrees: standard deviations of roll, pitch and yaw of the camera
_IN_FRONT, _AROUND_FRONT = 0.4, math.radians(50.0)  # share of the cameras, and their spread
_FOCAL = 1300.0  # pixels
_LENGTH_STD, _MOST = 0.08, 0.4  # of the logarithms of lengths, and their largest change
_WIDER = {"hip": 2.0, "shoulder": 1.2}  # by which widths vary more than limbs
_HIDDEN = (("knee", "ankle"), ("hip", "knee", "ankle"), ("elbow", "wrist"), ("wrist",))
_SHARE_HIDDEN, _SHARE_AT_DESK = 0.25, 0.4  # of the pieces, and of those in which people sit
_BELOW = ("pelvis", "hip", "knee", "ankle")
_HIDDEN_OF_UPPER = (("knee", "ankle"), _BELOW, _BELOW, ("elbow", "wrist"), ("wrist",))
_SHARE_HIDDEN_OF_UPPER = 0.4  # of the pieces from which upper bodies are learnt
_NEARER, _HIGHER, _CLEAR_OF_SEAT = 1.0, 0.3, 1.3  # metres, of cameras that see people who sit
_ARMS_OF_OTHERS = 0.3  # share of the pieces
_SLOWEST, _FASTEST = 12.0, 60.0  # frames per second that are drawn
_PELVIS, _NECK = BODY_15.joint("pelvis"), BODY_15.joint("neck")
_ARMS = [
    [BODY_15.joint(f"{side}_{name}") for name in ("shoulder", "elbow", "wrist")]
    for side in ("left", "right")
]


class _Recording(NamedTuple):
    """A recorded body: joints [T, 15, 3], the upward direction and the person's left [3], frame rate."""

    joints: Tensor
    up: Tensor
    left: Tensor
    fps: float


class _Pieces(NamedTuple):
    """Pieces of recordings: joints [N, T, 15, 3], up and left [N, 3], frame rates."""

    joints: Tensor
    up: Tensor
    left: Tensor
    fps: tuple[float, ...]


class LiftingExamples:
    """Draws features of keypoints, and the joints that they are of.

    Args:
        sets: their share of the pieces, and the recordings, of each. seed: of all that is drawn.
        seats: share of the pieces in which people sit. any_rate: draw the frame rate of each piece, whatever
            that of its recording is. upper_body: hide hips and legs in more pieces.
    """

    def __init__(
        self,
        sets: Sequence[tuple[float, Sequence[MocapClip]]],
        seed: int = 0,
        seats: float = 0.0,
        any_rate: bool = False,
        upper_body: bool = False,
    ) -> None:
        self.pool = [_recording(clip) for _, clips in sets for clip in clips]
        shares = [share / sum(map(len, clips)) for share, clips in sets for _ in clips]
        self.lengths = [len(one.joints) for one in self.pool]
        self.weights = torch.tensor(shares) * torch.tensor(self.lengths)
        self.generator = torch.Generator().manual_seed(seed)
        self.seats, self.any_rate = seats, any_rate
        self.hidden, self.share_hidden = _HIDDEN, _SHARE_HIDDEN
        if upper_body:
            self.hidden, self.share_hidden = _HIDDEN_OF_UPPER, _SHARE_HIDDEN_OF_UPPER

    def __call__(self) -> tuple[Float[Tensor, "N T F"], Float[Tensor, "N T 15 3"]]:
        """Return features, and joints from the pelvis in the axes of the camera, metres."""
        pieces = self._drawn()
        bodies = self._with_arms_of_others(pieces.joints)
        sits = torch.zeros(_SEQUENCES, 1, dtype=torch.bool)
        if self.seats:  # nothing is drawn otherwise
            sits = self._uniform(_SEQUENCES, 1) < self.seats
            in_seats = seated(bodies, pieces.up, self.generator)
            bodies = torch.where(sits[..., None, None], in_seats, bodies)
        pieces = pieces._replace(joints=_resized(bodies, self._factors()))
        joints = self._mirrored(self._as_seen(pieces, sits))
        pixels = _FOCAL * joints[..., :2] / joints[..., 2:].clamp_min(0.1)
        found = detect(pixels.transpose(0, 1), self.generator)  # a camera for each piece
        rays = (found.keypoints.transpose(0, 1) / _FOCAL).float()
        sure = found.confidence.transpose(0, 1).float()
        sure = torch.where(sure > 0, sure.clamp(*INLIER), 0.0) * self._shown(sits)[:, None]
        given = zip(rays.nan_to_num(), sure, pieces.fps, strict=True)
        seen = torch.stack([lifting_features(*one) for one in given])
        return seen, joints - joints[:, :, [_PELVIS]]

    def _drawn(self) -> _Pieces:
        """Return pieces of the recordings."""
        given = (self.weights, self.lengths, _FRAMES, _SEQUENCES, self.generator)
        pieces = [(self.pool[i], rows) for i, rows in draw_pieces(*given)]
        fps = [one.fps for one, _ in pieces]
        if self.any_rate:
            share = self._uniform(_SEQUENCES)
            fps = (_SLOWEST * (_FASTEST / _SLOWEST) ** share).tolist()
        given_at = zip(pieces, fps, strict=True)
        joints = torch.stack([_at_rate(one, int(rows[0]), rate) for (one, rows), rate in given_at])
        up, left = (
            torch.stack(x) for x in zip(*((one.up, one.left) for one, _ in pieces), strict=True)
        )
        return _Pieces(joints, up, left, tuple(fps))

    def _with_arms_of_others(self, joints: Float[Tensor, "N T 15 3"]) -> Float[Tensor, "N T 15 3"]:
        """Return bodies, some of which have the arms of another piece, in the axes of their trunks."""
        others = joints[torch.randperm(_SEQUENCES, generator=self.generator)]
        swapped = self._uniform(_SEQUENCES, 1, 1, 1) < _ARMS_OF_OTHERS
        return torch.where(swapped, with_arms(joints, others), joints)

    def _factors(self) -> Float[Tensor, "N 15"]:
        """Return factors on the lengths of bones, the same on both sides."""
        wider = [_WIDER.get(name.split("_")[-1], 1.0) for name in BODY_15.names]
        logs = _LENGTH_STD * torch.tensor(wider) * self._normal(_SEQUENCES, len(wider))
        first = torch.minimum(torch.arange(len(wider)), torch.tensor(OTHER))
        return logs[:, first].clamp(-_MOST, _MOST).exp()

    def _as_seen(self, pieces: _Pieces, sits: Bool[Tensor, "N 1"]) -> Float[Tensor, "N T 15 3"]:
        """Return the joints in the axes of cameras that look at the person."""
        joints, up, left, _ = pieces
        path = joints[:, :, _PELVIS]
        middle = (path.amin(1) + path.amax(1)) / 2
        height = (joints @ up[:, None, :, None]).squeeze(-1).nan_to_num(torch.inf).amin((1, 2))
        foot = middle - ((middle * up).sum(-1) - height)[:, None] * up
        azimuth = 2 * math.pi * self._uniform(_SEQUENCES, 1)
        in_front = self._uniform(_SEQUENCES, 1) < _IN_FRONT
        azimuth = torch.where(in_front, _AROUND_FRONT * self._normal(_SEQUENCES, 1), azimuth)
        ray = azimuth.cos() * torch.linalg.cross(left, up) + azimuth.sin() * left
        away, high = self._uniform(2, _SEQUENCES, 1)
        reach = ((path - middle[:, None]) * ray[:, None]).sum(-1).amax(1)[:, None]
        nearest = _NEAREST - _NEARER * sits
        clear = torch.where(sits, _CLEAR_OF_SEAT, _CLEAR)
        distance = torch.maximum(nearest + _DEPTHS * away, reach + clear)
        place = foot + distance * ray + (_LOW + (_HEIGHTS + _HIGHER * sits) * high) * up
        z = normalize(foot + _AIM * up - place, dim=-1)
        x = normalize(torch.linalg.cross(z, up), dim=-1)
        level = torch.stack([x, torch.linalg.cross(z, x), z], 1)
        turn = euler_to_matrix(torch.deg2rad(self._normal(_SEQUENCES, 3) * torch.tensor(_TURNS)))
        return (joints - place[:, None, None]) @ (turn @ level).mT[:, None]

    def _mirrored(self, joints: Float[Tensor, "N T 15 3"]) -> Float[Tensor, "N T 15 3"]:
        """Return the joints, every second time as a mirror has them."""
        flip = self._uniform(_SEQUENCES, 1, 1, 1) < 0.5
        mirror = torch.tensor([-1.0, 1.0, 1.0])
        return torch.where(flip, (joints * mirror)[..., OTHER, :], joints)

    def _shown(self, sits: Bool[Tensor, "N 1"]) -> Float[Tensor, "N 15"]:
        """Return 0 for joints that are not seen at all in a piece, and 1 for the others."""
        kinds = [[not name.endswith(kind) for name in BODY_15.names] for kind in self.hidden]
        kind = torch.randint(len(kinds), (_SEQUENCES,), generator=self.generator)
        share = self._uniform(_SEQUENCES, 1)
        hides = share < self.share_hidden
        if self.seats:
            at_desk = sits & ~hides & (share < self.share_hidden + _SHARE_AT_DESK)
            of_legs = len(kinds) - 2  # the first kinds
            kind = torch.where(at_desk[:, 0], kind % of_legs, kind)
            hides = hides | at_desk
        return torch.where(hides, torch.tensor(kinds)[kind].float(), 1.0)

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self.generator)

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator)


def _recording(clip: MocapClip) -> _Recording:
    left = mean_left(clip.joints, clip.up)
    return _Recording(clip.joints.float(), clip.up.float(), left.float(), clip.fps)


def _at_rate(recording: _Recording, first: int, fps: float) -> Float[Tensor, "T 15 3"]:
    """Return a piece from a frame on, at a frame rate; it ends in the last frame of a short recording."""
    last = len(recording.joints) - 1
    step = recording.fps / fps
    first = min(first, max(0, last - math.ceil(step * (_FRAMES - 1))))
    place = (first + step * torch.arange(_FRAMES)).clamp_max(last)
    before = place.floor().long()
    return torch.lerp(
        recording.joints[before],
        recording.joints[(before + 1).clamp_max(last)],
        (place - before)[:, None, None],
    )


def with_arms(
    joints: Float[Tensor, "N T 15 3"], others: Float[Tensor, "N T 15 3"]
) -> Float[Tensor, "N T 15 3"]:
    """Return bodies with the arms of others, turned with their trunks."""
    turn = _trunks(joints) @ _trunks(others).mT
    bodies = joints.clone()
    for shoulder, elbow, wrist in _ARMS:
        for start, end in ((shoulder, elbow), (elbow, wrist)):
            bone = others[..., end, :] - others[..., start, :]
            bodies[..., end, :] = bodies[..., start, :] + (turn @ bone[..., None]).squeeze(-1)
    return bodies.where(bodies.isfinite(), joints)


def _trunks(joints: Float[Tensor, "*batch 15 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the axes of trunks: to the left along the shoulders, upwards, and forwards."""
    y = normalize(joints[..., _NECK, :] - joints[..., _PELVIS, :], dim=-1)
    across = joints[..., _ARMS[0][0], :] - joints[..., _ARMS[1][0], :]
    x = normalize(across - (across * y).sum(-1, keepdim=True) * y, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], -1)


def _resized(
    joints: Float[Tensor, "N T 15 3"], factors: Float[Tensor, "N 15"]
) -> Float[Tensor, "N T 15 3"]:
    """Return bodies whose bones have other lengths and the same directions."""
    places: list[Tensor] = []
    for joint, parent in enumerate(BODY_15.parents):
        place = joints[:, :, joint]
        if parent >= 0:
            place = places[parent] + factors[:, None, [joint]] * (place - joints[:, :, parent])
        places.append(place)
    return torch.stack(places, 2)
