"""Scores of a prior and a tracker on one's own recordings, against errors that are worked out by hand."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.evaluation.recordings import poses_to_score, small_recipe, write_people
from torchpose.camera import PinholeCamera
from torchpose.cli import _evaluate as evaluate
from torchpose.errors import InputError, OverlapError
from torchpose.evaluation import _score as score
from torchpose.evaluation._trials import CAMERA, MEASURED, make_test_set, track
from torchpose.io import read_recordings
from torchpose.metrics import align
from torchpose.priors import load_prior
from torchpose.skeleton import UPPER_BODY


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_people(tmp_path_factory.mktemp("score") / "people", ("a", "b", "c"), 30)


@pytest.fixture(scope="module")
def prior(folder):
    """Fitted on a alone."""
    recordings = [r for r in read_recordings(folder) if r.person == "a"]
    return small_recipe(recordings, name="of a")


@pytest.fixture(scope="module")
def scored(folder, prior, tmp_path_factory):
    out = tmp_path_factory.mktemp("result")
    files = [folder / f"{person}_a01_t0.npz" for person in "bc"]
    return score.run(files, out, prior=prior, progress=False, noise_std=2.0, seed=4), out


def test_errors_are_those_of_the_tracker_and_of_the_mean_pose(folder, prior, scored) -> None:
    report, _ = scored
    assert list(report["persons"].rows)[:2] == ["b", "c"]
    assert report.settings["method"] == "default (mkf-fixed)"
    still = []
    for recording in read_recordings([folder / f"{person}_a01_t0.npz" for person in "bc"]):
        test = make_test_set(poses_to_score([recording], prior, None), CAMERA, 30.0, 4, 2.0)
        truth = test.truth3d[0]
        points = align(track(prior, CAMERA, test).joints3d[0], truth).points
        error = 100 * float((points - truth).norm(dim=-1).mean())
        assert report["persons"][recording.person, "filtered"] == pytest.approx(error, rel=1e-5)
        moved = align(prior.mean_pose().expand_as(truth), truth).points
        still.append(100 * (moved - truth).norm(dim=-1))
    wanted = torch.cat(still).mean(0)
    for j, name in enumerate(UPPER_BODY):
        found = report["joints"][name.replace("_", " "), "mean pose"]
        assert found == pytest.approx(float(wanted[j]), rel=1e-5)


@pytest.mark.slow
def test_recordings_are_tracked_at_their_own_rates(folder, tmp_path) -> None:
    """Of one person at two rates, all frames have the errors of both recordings by themselves."""
    prior = load_prior("kinect-upper-body-small")
    slow, fast = folder / "b_a01_t0.npz", tmp_path / "fast.npz"
    arrays = dict(np.load(folder / "c_a01_t0.npz")) | {"subject": "b", "fps": 120.0}
    np.savez(fast, **arrays)
    options = {"prior": prior, "method": "window-mixture", "progress": False}
    apart = [
        float(score.run(path, tmp_path / path.stem, **options)["persons"]["b", "filtered"])
        for path in (slow, fast)
    ]
    both = score.run([slow, fast], tmp_path / "both", **options)["persons"]["b", "filtered"]
    assert both == pytest.approx(np.mean(apart), rel=1e-5)


def test_every_joint_has_its_row(scored) -> None:
    report, out = scored
    table = report["joints"]
    assert [name.replace(" ", "_") for name in table.rows] == [*UPPER_BODY, "all_joints"]
    means = [float(table[name.replace("_", " "), "smoothed"]) for name in UPPER_BODY]
    assert table["all joints", "smoothed"] == pytest.approx(np.mean(means), rel=1e-6)
    assert 0 <= table["all joints", "in 50 %"] <= table["all joints", "in 90 %"] <= 100
    kept = json.loads((out / "report.json").read_text())
    assert set(kept["tables"]) == {"joints", "persons", "pose_classes"}
    assert (out / "persons.png").is_file()


def test_all_joints_tell_more_than_head_and_hands(folder, tmp_path) -> None:
    one = folder / "b_a01_t0.npz"
    options = {"prior": load_prior("kinect-upper-body-small"), "method": "mkf-fixed"}
    few, every = (
        score.run(one, tmp_path / joints, joints=joints, progress=False, **options)["joints"]
        for joints in ("head+hands", "all")
    )
    for joint in ("elbow left", "elbow right", "all joints"):
        assert every[joint, "filtered"] < few[joint, "filtered"] < few[joint, "mean pose"]


def test_a_method_that_cannot_smooth_has_no_such_errors(folder, prior, tmp_path) -> None:
    report = score.run(
        folder / "b_a01_t0.npz", tmp_path, prior=prior, method="mkf-sampled", progress=False
    )
    assert np.isnan(float(report["joints"]["all joints", "smoothed"]))
    assert report["joints"]["all joints", "filtered"] > 0


def test_persons_of_the_prior_are_refused_unless_asked_for(folder, prior, tmp_path) -> None:
    with pytest.raises(OverlapError, match=r"people#a; .* of the same name, rename their folders"):
        score.run(folder, tmp_path / "out", prior=prior, progress=False)
    report = score.run(folder, tmp_path / "out", prior=prior, progress=False, seen=True)
    assert "fitted on" in report.findings[-1] and "people#a" in report.findings[-1]


def test_a_neck_of_another_kind_does_not_count(folder, prior, tmp_path) -> None:
    other = small_recipe([r for r in read_recordings(folder) if r.person == "a"])
    other.info = replace(other.info, neck="mid-shoulder")
    report = score.run(folder / "b_a01_t0.npz", tmp_path, prior=other, progress=False)
    assert np.isnan(float(report["joints"]["neck", "filtered"]))
    assert np.isnan(float(report["joints"]["neck", "mean pose"]))
    assert "The neck of b is of another kind" in report.findings[-1]


def test_bad_settings(folder, prior, tmp_path) -> None:
    for options, message in (
        ({"method": "magic"}, "method must be one of"),
        ({"noise_std": 0.0}, "noise_std must be positive"),
        ({"every": 0}, "every must be at least 1"),
    ):
        with pytest.raises(InputError, match=message):
            score.run(folder, tmp_path / "none", prior=prior, progress=False, **options)
    assert not (tmp_path / "none").exists()


def test_on_the_command_line(folder, prior, tmp_path, capsys) -> None:
    file = tmp_path / "prior.safetensors"
    prior.save(file)
    one, out = str(folder / "b_a01_t0.npz"), str(tmp_path / "out")
    line = ["score", one, "--prior", str(file), "--out", out, "--method", "mkf-fixed"]
    assert evaluate.main([*line, "--joints", "all"]) == 0
    printed = capsys.readouterr().out
    assert "elbow right" in printed and "mean pose" in printed
    settings = json.loads((tmp_path / "out" / "report.json").read_text())["settings"]
    assert settings["method"] == "mkf-fixed" and settings["joints"] == "all"


def test_keypoints_of_any_joints() -> None:
    camera = PinholeCamera(500.0, 500.0, 320.0, 240.0)
    poses = [torch.randn(4, 8, 3, generator=torch.Generator().manual_seed(0))]
    every = make_test_set(poses, camera, 30.0, noise_std=1e-9, names=UPPER_BODY)
    torch.testing.assert_close(every.keypoints, every.truth2d, rtol=0, atol=1e-6)
    few = make_test_set(poses, camera, 30.0, noise_std=1e-9)
    assert few.names == MEASURED and few.keypoints.shape == (1, 4, 4, 2)
