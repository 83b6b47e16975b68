"""Animate a performer: joint angles between key frames, bones of fixed length.

The movement (wave, reach, cross the arms, a hand at the face, rest) is given as joint angles. It is not
sampled from any prior, so that tracking it is a fair test. The body and its angles are defined in
`torchpose.demo._mannequin`.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose.camera._pinhole import PinholeCamera
from torchpose.camera._projection import project
from torchpose.demo._mannequin import ANGLE_LIMITS, BodyAngles, BodySize, angles_to_joints
from torchpose.errors import InputError
from torchpose.math._rotations import euler_to_matrix
from torchpose.skeleton._joint_sets import UPPER_BODY

KEYPOINT_NAMES = ("head", "neck", "hand_left", "hand_right")
"""Names of the keypoints of `noisy_keypoints`, in its order."""


class Performance(NamedTuple):
    """Holds the joints of an animated performer.

    Attributes:
        joints: [T, 8, 3], camera axes, metres, in the order of `torchpose.skeleton.UPPER_BODY`.
        body: the same in the body frame [T, 8, 3]: origin at the neck of the body at rest.
        wrists: left and right wrist [T, 2, 3], camera axes.
        angles: of the joints.
        rotation, translation: [3, 3], [3]: joints = rotation body + translation.
        labels: the action, one word for each frame.
        fps: frames per second. names: the names of the joints.
    """

    joints: Tensor
    body: Tensor
    wrists: Tensor
    angles: BodyAngles
    rotation: Tensor
    translation: Tensor
    labels: tuple[str, ...]
    fps: float
    names: tuple[str, ...]


# --- key frames -----------------------------------------------------------------------------------


def minimum_jerk(
    times: Float[Tensor, " T"], keys: Float[Tensor, " N"], values: Float[Tensor, "N *shape"]
) -> Float[Tensor, "T *shape"]:
    """Return key frames interpolated with minimum jerk: at rest in every key, smooth in between.

    x(s) = a + (b - a) (10 s^3 - 15 s^4 + 6 s^5), s from 0 to 1 between two keys.

    Args:
        times: seconds; before the first key and after the last one the value stays.
        keys: increasing times of the keys, seconds.
        values: one for each key.

    Reference: Flash & Hogan (1985), DOI 10.1523/JNEUROSCI.05-07-01688.1985.
    """
    after = torch.searchsorted(keys, times.contiguous()).clamp(1, keys.numel() - 1)
    start, end = keys[after - 1], keys[after]
    s = ((times - start) / (end - start)).clamp(0, 1)
    s = s**3 * (10 - 15 * s + 6 * s**2)
    s = s.reshape(-1, *[1] * (values.ndim - 1))
    return values[after - 1] + s * (values[after] - values[after - 1])


_REST = (7.0, 4.0, -20.0, 17.0)
_Arm = tuple[float, float, float, float]
_Turn = tuple[float, float, float]

# Seconds of the movement, what it is called, then (abduction, flexion, twist, elbow) in degrees of
# the left and the right arm. Key frames of 0.3 s are the strokes of the wave.
_KEYS: tuple[tuple[float, str, _Arm, _Arm], ...] = (
    (0.0, "rest", _REST, _REST),
    (1.2, "rest", _REST, (8.0, 3.0, -18.0, 20.0)),
    (2.1, "wave", _REST, (62.0, 32.0, 62.0, 105.0)),
    (2.5, "wave", _REST, (66.0, 30.0, 84.0, 84.0)),
    (2.9, "wave", _REST, (60.0, 34.0, 42.0, 112.0)),
    (3.3, "wave", _REST, (66.0, 30.0, 84.0, 84.0)),
    (3.7, "wave", (9.0, 2.0, -25.0, 20.0), (60.0, 34.0, 42.0, 112.0)),
    (4.1, "wave", _REST, (65.0, 30.0, 82.0, 86.0)),
    (4.9, "rest", _REST, _REST),
    (5.4, "rest", (8.0, 6.0, -22.0, 22.0), _REST),
    (6.4, "reach", (22.0, 98.0, 15.0, 12.0), (10.0, -4.0, -20.0, 24.0)),
    (7.1, "reach", (20.0, 102.0, 12.0, 10.0), (10.0, -3.0, -20.0, 24.0)),
    (8.0, "reach", (104.0, 24.0, 20.0, 18.0), (12.0, 0.0, -20.0, 22.0)),
    (8.6, "reach", (100.0, 28.0, 22.0, 22.0), (12.0, 0.0, -20.0, 22.0)),
    (9.5, "cross", (0.0, 46.0, -74.0, 104.0), (4.0, 20.0, -76.0, 98.0)),
    (9.9, "cross", (0.0, 46.0, -74.0, 104.0), (3.0, 17.0, -82.0, 106.0)),
    (11.0, "cross", (-1.0, 45.0, -75.0, 105.0), (2.0, 17.0, -82.0, 106.0)),
    (11.4, "cross", (2.0, 42.0, -66.0, 100.0), (12.0, 12.0, -52.0, 84.0)),
    (11.9, "rest", _REST, _REST),
    (12.4, "rest", _REST, (8.0, 6.0, -25.0, 24.0)),
    (13.3, "face", (4.0, 14.0, -62.0, 84.0), (2.0, 72.0, -29.0, 128.0)),
    (14.6, "face", (4.0, 15.0, -60.0, 86.0), (2.0, 75.0, -30.0, 126.0)),
    (15.5, "rest", _REST, _REST),
    (16.5, "reach", (112.0, 88.0, 10.0, 28.0), (112.0, 88.0, 10.0, 28.0)),
    (17.2, "reach", (116.0, 86.0, 12.0, 20.0), (115.0, 88.0, 12.0, 22.0)),
    (18.4, "rest", _REST, _REST),
    (20.0, "rest", _REST, _REST),
)

# The same for roll, pitch, yaw in degrees of the torso and the head.
_TORSO_KEYS: tuple[tuple[float, _Turn, _Turn], ...] = (
    (0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    (2.1, (2.5, 0.0, -3.0), (-5.0, 0.0, 6.0)),
    (4.2, (2.5, 0.0, -2.0), (-4.0, -2.0, 4.0)),
    (5.2, (0.0, 0.0, 0.0), (0.0, 4.0, 0.0)),
    (6.6, (0.0, 7.0, 9.0), (0.0, -3.0, -4.0)),
    (8.2, (5.0, 1.0, -6.0), (3.0, 0.0, -22.0)),
    (9.6, (0.0, -2.0, 0.0), (0.0, 2.0, 4.0)),
    (11.1, (-1.5, -2.0, 0.0), (3.0, 2.0, 10.0)),
    (12.1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    (13.4, (0.0, 2.0, -2.0), (-6.0, 9.0, 5.0)),
    (14.7, (0.0, 2.0, -1.0), (-5.0, 7.0, 8.0)),
    (15.6, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    (16.7, (0.0, -5.0, 0.0), (0.0, -14.0, 0.0)),
    (18.4, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    (20.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
)
DURATION = 20.0


def performer_angles(
    n_frames: int = 600,
    fps: float = 30.0,
    seed: int = 0,
    dtype: torch.dtype = torch.float64,
) -> tuple[BodyAngles, tuple[str, ...]]:
    """Return the joint angles of the performance, and in each frame the action of the nearest key frame.

    Movements between key frames have minimum jerk, and the torso starts a little before the arms. Slow
    sway, breathing and tremor are added. The performance repeats after 20 s.

    Args:
        n_frames: T.
        fps: frames per second.
        seed: the seed of the sway, and of the amplitude of each movement (about 3 %).
        dtype: the floating-point type of the result.
    """
    if n_frames < 1 or not fps > 0:
        raise InputError(f"need n_frames >= 1 and fps > 0, got {n_frames} and {fps}")
    generator = torch.Generator().manual_seed(seed)
    clock = torch.arange(n_frames, dtype=torch.float64) / fps
    time = clock.remainder(DURATION)
    keys = torch.tensor([k[0] for k in _KEYS], dtype=torch.float64)
    poses = torch.tensor([k[2:] for k in _KEYS], dtype=torch.float64)
    effort = 1 + 0.03 * torch.randn(poses.shape[0], 1, 1, generator=generator, dtype=torch.float64)
    effort[[0, -1]] = 1  # the last frame of a round is the first one of the next
    poses = poses * effort.clamp(0.94, 1.06)
    shoulders = minimum_jerk(time, keys, poses[..., :3])
    # The elbow follows the shoulder; the two together curve the path of the hand.
    elbow = minimum_jerk((time - 0.06).clamp_min(0), keys, poses[..., 3:])
    arms = torch.cat([shoulders, elbow], -1) + sway(clock, (2, 4), 1.3, (0.15, 0.7), generator)
    low, high = torch.tensor(list(ANGLE_LIMITS.values()), dtype=torch.float64).unbind(-1)
    trunk_keys = torch.tensor([k[0] for k in _TORSO_KEYS], dtype=torch.float64)
    trunk_poses = torch.tensor([k[1:] for k in _TORSO_KEYS], dtype=torch.float64)
    trunk = minimum_jerk((time + 0.1).clamp_max(DURATION), trunk_keys, trunk_poses)
    trunk = trunk + sway(clock, (2, 3), 1.0, (0.1, 0.4), generator)
    trunk = torch.deg2rad(trunk).to(dtype)
    angles = BodyAngles(
        hip_sway(clock, generator).to(dtype),
        trunk[:, 0],
        trunk[:, 1],
        torch.deg2rad(torch.maximum(torch.minimum(arms, high), low)).to(dtype),
    )
    nearest = (time[:, None] - keys).abs().argmin(1)
    return angles, tuple(_KEYS[i][1] for i in nearest.tolist())


def hip_sway(clock: Tensor, generator: torch.Generator) -> Float[Tensor, "T 3"]:
    """Return the motion of the hips while standing and breathing, metres."""
    position = sway(clock, (3,), 0.008, (0.08, 0.3), generator)
    breathing = 0.003 * torch.sin(2 * math.pi * 0.25 * clock)
    position[:, 1] = 0.3 * position[:, 1] + breathing
    return position


def sway(
    clock: Tensor,
    shape: tuple[int, ...],
    amplitude: float,
    band: tuple[float, float],
    generator: torch.Generator,
) -> Tensor:
    """Return a slow sway: the sum of four sinusoids of random phase and frequency.

    Args:
        clock: seconds [T]. shape: the shape of what sways. amplitude: about its root mean square.
        band: lowest and highest frequency, Hz. generator: of phases and frequencies.

    Returns:
        [T, *shape].
    """
    size = (4, *shape)
    unit = torch.rand((2, *size), generator=generator, dtype=torch.float64)
    hertz = band[0] + (band[1] - band[0]) * unit[0]
    turns = clock.reshape(-1, *[1] * len(size)) * hertz + unit[1]
    return amplitude * torch.sin(2 * math.pi * turns).sum(1) / math.sqrt(2.0)


# --- the performer in front of a camera -----------------------------------------------------------


def performer(
    n_frames: int = 600,
    fps: float = 30.0,
    seed: int = 0,
    size: BodySize | None = None,
    distance: float = 2.0,
    dtype: torch.dtype = torch.float64,
) -> Performance:
    """Return the animated performer in front of `demo_camera`.

    Args:
        n_frames: T; the performance repeats after 20 s.
        fps: frames per second.
        seed: the seed of the variation.
        size: bone lengths.
        distance: the distance of the neck from the camera, metres.
        dtype: the floating-point type of the result.

    Returns:
        The performance in camera axes.

    >>> performer(n_frames=2).joints.shape
    torch.Size([2, 8, 3])
    """
    angles, labels = performer_angles(n_frames, fps, seed, dtype)
    return stage(angles, labels, fps, size, distance)


def stage(
    angles: BodyAngles,
    labels: tuple[str, ...],
    fps: float,
    size: BodySize | None = None,
    distance: float = 2.0,
) -> Performance:
    """Return a movement in front of `demo_camera`.

    Args:
        angles: the movement, T frames. labels: a word for each frame. fps: frames per second.
        size: bone lengths.
        distance: the distance of the neck from the camera, metres.

    Raises:
        InputError: too near for the camera to see the arms, or not a label for each frame.
    """
    if not 0.8 <= distance < math.inf:
        raise InputError(f"distance must be at least 0.8 m to see the arms, got {distance}")
    if len(labels) != len(angles.arms) or not fps > 0:
        raise InputError(
            f"need a label for each of {len(angles.arms)} frames and fps > 0, got {len(labels)} "
            f"labels and {fps}"
        )
    body, wrists = angles_to_joints(angles, size)
    dtype = angles.arms.dtype
    rotation = euler_to_matrix(torch.tensor([0.01, -0.04, 0.05], dtype=dtype))
    translation = torch.tensor([0.04, -0.16, distance], dtype=dtype)
    return Performance(
        body @ rotation.mT + translation,
        body,
        wrists @ rotation.mT + translation,
        angles,
        rotation,
        translation,
        labels,
        float(fps),
        UPPER_BODY,
    )


def demo_camera() -> PinholeCamera:
    """Return a camera like Kinect's: 640 x 480 pixels, f = 525 pixels."""
    return PinholeCamera(525.0, 525.0, 319.5, 239.5, 640, 480, name="demo")


def noisy_keypoints(
    joints: Float[Tensor, "T 8 3"],
    camera: PinholeCamera | None = None,
    std_px: float = 3.0,
    seed: int = 0,
    gap: tuple[str, float, float] | None = ("hand_right", 2.6, 1.0),
    fps: float = 30.0,
) -> Float[Tensor, "T 4 2"]:
    """Return simulated detections of head, neck and hands: pixels with noise and a gap.

    Args:
        joints: [T, 8, 3], camera axes, metres.
        camera: whose pixels; `demo_camera` by default.
        std_px: standard deviation of the Gaussian noise in u and v, independent per joint, frame.
        seed: the seed of the noise.
        gap: (name of a keypoint, start in s, length in s), where that one is missing; None = none.
        fps: frames per second, to place the gap.

    Returns:
        [T, 4, 2], pixels, in the order of `KEYPOINT_NAMES`; NaN in the gap.

    Raises:
        InputError: std_px negative or not finite, fps not positive, or an unknown keypoint in `gap`.
        ShapeError: joints of another shape.
    """
    check_shape("joints", joints, [None, 8, 3])
    if not 0 <= std_px < math.inf or not fps > 0:
        raise InputError(f"need std_px >= 0 and fps > 0, got {std_px} and {fps}")
    K = (camera or demo_camera()).matrix.to(joints)
    chosen = joints[:, [UPPER_BODY.index(name) for name in KEYPOINT_NAMES]]
    eye, origin = torch.eye(3).to(joints), torch.zeros(3).to(joints)
    pixels = project(chosen, K, eye, origin)[..., :2]
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    pixels = pixels + std_px * noise.to(pixels)
    if gap is not None:
        name, start, length = gap
        if name not in KEYPOINT_NAMES or start < 0 or length < 0:
            raise InputError(
                f"gap must be (one of {', '.join(KEYPOINT_NAMES)}, start >= 0, length >= 0) with "
                f"times in seconds, got {gap}"
            )
        first, count = round(start * fps), round(length * fps)
        pixels[first : first + count, KEYPOINT_NAMES.index(name)] = math.nan
    return pixels
