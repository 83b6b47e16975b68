"""Toes are seen with faults, baselines have known values, the prior is fitted, and tables are printed."""

import pytest
import torch
from torch.testing import assert_close

from benchmarks.keypoint_bodies import clips as bodies
from benchmarks.keypoint_bodies.clips import ACTIONS, CHOOSING, CLEAN, MHAD, SCORED, WALKS
from benchmarks.keypoint_feet.clips import begun, read_toed
from benchmarks.keypoint_feet.fit import fit_shipped
from benchmarks.keypoint_feet.methods import FIXED, PEERS, estimates_of
from benchmarks.keypoint_feet.tables import _with_toes
from tests.data import data_with
from torchpose.body import BODY_15
from torchpose.body._feet import ANKLES, FEET
from torchpose.priors._foot_prior import FootPrior, shipped_foot_prior

pytestmark = pytest.mark.usefixtures("undoubted_cameras")

TOES = [FEET.index(f"{side}_big_toe") for side in ("left", "right")]


@pytest.fixture(scope="module")
def walk():
    data = data_with("mocap_cmu_walk")
    (clip,) = read_toed(data, {WALKS: CHOOSING[WALKS][:1]})[WALKS]
    return begun(clip, 12)


@pytest.mark.data
def test_the_fifteen_joints_are_seen_as_without_toes(walk):
    data = data_with("mocap_cmu_walk")
    (clip,) = bodies.read_clips(data, {WALKS: CHOOSING[WALKS][:1]})[WALKS]
    alone = bodies.begun(clip, 12)
    assert_close(walk.body.seen.keypoints, alone.seen.keypoints, equal_nan=True)
    assert walk.keypoints.shape == (12, 4, 2, 2)


@pytest.mark.data
def test_toes_without_faults_are_where_cameras_see_them():
    data = data_with("mocap_cmu_walk")
    (clip,) = read_toed(data, {WALKS: CHOOSING[WALKS][:1]}, faults=CLEAN)[WALKS]
    clip = begun(clip, 5)
    pixels = clip.body.rig(clip.toes).pixels
    there = clip.clean
    assert_close(clip.keypoints[there], pixels[there])
    assert float(there.double().mean()) == 1.0


@pytest.mark.data
def test_tracked_toes_are_nearer_than_those_of_a_fixed_foot(walk):
    found = estimates_of(walk.body.rig, *_with_toes(walk), walk.body.fps)
    assert set(PEERS) < set(found)
    errors = {
        name: float((one.points[:, TOES] - walk.toes).norm(dim=-1).nanmean())
        for name, one in found.items()
    }
    assert errors["kalman"] < 0.03
    assert errors["kalman"] < errors["kalman-legs-alone"]
    assert errors[FIXED] < 0.15
    fixed = found[FIXED]
    assert fixed.joints is not None
    knee = BODY_15.parents[ANKLES[0]]
    shank = (fixed.joints[:, knee] - fixed.joints[:, ANKLES[0]]).norm(dim=-1)
    toe = (fixed.points[:, TOES[0]] - fixed.joints[:, ANKLES[0]]).norm(dim=-1)
    assert_close(toe / shank, torch.full_like(toe, float((toe / shank)[0])))


@pytest.mark.slow
@pytest.mark.data
def test_the_prior_over_feet_is_fitted_and_read_back(tmp_path):
    data = data_with("mocap_cmu_walk", ACTIONS, MHAD)
    path = tmp_path / "feet.safetensors"
    fit_shipped(data, quick=True).save(path)
    prior = FootPrior.load(path)
    assert prior.slope.shape == shipped_foot_prior().slope.shape
    assert prior.info.recordings[0].startswith("mocap_cmu")
    assert bool((prior.turn_std > 0).all())


def test_nobody_who_is_scored_is_in_the_prior():
    fitted = shipped_foot_prior().info.recordings
    for folder, names in SCORED.items():
        patterns = [p.partition("/")[2].rstrip("*") for p in fitted if p.startswith(folder)]
        assert patterns
        assert not [n for n in names for pattern in patterns if n.startswith(pattern)]


@pytest.mark.data
@pytest.mark.slow
def test_quick_run_prints_every_method(run_here, tmp_path):
    data = data_with("mocap_cmu_walk", ACTIONS, MHAD, "multicam_pose2sim")
    options = ("--data", str(data), "--out", str(tmp_path), "--threads", "1")
    printed = run_here("keypoint_feet.__main__", "--quick", *options)
    assert printed.count("| fixed-foot * |") == 3
    assert printed.count("| pose2sim |") == 2
