"""One camera that nobody calibrated, level and tilted: a phone in portrait.

Of every scored group of recordings some are seen from 3 to 5 m, within 60 degrees of the front, at 30 frames
a second, with a detector's faults; keypoints outside of the image are missing. A tilted camera either looks
at the middle of the person from above or below, or stays at 0.8 to 1.6 m and is turned there. Nobody is told
the focal length, which is that of the guess unless the view says otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence
from tqdm.auto import tqdm

import torchpose
from benchmarks._seeds import generator_of
from benchmarks.keypoint_bodies.clips import (
    KINECT,
    KINECT_SCORED,
    MHAD,
    SCORED,
    detect,
    hips_for_pelvis,
    mean_left,
    recorded,
)
from benchmarks.keypoint_bodies.methods import Method, row_of
from benchmarks.keypoint_bodies.scoring import from_the_start
from torchpose.body import BODY_15
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.evaluation import Report
from torchpose.metrics import align
from torchpose.whole_body import BodyTrack
from torchpose.whole_body._keypoints.camera_tilt import CameraTilt, find_camera_tilt

__all__ = ["add_tilt_tables"]

_FPS, _FRAMES, _QUICK_FRAMES = 30.0, 45, 20
_EVERY, _KINECT_EVERY = 4, 5  # recordings of each group
_WIDTH, _HEIGHT = 1080, 1920
_DISTANCE, _LENS, _AROUND, _NEAREST, _AIM = (3.0, 5.0), (0.8, 1.6), math.radians(60.0), 2.0, 0.95
_PELVIS = BODY_15.joint("pelvis")
_UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
_MOCAP = "motion capture"
_NOTE = (
    "Errors relative to the pelvis, mm. 'level': the camera is taken to be level; 'told': tilt and roll are; "
    "'found': by how the person stands. A method marked * has seen no later frame, but 'found' looked at all."
)


class _View(NamedTuple):
    """How a camera is held: degrees by which it looks up and is rolled, and its focal length over the guess.

    `turned` says that it stays in its place, and does not look at the person from above or below.
    """

    pitch: float = 0.0
    roll: float = 0.0
    focal: float = 1.0
    turned: bool = False


_VIEWS = {
    "level": _View(),
    "10 down": _View(-10.0),
    "20 down": _View(-20.0),
    "30 down": _View(-30.0),
    "10 up": _View(10.0),
    "20 up": _View(20.0),
    "rolled 10": _View(roll=10.0),
    "turned 15 down": _View(-15.0, turned=True),
    "turned 15 up": _View(15.0, turned=True),
    "level, f x 0.75": _View(focal=0.75),
    "level, f x 1.33": _View(focal=1.33),
    "20 down, f x 1.33": _View(-20.0, focal=1.33),
}


class _Seen(NamedTuple):
    """A person in a view.

    Attributes:
        joints: [T, 15, 3], camera axes. keypoints: [T, 1, 15, 2]. confidence: [T, 1, 15].
        camera: as it is held, with the guessed focal length.
    """

    joints: Tensor
    keypoints: Tensor
    confidence: Tensor
    camera: PinholeCamera


def add_tilt_tables(report: Report, lifters: Mapping[str, Method], data: Path, quick: bool) -> None:
    """Add the tables of one camera that nobody calibrated.

    Args:
        report: gets the tables. lifters: by name, of one camera. data: folder with the sets.
        quick: few recordings and views, to see that it works.
    """
    every = [name for name in _VIEWS if not quick or name in ("level", "10 up")]
    for group, bodies in _bodies(data, quick).items():
        found: dict[str, dict[str, Tensor]] = {}
        tilts = {}
        for name in tqdm(every, desc=group):
            people = [_seen(body, joints, _VIEWS[name]) for body, joints in bodies.items()]
            errors, angles = _errors(people, lifters)
            for row, scores in errors.items():
                found.setdefault(row, {})[name] = scores
            tilts[name] = _of_angles(angles, _VIEWS[name])
        for place, what in enumerate(("in axes of the camera", "in the room", "rigid")):
            title = f"An uncalibrated camera, {group}, {what} (mm)"
            table = report.table(title, title, every, digits=(1,) * len(every), note=_NOTE)
            for row, by_view in found.items():
                table.add(row, [float(by_view[name][place]) for name in every])
        title = f"Tilt found, {group} (degrees)"
        table = report.table(title, title, ["views", "error", "90 %", "roll"], digits=(0, 1, 0, 1), note=(
            "'views': in which somebody stands. Root mean square errors of pitch and roll; '90 %': share of "
            "pitches within 1.64 standard deviations, %."))  # fmt: skip
        for name in every:
            table.add(name, tilts[name])


def _bodies(data: Path, quick: bool) -> dict[str, dict[str, Tensor]]:
    """Return joints [T, 15, 3] to the person's left, up and ahead, by group and name."""
    scored = {MHAD: SCORED[MHAD][:1]} if quick else SCORED
    mocap = {
        f"{folder} {clip.trial}": _levelled(clip.joints, clip.up, clip.fps, quick)
        for folder, names in scored.items()
        for clip in recorded(data / folder, names[::_EVERY])
    }
    names = KINECT_SCORED[:1] if quick else KINECT_SCORED[::_KINECT_EVERY]
    kinect = {
        clip.trial: _levelled(hips_for_pelvis(clip.joints), clip.up, clip.fps, quick)
        for clip in recorded(data / KINECT, names)
    }
    return {_MOCAP: mocap, "persons of a Kinect": kinect}


def _levelled(joints: Tensor, up: Tensor, fps: float, quick: bool) -> Float[Tensor, "T 15 3"]:
    """Return the first joints of a recording at the usual frame rate."""
    joints, up = joints.double(), up.double()
    place = torch.arange(int((len(joints) - 1) * _FPS / fps), dtype=torch.float64) * fps / _FPS
    place = place[: _QUICK_FRAMES if quick else _FRAMES]
    before = place.floor().long()
    joints = torch.lerp(joints[before], joints[before + 1], (place - before)[:, None, None])
    left = mean_left(joints, up)
    return joints @ torch.stack([left, up, torch.linalg.cross(left, up)]).T


def _seen(name: str, joints: Float[Tensor, "T 15 3"], view: _View) -> _Seen:
    """Return a person as a camera sees them."""
    generator = generator_of(name)
    aside, away, high = torch.rand(3, generator=generator).tolist()
    azimuth = _AROUND * (2 * aside - 1)
    ray = torch.tensor([math.sin(azimuth), 0.0, math.cos(azimuth)], dtype=torch.float64)
    path = joints[:, _PELVIS]
    middle = (path.amin(0) + path.amax(0)) / 2
    foot = middle.clone()
    foot[1] = joints[..., 1].nan_to_num(math.inf).min()
    reach = float(((path - middle) @ ray).max())
    distance = max(_DISTANCE[0] + away * (_DISTANCE[1] - _DISTANCE[0]), reach + _NEAREST)
    height = _LENS[0] + high * (_LENS[1] - _LENS[0])
    if not view.turned:
        height = _AIM - distance * math.tan(math.radians(view.pitch))
    camera = PinholeCamera.from_image_size(_WIDTH, _HEIGHT)
    camera = camera.tilted(math.radians(view.pitch), math.radians(view.roll)).in_level_world()
    heading = torch.stack(
        [torch.linalg.cross(_UP, ray), _UP, ray]
    )  # x right, y up, z to the viewer
    level = (joints - foot - distance * ray - height * _UP) @ heading.T
    local = level @ camera.rotation_matrix.T
    matrix = camera.matrix.clone()
    matrix[[0, 1], [0, 1]] *= view.focal
    pixels = local[..., :2] / local[..., 2:] * matrix.diagonal()[:2] + matrix[:2, 2]
    inside = ((pixels >= 0) & (pixels < torch.tensor([_WIDTH, _HEIGHT]))).all(-1)
    found = detect(pixels.masked_fill(~inside[..., None], math.nan)[:, None], generator)
    return _Seen(local, found.keypoints, found.confidence, camera)


def _errors(
    people: Sequence[_Seen], lifters: Mapping[str, Method]
) -> tuple[dict[str, Tensor], list[CameraTilt | None]]:
    """Return mean errors of every method, and what is found of the tilt of each camera."""
    level = PinholeCamera.from_image_size(_WIDTH, _HEIGHT).in_level_world()
    unknown = _tracked(people, level)
    rows = {"kalman *, level": [(track, level) for track in unknown]}
    told = people[0].camera
    rows["kalman *, told"] = [(track, told) for track in _tracked(people, told, up="y")]
    angles = [find_camera_tilt([track], CameraRig([level])) for track in unknown]
    rows["kalman *, found"] = [
        _found(*given, level) for given in zip(people, unknown, angles, strict=True)
    ]
    scores = {}
    for name, tracks in rows.items():
        pairs = zip(tracks, people, strict=True)
        scores[name] = [_scores(_joints(track), camera, one) for (track, camera), one in pairs]
    for name, method in lifters.items():
        scores[f"{row_of(name)}, level"] = [
            _scores(method(CameraRig([level]), p.keypoints, p.confidence, _FPS).joints, level, p)
            for p in people
        ]
    return {name: torch.tensor(found).nanmean(0) for name, found in scores.items()}, angles


def _tracked(
    people: Sequence[_Seen], camera: PinholeCamera, up: str | None = None
) -> list[BodyTrack]:
    """Return the tracks of people whom one camera is taken to see."""
    tracker = torchpose.BodyTracker([camera], method="kalman", fps=_FPS, up=up)
    tracks = tracker(
        keypoints=pad_sequence([one.keypoints for one in people], True, math.nan),
        confidence=pad_sequence([one.confidence for one in people], True),
        names=BODY_15.names,
        lengths=torch.tensor([len(one.joints) for one in people]),
    )
    assert isinstance(tracks, list)
    return tracks


def _found(
    one: _Seen, unknown: BodyTrack, tilt: CameraTilt | None, level: PinholeCamera
) -> tuple[BodyTrack, PinholeCamera]:
    """Return a person tracked anew in the camera as it was found to be held, and that camera."""
    if tilt is None:
        return unknown, level
    camera = level.tilted(tilt.pitch, tilt.roll).in_level_world()
    return _tracked([one], camera, up="y")[0], camera


def _joints(track: BodyTrack) -> Float[Tensor, "T 15 3"]:
    return from_the_start(track.joints3d, track.first_frame)


def _scores(joints: Float[Tensor, "T 15 3"], camera: PinholeCamera, one: _Seen) -> list[float]:
    """Return errors in axes of the camera, in the room, and after the best motion, mm.

    Args:
        joints: in the world of `camera`. camera: as it was taken to be held. one: the truth.
    """
    joints = joints[: len(one.joints)]
    true_room = one.joints @ one.camera.rotation_matrix
    local = joints @ camera.rotation_matrix.T
    pairs = ((local, one.joints), (joints, true_room))
    apart = [_from_pelvis(found) - _from_pelvis(true) for found, true in pairs]
    apart.append(align(local, one.joints, joints=None).points - one.joints)
    return [1000 * float(off.norm(dim=-1).nanmean()) for off in apart]


def _from_pelvis(joints: Float[Tensor, "T 15 3"]) -> Float[Tensor, "T 15 3"]:
    return joints - joints[:, [_PELVIS]]


def _of_angles(angles: Sequence[CameraTilt | None], view: _View) -> list[float]:
    """Return how many tilts were found, and how well."""
    found = torch.tensor([angle for angle in angles if angle is not None]).reshape(-1, 4).rad2deg()
    pitch, roll = found[:, 0] - view.pitch, found[:, 1] - view.roll
    inside = 100 * (pitch.abs() < 1.645 * found[:, 2]).double().mean()
    errors = [float(off.square().mean().sqrt()) for off in (pitch, roll)]
    return [len(found), errors[0], float(inside), errors[1]]
