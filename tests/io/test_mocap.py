"""Clips of whole bodies: the axes of the file, one rate, persons by their numbers."""

import numpy as np
import pytest
import torch

from benchmarks.bodies.clips import select_persons
from tests.data import data_dir_or_skip
from torchpose.body import BODY_15
from torchpose.errors import InputError
from torchpose.io._mocap import read_mocap, resample_frames
from torchpose.skeleton import SKELETONS
from torchpose.skeleton._joint_sets import canonical_names

# metres from the floor: height, and how far to the side; someone who stands, arms hanging
_HEIGHTS = {
    "head": 1.65, "neck": 1.45, "upper_neck": 1.5, "lower_neck": 1.43, "thorax": 1.35,
    "upper_back": 1.25, "lower_back": 1.1, "hip_center": 0.95, "nose": 1.62, "shoulder": 1.4,
    "elbow": 1.12, "wrist": 0.87, "wrist_end": 0.85, "hand": 0.8, "fingers": 0.75, "thumb": 0.78,
    "hip": 0.93, "knee": 0.5, "ankle": 0.1, "foot": 0.05, "toe": 0.02, "big_toe": 0.02,
    "small_toe": 0.02, "heel": 0.03,
}  # fmt: skip
_SIDES = {"shoulder": 0.19, "elbow": 0.2, "wrist": 0.2}


def standing(names, n_frames, velocity=(0.0, 0.0, 1.0)):
    """[T, J, 3], y up, facing +z, left at larger x; moves by `velocity` metres a second at 60 Hz."""
    points = []
    for name in canonical_names(names):
        part, _, side = name.rpartition("_")
        if side in ("left", "right"):
            x = _SIDES.get(part, 0.1) * (1 if side == "left" else -1)
            points.append((x, _HEIGHTS[part], 0.15 if part in ("toe", "big_toe") else 0.0))
        else:
            points.append((0.0, _HEIGHTS[name], 0.0))
    t = np.arange(n_frames)[:, None, None] / 60
    return np.array(points) + t * np.array(velocity)


def write(folder, name, joints, names, fps=60.0, **facts):
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(
        folder / f"{name}.npz", joints=joints.astype(np.float32), names=np.array(names), fps=fps,
        **{"subject": "s07", "action": "walk", "source": "example/x", **facts},
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["humaneva-15", "mhad-16", "cmu-31", "cmu-23", "pose2sim-21"])
def test_joint_sets_become_fifteen_joints_where_they_were(tmp_path, kind):
    skeleton = SKELETONS[kind]
    joints = standing(skeleton.joints, 12)
    if skeleton.axes == "z-up":  # x stays, forward becomes -y
        joints = np.stack([joints[..., 0], -joints[..., 2], joints[..., 1]], -1)
    joints += (3.0, 0.0, 0.0)
    write(tmp_path, "a", joints, skeleton.joints)
    (clip,) = read_mocap(tmp_path)
    assert (clip.person, clip.action, clip.trial, clip.fps, len(clip)) == (
        "s07", "walk", "a", 60.0, 12,
    )  # fmt: skip
    np.testing.assert_allclose(clip.recorded.numpy(), joints, atol=1e-6)
    up = (0.0, 0.0, 1.0) if skeleton.axes == "z-up" else (0.0, 1.0, 0.0)
    np.testing.assert_allclose(clip.up.numpy(), up, atol=1e-12)
    heights = dict(zip(BODY_15.names, (clip.joints @ clip.up)[0].tolist(), strict=True))
    assert heights["left_knee"] == pytest.approx(0.5, abs=1e-6)
    assert heights["right_wrist"] == pytest.approx(0.87, abs=1e-6)
    assert heights["pelvis"] == pytest.approx(0.94, abs=0.011)
    assert np.isnan(heights["head"]) == (kind == "mhad-16")
    apart = clip.joints[:, BODY_15.joint("left_hip")] - clip.joints[:, BODY_15.joint("right_hip")]
    np.testing.assert_allclose(apart[0].numpy(), (0.2, 0.0, 0.0), atol=1e-6)


def test_rates_become_one(tmp_path):
    names = SKELETONS["humaneva-15"].joints
    slow = standing(names, 31)[::2]
    write(tmp_path, "fast", np.repeat(standing(names, 20), 2, 0)[1:], names, 120.0, axes="y-up")
    write(tmp_path, "slow", slow, names, 30.0, axes="y-up")
    fast, slower = read_mocap(tmp_path)
    assert len(fast) == 20 and len(slower) == 31
    np.testing.assert_allclose(slower.recorded.numpy(), standing(names, 31), atol=1e-5)
    (kept,) = read_mocap(tmp_path / "slow.npz", fps=None)
    assert len(kept) == 16 and kept.fps == 30


@pytest.mark.parametrize("rates", [(50.0, 60.0), (100.0, 60.0), (120.0, 60.0), (30.0, 60.0)])
def test_resampled_curves_stay_on_the_curve(rates):
    fps, target = rates

    def curve(t):
        return torch.stack([torch.sin(4 * t), t**2, 1 - t], -1)

    t = torch.arange(200, dtype=torch.float64) / fps
    found = resample_frames(curve(t), fps, target)
    expected = curve(torch.arange(len(found), dtype=torch.float64) / target)
    assert len(found) == int(199 * target / fps + 1e-6) + 1
    torch.testing.assert_close(found[1:-1], expected[1:-1], atol=2e-4, rtol=0)


def test_gaps_stay_gaps():
    values = torch.arange(10.0, dtype=torch.float64)
    values[4] = torch.nan
    found = resample_frames(values, 30.0, 60.0)
    assert bool(found[8].isnan()) and bool(found[:4].isfinite().all())
    assert bool(found[13:].isfinite().all())


def test_persons_by_number_and_by_name(tmp_path):
    names = SKELETONS["cmu-31"].joints
    for person in ("s07", "s35", "unknown (one skeleton)"):
        write(tmp_path, f"{person[:4]}", standing(names, 12), names, subject=person)
    clips = read_mocap(tmp_path)
    assert list(select_persons(clips, ["35", "s7"])) == ["s35", "s07"]
    assert list(select_persons(clips, ["unknown"])) == ["unknown"]
    assert set(select_persons(clips, [])) == {"s07", "s35", "unknown"}
    with pytest.raises(InputError, match="person 8; there are those of s07"):
        select_persons(clips, ["8"])


def test_refusals(tmp_path):
    names = SKELETONS["cmu-31"].joints
    write(tmp_path, "a", standing(names, 12), names)
    with pytest.raises(InputError, match="recordings of run; there are walk"):
        read_mocap(tmp_path, actions=["run"])
    with np.load(tmp_path / "a.npz") as archive:
        content = {k: archive[k] for k in archive.files if k != "fps"}
    np.savez(tmp_path / "a.npz", **content)
    with pytest.raises(InputError, match="states no frame rate"):
        read_mocap(tmp_path)
    with pytest.raises(InputError, match="positive"):
        resample_frames(torch.zeros(3), 0.0, 60.0)


@pytest.mark.data
def test_real_walks():
    folder = data_dir_or_skip("mocap_cmu_walk")
    (clip,) = read_mocap(folder / "s07_07_01_walk.npz")
    assert (clip.person, len(clip), clip.fps) == ("s07", 158, 60.0)
    knee, ankle = (clip.joints[:, BODY_15.joint(f"left_{j}")] for j in ("knee", "ankle"))
    length = (knee - ankle).norm(dim=-1)
    assert float(length.std()) < 1e-4 and 0.35 < float(length.mean()) < 0.5
    heads = (clip.joints[:, BODY_15.joint("head")] @ clip.up).mean()
    assert 1.3 < float(heads) < 1.8
