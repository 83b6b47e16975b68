"""Generate movements for rendered benchmarks: hands that sign, clap, merge, cross, rise; crossing persons.

Key frames are places of the hands in the torso's axes, metres; the arms follow by inverse kinematics. Those
of raised arms are angles, since the elbows of arms above the head are not told by the hands.
Movements are random, so that every seed gives another sequence.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_finite, check_shape
from torchpose.demo._mannequin import ANGLE_LIMITS, BodyAngles, BodySize, raised_shoulder
from torchpose.demo._performer import Performance, hip_sway, minimum_jerk, performer, stage, sway
from torchpose.errors import InputError
from torchpose.math._rotations import rotvec_to_matrix

__all__ = ["PERFORMANCES", "crossing", "hands_to_arms", "performance"]

PERFORMANCES = (
    "performer", "signing", "clapping", "merging hands", "crossed arms", "raised arms"
)  # fmt: skip
"""Names that `performance` takes."""

Place = tuple[float, float, float]
_Arm = tuple[float, float, float, float]
_FASTEST = 3.2  # metres per second at the middle of a movement
_REST: Place = (0.20, 0.66, -0.10)
_LABEL_REST = "rest"
_HANGING = (7.0, 4.0, -20.0, 17.0)  # abduction, flexion, twist and elbow of an arm, degrees
_HEIGHTS = {"above": (110, 160), "beside": (60, 110), "across": (40, 100)}  # of raised arms

_ELBOW_SIDE = (0.40, 0.80, 0.35)  # where the elbow goes, seen from the line to the hand: out, down


class _Keys(NamedTuple):
    """Holds key frames: seconds, words, places of the left and the right hand."""

    times: list[float]
    labels: list[str]
    hands: list[tuple[Place, Place]]

    @classmethod
    def begin(cls) -> "_Keys":
        """Return the first key frame, with hands hanging down."""
        return cls([0.0], [_LABEL_REST], [(_REST, _mirror(_REST))])

    def go(self, label: str, left: Place, right: Place, seconds: float) -> None:
        """Add a key after some time, which is extended if the path is too long."""
        before = self.hands[-1]
        way = max(math.dist(a, b) for a, b in zip(before, (left, right), strict=True))
        # The quickest moment of a minimum-jerk movement is 1.875 times its mean speed.
        self.times.append(self.times[-1] + max(seconds, 1.875 * way / _FASTEST))
        self.labels.append(label)
        self.hands.append((left, right))

    def stay(self, seconds: float) -> None:
        """Keep the hands where they are."""
        self.go(self.labels[-1], *self.hands[-1], seconds)

    def rest(self, seconds: float) -> None:
        """Let the hands hang."""
        self.go(_LABEL_REST, _REST, _mirror(_REST), 0.9)
        self.stay(seconds)


def performance(
    name: str,
    n_frames: int = 1000,
    fps: float = 30.0,
    seed: int = 0,
    distance: float = 2.0,
    size: BodySize | None = None,
) -> Performance:
    """Return a movement by its name, in front of `torchpose.demo.demo_camera`.

    Args:
        name: one of `PERFORMANCES`.
        n_frames, fps: how long, and frames per second.
        seed: of the movement.
        distance: of the neck from the camera, metres. size: bone lengths.

    Raises:
        InputError: an unknown name, or lengths out of range.

    Reference:
        Burke & Lasenby, figure 8: hands that merge, and clapping, are what trackers fail at.
    """
    if name not in PERFORMANCES:
        raise InputError(f"name must be one of {', '.join(PERFORMANCES)}, got {name!r}")
    if n_frames < 1 or not 0 < fps < math.inf:
        raise InputError(f"need n_frames >= 1 and fps > 0, got {n_frames} and {fps}")
    if name == "performer":
        return performer(n_frames, fps, seed, size, distance)
    clock = torch.arange(n_frames, dtype=torch.float64) / fps
    rng = np.random.default_rng([seed, PERFORMANCES.index(name)])
    if name == "raised arms":
        angles, labels = _raised(clock, rng, seed)
        return stage(angles, labels, fps, size, distance)
    make = {
        "signing": _sign,
        "clapping": _clap,
        "merging hands": _merge,
        "crossed arms": _cross,
    }[name]
    keys = _Keys.begin()
    keys.stay(0.6)
    while keys.times[-1] < n_frames / fps:
        make(keys, rng)
    angles, labels = _animate(keys, clock, seed, size)
    return stage(angles, labels, fps, size, distance)


def crossing(
    n_frames: int = 1000, fps: float = 30.0, seed: int = 0, seconds: float = 9.0
) -> tuple[Performance, Performance]:
    """Return two performers who walk past each other, one behind the other, to and fro.

    Args:
        n_frames, fps: how long, and frames per second. seed: of both movements.
        seconds: from one side to the other; they meet in the middle.

    Returns:
        The near and the far one, 1.4 and 1.95 m away.

    Raises:
        InputError: see `performance`; a walk that takes no time.
    """
    if not 1 <= seconds < math.inf:
        raise InputError(f"seconds must be at least 1, got {seconds}")
    walkers = []
    for i, (name, distance, side) in enumerate((("performer", 1.4, -0.5), ("signing", 1.95, 0.7))):
        still = performance(name, n_frames, fps, seed + i, distance)
        clock = torch.arange(n_frames, dtype=torch.float64) / fps
        turns = clock / seconds
        keys = torch.arange(float(turns.max()) // 1 + 3, dtype=torch.float64)
        places = side * (1 - 2 * keys.remainder(2))
        # Stand for a third of the time, walk for the rest.
        walked = minimum_jerk(
            turns.floor() + ((turns.frac() - 0.15) / 0.7).clamp(0, 1), keys, places
        )
        position = still.angles.position.clone()
        position[:, 0] += walked
        angles = still.angles._replace(position=position)
        walkers.append(stage(angles, still.labels, fps, distance=distance))
    return walkers[0], walkers[1]


def _animate(
    keys: _Keys, clock: Tensor, seed: int, size: BodySize | None
) -> tuple[BodyAngles, tuple[str, ...]]:
    """Return the angles between the key frames, and the word of each frame."""
    generator = torch.Generator().manual_seed(seed)
    times = torch.tensor(keys.times, dtype=torch.float64)
    hands = minimum_jerk(clock, times, torch.tensor(keys.hands, dtype=torch.float64))
    hands = hands + sway(clock, (2, 3), 0.004, (0.15, 0.8), generator)
    angles = _swaying(clock, hands_to_arms(hands, size), generator)
    return angles, _words(clock, times, keys.labels)


def hands_to_arms(
    hands: Float[Tensor, "T 2 3"], size: BodySize | None = None
) -> Float[Tensor, "T 2 4"]:
    """Return the angles of the arms that bring the hands to given places (inverse kinematics).

    Upper arm and forearm form a triangle over the line from shoulder to hand; the elbow is on its
    lower, outer side. The shoulder rises with the upper arm, so it is found by iteration.

    Args:
        hands: of the left and the right hand, from the neck, in the torso's axes, metres. Places out
            of reach are replaced by the nearest on the line to them.
        size: bone lengths.

    Returns:
        Abduction, flexion, twist, elbow, radians; only the elbow is certain to be within `ANGLE_LIMITS`.
    """
    size = size or BodySize()
    check_shape("hands", hands, [None, 2, 3])
    check_finite("hands", hands)
    mirror = hands.new_tensor([[1.0, 1, 1], [-1.0, 1, 1]])
    hands = hands * mirror
    a, b = size.upper_arm, size.forearm + size.hand
    bent = torch.deg2rad(hands.new_tensor(ANGLE_LIMITS["elbow"]))
    far, near = (a * a + b * b + 2 * a * b * torch.cos(bent)).sqrt().tolist()
    raised = torch.zeros_like(hands[..., 0])
    for _ in range(12):
        to_hand = hands - raised_shoulder(raised, size)
        reach = to_hand.norm(dim=-1, keepdim=True)
        to_hand = to_hand / reach
        reach = reach.clamp(near, far)
        outer = hands.new_tensor(_ELBOW_SIDE) - to_hand * (
            to_hand @ hands.new_tensor(_ELBOW_SIDE)
        ).unsqueeze(-1)
        outer = outer / outer.norm(dim=-1, keepdim=True)
        cosine = (a * a + reach * reach - b * b) / (2 * a * reach)
        upper = cosine * to_hand + (1 - cosine * cosine).clamp_min(0).sqrt() * outer
        raised = torch.acos(upper[..., 1].clamp(-1, 1))
    per_sine = raised / torch.sin(raised).clamp_min(1e-9)
    abduction, flexion = per_sine * upper[..., 0], -per_sine * upper[..., 2]
    swing = rotvec_to_matrix(torch.stack([-flexion, torch.zeros_like(flexion), -abduction], -1))
    fore = (swing.mT @ (reach * to_hand - a * upper).unsqueeze(-1)).squeeze(-1)
    twist = torch.atan2(fore[..., 0], -fore[..., 2])
    straight = (reach[..., 0].square() - a * a - b * b) / (2 * a * b)
    return torch.stack([abduction, flexion, twist, torch.acos(straight.clamp(-1, 1))], -1)


def _swaying(clock: Tensor, arms: Tensor, generator: torch.Generator) -> BodyAngles:
    """Return the angles of a body that sways, whose arms [T, 2, 4] are clamped to their limits."""
    low, high = torch.deg2rad(torch.tensor(list(ANGLE_LIMITS.values())).double()).unbind(-1)
    torso = sway(clock, (3,), 1.6, (0.06, 0.3), generator)
    head = sway(clock, (3,), 3.0, (0.08, 0.4), generator)
    position = hip_sway(clock, generator)
    return BodyAngles(position, torch.deg2rad(torso), torch.deg2rad(head), arms.clamp(low, high))


def _words(clock: Tensor, times: Tensor, labels: Sequence[str]) -> tuple[str, ...]:
    """Return the word of the key frame that comes next, for each frame."""
    after = torch.searchsorted(times, clock, right=True).clamp(1, len(times) - 1)
    return tuple(labels[i] for i in after.tolist())


def _raised(
    clock: Tensor, rng: np.random.Generator, seed: int
) -> tuple[BodyAngles, tuple[str, ...]]:
    """Return arms, one or both, that are raised to any height and side, with the word of each frame."""
    generator = torch.Generator().manual_seed(seed)
    times, labels, poses = [0.0, 0.5], [_LABEL_REST] * 2, [(_HANGING, _HANGING)] * 2
    while times[-1] < clock[-1]:
        kind = str(rng.choice(list(_HEIGHTS), p=[0.4, 0.4, 0.2]))
        left = _raised_arm(kind, rng)
        right = left if rng.random() < 0.6 else _raised_arm(kind, rng)
        which = rng.choice(["both", "left", "right"], p=[0.5, 0.25, 0.25])
        pose = (
            left if which != "right" else _HANGING, right if which != "left" else _HANGING
        )  # fmt: skip
        steps = [(kind, pose, rng.uniform(0.9, 1.4)), (kind, pose, rng.uniform(0.2, 1.2))]
        if rng.random() < 0.4:
            steps.append((_LABEL_REST, (_HANGING, _HANGING), rng.uniform(0.9, 1.4)))
        for label, arms, seconds in steps:
            times.append(times[-1] + seconds)
            labels.append(label)
            poses.append(arms)
    keys = torch.tensor(times, dtype=torch.float64)
    angles = minimum_jerk(clock, keys, torch.tensor(poses, dtype=torch.float64))
    angles = angles + sway(clock, (2, 4), 1.3, (0.15, 0.7), generator)
    return _swaying(clock, torch.deg2rad(angles), generator), _words(clock, keys, labels)


def _raised_arm(kind: str, rng: np.random.Generator) -> _Arm:
    """Return the angles of an arm that is raised, degrees."""
    height = rng.uniform(*_HEIGHTS[kind])
    ahead = math.radians(rng.uniform(60, 130) if kind == "across" else rng.uniform(0, 90))
    bent = rng.uniform(8, 100 if kind == "beside" else 50)
    return height * math.cos(ahead), height * math.sin(ahead), rng.uniform(-30, 60), bent


# --- kinds of movement ----------------------------------------------------------------------------
# Places are (to the person's left, down, back) from the neck, on the torso.


def _clap(keys: _Keys, rng: np.random.Generator) -> None:
    """Add a series of claps in front of the body, sometimes with a rest."""
    x, y, z = rng.uniform(-0.06, 0.06), rng.uniform(0.08, 0.34), rng.uniform(-0.38, -0.28)
    half, period = rng.uniform(0.08, 0.17), rng.uniform(0.42, 0.62)
    tilt = rng.uniform(-0.02, 0.02)

    def at(open_by: float) -> tuple[Place, Place]:
        return (x + open_by, y + tilt, z), (x - open_by, y - tilt, z)

    keys.go("clap", *at(half), 0.7)
    for _ in range(rng.integers(4, 9)):
        keys.go("clap", *at(0.034), period / 2)
        keys.go("clap", *at(half), period / 2)
    if rng.random() < 0.35:
        keys.rest(rng.uniform(0.2, 0.8))


def _merge(keys: _Keys, rng: np.random.Generator) -> None:
    """Add hands that meet and part, swap sides, and swap heights, with occlusion."""
    for kind in rng.permutation(["meet", "swap", "stack"]):
        y, z = rng.uniform(0.14, 0.32), rng.uniform(-0.34, -0.28)
        wide, pace = rng.uniform(0.15, 0.24), rng.uniform(0.4, 0.8)
        front = 0.07 * rng.choice([-1, 1])
        apart = (wide, y, z), (-wide, y, z)
        x, up, down = rng.uniform(-0.06, 0.06), y - 0.09, y + 0.09
        # Two places of both hands, between which they go to and fro.
        one, two = {
            "meet": (apart, ((0.02, y, z + front), (-0.02, y, z - front))),
            "swap": (
                apart,
                ((-0.6 * wide, y + 0.02, z + front), (0.6 * wide, y - 0.02, z - front)),
            ),
            "stack": (
                ((x, up, z + front), (x, down, z - front)),
                ((x, down, z + front), (x, up, z - front)),
            ),
        }[str(kind)]
        keys.go("apart", *apart, 0.7)
        for _ in range(rng.integers(1, 4)):
            keys.go(str(kind), *one, pace)
            keys.go(str(kind), *two, pace)
            keys.stay(rng.uniform(0.1, 0.7))
        keys.go("apart", *apart, pace)
    if rng.random() < 0.4:
        keys.rest(rng.uniform(0.2, 0.6))


def _cross(keys: _Keys, rng: np.random.Generator) -> None:
    """Add arms that are folded, clasped, or reach across, or a hand at the face above the other one."""
    u = rng.uniform
    kind = str(rng.choice(["folded", "at the face", "across", "clasped", "apart"]))
    if kind == "folded":
        front = 0.06 * rng.choice([-1, 1])
        hands = (
            (-u(0.08, 0.2), u(0.12, 0.36), front - 0.26),
            (u(0.08, 0.2), u(0.12, 0.36), -front - 0.26),
        )
    elif kind == "at the face":
        hands = (u(-0.05, 0.08), -u(0.06, 0.2), -0.25), (u(0.0, 0.14), u(0.3, 0.5), -0.24)
    elif kind == "across":
        hands = (-u(0.1, 0.2), u(0.1, 0.36), -0.34), (-u(0.15, 0.25), u(0.45, 0.58), -0.16)
    elif kind == "clasped":
        x, y, z = u(-0.05, 0.05), u(0.3, 0.56), u(-0.3, -0.2)
        hands = (x + 0.035, y, z), (x - 0.035, y + u(-0.03, 0.03), z)
    else:
        hands = tuple((side * u(0.25, 0.45), u(0.0, 0.4), -u(0.14, 0.4)) for side in (1, -1))
    left, right = hands
    if rng.random() < 0.5:
        left, right = _mirror(right), _mirror(left)
    wide = u(0.2, 0.3), u(0.15, 0.4), -0.34  # between two of these, so that arms do not meet
    keys.go("apart", wide, _mirror(wide), u(0.4, 0.7))
    keys.go(kind, left, right, u(0.5, 1.0))
    keys.stay(u(0.2, 1.6))
    if rng.random() < 0.3:
        keys.rest(u(0.2, 0.6))


_AT_FACE = ((0.05, -0.05, -0.24), (0.10, -0.13, -0.22), (0.10, -0.21, -0.22), (0.03, -0.06, -0.25))
_AT_CHEST = ((0.05, 0.14, -0.22), (0.10, 0.22, -0.24), (0.02, 0.20, -0.26))
_IN_SPACE = ((0.14, 0.10, -0.34), (0.22, 0.18, -0.30), (0.10, 0.24, -0.36), (0.20, 0.00, -0.30))


def _sign(keys: _Keys, rng: np.random.Generator) -> None:
    """Add a movement like a sign: one hand or both go to a place and make strokes there."""
    dominant = rng.random() < 0.7  # the right hand leads more often
    where = (_AT_FACE, _AT_CHEST, _IN_SPACE)[rng.choice(3, p=[0.3, 0.3, 0.4])]
    jitter = rng.uniform(-0.02, 0.02, 3)
    place = np.array(where[rng.integers(len(where))]) + jitter
    manner = rng.choice(["alone", "both", "on the other"])
    if where is _AT_FACE and manner == "on the other":
        manner = "alone"
    direction = rng.normal(0, 1, 3) * (1, 1, 0.6)
    stroke = rng.uniform(0.05, 0.11) * direction / np.linalg.norm(direction)
    stroke[2] = -abs(stroke[2])  # away from the body
    other = np.array([0.16, 0.30, -0.24]) + rng.uniform(-0.03, 0.03, 3)
    if manner == "both":
        place[0] = max(place[0], 0.06)
        stroke[0] = abs(stroke[0])
    if manner == "on the other":
        place = np.array([0.01, 0.15, -0.33]) + jitter
        other = np.array([0.02, 0.25, -0.25])

    def hands(move: float) -> tuple[Place, Place]:
        moving = tuple((place + move * stroke).tolist())
        if manner == "both":
            return moving, _mirror(moving)
        still = tuple(other.tolist())
        # The leading hand is the right one: its side is mirrored.
        return (still, _mirror(moving)) if dominant else (moving, _mirror(still))

    keys.go("sign", *hands(0.0), rng.uniform(0.30, 0.45))
    for _ in range(rng.integers(1, 4)):
        keys.go("sign", *hands(1.0), rng.uniform(0.17, 0.28))
        keys.go("sign", *hands(0.0), rng.uniform(0.17, 0.28))
    if rng.random() < 0.06:
        keys.rest(rng.uniform(0.1, 0.4))


def _mirror(place: Place) -> Place:
    return -place[0], place[1], place[2]
