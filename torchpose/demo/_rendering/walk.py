"""Animate a walk from joint angles of textbooks, and render it in calibrated cameras.

The walk is neither recorded nor sampled from a learnt model, so that it is held out from every manifold of
recorded walks. The body is that of `clothed_body`: its limbs, radii and trunk differ from those of a
tracker's body.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

from torchpose._core.images import Image
from torchpose.body._kinematics import Body
from torchpose.body._limbs import Limbs
from torchpose.body._skeleton import BODY_15
from torchpose.camera._pinhole import PinholeCamera
from torchpose.demo._rendering.clothed_body import TrueShape, limb_kinds, true_limbs
from torchpose.demo._rendering.look import smooth_noise
from torchpose.demo._rendering.paint import Array, Capsule, paint_capsule
from torchpose.errors import InputError
from torchpose.io._mocap import MocapClip
from torchpose.math._hermite import hermite

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
    """Holds the states and joints of a walking person.

    Attributes:
        body: of the person. states: [T, 36] of the body. joints: [T, 15, 3], metres, y up, the floor at 0.
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
    """Return a walk past the origin along z, in a bend.

    Args:
        seconds: length of the walk. fps: frames per second.
        height: metres; of it, the legs have more and trunk and arms less than average.
        seed: the seed of small differences from step to step. cadence: gait cycles (two steps) per second.
        stray: degrees by which the path bends from its start to its end.

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
    """Return a body of other proportions than the average."""
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
    """Return the walk with its supporting foot fixed on the floor."""
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
    """Return the moving average over an odd number of frames; the ends are repeated."""
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
    return hermite(s, (value[1:-1][k], value[2:][k]), (slope[k], slope[k + 1]), h)


_SHIRT, _SKIN, _TROUSERS, _SHOES = (44, 84, 158), (206, 150, 120), (34, 58, 108), (236, 236, 240)
_WORN = {
    "forearm": _SKIN, "hand": _SKIN, "neck": _SKIN, "skull": (84, 58, 40), "face": _SKIN,
    "thigh": _TROUSERS, "shank": _TROUSERS, "buttock": _TROUSERS, "foot": _SHOES, "toes": _SHOES,
}  # fmt: skip
_WALL, _FLOOR = (196.0, 200.0, 194.0), (150.0, 132.0, 112.0)
_TO_WALL = 7.0  # metres from the camera, where wall and floor meet
_NOISE, _NOISES = 2.5, 8  # of the sensor, of 255; pictures of it that take turns
_NEAR = 0.2  # metres, in front of which nothing is painted


def walk_clip(walk: Walk) -> MocapClip:
    """Return a walk as the clip of a recording, y up."""
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    return MocapClip(
        walk.joints, walk.joints, BODY_15.names, up, walk.fps, "walker", "walk", "walk"
    )


def empty_scene(camera: PinholeCamera, seed: int = 0) -> Array:
    """Return the empty room [H, W, 3], 0 to 255: a wall, a floor, a skirting board, plaster.

    Args:
        camera: level, with the size of its image. seed: the seed of the plaster and the light.

    Raises:
        InputError: a camera without a size.
    """
    if camera.image_size is None:
        raise InputError(
            "a camera that is rendered needs the size of its image; give width and height"
        )
    width, height = camera.image_size
    place = -camera.rotation_matrix.mT @ camera.translation
    floor = int(float(camera.matrix[1, 2] + camera.matrix[1, 1] * place[1] / _TO_WALL))
    x, y = np.linspace(0, 1, width)[None, :, None], np.linspace(0, 1, height)[:, None, None]
    light = 1.02 - 0.15 * x - 0.08 * y
    rows = np.arange(height)[:, None, None]
    picture = np.where(rows < floor, np.array(_WALL), np.array(_FLOOR)) * light
    board = (rows >= floor - 6) & (rows < floor)
    picture = np.where(board, 226.0 * light, picture)
    plaster = smooth_noise((height, width), (1.5, 1.5), seed + 31)
    return np.clip(picture + 3.0 * plaster[..., None], 0, 255).astype(np.float32)


def render_body_video(
    folder: str | Path, walk: Walk, cameras: list[PinholeCamera], seed: int
) -> tuple[list[Path], list[Path]]:
    """Write a video for each camera, NAME.mp4, and a picture of its empty scene, NAME-empty.png.

    Args:
        folder: must exist. walk: of the person. cameras: with names and sizes, y up.
        seed: the seed of the shape of the body, the rooms and the sensors' noise.

    Returns:
        Paths of the videos and of the pictures.
    """
    import cv2

    from torchpose._core.files import atomic_path
    from torchpose.video._writer import VideoWriter

    limbs = true_limbs(walk_clip(walk), TrueShape.draw(seed))
    colours = [np.array(_WORN.get(kind, _SHIRT), np.float32) for kind in limb_kinds()]
    videos, pictures = [], []
    for i, camera in enumerate(cameras):
        room = empty_scene(camera, seed + i)
        videos.append(Path(folder) / f"{camera.name}.mp4")
        with VideoWriter(videos[-1], walk.fps, camera.image_size or (0, 0)) as writer:
            for image in _frames(limbs, colours, camera, room, seed + i):
                writer.write(image)
        pictures.append(Path(folder) / f"{camera.name}-empty.png")
        with atomic_path(pictures[-1]) as temporary:
            coded = cv2.imencode(".png", _bytes(room)[..., ::-1])[1]
            temporary.write_bytes(coded.tobytes())
    return videos, pictures


def _frames(
    limbs: Limbs, colours: list[Array], camera: PinholeCamera, room: Array, seed: int
) -> Iterator[Image]:
    start, end = (_seen(points, camera) for points in (limbs.start, limbs.end))  # [T, L, 3]
    radii = limbs.radii.double().numpy() * float(camera.matrix[1, 1])
    rng = np.random.default_rng([seed, 7])
    noise = [rng.normal(0, _NOISE, room.shape).astype(np.float32) for _ in range(_NOISES)]
    for t in range(len(start)):
        canvas = room.copy()
        depth = start[t, :, 2] + end[t, :, 2]
        for i in np.argsort(-depth):
            a, b = start[t, i], end[t, i]
            if min(a[2], b[2]) > _NEAR:
                capsule = Capsule(
                    (a[0], a[1]), (b[0], b[1]), radii[i, 0] / a[2], radii[i, 1] / b[2]
                )
                paint_capsule(canvas, capsule, colours[i])
        yield _bytes(canvas + noise[rng.integers(_NOISES)])


def _seen(points: Tensor, camera: PinholeCamera) -> NDArray:
    """Return the pixels and depth [T, L, 3] of points."""
    seen = camera(points)
    return np.asarray(seen.double().numpy())


def _bytes(picture: Array) -> Image:
    return np.clip(picture + 0.5, 0, 255).astype(np.uint8)


_PELVIS = BODY_15.joint("pelvis")

AZIMUTHS = (30.0, 150.0, 270.0)
"""Where the cameras stand, degrees from the direction of the walk, to the walker's left."""


def cameras_around(
    clip: MocapClip,
    azimuths: Sequence[float] = AZIMUTHS,
    distance: float = 3.8,
    height: float = 1.5,
    focal: float = 450.0,
) -> list[PinholeCamera]:
    """Return cameras of 640 x 480 pixels around the middle of the path, which they look at.

    They stand at `azimuths` from the direction of the walk, none of them in its line. So the person
    is in view over four metres of the path.

    Args:
        clip: of the walk. azimuths: degrees, one camera each. distance: from the middle, metres.
        height: above the lowest joint, metres. focal: length, pixels.
    """
    up = clip.up.double()
    forward, left = _way(clip)
    points = clip.joints[:, _PELVIS]
    low, high = points.amin(0), points.amax(0)
    floor = float((clip.joints @ up).nan_to_num(math.inf).min())
    middle = (low + high) / 2
    middle = middle - (middle @ up) * up
    target = middle + (floor + 0.95) * up
    cameras = []
    for i, azimuth in enumerate(azimuths, start=1):
        angle = math.radians(azimuth)
        place = middle + distance * (math.cos(angle) * forward + math.sin(angle) * left)
        place = place + (floor + height) * up
        cameras.append(_looking(place, target, up, focal, f"cam_{i:02d}"))
    return cameras


def _way(clip: MocapClip) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Return the horizontal direction of the walk, or of the chest without a walk, and its left."""
    up = clip.up.double()
    pelvis = clip.joints[:, _PELVIS].double()
    way = pelvis[-1] - pelvis[0]
    way = way - (way @ up) * up
    if float(way.norm()) < 0.5:
        sides = (BODY_15.joint("left_shoulder"), BODY_15.joint("right_shoulder"))
        across = (clip.joints[:, sides[0]] - clip.joints[:, sides[1]]).double().nanmean(0)
        way = torch.linalg.cross(across, up)
    forward = normalize(way, dim=-1)
    return forward, torch.linalg.cross(up, forward)


def _looking(
    place: Float[Tensor, "3"], target: Float[Tensor, "3"], up: Float[Tensor, "3"], focal: float,
    name: str,
) -> PinholeCamera:  # fmt: skip
    """Return a camera at `place` with `target` in the middle of the image, upright."""
    import cv2

    z = normalize(target - place, dim=-1)
    x = normalize(torch.linalg.cross(z, up), dim=-1)
    R = torch.stack([x, torch.linalg.cross(z, x), z])
    return PinholeCamera(
        focal, focal, 319.5, 239.5, 640, 480, name,
        rotation=cv2.Rodrigues(R.numpy())[0].ravel().tolist(), translation=(-R @ place).tolist(),
    )  # fmt: skip
