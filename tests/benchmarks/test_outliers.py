"""The benchmark of outliers spoils what it says, and runs on a few recordings."""

import pytest
import torch

from benchmarks import outliers
from tests.data import data_dir_or_skip
from torchpose.demo import performer
from torchpose.evaluation._trials import CAMERA, make_test_set


@pytest.fixture(scope="module")
def trials():
    poses = [performer(n, seed=n).joints.double() for n in (150, 120)]
    return make_test_set([p - p[:, 4:5] for p in poses], CAMERA, 30.0)


def test_keypoints_are_spoiled_as_often_as_is_said(trials):
    wilds = [outliers.spoiled(trials, seed) for seed in range(20)]
    n_frames = 20 * int(trials.lengths.sum())
    share = sum(int(w.outliers.sum()) for w in wilds) / (4 * n_frames)
    exchanged = sum(int(w.exchanged.sum()) for w in wilds) / n_frames
    assert share == pytest.approx(0.05, abs=0.01) and exchanged == pytest.approx(0.02, abs=0.008)
    wild = wilds[0]
    as_it_was = (wild.test.keypoints == trials.keypoints).all(-1)
    hands = torch.tensor([name.startswith("hand") for name in trials.names])
    touched = wild.outliers | (wild.exchanged[..., None] & hands)
    assert torch.equal(as_it_was, ~touched & trials.inside[..., None])


def test_single_outliers_are_far_apart_in_time(trials):
    wild, at = outliers.one_outlier(trials, "neck", 300.0, 0)
    apart = (wild.keypoints - trials.keypoints).norm(dim=-1)
    neck = trials.names.index("neck")
    torch.testing.assert_close(apart[..., neck][at], torch.full((int(at.sum()),), 300.0).double())
    assert not bool(apart.nan_to_num()[..., [i for i in range(4) if i != neck]].any())
    assert at[0].nonzero().flatten().diff().min() >= 20


def test_a_median_takes_a_single_outlier_out_and_keeps_what_is_missing():
    keypoints = torch.arange(9.0, dtype=torch.float64)[None, :, None, None].repeat(1, 1, 1, 2)
    keypoints[0, 4] = 1000.0
    keypoints[0, 7] = torch.nan
    found = outliers.median_of_frames(keypoints)
    assert found[0, 4, 0, 0] == 5.0 and found[0, 7].isnan().all()
    assert found[0, 2, 0, 0] == 2.0


@pytest.mark.slow
def test_it_runs_on_a_few_recordings(run_here, few_people, tmp_path, monkeypatch):
    data_dir_or_skip("kinect_utd_mhad")
    monkeypatch.setattr(outliers, "SIZES", (1e4,))
    monkeypatch.setattr(outliers, "JOINTS", ("neck",))
    options = ("--quick", "--every", "4", "--data", str(few_people), "--out", str(tmp_path))
    printed = run_here("outliers", *options)
    rows = {
        line.split("|")[1].strip(): line for line in printed.splitlines() if line.startswith("|")
    }
    wild, found = (
        float(rows[f"mkf-fixed, {name}"].split("|")[3])
        for name in ("as they are", "outliers left out")
    )
    assert wild > 1.5 * found
    assert float(rows["mkf-fixed, neck, 10,000 px"].split("|")[2]) < 5
