"""The protocol Silhouette on files in HumanEva-I's layout: partitions, frames in step, a whole run."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks import humaneva_files as humaneva
from benchmarks.bodies import clips as body_clips
from benchmarks.bodies.silhouettes import true_silhouettes
from benchmarks.silhouette import humaneva as silhouette_humaneva
from benchmarks.silhouette import protocol as silhouette
from benchmarks.silhouette.humaneva import HumanEvaFootage, humaneva_splits
from tests.io.humaneva_files import clip_of, walking_joints, write_avi, write_humaneva
from torchpose.demo._rendering.clothed_body import TrueShape
from torchpose.errors import InputError

SIZE = (120, 160)
N = 48
PARTITION = {("S1", "Walking"): (4, 24, N)}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder, and the rig that filmed it."""
    root = tmp_path_factory.mktemp("humaneva")
    return root, write_humaneva(root, N)


@pytest.fixture(autouse=True)
def partitions(monkeypatch):
    monkeypatch.setattr(silhouette_humaneva, "PARTITIONS", PARTITION)


@pytest.fixture
def root(made, tmp_path):
    """A copy that may be spoilt."""
    return shutil.copytree(made[0], tmp_path / "copy")


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """A folder that keeps silhouettes from one test to the next."""
    return tmp_path_factory.mktemp("out")


def splits_of(root, out, **options):
    footage = HumanEvaFootage(out)
    return footage, humaneva_splits(root, footage, ("Walking",), **options)


def test_the_recording_is_what_was_written(made):
    """The helper's points give back the joints that it was given."""
    trial = humaneva.read_humaneva(made[0], "S1", "Walking", 1)
    expected = torch.from_numpy(walking_joints(2 * N, 0, 120.0)[::2])
    apart = (trial.joints - expected).norm(dim=-1)
    assert float(apart[:, 1:14].max()) < 0.012 and float(apart.max()) < 0.15  # head: 316 mm long
    assert trial.first_frames == {"C1": 0, "C2": 2, "C3": 5}


def test_partitions(made, tmp_path):
    footage, (split,) = splits_of(made[0], tmp_path)
    (test,) = split.test
    assert (split.person, test.action, test.trial) == ("S1", "Walking", "Walking_1 from 4")
    assert len(test) == 21 and split.seen
    assert [c.trial for c in split.manifold] == ["Walking_3 from 1", "Walking_4 from 1"]
    assert [(c.trial, len(c)) for c in split.validation] == [("Walking_1 from 25", N - 24)]
    assert [c.trial for c in split.body] == ["Walking_1 from 25"]
    assert footage.sees(test) and not footage.sees(split.manifold[0])
    everything = humaneva.read_humaneva(made[0], "S1", "Walking", 1).joints
    torch.testing.assert_close(test.recorded, everything[3:24])
    torch.testing.assert_close(split.validation[0].recorded, everything[24:])


@pytest.mark.slow
def test_silhouettes_of_the_videos_are_in_step_with_the_motion(made, out):
    root, rig = made
    footage, (split,) = splits_of(root, out)
    found_rig, found = footage(split.test[0], SIZE, 3)
    torch.testing.assert_close(found_rig.matrix, rig.scaled(*SIZE).matrix)
    walk = clip_of(walking_joints(2 * N, 0, 120.0)[::2])
    clean = true_silhouettes(walk, TrueShape.draw(0), found_rig)
    overlap = torch.stack([_overlap(found, clean[3 + d : 24 + d]).mean(0) for d in range(-3, 4)])
    assert bool((overlap[3] > 0.75).all())
    assert int(overlap.sum(1).argmax()) == 3  # frame by frame
    assert bool(((overlap.argmax(0) - 3).abs() <= 1).all())  # in each of the cameras
    one_rig, one = footage(split.test[0].cut(0, 5), SIZE, 1)
    assert len(one_rig) == 1 and bool((one == found[:5, :1]).all())


def _overlap(one, other):
    both, either = (one & other).sum((-1, -2)), (one | other).sum((-1, -2))
    return both.double() / either


def test_silhouettes_are_kept(made, out, monkeypatch):
    footage, (split,) = splits_of(made[0], out)
    _, found = footage(split.test[0], SIZE, 2)
    footage, (split,) = splits_of(made[0], out)
    monkeypatch.setattr(footage, "_measure", None)  # would be called
    _, again = footage(split.test[0], SIZE, 2)
    assert bool((again == found).all())
    assert len(list(out.glob("run-*.npz"))) == 1


def test_gaps_are_left_out(made, tmp_path, monkeypatch):
    read = silhouette_humaneva.read_humaneva

    def with_gaps(*arguments):
        trial = read(*arguments)
        joints = trial.joints.clone()
        joints[[3, 10, 27]] = torch.nan
        return replace(trial, joints=joints)

    monkeypatch.setattr(silhouette_humaneva, "read_humaneva", with_gaps)
    _, (split,) = splits_of(made[0], tmp_path)
    (test,) = split.test
    assert test.trial == "Walking_1 from 5" and len(test) == 20  # frame 4 is lost
    assert body_clips.whole_frames(test).tolist() == [i != 6 for i in range(20)]
    # frames 25 to 27 are too short a piece
    assert [(c.trial, len(c)) for c in split.validation] == [("Walking_1 from 29", N - 28)]
    assert all(bool(c.joints.isfinite().all()) for c in (*split.manifold, *split.validation))


@pytest.mark.slow
def test_a_whole_run(made, out):
    options = {
        "progress": False, "actions": ("Walking",), "method": ("sir", "mrpf"), "seeds": 2,
        "frames": 6, "particles": (60,), "sharpness": 100.0,
    }  # fmt: skip
    report = silhouette.run(made[0], out, **options)
    assert list(report["errors"].rows) == ["S1 Walking_1 from 4", "all"]
    assert report["sequences"]["S1 Walking_1 from 4", "overlap"] > 0.6
    assert report["sequences"]["S1 Walking_1 from 4", "nearest state (mm)"] < 20
    assert report["errors"]["all", "SIR"] < 90
    assert report.settings["faults"] == "real" and "HumanEva" in report.settings["cameras"]
    kept = {p: p.stat().st_mtime_ns for p in out.glob("*.npz")}
    again = silhouette.run(made[0], out, **options)
    assert again["errors"].rows == report["errors"].rows
    assert {p: p.stat().st_mtime_ns for p in out.glob("*.npz")} == kept


def test_without_other_trials_half_of_what_was_filmed_makes_the_manifold(
    root, tmp_path, monkeypatch
):
    monkeypatch.setitem(PARTITION, ("S1", "Walking"), (1, 4, N))
    for path in (root / "S1" / "Mocap_Data").glob("Walking_[34].c3d"):
        path.unlink()
    for path in (root / "Background").iterdir():
        path.unlink()  # then the mixture learns from the video itself
    footage, (split,) = splits_of(root, tmp_path)
    assert [(c.trial, len(c)) for c in split.manifold] == [("Walking_1 from 5", 22)]
    assert [(c.trial, len(c)) for c in split.validation] == [("Walking_1 from 27", 22)]
    assert footage.sees(split.validation[0])
    _, found = footage(split.validation[0], (60, 80), 3)
    assert float(found.any((-1, -2)).double().mean()) > 0.5  # who hardly moves becomes background


def test_what_is_not_there_is_said(root, tmp_path):
    with pytest.raises(InputError, match="motion capture of Walking of S1"):
        humaneva_splits(root, HumanEvaFootage(tmp_path), ("Box",))
    with pytest.raises(InputError, match="needs one action"):
        humaneva_splits(root, HumanEvaFootage(tmp_path), (), ("Walking",))
    with pytest.raises(InputError, match="recordings of person S3"):
        splits_of(root, tmp_path, test_persons=("S3",))
    footage, (split,) = splits_of(root, tmp_path)
    with pytest.raises(InputError, match="4 cameras are asked for, and there are 3"):
        footage(split.test[0], SIZE, 4)
    with pytest.raises(InputError, match="there are no videos of this clip"):
        footage(split.manifold[0], SIZE, 3)
    for options, message in (
        ({"cameras": "rig.toml"}, "HumanEva has its own calibration"),
        ({"loop": 2}, "no meaning for the videos"),
    ):
        with pytest.raises(InputError, match=message):
            silhouette.run(root, tmp_path / "out", progress=False, **options)
    path = root / "S1" / "Image_Data" / "Walking_1_(C2).avi"
    write_avi(path, [np.zeros((480, 640, 3), np.uint8)] * 12)
    with pytest.raises(InputError, match="48 frames of motion capture and 10 of the"):
        splits_of(root, tmp_path)
    path.unlink()
    with pytest.raises(InputError, match="videos of all three colour cameras"):
        splits_of(root, tmp_path)
