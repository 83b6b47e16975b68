"""Files of poses whose fields do not agree with one another are refused, by `load` and by `info`."""

import math

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from tests.fuzz.samples import body_poses, pose_track
from torchpose.cli import main
from torchpose.errors import TorchposeError
from torchpose.upper_body import PoseTrack
from torchpose.whole_body import BodyTrack


def put(key, at, value):
    """A change of one element."""

    def change(arrays):
        arrays[key][at] = value

    return change


def set_to(key, value):
    return lambda arrays: arrays.__setitem__(key, np.asarray(value))


def cut(key, where):
    return lambda arrays: arrays.__setitem__(key, arrays[key][where])


TRACKS = {
    "a key less": lambda a: a.pop("covariance2d"),
    "frames less": cut("covariance3d", slice(0, 3)),
    "joints less": cut("joints2d", (slice(None), slice(0, 7))),
    "a dimension less": cut("joints3d", (..., slice(0, 2))),
    "no frame": cut("joints3d", slice(0, 0)),
    "numbers for masks": set_to("observed", np.ones((6, 8))),
    "half precision": lambda a: a.__setitem__("joints3d", a["joints3d"].astype(np.float16)),
    "complex": lambda a: a.__setitem__("joints3d", a["joints3d"].astype(complex)),
    "text": set_to("lengths", "6"),
    "too long": set_to("lengths", 7),
    "nothing long": set_to("lengths", 0),
    "a failure behind the end": set_to("failed_at", 6),
    "a failure that is none": set_to("failed_at", 3),
    "several rates": set_to("fps", [30.0, 30.0]),
    "an infinite rate": set_to("fps", math.inf),
    "a rate of nobody": set_to("fps", 1e6),
    "a frame before the first": set_to("first_frame", -1),
    "half a frame": set_to("first_frame", 1.5),
    "other axes": set_to("frame", "sideways"),
    "axes in numbers": set_to("frame", 3),
    "other joints": set_to("names", [f"j{i}" for i in range(8)]),
    "notes in numbers": set_to("notes", [1.0, 2.0]),
    "no camera": set_to("K", np.zeros((3, 3))),
    "an infinite pixel": put("joints2d", (2, 3, 0), math.inf),
    "half a joint": put("joints3d", (2, 3, 0), math.nan),
    "a joint without covariance": put("covariance3d", (2, 3, 0, 0), math.nan),
    "no symmetry": put("covariance3d", (2, 3, 0, 1), 9.0),
    "a variance below zero": put("covariance2d", (2, 3, 0, 0), -1.0),
    "infinite evidence": put("log_evidence_arms", (2, 0), math.inf),
}

BODIES = {
    "a key less": lambda a: a.pop("state_std"),
    "states of another body": cut("state", (..., slice(0, 30))),
    "frames less": cut("respread", slice(0, 3)),
    "details of other frames": cut("detail_actions", slice(0, 3)),
    "names of other actions": cut("action_names", slice(0, 2)),
    "states that are lost": put("state", (1, 2), math.nan),
    "a deviation below zero": put("state_std", (1, 2), -1.0),
    "joints elsewhere": put("joints3d", (1, 2, 0), 4.0),
    "an infinite covariance": put("covariance3d", (1, 2, 0, 0), math.inf),
    "infinite particles": put("effective_sample_size", (1,), math.inf),
    "masks in numbers": set_to("coasting", np.zeros(6)),
    "a giant": lambda a: a.__setitem__("body_bone_lengths", 10 * a["body_bone_lengths"]),
    "bones of no length": lambda a: a.__setitem__("body_bone_lengths", 0 * a["body_bone_lengths"]),
    "radii of metres": lambda a: a.__setitem__("body_radii", 1e3 * a["body_radii"]),
    "another skeleton": set_to("body_skeleton", "horse-40"),
    "other joints": set_to("names", ["x"] * 15),
    "a rate of nobody": set_to("fps", -1.0),
}


def changed_is_refused(cls, path, change, capsys):
    with np.load(path) as file:
        arrays = dict(file)
    change(arrays)
    np.savez(path, **arrays)
    with pytest.raises(TorchposeError, match=path.name) as caught:
        cls.load(path)
    assert str(caught.value).isprintable()
    assert main(["info", str(path)]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1 and path.name in said.err


@pytest.mark.parametrize("what", TRACKS)
def test_poses_that_do_not_agree(tmp_path, capsys, what):
    pose_track().save(tmp_path / "poses.npz")
    changed_is_refused(PoseTrack, tmp_path / "poses.npz", TRACKS[what], capsys)


@pytest.mark.parametrize("what", BODIES)
def test_bodies_that_do_not_agree(tmp_path, capsys, what):
    body_poses().save(tmp_path / "body.npz")
    changed_is_refused(BodyTrack, tmp_path / "body.npz", BODIES[what], capsys)


@pytest.mark.parametrize("batch", [1, 2])
def test_poses_come_back_as_they_were(tmp_path, batch):
    track = pose_track(batch)
    track.joints3d[:, 2, 3] = math.nan  # lost joints are no fault, with or without a covariance
    track.covariance3d[:, 2, 3] = math.nan
    track.save(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as file:  # in the other order of bytes
        arrays = {k: v.astype(v.dtype.newbyteorder(">")) for k, v in file.items()}
    np.savez(tmp_path / "b.npz", **arrays)
    for name in ("a.npz", "b.npz"):
        back = PoseTrack.load(tmp_path / name)
        for field in ("joints2d", "joints3d", "covariance2d", "covariance3d", "observed", "matrix",
                      "log_evidence", "lengths", "failed_at"):  # fmt: skip
            expected, found = getattr(track, field), getattr(back, field)
            assert torch.equal(expected.nan_to_num(7.0), found.nan_to_num(7.0)), field
        assert (back.fps, back.notes, back.first_frame) == (track.fps, track.notes, 0)


def test_what_a_file_says_cannot_act_on_a_terminal(tmp_path, capsys):
    track = pose_track()
    track.notes = ("\x1b[2J\x1b]0;title\x07 cleared", "y" * 100_000)
    track.save(tmp_path / "poses.npz")
    assert main(["info", str(tmp_path / "poses.npz")]) == 0
    out = capsys.readouterr().out
    assert "\\x1b[2J" in out and len(out) < 5000
    assert all(line.isprintable() for line in out.split("\n"))


@pytest.mark.parametrize("make", [pose_track, body_poses])
def test_a_loader_keeps_poses_in_a_list(make):
    track = make()
    loader = DataLoader([track, track], batch_size=2, num_workers=1, collate_fn=list)
    (batch,) = loader
    assert [type(each) for each in batch] == 2 * [type(track)]
    assert all(torch.equal(each.joints3d, track.joints3d) for each in batch)
