"""Recorded bodies seen by a ring of cameras, as a detector of keypoints would see them.

Recordings are split by person into those on which constants may be chosen and those that are scored. The
actions of CMU name no person and are all on one skeleton, whose bone lengths are thus no stranger's: they are
split by action, and the walkers 10, 16 and 35, who probably play soccer and run as well, are on the
same side of the split. Each of their files begins with a frame in the rest pose, which is left out, and one
file in which the body falls apart is not used. Berkeley MHAD has no head.

The persons of UTD-MHAD are seen from where their Kinect was, by one camera. Their skeletons are Kinect's,
with other joints than motion capture has. Lifters learn from half of them, s1 to s4. The person of the other
Kinect is in no fit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from benchmarks._data import data_files
from benchmarks._seeds import generator_of
from torchpose.body import BODY_15
from torchpose.body._skeleton import other_side
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.io._mocap import MocapClip, read_mocap

WALKS, ACTIONS, MHAD = "mocap_cmu_walk", "mocap_cmu_actions", "mocap_berkeley_mhad"
KINECT, OTHER_KINECT = "kinect_utd_mhad", "kinect_laban"

CHOOSING = {
    WALKS: ("s02_02_01_walk", "s05_05_01_walk", "s06_06_01_walk", "s07_07_01_walk",
            "s08_08_01_walk", "s39_39_01_walk"),
    ACTIONS: ("basketball_train_1", "basketball_train_3", "basketball_signal_train_1",
              "directing_traffic_train_4", "washwindow_test_1"),
    MHAD: ("s01_a01_jump_in_place_r1", "s01_a08_throw_r1", "s02_a02_jumping_jacks_r1",
           "s02_a09_sit_stand_r1", "s03_a03_bend_r1", "s03_a04_punch_r1"),
}  # fmt: skip
"""Recordings on which constants are chosen, by set."""

SCORED = {
    WALKS: ("s10_10_04_walk", "s16_16_15_walk", "s16_16_31_walk", "s32_32_01_walk", "s32_32_02_walk",
            "s35_35_02_walk", "s35_35_28_walk", "s38_38_01_walk", "s43_43_01_walk", "s55_55_04_walk"),
    ACTIONS: ("soccer_test_1", "soccer_train_1", "soccer_train_3", "running_test_1",
              "running_train_1", "running_train_2", "running_train_4", "jumping_train_2",
              "jumping_train_3", "jumping_train_5"),
    MHAD: ("s09_a02_jumping_jacks_r1", "s09_a09_sit_stand_r1", "s10_a03_bend_r1",
           "s10_a05_wave_two_hands_r1", "s10_a11_stand_up_r1", "s11_a04_punch_r1",
           "s11_a07_clap_r1", "s12_a01_jump_in_place_r1", "s12_a08_throw_r1",
           "s12_a10_sit_down_r1"),
}  # fmt: skip
"""Recordings that are scored, by set; of persons, or actions, who are not in `CHOOSING`."""

KINECT_SCORED = tuple(f"s0{5 + action % 4}_a{action:02d}_*_t1" for action in range(1, 28))
"""Recordings of UTD-MHAD that are scored: every action of one of s5 to s8."""

KINECT_TRAINING = ("s01_*", "s02_*", "s03_*", "s04_*")
"""Patterns of the recordings of UTD-MHAD from which lifters learn."""

TRAINING = {
    WALKS: ("s02_*", "s05_*", "s06_*", "s07_*", "s08_*", "s39_*"),
    ACTIONS: ("basketball_*", "directing_traffic_train_4", "washwindow_*"),
    MHAD: ("s01_*", "s02_*", "s03_*", "s04_*", "s05_*", "s06_*", "s07_*", "s08_*"),
}
"""Patterns of the recordings from which methods may learn, this package's prior over bodies among them."""

WIDTH, HEIGHT = 1920, 1080
RIGS = (4, 3, 2, 1)
"""Numbers of cameras: the first ones of each ring."""

FASTEST, LONGEST = 60.0, 300  # frames per second, frames
_QUICK_FRAMES = 12
_AZIMUTHS, _JITTER = (35.0, 125.0, 215.0, 305.0), 10.0  # degrees from the front to the left
_DISTANCE, _CAMERA_HEIGHT, _NEAREST = (3.0, 5.0), (1.0, 2.5), 2.0  # metres
_LONGEST_FOCAL, _MARGIN = 1500.0, 60.0  # pixels
_PELVIS = BODY_15.joint("pelvis")
_KINECT_FOCAL = 1575.0  # pixels: three times that of an image of 640


def pair_of(name: str) -> list[int]:
    """Return the left and the right joint of a name, such as "hip"."""
    return [BODY_15.joint(f"{side}_{name}") for side in ("left", "right")]


class Faults(NamedTuple):
    """How a detector errs.

    Args:
        noise: standard deviation, pixels.
        missing: share of the keypoints of each camera and joint, in bursts of `missing_frames` on average.
        outliers: share of single keypoints: half of them anywhere in the person's box, enlarged to
            `box` times its size, half `away` pixels off.
        exchanged: share of the frames of each camera, in bursts of `exchanged_frames`, in which left and
            right are exchanged, of the legs, the arms or both.
        sure, unsure: mean and standard deviation of the confidence of others and of outliers.
    """

    noise: float = 4.0
    missing: float = 0.10
    missing_frames: float = 10.0
    outliers: float = 0.05
    box: float = 1.5
    away: tuple[float, float] = (20.0, 200.0)
    exchanged: float = 0.03
    exchanged_frames: float = 5.0
    sure: tuple[float, float] = (0.85, 0.1)
    unsure: tuple[float, float] = (0.5, 0.25)


FAULTS = Faults()
NOISE_ALONE = Faults(missing=0.0, outliers=0.0, exchanged=0.0)
CLEAN = Faults(noise=0.0, missing=0.0, outliers=0.0, exchanged=0.0)


class Detections(NamedTuple):
    """Keypoints of a detector, and what is wrong with them.

    Attributes:
        keypoints: [T, C, 15, 2], pixels, NaN where missing. confidence: [T, C, 15], 0 where missing.
        missing, outlier, exchanged: [T, C, 15], which keypoints are; missing ones are nothing else.
    """

    keypoints: Tensor
    confidence: Tensor
    missing: Tensor
    outlier: Tensor
    exchanged: Tensor

    def of_cameras(self, count: int) -> Detections:
        """Return the detections in the first cameras."""
        return Detections(*(values[:, :count] for values in self))


class Clip(NamedTuple):
    """A recorded body as cameras see it.

    Attributes:
        name: of the recording. fps: frames per second. joints: [T, 15, 3], metres, in the axes of the
            room, NaN where the set lacks a joint. up: [3], of the room. rig: cameras.
        seen: in every camera.
    """

    name: str
    fps: float
    joints: Tensor
    up: Tensor
    rig: CameraRig
    seen: Detections

    def of_cameras(self, count: int) -> Clip:
        """Return the clip in the first cameras of its ring."""
        return self._replace(rig=self.rig.select(range(count)), seen=self.seen.of_cameras(count))

    def without(self, joints: Sequence[int]) -> Clip:
        """Return the clip in which no camera sees some joints."""
        keypoints, confidence = self.seen.keypoints.clone(), self.seen.confidence.clone()
        keypoints[..., joints, :] = math.nan
        confidence[..., joints] = 0.0
        return self._replace(seen=self.seen._replace(keypoints=keypoints, confidence=confidence))

    @property
    def given(self) -> tuple[CameraRig, Tensor, Tensor, float]:
        """Return what methods get: cameras, keypoints, confidence, and frames per second."""
        return self.rig, self.seen.keypoints, self.seen.confidence, self.fps

    @property
    def cameras_that_see(self) -> Int[Tensor, "T 15"]:
        """Return the number of cameras in which a keypoint is neither missing nor an outlier."""
        return (~(self.seen.missing | self.seen.outlier)).sum(1)


def read_clips(
    data: Path, names: Mapping[str, Sequence[str]], seed: int = 0, faults: Faults = FAULTS
) -> dict[str, list[Clip]]:
    """Return clips by set, as cameras see them.

    Args:
        data: folder with the sets. names: recordings by set, such as `SCORED`. seed: of cameras and
            faults. faults: of the detector.
    """
    return {
        folder: [see(clip, seed, faults) for clip in recorded(data / folder, chosen)]
        for folder, chosen in names.items()
    }


def read_kinect(
    data: Path,
    names: Sequence[str] = KINECT_SCORED,
    seed: int = 0,
    faults: Faults = FAULTS,
    folder: str = KINECT,
) -> list[Clip]:
    """Return recordings of a Kinect in one camera where it was, with its axes.

    The pelvis is the middle of the hips, as detectors have it; Kinect's is higher.

    Args:
        data: folder with the sets. names: of files without their suffix, or patterns. seed: of faults.
        faults: of the detector. folder: `KINECT` or `OTHER_KINECT`.
    """
    camera = PinholeCamera(
        _KINECT_FOCAL, _KINECT_FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT, "kinect",
        rotation=(0.0, 0.0, math.pi), translation=(0.0, 0.0, 0.0),
    )  # fmt: skip
    rig, found = CameraRig([camera]), []
    for clip in recorded(data / folder, names):
        generator = generator_of(clip.trial, seed)
        joints = hips_for_pelvis(clip.joints.double())
        seen = detect(rig(joints).pixels, generator, faults)
        found.append(Clip(clip.trial, clip.fps, joints, clip.up.double(), rig, seen))
    return found


def recorded(folder: Path, names: Sequence[str], longest: int = LONGEST) -> Iterator[MocapClip]:
    """Yield recordings of a set at no more than 60 Hz, the middle of those that are too long.

    Args:
        folder: of the set. names: of files without their suffix, or patterns. longest: frames.
    """
    files = data_files(folder, *(f"{name}.*" for name in names))
    for path in (path for path in files if path.suffix in (".npz", ".csv")):
        (clip,) = read_mocap(path, fps=None)
        if clip.fps > FASTEST:
            (clip,) = read_mocap(path, fps=FASTEST)
        first = 1 if folder.name == ACTIONS else 0  # not the rest pose
        start = first + max(0, (len(clip) - first - longest) // 2)
        yield clip.cut(start, start + longest)


def hips_for_pelvis(joints: Float[Tensor, "T 15 3"]) -> Float[Tensor, "T 15 3"]:
    """Return joints with the middle of the hips as the pelvis."""
    joints = joints.clone()
    joints[:, _PELVIS] = joints[:, pair_of("hip")].mean(1)
    return joints


def see(clip: MocapClip, seed: int = 0, faults: Faults = FAULTS, turn: float = 0.0) -> Clip:
    """Return a recording in a ring of cameras that its name and the seed draw.

    Args:
        clip: the recording. seed: of the cameras and faults. faults: of the detector. turn: of the ring,
            degrees.
    """
    generator = generator_of(clip.trial, seed)
    joints, up = clip.joints.double(), clip.up.double()
    rig = draw_ring(joints, up, generator, turn)
    pixels = rig(joints).pixels
    return Clip(clip.trial, clip.fps, joints, up, rig, detect(pixels, generator, faults))


def begun(clip: Clip, frames: int = _QUICK_FRAMES) -> Clip:
    """Return the first frames of a clip."""
    return cut(clip, slice(frames))


def cut(clip: Clip, frames: slice) -> Clip:
    """Return some frames of a clip."""
    seen = Detections(*(values[frames] for values in clip.seen))
    return clip._replace(joints=clip.joints[frames], seen=seen)


# --- cameras


def draw_ring(
    joints: Float[Tensor, "T 15 3"],
    up: Float[Tensor, "3"],
    generator: torch.Generator,
    turn: float = 0.0,
) -> CameraRig:
    """Return four cameras around the middle of a path, at which they look.

    They are a quarter of a turn apart, the first one at the person's front and left, 3 to 5 m from the
    middle and at least 2 m from every place of the pelvis. The focal length keeps all joints in view.

    Args:
        joints: of the recording. up: of the room. generator: of places. turn: of the ring from there,
            degrees.
    """
    path = joints[:, _PELVIS]
    middle = (path.amin(0) + path.amax(0)) / 2
    floor = (joints @ up).nan_to_num(math.inf).min()
    foot = middle - (middle @ up - floor) * up
    left = mean_left(joints, up)
    forward = torch.linalg.cross(left, up)
    drawn = torch.rand(len(_AZIMUTHS), 3, generator=generator, dtype=torch.float64)
    cameras = []
    for i, (azimuth, (off, away, high)) in enumerate(zip(_AZIMUTHS, drawn, strict=True), 1):
        angle = torch.deg2rad(azimuth + turn + _JITTER * (2 * off - 1))
        ray = angle.cos() * forward + angle.sin() * left
        reach = ((path - middle) @ ray).max()
        distance = torch.maximum(_between(_DISTANCE, away), reach + _NEAREST)
        place = foot + distance * ray + _between(_CAMERA_HEIGHT, high) * up
        cameras.append(aimed(place, foot + 0.95 * up, up, joints, f"cam_{i:02d}"))
    return CameraRig(cameras)


def _between(limits: tuple[float, float], share: Tensor) -> Tensor:
    return limits[0] + (limits[1] - limits[0]) * share


def mean_left(joints: Float[Tensor, "T 15 3"], up: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Return the horizontal direction to the person's left, averaged over hips, shoulders and frames.

    Args:
        joints: of a recording. up: of the room.
    """
    left, right = zip(pair_of("hip"), pair_of("shoulder"), strict=True)
    across = (joints[:, left] - joints[:, right]).mean((0, 1))
    return normalize(across - (across @ up) * up, dim=-1)


def aimed(
    place: Tensor, target: Tensor, up: Tensor, joints: Float[Tensor, "T 15 3"], name: str
) -> PinholeCamera:
    """Return an upright camera that looks at a target and has all joints in its image."""
    import cv2

    z = normalize(target - place, dim=-1)
    x = normalize(torch.linalg.cross(z, up), dim=-1)
    rotation = torch.stack([x, torch.linalg.cross(z, x), z])
    local = (joints - place) @ rotation.T
    widest = (local[..., :2] / local[..., 2:]).abs().nan_to_num().amax((0, 1))
    half = torch.tensor([WIDTH / 2 - _MARGIN, HEIGHT / 2 - _MARGIN], dtype=torch.float64)
    focal = min(float((half / widest).min()), _LONGEST_FOCAL)
    return PinholeCamera(
        focal, focal, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT, name,
        rotation=cv2.Rodrigues(rotation.numpy())[0].ravel().tolist(),
        translation=(-rotation @ place).tolist(),
    )  # fmt: skip


# --- a detector


def detect(
    pixels: Float[Tensor, "T C 15 2"], generator: torch.Generator, faults: Faults = FAULTS
) -> Detections:
    """Return what a detector makes of projected joints.

    Args:
        pixels: of all joints, NaN where one is unknown. generator: of faults. faults: their amounts.
    """
    shape = pixels.shape[:-1]
    noisy = pixels + faults.noise * torch.randn(
        pixels.shape, generator=generator, dtype=pixels.dtype
    )
    exchanged = _exchanges(shape, generator, faults)
    found = torch.where(exchanged[..., None], noisy[..., OTHER, :], noisy)
    outlier = torch.rand(shape, generator=generator) < faults.outliers
    found = torch.where(outlier[..., None], _wild(pixels, generator, faults), found)
    missing = bursts(shape, faults.missing, faults.missing_frames, generator)
    missing = missing | found.isnan().any(-1)
    means, stds = (
        torch.where(outlier, unsure, sure)
        for unsure, sure in zip(faults.unsure, faults.sure, strict=True)
    )
    confidence = means + stds * torch.randn(shape, generator=generator)
    return Detections(
        found.masked_fill(missing[..., None], math.nan),
        confidence.clamp(0.05, 1.0).masked_fill(missing, 0.0).to(pixels.dtype),
        missing, outlier & ~missing, exchanged & ~outlier & ~missing,
    )  # fmt: skip


def bursts(
    shape: Sequence[int], share: float, frames: float, generator: torch.Generator
) -> Bool[Tensor, "T *rest"]:
    """Return a Markov chain over the first axis that is on for a share of the time, in bursts.

    Args:
        shape: of the result. share: of the time. frames: mean length of a burst.
        generator: of random numbers.
    """
    drawn = torch.rand(tuple(shape), generator=generator)
    begins = share / (1 - share) / frames
    state = drawn[0] < share
    states = [state]
    for row in drawn[1:]:
        state = torch.where(state, row >= 1 / frames, row < begins)
        states.append(state)
    return torch.stack(states)


OTHER = tuple(BODY_15.joint(other_side(name)) for name in BODY_15.names)
"""The joint on the other side of each, and itself in the middle."""

_LEGS, _ARMS = (
    torch.tensor([name.endswith(ends) for name in BODY_15.names])
    for ends in (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"))
)
_SIDES = torch.stack([_LEGS, _ARMS, _LEGS | _ARMS])


def _exchanges(
    shape: Sequence[int], generator: torch.Generator, faults: Faults
) -> Bool[Tensor, "T C 15"]:
    """Return whose left and right are exchanged; within a burst always the same limbs."""
    on = bursts(shape[:2], faults.exchanged, faults.exchanged_frames, generator)
    begins = on & ~torch.cat([torch.zeros_like(on[:1]), on[:-1]])
    place = torch.where(begins, torch.arange(len(on))[:, None], 0).cummax(0).values
    kinds = torch.randint(len(_SIDES), tuple(shape[:2]), generator=generator)
    return on[..., None] & _SIDES[kinds.gather(0, place)]


def _wild(
    pixels: Float[Tensor, "T C 15 2"], generator: torch.Generator, faults: Faults
) -> Float[Tensor, "T C 15 2"]:
    """Return outliers in place of all keypoints: anywhere in the enlarged box, or off by a distance."""
    drawn = torch.rand(*pixels.shape[:-1], 5, generator=generator, dtype=pixels.dtype)
    low = pixels.nan_to_num(math.inf).amin(2, keepdim=True)
    high = pixels.nan_to_num(-math.inf).amax(2, keepdim=True)
    anywhere = (low + high) / 2 + faults.box * (high - low) * (drawn[..., :2] - 0.5)
    return displaced(pixels, anywhere, drawn[..., 2:], faults).masked_fill(pixels.isnan(), math.nan)


def displaced(
    pixels: Float[Tensor, "*batch 2"],
    anywhere: Float[Tensor, "*batch 2"],
    drawn: Float[Tensor, "*batch 3"],
    faults: Faults,
) -> Float[Tensor, "*batch 2"]:
    """Return outliers, half of them anywhere, half off by a distance.

    Args:
        pixels: of keypoints. anywhere: where the first half is.
        drawn: direction, distance, and which half, each from 0 to 1. faults: the distances.
    """
    angle = 2 * math.pi * drawn[..., :1]
    off = _between(faults.away, drawn[..., 1:2]) * torch.cat([angle.cos(), angle.sin()], -1)
    return torch.where(drawn[..., 2:] < 0.5, anywhere, pixels + off)
