"""Persons whom no prior saw, by measured joints: geometry that is told the truth, and a quick run."""

import pytest
import torch

from benchmarks.ub_people_joints import lifted
from tests.evaluation.recordings import write_people
from torchpose.evaluation._trials import CAMERA, centred_on_neck, make_test_set
from torchpose.io import read_recordings
from torchpose.metrics import joint_errors_3d
from torchpose.skeleton import UPPER_BODY


def test_geometry_that_is_told_everything_finds_the_truth_where_pixels_are_exact(tmp_path):
    recordings = read_recordings(write_people(tmp_path / "kinect_utd_mhad"))[:2]
    poses = [centred_on_neck(r.upper_body().joints) for r in recordings]
    test = make_test_set(poses, CAMERA, 30.0, noise_std=0.0, names=tuple(UPPER_BODY))
    told = lifted(test, depths=True, lengths="in every frame", nearer_end=True)
    torch.testing.assert_close(told.joints3d, test.truth3d, equal_nan=True, rtol=0, atol=1e-6)
    errors = [
        joint_errors_3d(lifted(test, depths, "own", ends).joints3d, test.truth3d)
        for depths, ends in ((True, True), (False, True), (False, False))
    ]
    means = [float(found.nanmean()) for found in errors]
    assert 0 < means[0] < means[1] < means[2]


@pytest.mark.slow
def test_a_quick_run_has_trackers_learned_lifters_and_geometry(run_here, few_people, tmp_path):
    printed = run_here(
        "ub_people_joints", "--quick", "--data", str(few_people), "--out", str(tmp_path)
    )
    rows = {
        line.split("|")[1].strip(): line.split("|")[2:-1]
        for line in printed.splitlines()
        if line.startswith("|")
    }
    wanted = ("windows", "windows, smoothed", "GRU, causal", "MLP, per frame", "nearest neighbour",
              "mean pose", "geometry, told depths of the torso, lengths, nearer ends")  # fmt: skip
    for name in wanted:
        assert 0 < float(rows[name][0]) < 100, name
    assert printed.count("| GRU, causal |") == 2  # all joints, and few
