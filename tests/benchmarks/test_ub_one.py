"""UB-one on a tiny recording."""

from dataclasses import replace

import pytest
import torch

from benchmarks import _upper_body, ub_one
from benchmarks._upper_body import TRACKING, Tracker, plain_prior, trials_of
from benchmarks.engine import Grid
from tests.data import data_dir_or_skip
from tests.evaluation.recordings import small_recipe, write_one
from torchpose.errors import InputError, OverlapError


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_one(tmp_path_factory.mktemp("data") / "burke_kinect")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchpose.errors.DegenerateFilterWarning")
def test_all_trackers(data, tmp_path):
    report = ub_one.run(
        data.parent, tmp_path, progress=False, particles=40, n_seeds=2, n_components=3,
        recipe=small_recipe,
    )  # fmt: skip
    for key in ("errors_2d", "errors_3d", "behaviour", "pcp", "time"):
        assert set(report[key].rows) >= set(ub_one.TRACKERS)
    ran_with = {name: report["summary"][name, "process noise"] for name in ub_one.TRACKERS}
    assert ran_with["MKF fixed tracks"] == ran_with["PF mixture, Q of the MKF"] == "the released Q"
    assert ran_with["PF mixture"] == "4 x the released Q"
    assert ran_with["PF walk, scaled"] == "0.3 x human steps, burn-in of 15 frames"
    assert all(row[0] > 0 for row in report["time"].rows.values())
    assert report["errors_2d"]["MKF sampled", "spread"] > 0  # two seeds
    assert len(report.findings) >= 8
    assert all(": yes (" in line or ": no (" in line for line in report.findings)
    assert all((tmp_path / name).stat().st_size > 1000 for name in report.pictures)
    runs = len(ub_one.TRACKERS) + sum(m in ub_one.SAMPLED for m in ub_one.TRACKERS.values())
    assert len(list(tmp_path.glob("run-*.npz"))) == runs


@pytest.mark.filterwarnings("ignore::torchpose.errors.DegenerateFilterWarning")
def test_estimates_are_kept(data, tmp_path, monkeypatch):
    first, rest = ub_one.split_recording(data)
    prior = plain_prior(small_recipe([first], 2))
    short = replace(rest, joints=rest.joints[:5])
    tracker = Tracker(prior, {"method": "pf-mixture", "n_particles": 30})
    grid = Grid({"": trials_of([short])}, {"a": tracker})
    (fresh,) = TRACKING.run({"": grid}, (0,), tmp_path).runs
    monkeypatch.setattr(_upper_body, "track", lambda *_, **__: pytest.fail("tracked again"))
    (kept,) = TRACKING.run({"": grid}, (0,), tmp_path).runs
    for ours, other in zip(fresh, kept, strict=True):
        torch.testing.assert_close(ours, other, rtol=0, atol=0, equal_nan=True)
    with pytest.raises(pytest.fail.Exception):
        TRACKING.run({"": grid}, (1,), tmp_path)


def test_the_split_keeps_frames_and_persons_apart(data):
    first, rest = ub_one.split_recording(data)
    assert (len(first), len(rest)) == (36, 24)
    prior = small_recipe([first], 2)
    prior.check_unseen({rest.person_id})
    with pytest.raises(OverlapError):
        prior.check_unseen({first.person_id})


def test_too_many_recordings(data, tmp_path):
    folder = write_one(tmp_path / "burke_kinect")
    (folder / "again.npz").write_bytes((data / "kinect_joints.npz").read_bytes())
    with pytest.raises(InputError, match="one recording"):
        ub_one.split_recording(folder)


def test_raised_arms():
    pose = torch.zeros(2, 8, 3, dtype=torch.float64)
    pose[0, 0, 1] = -0.2  # y points down: the left hand is up
    pose[:, 7, 1] = 0.3
    assert ub_one.raised_arms(pose).tolist() == [[True, False], [False, False]]


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchpose.errors.DegenerateFilterWarning")
def test_real_recording(tmp_path):
    folder = data_dir_or_skip("burke_kinect")
    report = ub_one.run(folder, tmp_path, progress=False, quick=True, recipe=small_recipe)
    assert report["errors_2d"]["MKF fixed tracks", "mean"] < 30
