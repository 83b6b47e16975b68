"""A body that walks past three small cameras, for filters that need silhouettes."""

import math

import torch

from torchpose.body import BODY_15, Body
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.math._rotations import matrix_to_quaternion_vector

HEIGHT, WIDTH = 60, 80


def walker():
    return Body.of_height(BODY_15, 1.75)


def rig(n_cameras=3, distance=3.5, target=(0.0, 0.95, 0.0)):
    """Cameras around the origin of a room whose y axis points up, level and looking at `target`."""
    cameras = []
    for i in range(n_cameras):
        angle = 2 * math.pi * i / max(n_cameras, 3) + 0.4
        # camera axes in the room: x right, y down, z towards the target
        ahead = torch.tensor([-math.sin(angle), 0.0, -math.cos(angle)], dtype=torch.float64)
        down = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
        rotation = torch.stack([torch.linalg.cross(down, ahead), down, ahead])
        centre = torch.tensor(target, dtype=torch.float64) - distance * ahead
        cameras.append(
            PinholeCamera(
                90, 90, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT, f"c{i}",
                rotation=rotation_vector(rotation).tolist(),
                translation=(-rotation @ centre).tolist(),
            )
        )  # fmt: skip
    return CameraRig(cameras)


def rotation_vector(rotation):
    """Rodrigues vector of a rotation matrix."""
    vector = matrix_to_quaternion_vector(rotation)
    sine = vector.norm()
    return vector / sine * 2 * sine.clamp_max(1).asin()


def walk(body, n_frames, seed=0, speed=0.02, phase=0.0, heading=0.3):
    """States of a walk along the heading, at 60 Hz: limbs swing once a second, everything drifts."""
    t = torch.arange(n_frames, dtype=torch.float64)
    angle = phase + 2 * math.pi * t / 60
    states = torch.zeros(n_frames, body.dim, dtype=torch.float64)
    along = torch.tensor([math.sin(heading), 0.0, math.cos(heading)], dtype=torch.float64)
    states[:, :3] = (t - n_frames / 2)[:, None] * speed * along
    states[:, 1] = 0.93 + 0.02 * (2 * angle).cos()
    states[:, 4] = math.sin(heading / 2)
    swings = {
        "left_thigh": 0.5 * angle.sin(), "right_thigh": -0.5 * angle.sin(),
        "left_shank": 0.5 + 0.4 * angle.cos(), "right_shank": 0.5 - 0.4 * angle.cos(),
        "left_upper_arm": -0.5 * angle.sin(), "right_upper_arm": 0.5 * angle.sin(),
        "left_forearm": -0.5 - 0.2 * angle.sin(), "right_forearm": -0.5 + 0.2 * angle.sin(),
    }  # fmt: skip
    for part, swing in swings.items():
        states[:, 3 + 3 * body.skeleton.part(part)] = (swing / 2).sin()
    g = torch.Generator().manual_seed(seed)
    rate, shift = (torch.rand(2, body.dim, generator=g, dtype=torch.float64)).unbind()
    drift = 0.03 * (2 * math.pi * (t[:, None] * (0.2 + rate) / 60 + shift)).sin()
    states[:, 6:] += drift[:, 6:]
    return states
