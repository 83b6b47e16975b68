"""Generate movements for rendered benchmarks: signing, clapping, merging hands, crossing persons.

Key frames are places of the hands in the torso's axes, metres; the arms follow by inverse kinematics.
Movements are random, so that every seed gives another sequence.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchpose.demo._mannequin import ANGLE_LIMITS, BodyAngles, BodySize, hands_to_arms
from torchpose.demo._performer import Performance, hip_sway, minimum_jerk, performer, stage, sway
from torchpose.errors import InputError

__all__ = ["PERFORMANCES", "crossing", "performance"]

PERFORMANCES = ("performer", "signing", "clapping", "merging hands")
"""Names that `performance` takes."""

Place = tuple[float, float, float]
_FASTEST = 3.2  # metres per second at the middle of a movement
_REST: Place = (0.20, 0.66, -0.10)
_LABEL_REST = "rest"


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
    make = {"signing": _sign, "clapping": _clap, "merging hands": _merge}[name]
    rng = np.random.default_rng([seed, PERFORMANCES.index(name)])
    keys = _Keys.begin()
    keys.stay(0.6)
    while keys.times[-1] < n_frames / fps:
        make(keys, rng)
    clock = torch.arange(n_frames, dtype=torch.float64) / fps
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
    low, high = torch.deg2rad(torch.tensor(list(ANGLE_LIMITS.values())).double()).unbind(-1)
    arms = hands_to_arms(hands, size).clamp(low, high)
    torso = sway(clock, (3,), 1.6, (0.06, 0.3), generator)
    head = sway(clock, (3,), 3.0, (0.08, 0.4), generator)
    angles = BodyAngles(hip_sway(clock, generator), torch.deg2rad(torso), torch.deg2rad(head), arms)
    after = torch.searchsorted(times, clock, right=True).clamp(1, len(times) - 1)
    return angles, tuple(keys.labels[i] for i in after.tolist())


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
