"""People who lie, hang or stand on their hands, and cameras on their side, with one camera.

Persons 9 to 12 of Berkeley MHAD, who do jumping jacks, bend and wave, are turned about horizontal axes and
put on the floor. They are seen across the body, along it (from head and feet) and from between, by a camera
on a tripod, and from the ceiling, with a detector's faults. Nobody is told which way is up.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._seeds import generator_of
from benchmarks.keypoint_bodies.clips import (
    HEIGHT,
    MHAD,
    WIDTH,
    Clip,
    aimed,
    detect,
    mean_left,
    recorded,
)
from benchmarks.keypoint_bodies.methods import Method, row_of
from benchmarks.keypoint_bodies.scoring import Score, score
from torchpose.body import BODY_15
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.evaluation import Report
from torchpose.math._rotations import rotvec_to_matrix

__all__ = ["add_lying_table", "lying_clips"]

_RECORDINGS = ("s09_a02_jumping_jacks_r1", "s10_a03_bend_r1", "s11_a05_wave_two_hands_r1",
               "s12_a02_jumping_jacks_r1")  # fmt: skip
_FRAMES, _QUICK_FRAMES = 30, 4
_JOINT = 0.08  # metres, of the lowest joint above the floor
_LEFT, _UP, _AHEAD = torch.eye(3, dtype=torch.float64)
_QUARTER = math.pi / 2
_POSTURES = {
    "supine": -_QUARTER * _LEFT,
    "prone": _QUARTER * _LEFT,
    "on a side": _QUARTER * _AHEAD,
    "upside down": 2 * _QUARTER * _LEFT,
    "standing": 0 * _LEFT,
}
_LYING = ("supine", "prone", "on a side")
_SIDES = (0.0, 90.0)  # degrees
_COLUMNS = ("error", "rigid", "inside_50", "inside_90")
_DIGITS = (1, 1, 0, 0)
_NOTE = (
    "Errors are relative to the pelvis, mm, 'rigid' after the best motion of each frame; then shares of true "
    "joints in the ellipsoids, %. A method marked * has seen no later frame."
)


class _View(NamedTuple):
    """Who is seen, and by which camera.

    Attributes:
        postures: of the persons. azimuths: degrees to their left from which they are seen, before they are
            turned. height, distance, aim: metres, of the camera and of where it looks. roll: degrees.
    """

    postures: tuple[str, ...]
    azimuths: tuple[float, ...]
    height: float = 1.5
    distance: float = 3.0
    aim: float = 0.4
    roll: float = 0.0


_VIEWS = {
    "lying, across": (
        _View(("supine", "prone"), (90.0, 270.0)),
        _View(("on a side",), (0.0, 180.0)),
    ),
    "lying, at 45 degrees": (_View(_LYING, (45.0,)),),
    "lying, from head or feet": (
        _View(("supine", "prone"), (0.0, 180.0)),
        _View(("on a side",), (90.0, 270.0)),
    ),
    "lying, from the ceiling": (_View(_LYING, (90.0,), 3.0, 0.0, 0.0),),
    "upside down": (_View(("upside down",), _SIDES, aim=0.9),),
    "camera on its side": (_View(("standing",), _SIDES, aim=0.9, roll=90.0),),
    "standing, level camera": (_View(("standing",), _SIDES, aim=0.9),),
}


def add_lying_table(report: Report, methods: Mapping[str, Method], data: Path, quick: bool) -> None:
    """Add the table of people who lie.

    Args:
        report: gets the table. methods: by name, of one camera. data: folder with the sets.
        quick: one clip of few frames for each row, to see that it works.
    """
    views = lying_clips(data, quick)
    table = report.table("lying", "One camera, people who lie (mm)", [*_COLUMNS], digits=_DIGITS,
                         note=_NOTE)  # fmt: skip
    chosen = [Score._fields.index(column) for column in _COLUMNS]
    for name, method in tqdm(methods.items(), desc="people who lie"):
        for view, clips in views.items():
            scores = [score(method(*clip.given), clip) for clip in clips]
            table.add(f"{row_of(name)}, {view}", torch.tensor(scores).nanmean(0)[chosen].tolist())


def lying_clips(data: Path, quick: bool) -> dict[str, list[Clip]]:
    """Return clips of people who lie, by how they are seen.

    Args:
        data: folder with the sets. quick: one of each kind, with few frames.
    """
    frames = _QUICK_FRAMES if quick else _FRAMES
    bodies = [_body(data, name, frames) for name in _RECORDINGS[: 1 if quick else None]]
    every = {
        name: [
            _seen(body, view, posture, azimuth)
            for body in bodies
            for view in views
            for posture in view.postures
            for azimuth in view.azimuths
        ]
        for name, views in _VIEWS.items()
    }
    return {name: clips[:1] for name, clips in every.items()} if quick else every


class _Body(NamedTuple):
    """A person: name, joints [T, 15, 3] from the mean pelvis, to the left, up and ahead, and frame rate."""

    name: str
    joints: Tensor
    fps: float


def _body(data: Path, name: str, frames: int) -> _Body:
    """Return every other frame of the middle of a recording."""
    (clip,) = recorded(data / MHAD, [name], 2 * frames)
    joints, up = clip.joints[::2].double(), clip.up.double()
    left = mean_left(joints, up)
    joints = joints @ torch.stack([left, up, torch.linalg.cross(left, up)]).T
    pelvis = joints[:, BODY_15.joint("pelvis")].mean(0)
    return _Body(name, joints - pelvis, clip.fps / 2)


def _seen(body: _Body, view: _View, posture: str, azimuth: float) -> Clip:
    """Return a person in a posture as a camera sees them."""
    turn = rotvec_to_matrix(-math.radians(azimuth) * _UP) @ rotvec_to_matrix(_POSTURES[posture])
    joints = body.joints @ turn.T
    joints = joints - (joints[..., 1].nan_to_num(math.inf).min() - _JOINT) * _UP
    rig = CameraRig([_camera(view, joints)])
    name = f"{body.name}, {posture}, from {azimuth:g} degrees, {view.height:g} m"
    generator = generator_of(name)
    return Clip(name, body.fps, joints, _UP, rig, detect(rig(joints).pixels, generator))


def _camera(view: _View, joints: Float[Tensor, "T 15 3"]) -> PinholeCamera:
    """Return the camera of a view; on the ceiling the top of the image is away from where it is seen from."""
    import cv2

    place = view.distance * _AHEAD + view.height * _UP
    top = _UP if view.distance else -_AHEAD
    level = aimed(place, view.aim * _UP, top, joints, "camera")
    if not view.roll:
        return level
    rig = CameraRig([level])
    roll = rotvec_to_matrix(math.radians(view.roll) * _AHEAD)
    rotation, translation = roll @ rig.rotation[0].double(), roll @ rig.translation[0].double()
    focal = float(rig.matrix[0, 0, 0]) * HEIGHT / WIDTH  # all stays in the image
    return PinholeCamera(
        focal, focal, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT, "camera",
        rotation=cv2.Rodrigues(rotation.numpy())[0].ravel().tolist(), translation=translation.tolist(),
    )  # fmt: skip
