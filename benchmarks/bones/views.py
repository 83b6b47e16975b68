"""Recordings of the upper body, each seen by one camera."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import torchpose
from benchmarks._data import data_files
from torchpose.evaluation._trials import CAMERA, centred_on_neck, make_test_set
from torchpose.io import Recording, read_recordings
from torchpose.skeleton import UPPER_BODY
from torchpose.skeleton._joint_sets import canonical_names
from torchpose.skeleton._torso import KINECT_NECK
from torchpose.upper_body._face_points import FACE

_SEVEN = ("wrist_left", "elbow_left", "shoulder_left", "neck", "shoulder_right", "elbow_right",
          "wrist_right")  # fmt: skip
_MHAD = ("left_wrist", "left_elbow", "left_shoulder", "neck", "right_shoulder", "right_elbow",
         "right_wrist")  # fmt: skip
_OPENPOSE_FACE = ("Nose", "LEye", "REye", "LEar", "REar")
_PLACE, EVERY, _FRAMES, _STD = (0.05, -0.2, 2.5), 4, 150, 3.0
_MHAD_PERSONS = ("s09", "s10", "s11", "s12")  # the network of upper bodies was fitted to the others
_KINECT = (*(name.replace("wrist", "hand") for name in _SEVEN), "head")
UTD, UTD_PERSONS, UTD_EVERY = "kinect_utd_mhad", ("s7", "s8"), 8
_VISIBLE, _UNSEEN = 0.6, 0.3  # MediaPipe's visibility: of an arm that is scored, of a missing joint
_QUICK_FRAMES = 4  # of a view of a quick run
_RATE, _FEWEST = 30.0, 15  # frames per second, and frames with arms, of a recording
_HEAD, _NECK = UPPER_BODY.index("head"), UPPER_BODY.index("neck")
_SHOULDERS = [UPPER_BODY.index(f"shoulder_{side}") for side in ("left", "right")]


def arm_rows(names: Sequence[str]) -> list[list[int]]:
    """Return the places of shoulder, elbow and wrist, or else hand, of left and right among joints."""
    known = canonical_names(names)
    end = "wrist" if "wrist_left" in known else "hand"
    return [[known.index(f"{joint}_{side}") for joint in ("shoulder", "elbow", end)]
            for side in ("left", "right")]  # fmt: skip


ENDS = arm_rows(UPPER_BODY)


class View(NamedTuple):
    """A recording seen by one camera.

    Attributes:
        keypoints: [T, J, 2], NaN where missing, in the order of `names`. confidence: [T, J].
        names: of the keypoints. camera: of the pixels. neck: kind of the keypoints' neck.
        truth: of left and right: shoulder, elbow, wrist, camera axes, [T, 2, 3, 3].
        fps: frames per second. depth: of the shoulders, metres; None is that of the truth.
    """

    keypoints: Tensor
    confidence: Tensor
    names: Sequence[str]
    camera: torchpose.PinholeCamera
    neck: str
    truth: Tensor
    fps: float
    depth: float | None = None

    @property
    def far(self) -> float:
        """Return the depth of the shoulders, metres."""
        return float(self.truth[..., 0, 2].nanmean()) if self.depth is None else self.depth


def mhad_views(data: Path, every: int = EVERY, pitch: float = 0.0) -> list[View]:
    """Return one recording in four of s9 to s12 of Berkeley MHAD, 150 frames each, in a camera at 2.5 m.

    Args:
        data: folder with mocap_berkeley_mhad/. every: one recording in so many.
        pitch: the angle by which the camera looks up, radians; it turns about the neck.
    """
    camera = torchpose.PinholeCamera(525.0, 525.0, 319.5, 239.5)
    tilted = camera.tilted(
        pitch
    ).level_rotation.numpy()  # level axes from the left, camera from the right
    rng = np.random.default_rng(0)
    views = []
    files = data_files(data / "mocap_berkeley_mhad", *(f"**/{p}*.npz" for p in _MHAD_PERSONS))
    for path in files[3::every]:
        with np.load(path) as file:
            names = [str(name) for name in file["names"]]
            picked = [names.index(name) for name in _MHAD]
            joints = file["joints"][:_FRAMES, picked].astype(float) * np.array([1, -1, -1.0])
        joints = joints - joints[:, [3]]
        joints = (joints @ tilted if pitch else joints) + np.array(_PLACE)
        pixels = joints[..., :2] / joints[..., 2:] * 525 + np.array([319.5, 239.5])
        pixels = torch.tensor(pixels + rng.normal(0, _STD, pixels.shape))
        truth = torch.tensor(joints)[:, arm_rows(_SEVEN)]
        views.append(
            View(pixels, torch.ones(pixels.shape[:2]), _SEVEN, camera, "mid-shoulder", truth, 30.0)
        )
    return views


def openpose_views(data: Path) -> list[View]:
    """Return the balancing person in each of four cameras, as OpenPose saw the upper body.

    Args:
        data: folder with multicam_pose2sim/.
    """
    views = []
    for path in data_files(data / "multicam_pose2sim", "**/*.npz"):
        with np.load(path) as file:
            if "openpose_2d" not in file:
                continue
            arrays = {key: file[key] for key in file.files}
        ends = arm_rows([str(name) for name in arrays["names"]])
        seen = [str(name) for name in arrays["openpose_names"]]
        limbs = ("Wrist", "Elbow", "Shoulder")
        wanted = [f"L{limb}" for limb in limbs] + ["Neck"] + [f"R{limb}" for limb in limbs[::-1]]
        for k, rotation, t, found in zip(
            *(arrays[key] for key in ("K", "R", "t", "openpose_2d")), strict=True
        ):
            world = arrays["joints"].astype(float)[:, ends]
            truth = torch.tensor(world @ np.asarray(rotation, float).T + np.ravel(t))
            keypoints = torch.tensor(
                found[:, [seen.index(name) for name in (*wanted, *_OPENPOSE_FACE)]],
                dtype=torch.float64,
            )
            sure = keypoints[..., 2].clamp(0, 1)
            camera = torchpose.PinholeCamera(
                float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])
            )
            fps = float(arrays["fps"])
            views.append(
                View(keypoints[..., :2], sure, (*_SEVEN, *FACE), camera, "mid-shoulder", truth, fps)
            )
    return views


def webcam_views(data: Path) -> list[View]:
    """Return clips of strangers as MediaPipe saw them, with its own 3D landmarks in place of a truth.

    Frames in which it is not sure of an arm have no truth. Clips without a visible arm are left out. The
    depth is the one at which the shoulders have the size of the image; hands are nearer.

    Args:
        data: folder with video_people/ and video_asl/.
    """
    views = []
    folders = (data / name for name in ("video_people", "video_asl"))
    for path in (p for folder in folders for p in data_files(folder, "*_mediapipe_pose1.npz")):
        with np.load(path) as file:
            arrays = {key: file[key] for key in file.files}
        names = [str(name) for name in arrays["names"]]
        kept = [i for i, name in enumerate(names) if not name.endswith(("hip", "index"))]
        ends = arm_rows(names)
        sure = torch.tensor(arrays["visibility"]).double().clamp(0, 1)
        keypoints = torch.tensor(arrays["joints2d"]).double()
        truth = torch.tensor(arrays["joints3d"]).double()[:, ends]
        widths = [
            arms[:, :, 0, :2].diff(dim=1).norm(dim=-1) for arms in (truth, keypoints[:, ends])
        ]
        truth[(sure[:, ends] < _VISIBLE).any(-1)] = torch.nan
        if not bool(truth.isfinite().any()):
            continue
        camera = torchpose.PinholeCamera.from_image_size(*(int(x) for x in arrays["image_size"]))
        depth = float((widths[0] / widths[1]).nanmedian() * camera.matrix[0, 0])
        sure, fps = torch.where(sure < _UNSEEN, 0.0, sure)[:, kept], float(arrays["fps"])
        seen = [names[i] for i in kept]
        views.append(
            View(keypoints[:, kept], sure, seen, camera, "mid-shoulder", truth, fps, depth)
        )
    return views


@cache
def recordings(folder: Path) -> list[Recording]:
    """Return the recordings of a set, read once."""
    return read_recordings(folder)


def kinect_views(
    data: Path, every: int = UTD_EVERY, persons: Sequence[str] = UTD_PERSONS
) -> list[View]:
    """Return sequences of some persons of UTD-MHAD in the test camera of UB-people, 3 px of noise.

    Args:
        data: folder with kinect_utd_mhad/. every: one sequence in so many. persons: by default s7 and s8.
    """
    chosen = [r for r in recordings(data / UTD) if r.person in persons][::every]
    return seen_by_camera([r.upper_body().joints.double() for r in chosen])


def seen_by_camera(joints: Sequence[Float[Tensor, "T 8 3"]]) -> list[View]:
    """Return recordings in the test camera of UB-people, 3 px of noise.

    Args:
        joints: of each, at 30 frames a second.
    """
    poses = [centred_on_neck(x) for x in joints]
    test = make_test_set(poses, CAMERA, 30.0, noise_std=_STD, names=_KINECT)
    views = []
    for keypoints, truth, n in zip(
        test.keypoints, test.truth3d, test.lengths.tolist(), strict=True
    ):
        sure = torch.ones(n, len(_KINECT))
        views.append(View(keypoints[:n], sure, _KINECT, CAMERA, "neck", truth[:n][:, ENDS], 30.0))
    return views


def at_rate(recording: Recording) -> Tensor:
    """Return the eight joints at 30 frames a second, with Kinect's neck where that is known, [T, 8, 3]."""
    step = max(1, round(float(recording.fps or _RATE) / _RATE))
    body = recording.upper_body()
    joints = body.joints.double()[::step]
    if body.neck == "mid-shoulder":
        joints = joints.clone()
        joints[:, _NECK] = (
            joints[:, _SHOULDERS].mean(1).lerp(joints[:, _HEAD], KINECT_NECK.fraction)
        )
    return joints


def with_arms(found: Sequence[Recording]) -> list[Tensor]:
    """Return the frames of recordings in which both arms are known."""
    joints = [at_rate(recording) for recording in found]
    whole = [x[x[:, ENDS].isfinite().flatten(1).all(1)] for x in joints]
    return [x for x in whole if len(x) > _FEWEST]


def begun(view: View, frames: int = _QUICK_FRAMES) -> View:
    """Return the first frames of a view."""
    seen = (view.keypoints, view.confidence, view.truth)
    keypoints, confidence, truth = (values[:frames] for values in seen)
    return view._replace(keypoints=keypoints, confidence=confidence, truth=truth)
