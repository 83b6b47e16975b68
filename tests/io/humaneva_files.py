"""A folder written in HumanEva-I's layout: someone walks, seen by three cameras, in the set's own files."""

import warnings

import cv2
import numpy as np
import pytest
import torch

from benchmarks.bodies.clips import place_cameras
from benchmarks.bodies.silhouettes import true_silhouettes
from tests.benchmarks.walkers import NAMES, walker
from torchpose.body import body_joints
from torchpose.demo._rendering.clothed_body import TrueShape
from torchpose.io._mocap import MocapClip

WIDTH, HEIGHT = 640, 480
CAMERAS = ("C1", "C2", "C3")
COLOUR = (40, 30, 190)


def write_c3d(path, points, lost=()):
    """Points [S, 3] by label, mm, at 120 Hz; `lost`: pairs of frame and label."""
    c3d = pytest.importorskip("c3d")
    labels = list(points)
    writer = c3d.Writer(point_rate=120.0, point_units="mm  ")
    writer.set_point_labels([f"S1:{name}" for name in labels])
    writer.set_screen_axis("+X", "+Z")
    for t in range(len(next(iter(points.values())))):
        frame = np.zeros((len(labels), 5), np.float32)
        frame[:, :3] = [points[name][t] for name in labels]
        for when, label in lost:
            if when == t:
                frame[labels.index(label)] = (0, 0, 0, -1, 0)
        writer.add_frames([(frame, np.empty((0, 0)))])
    path.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings(), path.open("wb") as stream:
        warnings.simplefilter("ignore")
        writer.write(stream)


def write_calibration(path, K, R, t, distortions=(0.0,) * 5, skew=0.0):
    """The 22 numbers of a .cal file; t in millimetres."""
    numbers = [K[0][0], K[1][1], K[0][2], K[1][2], skew, *distortions, *np.ravel(R), *t]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\r\n".join(f"{float(v):.8f}" for v in numbers))


def walking_joints(n_frames, phase=0.0, fps=60.0):
    """Joints of a walk on the spot [T, 15, 3], metres, z up, facing +x."""
    return walker(n_frames, phase, speed=0.4, fps=fps)[..., [2, 0, 1]]


def segment_points(joints):
    """Points of Vicon's body model by label, mm, whose joint centres are these joints [S, 15, 3], m."""
    at = {name: 1000 * joints[:, i] for i, name in enumerate(NAMES)}
    forward, left = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    points = {}

    def segment(name, origin, towards, label=None):
        z = towards - origin
        z = z / np.linalg.norm(z, axis=-1, keepdims=True)
        points[f"{name}O"] = origin
        points[f"{name}A"], points[f"{name}L"] = origin + 40 * forward, origin + 40 * left
        points[label or f"{name}P"] = towards if label else origin + 40 * z

    segment("PEL", at["pelvis"] + 50 * forward, at["thorax"] + 50 * forward)
    segment("TRX", at["thorax"], at["head"])
    segment("HED", at["thorax"], at["head"])
    for side, s in (("left", "L"), ("right", "R")):
        points[f"{s}CLO"] = at[f"{side}_shoulder"]
        segment(f"{s}HU", at[f"{side}_elbow"], at[f"{side}_shoulder"])
        segment(f"{s}RA", at[f"{side}_wrist"], at[f"{side}_elbow"])
        segment(f"{s}FE", at[f"{side}_knee"], at[f"{side}_hip"], f"{s}FEP")
        segment(f"{s}TI", at[f"{side}_ankle"], at[f"{side}_knee"])
    return points


def clip_of(joints, trial="Walking_1"):
    joints = torch.from_numpy(joints)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return MocapClip(
        body_joints(joints, NAMES), joints, NAMES, up, 60.0, "S1", "Walking", trial
    )  # fmt: skip


def write_humaneva(root, n_frames=60, starts=(1, 3, 6), persons=("S1",), n_backgrounds=2):
    """One filmed trial and one without videos of each person.

    Args:
        starts: image of each camera's video (from one) in which the motion capture begins.

    Returns:
        The rig that filmed the first person.
    """
    rigs = []
    for p, person in enumerate(persons):
        folder = root / person
        joints = walking_joints(2 * n_frames, p, 120.0)
        write_c3d(folder / "Mocap_Data" / "Walking_1.c3d", segment_points(joints))
        for trial, phase in (("3", 0.5 + p), ("4", 1.5 + p)):
            path = folder / "Mocap_Data" / f"Walking_{trial}.c3d"
            write_c3d(path, segment_points(walking_joints(100, phase, 120.0)))
        for name in ("Sync_Data", "Image_Data", "Calibration_Data"):
            (folder / name).mkdir()
        clip = clip_of(joints[::2])
        rig = place_cameras(clip)
        for i, camera in enumerate(CAMERAS):
            write_calibration(
                folder / "Calibration_Data" / f"{camera}.cal",
                rig.matrix[i].numpy(), rig.rotation[i].numpy(), 1000 * rig.translation[i].numpy(),
            )  # fmt: skip
            (folder / "Sync_Data" / f"Walking_1_({camera}).ofs").write_text(f"{starts[i]}\n1\n2\n")
        seen = true_silhouettes(clip, TrueShape.draw(p), rig)
        write_videos(root, folder / "Image_Data", seen, starts, n_backgrounds if p == 0 else 0)
        rigs.append(rig)
    return rigs[0]


def write_videos(root, folder, seen, starts, n_backgrounds):
    """Videos of dark blue people before a coarse pattern that is another one for every camera."""
    background = root / "Background"
    background.mkdir(exist_ok=True)
    for c, camera in enumerate(CAMERAS):
        rng = np.random.default_rng(c)
        coarse = rng.integers(100, 200, (6, 8, 3)).astype(np.uint8)
        empty = cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
        frames = [empty] * (starts[c] - 1)
        for mask in seen[:, c].numpy():
            frame = empty.copy()
            frame[mask] = COLOUR
            frames.append(frame)
        write_avi(folder / f"Walking_1_({camera}).avi", frames)
        for k in range(n_backgrounds):  # the light was another one on another day
            lit = np.clip(empty.astype(int) + 12 * k, 0, 255).astype(np.uint8)
            write_avi(background / f"Background_{k + 1}_({camera}).avi", [lit] * 4)


def write_avi(path, frames):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 60.0, (WIDTH, HEIGHT))
    for frame in frames:
        writer.write(frame[..., ::-1])
    writer.release()
