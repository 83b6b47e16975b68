"""Bodies in motion as several cameras see them, for tests of tracking by keypoints."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.body import BODY_15, Body
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.whole_body import BodyTrack, BodyTracker

FPS = 30.0
NAMES = BODY_15.names


class Scene(NamedTuple):
    """Joints [T, 15, 3], their keypoints [T, C, 15, 2] and confidences [T, C, 15]."""

    joints: Tensor
    rig: CameraRig
    keypoints: Tensor
    confidence: Tensor


def ring(count: int, distance: float = 4.0) -> CameraRig:
    """Cameras around the origin, 1 m above the pelvis, world axes with y up."""
    return CameraRig([camera_at(0.6 + i * math.pi / 2, distance, f"c{i}") for i in range(count)])


def camera_at(angle: float, distance: float, name: str) -> PinholeCamera:
    tilt, s, c = 0.2, math.sin(angle), math.cos(angle)
    right = torch.tensor([c, 0.0, -s], dtype=torch.float64)
    ahead = -torch.tensor(
        [s * math.cos(tilt), math.sin(tilt), c * math.cos(tilt)], dtype=torch.float64
    )
    rotation = torch.stack([right, torch.linalg.cross(ahead, right), ahead])
    position = -ahead * distance
    rotvec = torch.from_numpy(_rotvec(rotation.numpy()))
    return PinholeCamera(
        1300, 1300, 959.5, 539.5, 1920, 1080, name,
        rotation=tuple(rotvec.tolist()), translation=tuple((-rotation @ position).tolist()),
    )  # fmt: skip


def _rotvec(matrix):
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(matrix).as_rotvec()


def moving_body(n_frames: int = 40, height: float = 1.7, phase: float = 0.0) -> Tensor:
    """A person who walks on the spot, turns a little and swings the arms, [T, 15, 3]."""
    body = Body.of_height(BODY_15, height)
    t = torch.arange(n_frames, dtype=torch.float64) / FPS + phase
    state = torch.zeros(n_frames, body.dim, dtype=torch.float64)
    parts = {name: 3 + 3 * i for i, name in enumerate(BODY_15.parts)}
    swing = torch.sin(2 * math.pi * 0.8 * t)
    state[:, 0], state[:, parts["pelvis"] + 1] = 0.2 * torch.sin(t), 0.15 * torch.sin(t)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        state[:, parts[f"{side}_thigh"]] = -0.15 - 0.12 * sign * swing
        state[:, parts[f"{side}_shank"]] = 0.25 + 0.1 * sign * swing
        state[:, parts[f"{side}_upper_arm"]] = -0.1 + 0.15 * sign * swing
        state[:, parts[f"{side}_forearm"]] = -0.35 + 0.1 * swing
    return body.joints(state)


def scene(
    cameras: int = 4, n_frames: int = 40, noise: float = 4.0, seed: int = 0, height: float = 1.7
) -> Scene:
    """A moving body with noise of some pixels."""
    return seen_by(ring(cameras), moving_body(n_frames, height), noise, seed)


def seen_by(rig: CameraRig, joints: Tensor, noise: float = 4.0, seed: int = 0) -> Scene:
    """Joints with noise of some pixels."""
    pixels = noisy(rig(joints).pixels, noise, seed)
    return Scene(joints, rig, pixels, torch.full_like(pixels[..., 0], 0.9))


def noisy(pixels: Tensor, noise: float = 4.0, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return pixels + noise * torch.randn(pixels.shape, generator=generator, dtype=pixels.dtype)


def kalman(rig, **options) -> BodyTracker:
    return BodyTracker(rig, "kalman", fps=FPS, **options)


def track(given: Scene, smoothing: str = "none", **options) -> BodyTrack:
    return kalman(given.rig, **options)(
        keypoints=given.keypoints, confidence=given.confidence, smoothing=smoothing
    )


def errors(track, joints: Tensor) -> Tensor:
    """Distances [T, 15] in metres."""
    return (track.joints3d - joints).norm(dim=-1)
