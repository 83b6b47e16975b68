"""Whole files of every kind, small, that the fuzzer damages."""

import io
import json
import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from tests.io.skeleton_files import (
    azure_text,
    daily_text,
    header_text,
    ntu_text,
    person,
    rows_text,
    to_kinect,
)
from tests.priors.mixtures import random_mixture
from tests.priors.motions import motion, some_body_motion
from tests.priors.performances import performances
from torchpose.body import BODY_15, Body, centres_of
from torchpose.camera import PinholeCamera, save_cameras
from torchpose.learning import fit_action_space, fit_gplvm, fit_limb_conditionals
from torchpose.priors import ActionBank, ActionSpace, ManifoldInfo, UpperBodyPrior
from torchpose.priors._limb_conditionals import in_body_frame
from torchpose.priors._prior_file import PriorInfo
from torchpose.skeleton import SKELETONS, UPPER_BODY
from torchpose.upper_body import PoseTrack
from torchpose.upper_body._pose_files import write_bvh
from torchpose.whole_body import BodyTrack

__all__ = ["SAMPLES", "Content"]

Content = bytes | dict[str, bytes]
"""A file, or the files of a folder by name."""

_FRAMES = 6
_KINECT = SKELETONS["kinect-v1-20"].joints


def pose_track(batch: int = 1) -> PoseTrack:
    """Poses in front of a camera, with covariances that are positive definite."""
    g = torch.Generator().manual_seed(batch)
    joints = torch.from_numpy(person(UPPER_BODY, _FRAMES)).expand(batch, -1, -1, -1).clone()
    factor = 0.02 * torch.randn(batch, _FRAMES, 8, 3, 3, generator=g, dtype=torch.float64)
    factor2d = torch.randn(batch, _FRAMES, 8, 2, 2, generator=g, dtype=torch.float64)
    matrix = torch.tensor([[525.0, 0, 319.5], [0, 525.0, 239.5], [0, 0, 1]], dtype=torch.float64)
    pixels = joints @ matrix.mT
    return PoseTrack(
        pixels[..., :2] / pixels[..., 2:],
        joints,
        factor2d @ factor2d.mT + torch.eye(2, dtype=torch.float64),
        factor @ factor.mT + 1e-4 * torch.eye(3, dtype=torch.float64),
        torch.rand(batch, _FRAMES, 8, generator=g) > 0.3,
        torch.randn(batch, _FRAMES, 2, generator=g, dtype=torch.float64),
        torch.full((batch,), _FRAMES),
        matrix,
        torch.full((batch,), -1),
        fps=30.0,
        notes=("a note", "another"),
    )


def body_poses() -> BodyTrack:
    """Poses of a whole body with details of a bank of actions."""
    g = torch.Generator().manual_seed(1)
    body = Body.of_height(BODY_15, 1.7)
    states = 0.2 * torch.randn(_FRAMES, body.dim, generator=g, dtype=torch.float64)
    body = body.altered(centres=centres_of(body, states))
    factor = 0.05 * torch.randn(_FRAMES, 15, 3, 3, generator=g, dtype=torch.float64)
    return BodyTrack(
        body, states, states.abs(), body.joints(states), factor @ factor.mT,
        torch.randn(_FRAMES, generator=g, dtype=torch.float64),
        1 + torch.rand(_FRAMES, generator=g, dtype=torch.float64),
        torch.arange(_FRAMES) == 1, torch.zeros(_FRAMES, dtype=torch.bool), 50.0, ("a note",), 7,
        {"actions": torch.softmax(torch.randn(_FRAMES, 3, generator=g), -1)},
        ("bend", "wave", "none"),
    )  # fmt: skip


def prior() -> UpperBodyPrior:
    """A prior with two components, random but positive definite, and learnt noise."""
    arms = (random_mixture(2, 21, seed) for seed in (0, 1))
    eye = torch.eye(21, dtype=torch.float64)
    noise = {"process_cov_left": eye, "process_cov_right": 2 * eye}
    return UpperBodyPrior(*arms, PriorInfo(name="small", persons=("set#a",)), noise)


def _npz(**arrays: object) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def _saved(save: Callable[[Path], object], name: str) -> Callable[[Path], bytes]:
    def made(folder: Path) -> bytes:
        save(folder / name)
        return (folder / name).read_bytes()

    return made


def _keypoints_npz(_: Path) -> bytes:
    points = person(UPPER_BODY, _FRAMES)[..., :2] * 250 + 320
    return _npz(
        keypoints=points, names=np.array(UPPER_BODY), confidence=np.full(points.shape[:2], 0.9),
        fps=30.0, K=np.array([[525.0, 0, 319.5], [0, 525, 239.5], [0, 0, 1]]),
        image_size=np.array([640, 480]), neck=np.array("neck"),
    )  # fmt: skip


def _recording_npz(_: Path) -> bytes:
    joints = person(UPPER_BODY, _FRAMES)
    return _npz(joints=joints, names=np.array(UPPER_BODY), fps=30.0, subject=np.array("s1"),
                action=np.array("wave"), axes=np.array("camera"),
                weights=np.ones(joints.shape[:2]))  # fmt: skip


def _keypoints_csv(long: bool) -> bytes:
    points = person(UPPER_BODY, _FRAMES)[..., :2] * 250 + 320
    lines = ["# fps = 30", "# image_size = 640,480"]
    if long:
        lines.append("frame,name,x,y,confidence")
        lines += [f"{t},{name},{x:.2f},{y:.2f},0.9" for t, row in enumerate(points)
                  for name, (x, y) in zip(UPPER_BODY, row, strict=True)]  # fmt: skip
    else:
        lines.append(",".join(["frame", *(f"{n}_{a}" for n in UPPER_BODY for a in "xy")]))
        lines += [",".join([str(t), *(f"{v:.2f}" for v in row.ravel())])
                  for t, row in enumerate(points)]  # fmt: skip
    return ("\n".join(lines) + "\n").encode()


def _openpose(_: Path) -> Content:
    rng = np.random.default_rng(0)
    frames = {}
    for frame in range(4):
        people = [{"pose_keypoints_2d": (100 * rng.random(75)).round(2).tolist()} for _ in "ab"]
        name = f"clip_{frame:012d}_keypoints.json"
        frames[name] = json.dumps({"version": 1.3, "people": people}).encode()
    return frames


def _opencv(_: Path) -> bytes:
    joints = person(UPPER_BODY, _FRAMES, (0.0, 0.0, 0.0)).reshape(_FRAMES, 24)
    data = ", ".join(f"{v:.6e}" for v in joints.ravel())
    head = f"   rows: {_FRAMES}\n   cols: 24\n   dt: d\n   data: [ {data} ]\n"
    return f"%YAML:1.0\n---\nposes: !!opencv-matrix\n{head}".encode()


def _c3d(folder: Path) -> bytes:
    import c3d

    labels = ("LShoulder", "RShoulder", "LElbow", "RElbow", "LWrist", "RWrist", "Head", "Neck")
    joints = person(labels, _FRAMES, (0.0, 0.0, 0.0))[..., [0, 2, 1]] * (1000, 1000, -1000)
    writer = c3d.Writer(point_rate=100.0, point_units="mm  ")
    writer.set_point_labels(list(labels))
    writer.set_screen_axis("+X", "+Z")
    for frame in joints:
        points = np.zeros((len(labels), 5), np.float32)
        points[:, :3] = frame
        writer.add_frames([(points, np.empty((0, 0)))])
    with warnings.catch_warnings(), (folder / "a.c3d").open("wb") as stream:
        warnings.simplefilter("ignore")
        writer.write(stream)
    return (folder / "a.c3d").read_bytes()


def _bvh(folder: Path) -> bytes:
    write_bvh(pose_track(), folder / "a.bvh")
    return (folder / "a.bvh").read_bytes()


def _cameras(path: Path) -> None:
    first = PinholeCamera(
        525, 525, 319.5, 239.5, 640, 480, "one", distortions=(0.1, -0.2, 0.0, 0.0),
        rotation=(0.1, 0.2, 0.3), translation=(0.0, 0.5, 2.0),
    )  # fmt: skip
    save_cameras([first, PinholeCamera(600, 610, 330, 250, 640, 480, "two")], path)


def _manifold(path: Path) -> None:
    body = Body.of_height(BODY_15, 1.7)
    info = ManifoldInfo.of_body(body, name="walk", fps=60.0, persons=("a",))
    fit_gplvm([motion(20), motion(15)], steps=1, info=info).save(path)


def _limbs(path: Path) -> None:
    g = torch.Generator().manual_seed(0)
    body = Body.of_height(BODY_15, 1.75)
    states = 0.1 * torch.randn(60, body.dim, generator=g, dtype=torch.float64)
    own, moved = in_body_frame([(body, [states])])
    fit_limb_conditionals(own, moved, 60.0, name="walk", persons=("a",)).save(path)


def _spaces() -> list[ActionSpace]:
    return [fit_action_space(performances(6, i), 3, name=f"action {i}", fps=30.0) for i in range(2)]


def _azure(_: Path) -> bytes:
    names = SKELETONS["azure-32"].joints
    joints = person(names, 3)
    return azure_text({1: dict(enumerate(joints)), 2: {1: joints[1] + 0.5}}, 3, names).encode()


def _kinect_v2(_: Path) -> bytes:
    joints = to_kinect(person(SKELETONS["kinect-v2-25"].joints, _FRAMES))
    stamps = 1e9 + 333333.0 * np.arange(_FRAMES)
    rows = np.concatenate([joints, np.full((_FRAMES, 25, 1), 2.0)], -1).reshape(_FRAMES, -1)
    return "\n".join(
        ",".join([f"{stamp:.0f}", *(f"{v:.6g}" for v in row)])
        for stamp, row in zip(stamps, rows, strict=True)
    ).encode()


def _ntu(_: Path) -> bytes:
    joints = to_kinect(person(SKELETONS["kinect-v2-25"].joints, 3))
    return ntu_text({"7205": dict(enumerate(joints)), "7206": {1: joints[1] + 0.4}}, 3).encode()


def _calibration(_: Path) -> bytes:
    numbers = [1400, 1410, 320, 240, 0, 0.1, 0, 0, 0, 0, *np.eye(3).ravel(), 100, 200, 3000]
    return "\r\n".join(f"{float(v):.8f}" for v in numbers).encode()


def _video(folder: Path) -> bytes:
    from tests.video.make import make_video

    return make_video(folder / "a.mp4", 6).read_bytes()


def _kinect_v1(_: Path) -> bytes:
    return rows_text(to_kinect(person(_KINECT, _FRAMES)), fourth=1.0).encode()


def _daily(_: Path) -> bytes:
    joints = to_kinect(person(_KINECT, 3))
    return daily_text([dict(enumerate(joints))], 3).encode()


def _table(_: Path) -> bytes:
    names, time = ("Head", "Neck", "LShoulder", "RShoulder", "LElbow", "RElbow"), range(_FRAMES)
    extra = {"frame": time, "time_ms": [33 * t for t in time], "body_id": [1] * _FRAMES}
    return header_text(
        person(names, _FRAMES), names, extra, facts=("fps = 30", "axes = camera")
    ).encode()


def _half_track(path: Path) -> None:
    """Poses of which the filter lost the last two frames."""
    track = pose_track()
    for name in ("joints2d", "joints3d", "covariance2d", "covariance3d"):
        getattr(track, name)[:, 4:] = math.nan
    replace(track, failed_at=torch.tensor([4])).save(path)


SAMPLES: dict[str, dict[str, Callable[[Path], Content]]] = {
    "poses": {
        "one.npz": _saved(lambda p: pose_track().save(p), "one.npz"),
        "lost.npz": _saved(_half_track, "lost.npz"),
        "two.npz": _saved(lambda p: pose_track(2).save(p), "two.npz"),
    },
    "body poses": {"body.npz": _saved(lambda p: body_poses().save(p), "body.npz")},
    "keypoints npz": {"keypoints.npz": _keypoints_npz},
    "keypoints csv": {
        "wide.csv": lambda _: _keypoints_csv(False),
        "long.csv": lambda _: _keypoints_csv(True),
    },
    "OpenPose": {"openpose": _openpose},
    "recording npz": {"joints.npz": _recording_npz},
    "recording text": {
        "v2.csv": _kinect_v2, "table.csv": _table, "v1.txt": _kinect_v1, "daily.txt": _daily,
        "a.skeleton": _ntu, "azure.json": _azure,
    },
    "recording yaml": {"opencv.yaml": _opencv},
    "motion capture": {"a.bvh": _bvh, "a.c3d": _c3d},
    "cameras": {"cameras.toml": _saved(_cameras, "cameras.toml")},
    "HumanEva": {"C1.cal": _calibration, "C1.ofs": lambda _: b"3\n1\n2.0\n"},
    "prior": {"prior.safetensors": _saved(lambda p: prior().save(p), "prior.safetensors")},
    "models": {
        "manifold.safetensors": _saved(_manifold, "manifold.safetensors"),
        "limbs.safetensors": _saved(_limbs, "limbs.safetensors"),
        "space.safetensors": _saved(lambda p: _spaces()[0].save(p), "space.safetensors"),
        "body.safetensors": _saved(lambda p: some_body_motion().save(p), "body.safetensors"),
        "bank.safetensors": _saved(lambda p: ActionBank(_spaces()).save(p), "bank.safetensors"),
    },
    "video": {"a.mp4": _video},
}  # fmt: skip
"""What makes a file of each name, by the kind that the fuzzer counts it under."""
