"""`torchpose info`: every kind of file, and what is none."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.cli.conftest import keypoints
from tests.io.skeleton_files import ntu_text, person, to_kinect
from torchpose.body import BODY_15, Body
from torchpose.camera import PinholeCamera
from torchpose.io import write_keypoints
from torchpose.learning import fit_action_space, fit_gplvm, fit_limb_conditionals
from torchpose.priors import ActionBank, ManifoldInfo
from torchpose.priors._actions.action_file import ActionInfo
from torchpose.priors._limb_conditionals import in_body_frame
from torchpose.skeleton._joint_sets import SKELETONS
from torchpose.skeleton._mediapipe_landmarks import LANDMARKS
from torchpose.whole_body import BodyTrack


def test_installation(torchpose):
    done = torchpose("info")
    assert done.code == 0
    assert [line.split()[0] for line in done.out.splitlines()][:2] == ["torchpose", "torch"]
    assert "priors" in done.out


def test_prior(torchpose, files):
    done = torchpose("info", files / "prior.safetensors")
    assert done.code == 0
    facts = dict(line.split("  ", 1) for line in done.out.splitlines())
    facts = {key: value.strip() for key, value in facts.items()}
    assert facts["prior"] == "tiny"
    assert facts["components"] == "4 left, 4 right, right arm mirrored from the left"
    assert facts["camera"] == "f = (525, 525), centre (319.5, 239.5) pixels"
    assert facts["persons"] == "2: site:set#p1, site:set#p2"


def test_poses(torchpose, files, tmp_path):
    line = ("--prior", files / "prior.safetensors", "--pictures", "false", "--out", tmp_path)
    assert torchpose("track", files / "keypoints.npz", *line).code == 0
    done = torchpose("info", tmp_path / "poses.npz")
    assert done.code == 0
    assert "24 (0.8 s at 30 fps)" in done.out
    row = next(line for line in done.out.splitlines() if line.startswith("hand_right"))
    with np.load(tmp_path / "poses.npz") as poses:
        variance = np.einsum("tii->t", poses["covariance3d"][:, 7]) / 3
    assert row.split() == ["hand_right", "87.5", "%", f"{100 * np.sqrt(variance).mean():.1f}"]
    assert "std per axis (cm)" in done.out


def test_keypoints(torchpose, files, tmp_path):
    done = torchpose("info", files / "keypoints.npz")
    assert done.code == 0 and "hand_right 87.5 %" in done.out and "f = (525, 525)" in done.out
    write_keypoints(tmp_path / "k.csv", keypoints(K=None, image_size=None))
    done = torchpose("info", tmp_path / "k.csv")
    assert done.code == 0 and "not stated: give --camera" in done.out


def test_recordings_and_cameras(torchpose, files, tmp_path):
    for what, frames in ((files / "recordings", "900"), (files / "recordings" / "p1.npz", "450")):
        done = torchpose("info", what)
        assert done.code == 0 and f"{frames} (" in done.out and "upper-body-8" in done.out
    PinholeCamera(600, 610, 330, 250, name="door").save(tmp_path / "cameras.toml")
    done = torchpose("info", tmp_path / "cameras.toml")
    assert done.out == "door  f = (600, 610), centre (330, 250) pixels\n"


def test_recordings_tell_their_rates_and_what_was_assumed(torchpose, files, tmp_path):
    """Two rates were unknown ones, and nothing said that millimetres were guessed."""
    for name, fps, unit in (("p1", 30.0, 1), ("p2", 15.0, 1000)):
        with np.load(files / "recordings" / f"{name}.npz") as archive:
            joints = unit * archive["joints"]
            np.savez(tmp_path / f"{name}.npz", **{**archive, "fps": fps, "joints": joints})
    (tmp_path / "p3.csv").write_text("nothing")
    done = torchpose("info", tmp_path)
    assert "900 (45.0 s at 15 to 30 fps)" in done.out
    assert "taken for millimetres" in done.out and "(1 recording)" in done.out
    assert f"not read, since the folder holds recordings as .npz: {tmp_path}/p3.csv" in done.out


def test_a_table_as_wide_as_those_of_a_kinect(torchpose, tmp_path):
    """MediaPipe's 33 landmarks with visibilities have as many columns as 25 joints with states."""
    head = ["frame", *(f"{name}_{kind}" for name in LANDMARKS for kind in ("x", "y", "visibility"))]
    row = ["0", *map(str, range(200, 200 + 3 * len(LANDMARKS)))]
    row[3::3] = ["0.9"] * len(LANDMARKS)
    (tmp_path / "pose.csv").write_text("\n".join([",".join(head), ",".join(row)]))
    assert "elbow_left 100 %" in torchpose("info", tmp_path / "pose.csv").out


def test_recordings_of_every_layout(torchpose, tmp_path):
    names = SKELETONS["kinect-v2-25"].joints
    joints = to_kinect(person(names))
    table = ["frame," + ",".join(f"{name}_{axis}" for name in names for axis in "xyz")]
    table += [f"{t},{','.join(map(str, row.ravel()))}" for t, row in enumerate(joints)]
    (tmp_path / "table.csv").write_text("\n".join(table))
    (tmp_path / "a.skeleton").write_text(ntu_text({"7": dict(enumerate(joints))}, len(joints)))
    for what in ("table.csv", "a.skeleton"):
        done = torchpose("info", tmp_path / what)
        assert done.code == 0 and "6 (" in done.out and "kinect-v2-25" in done.out


def test_what_body_trackers_learn(torchpose, tmp_path):
    g = torch.Generator().manual_seed(0)
    body = Body.of_height(BODY_15, 1.75)
    states = 0.1 * torch.randn(60, body.dim, generator=g, dtype=torch.float64)
    about = {"name": "walk", "persons": ("set#p1", "set#p2"), "licence": "free"}
    own, moved = in_body_frame([(body, [states])])
    limbs = fit_limb_conditionals(own, moved, 60.0, **about).at_rate(30.0)
    held_out = {"frames": 7, "deviation": 1.25, "speed": 2.0}
    limbs.info = replace(limbs.info, extra={"held_out": held_out})
    limbs.save(tmp_path / "limbs.safetensors")
    wave = torch.linspace(0, 6, 40, dtype=torch.float64)[:, None].sin()
    turns = 30 * torch.rand(5, 1, 36, generator=g, dtype=torch.float64)
    spaces = [
        fit_action_space([wave * k * turn for turn in turns], 3, name=name, fps=30.0,
                        info=ActionInfo(persons=("set#p1",), extra={"accepted": 0.5}))
        for name, k in (("bend", 1.0), ("wave", -0.5))
    ]  # fmt: skip
    spaces[0].save(tmp_path / "bend.safetensors")
    ActionBank(spaces, gate_dimensions=2).save(tmp_path / "bank.safetensors")
    manifold = fit_gplvm(body.relative(states), steps=1, info=ManifoldInfo.of_body(body, **about))
    manifold.save(tmp_path / "manifold.safetensors")
    expected = {
        "limbs": ("walk", "30, learnt at 60", "left_shank on left_thigh:", "2: set#p1, set#p2",
                  "7 frames, whose limbs deviate 1.25 times", "--method root"),
        "bend": ("bend", "3, ", "5", "lets 50 % of held-out postures through", "1: set#p1"),
        "bank": ("2 actions", "bend: 3 dimensions", "wave: 3 dimensions", "first 2 dimensions", "30"),
        "manifold": ("walk", "2 dimensions", "60 frames of 30 columns", "not fitted yet", "free"),
    }  # fmt: skip
    for name, parts in expected.items():
        done = torchpose("info", tmp_path / f"{name}.safetensors")
        assert done.code == 0, done.err
        for part in parts:
            assert part in done.out, (name, part)


def test_poses_of_a_whole_body(torchpose, tmp_path):
    body = Body.of_height(BODY_15, 1.7, "body")
    states = torch.zeros(4, body.dim, dtype=torch.float64)
    nothing = torch.zeros(4)
    BodyTrack(
        body, states, states, body.joints(states), 0.01 * torch.eye(3).expand(4, 15, 3, 3),
        nothing, nothing, nothing > 0, nothing > 0, 25.0, ("a note",), 3,
        {"actions": torch.eye(2)[[0, 0, 0, 1]]}, ("bend", "none"),
    ).save(tmp_path / "body.npz")  # fmt: skip
    done = torchpose("info", tmp_path / "body.npz")
    assert done.code == 0, done.err
    for part in ("4 (0.2 s at 25 fps) from frame 3", "1.70 m, rotations against the root",
                 "bend 3-5, none 6-6", "std per axis (cm)", "left_wrist 10.0", "a note"):  # fmt: skip
        assert part in done.out, part


def test_config(torchpose, files, tmp_path):
    (tmp_path / "info.yaml").write_text(f"what: {files / 'prior.safetensors'}\n")
    assert torchpose("info", "--config", tmp_path / "info.yaml").out.startswith("prior")


@pytest.mark.parametrize(
    "name, message",
    [
        ("nothing", "expected the name of a prior"),
        ("nothing.safetensors", "of whole bodies (exercises, walk, whole-body), or a file, got"),
        ("other.npz", "got the keys a"),
        ("cut.npz", "truncated"),
        ("text.csv", "text.csv"),
        ("notes.txt", "expected keypoints as"),
        ("empty", "found none"),
        ("cut.safetensors", "truncated or of another kind"),
    ],
)
def test_refusals(name, message, torchpose, files, tmp_path):
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    (tmp_path / "cut.npz").write_bytes((files / "keypoints.npz").read_bytes()[:200])
    (tmp_path / "cut.safetensors").write_bytes((files / "prior.safetensors").read_bytes()[:2000])
    (tmp_path / "text.csv").write_text("a,b\n1,2\n")
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "empty").mkdir()
    done = torchpose("info", tmp_path / name)
    assert done.code == 2 and message in done.err and len(done.err.splitlines()) == 1


def test_several_people_and_notes_on_keypoints_are_shown(torchpose, tmp_path):
    people = [
        {"pose_keypoints_2d": [value for i in range(25) for value in (x, 100.0 + 9 * i, score)]}
        for x, score in ((50.0, 6.3), (400.0, 3.0))
    ]
    for t in range(2):
        (tmp_path / f"cam_{t}_keypoints.json").write_text(json.dumps({"people": people}))
    shown = torchpose("info", tmp_path).out
    assert "several people, up to 2, from frame 0 on" in shown
    assert "confidences of up to 6.3 are no probabilities" in shown
