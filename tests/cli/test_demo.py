"""`torchpose demo`: files, scores, exit code."""

import contextlib
import io
from functools import partial

import numpy as np
import pytest
import torch

from torchpose.camera import lift
from torchpose.cli import _demo_keypoints as demo_keypoints
from torchpose.cli import _demo_walk as demo_walk
from torchpose.cli import main
from torchpose.io import read_keypoints
from torchpose.math import euler_to_matrix
from torchpose.priors import load_prior
from torchpose.skeleton import LEFT_ARM, RIGHT_ARM, UPPER_BODY
from torchpose.upper_body import PoseTrack
from torchpose.whole_body import find_first_pose


@pytest.fixture
def shipped(files, tmp_path, monkeypatch):
    """The small prior under the name of the shipped one."""
    weights = tmp_path / "weights"
    weights.mkdir()
    prior = (files / "prior.safetensors").read_bytes()
    (weights / "kinect-upper-body.safetensors").write_bytes(prior)
    monkeypatch.setattr("torchpose.priors._upper_body_prior.WEIGHTS", weights)


def test_demo_beats_the_mean_pose(torchpose, shipped, tmp_path):
    pytest.importorskip("matplotlib")
    out = tmp_path / "out"
    done = torchpose("demo", "--out", out, "--seconds", 2, "--input", "keypoints")
    assert done.code == 0, done.err
    assert "smoke test on an animated performer" in done.out
    pictures = [line.strip() for line in done.out.splitlines()[-4:]]
    names = ["pose_strip.png", "joint_curves.png", "pose_3d.png", "errors.png"]
    assert pictures == [str(out / name) for name in names]
    assert done.out.splitlines()[-5] == "Pictures:"
    assert all((out / name).read_bytes().startswith(b"\x89PNG") for name in names)
    everything = {*names, "keypoints.npz", "poses.npz", "poses.csv", "poses.bvh"}
    everything |= {".torchpose-track.json"}
    assert {p.name for p in out.iterdir()} == everything

    clip, poses = read_keypoints(out / "keypoints.npz"), PoseTrack.load(out / "poses.npz")
    gap = ~clip.measured[:, clip.names.index("hand_right")]
    assert int(gap.sum()) == 18 and len(clip) == 60
    assert torch.equal(gap, ~poses.observed[0, :, UPPER_BODY.index("hand_right")])
    table = {row[:42].strip(): row[42:].split() for row in done.out.splitlines() if row[:1].strip()}
    filtered, smoothed, mean = (float(cell) for cell in table["all joints"])
    assert max(filtered, smoothed) < mean
    assert table["2D error, all joints (pixels)"][2] == "-"
    assert "right hand while hidden (18 frames)" in table

    again = ("--out", tmp_path / "again", "--pictures", "false")
    tracked = torchpose("track", out / "keypoints.npz", *again)
    assert tracked.code == 0, tracked.err
    again = PoseTrack.load(tmp_path / "again" / "poses.npz")
    torch.testing.assert_close(again.joints3d, poses.joints3d, rtol=0, atol=1e-9)


def test_failure_has_an_exit_code(torchpose, shipped, tmp_path, monkeypatch):
    perfect = demo_keypoints.Scores(torch.zeros(60, 8))
    monkeypatch.setattr(demo_keypoints, "score_mean_pose", lambda *_: perfect)
    options = ("--seconds", 2, "--pictures", "false", "--input", "keypoints")
    done = torchpose("demo", "--out", tmp_path / "out", *options)
    assert done.code == 1
    assert "no better than the mean pose" in done.err
    assert (tmp_path / "out" / "poses.npz").exists()


def test_mean_pose_is_that_of_samples(files):
    """The oracle draws states, lifts each by (BL 5) and averages."""
    prior = load_prior(files / "prior.safetensors")
    g = torch.Generator().manual_seed(0)
    mean = prior.mean_pose()
    for mixture, arm in ((prior.left, LEFT_ARM), (prior.right, RIGHT_ARM)):
        x = mixture.sample((20_000,), generator=g)
        R = euler_to_matrix(x[:, 15:18], prior.info.rotation_order)
        joints = lift(x[:, :15].reshape(-1, 5, 3), prior.info.matrix, R, x[:, 18:])
        rows = list(arm[:3])  # head and neck are averaged over the arms
        error = (mean[rows] - joints.mean(0)[:3]).abs()
        assert float((error / (joints.std(0)[:3] / 20_000**0.5)).max()) < 6


def test_scores_of_the_truth_itself(files):
    performance, clip, _ = demo_keypoints.perform(2.0, seed=1)
    track = demo_keypoints.track_clip(load_prior(files / "prior.safetensors"), clip, None)
    track.joints3d = performance.joints[None]
    scores = demo_keypoints.score(track, performance.joints)
    assert float(scores.errors3d.abs().max()) < 1e-9
    assert scores.inside == (1.0, 1.0)


@pytest.mark.parametrize("seconds", [1.0, 2.5, 20.0])
def test_gap_lies_inside(seconds):
    performance, clip, gap = demo_keypoints.perform(seconds, seed=0)
    missing = ~clip.measured[:, clip.names.index("hand_right")]
    assert torch.nonzero(missing).flatten().tolist() == list(range(gap.start, gap.stop))
    assert 0 < gap.start < gap.stop < len(clip) == len(performance.joints)


def test_refusals(torchpose, shipped, tmp_path):
    for options, message in (
        (("--seconds", 0), "from 1 to 3600"),
        (("--input", "radio"), "video, keypoints"),
        (("--prior", "nobody"), "kinect-upper-body"),
        (("--input", "walk", "--prior", "nobody"), "--prior is for the performer"),
        (("--out", tmp_path / "weights" / "kinect-upper-body.safetensors"), "cannot be written"),
    ):
        done = torchpose("demo", "--out", tmp_path / "out", *options)
        assert done.code == 2 and message in done.err and len(done.err.splitlines()) == 1
        assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """The folder of a walk that was rendered and tracked, and what was printed."""
    out, printed = tmp_path_factory.mktemp("walk") / "walk", io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setattr(demo_walk, "_PARTICLES", 50)
        search = partial(find_first_pose, n_particles=300, n_tracking=50)  # a sixth of the usual
        patch.setattr("torchpose.whole_body._particle_follower.find_first_pose", search)
        patch.delenv("TORCHPOSE_DATA", raising=False)
        options = ["--input", "walk", "--seconds", "1", "--pictures", "false"]
        assert main(["demo", *options, "--out", str(out)]) == 0
    return out, printed.getvalue()


@pytest.mark.slow
def test_a_walk_in_three_cameras_needs_no_data(walked):
    out, printed = walked
    assert "neither recorded nor drawn from the manifold" in " ".join(printed.split())
    cells = next(row.split() for row in printed.splitlines() if row.startswith("all joints"))
    tracked, still = float(cells[2]), float(cells[3])
    with np.load(out / "body.npz") as found, np.load(out / "truth.npz") as truth:
        apart = np.linalg.norm(found["joints3d"] - truth["joints"], axis=-1)
        moved = np.linalg.norm(truth["joints"] - truth["joints"][:1], axis=-1)
    assert tracked == pytest.approx(1000 * apart.mean(), abs=0.6) and tracked < 200
    assert still == pytest.approx(1000 * moved.mean(), abs=0.6) and still > 300
    names = {path.name for path in out.iterdir()}
    assert {"cameras.toml", "cam_03.mp4", "cam_03-empty.png", "truth.npz", "report.html"} <= names


def test_standing_still_that_is_no_worse_fails_the_demo(torchpose, walked, monkeypatch):
    """Of the walk that is tracked already."""
    out, _ = walked
    monkeypatch.setattr(demo_walk, "_render", lambda *_: ([], []))
    monkeypatch.setattr("torchpose.cli._track_body.main", lambda _: 0)
    monkeypatch.setattr(demo_walk, "_still", lambda truth: torch.zeros(len(truth), 15))
    options = ("--input", "walk", "--seconds", 1, "--pictures", "false")
    done = torchpose("demo", *options, "--out", out)
    assert done.code == 1 and "no better than standing still" in done.err
    done = torchpose("demo", "--input", "walk", "--seconds", 9, "--out", out / "other")
    assert done.code == 2 and "from 1 to 4" in done.err
