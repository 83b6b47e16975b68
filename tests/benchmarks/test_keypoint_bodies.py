"""Clips come from their seed, triangulation is exact, scores have known values, and tables are printed."""

import math

import pytest
import torch

from benchmarks.keypoint_bodies.camera_heights import add_height_table
from benchmarks.keypoint_bodies.clips import (
    ACTIONS,
    CHOOSING,
    CLEAN,
    FAULTS,
    HEIGHT,
    KINECT,
    KINECT_SCORED,
    MHAD,
    OTHER_KINECT,
    SCORED,
    WALKS,
    WIDTH,
    begun,
    bursts,
    draw_ring,
    read_kinect,
    see,
)
from benchmarks.keypoint_bodies.hidden import Gap, gaps_of, guesses, lines
from benchmarks.keypoint_bodies.joint_filters import project_one
from benchmarks.keypoint_bodies.lifters import placed
from benchmarks.keypoint_bodies.lifting import fit_shipped, fit_upper_body
from benchmarks.keypoint_bodies.lifting_examples import LiftingExamples, _at_rate, _recording
from benchmarks.keypoint_bodies.methods import METHODS, OURS
from benchmarks.keypoint_bodies.real import predicted, read_filmed
from benchmarks.keypoint_bodies.scoring import Estimate, bone_spread, score
from benchmarks.keypoint_bodies.seats import seated
from benchmarks.keypoint_bodies.triangulation import (
    held,
    interpolated,
    triangulate_subsets,
    without_outliers,
)
from tests.data import data_with
from torchpose.body import BODY_15
from torchpose.demo._rendering.walk import walk, walk_clip
from torchpose.evaluation import Report
from torchpose.priors._lifting_network import LiftingNetwork, shipped_lifting_network

PEERS = [name for name in METHODS if name not in OURS]


@pytest.fixture(scope="module")
def walker():
    return walk_clip(walk(seconds=1.0))


@pytest.fixture(scope="module")
def clean(walker):
    return see(walker, faults=CLEAN)


def test_nobody_is_in_both_lists():
    for folder in (WALKS, MHAD):
        persons = [{name[:3] for name in names[folder]} for names in (CHOOSING, SCORED)]
        assert not persons[0] & persons[1]
    actions = [{name.split("_t")[0] for name in names[ACTIONS]} for names in (CHOOSING, SCORED)]
    assert not actions[0] & actions[1]


def test_clips_come_from_their_seed(walker):
    clips = [see(walker, seed) for seed in (0, 0, 1)]
    first, again, other = (torch.cat([clip.rig.matrix.flatten(),
                                      clip.seen.keypoints.nan_to_num().flatten(),
                                      clip.seen.confidence.flatten()]) for clip in clips)  # fmt: skip
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_everybody_is_in_view_of_all_cameras(walker):
    rig = draw_ring(walker.joints.double(), walker.up.double(), torch.Generator().manual_seed(3))
    view = rig(walker.joints.double())
    assert bool((view.pixels > 0).all() & (view.pixels < torch.tensor([1920, 1080])).all())
    assert float(view.depth.min()) > 1.5 and float(view.depth.max()) < 8


def test_faults_have_their_shares(walker):
    long = torch.cat([walker.joints] * 20)
    clip = see(type(walker)(long, long, (), walker.up, walker.fps, trial="long"))
    seen = clip.seen
    assert float(seen.missing.double().mean()) == pytest.approx(FAULTS.missing, abs=0.02)
    assert float(seen.outlier.double().mean()) == pytest.approx(0.9 * FAULTS.outliers, abs=0.01)
    assert bool(seen.keypoints[seen.missing].isnan().all())
    assert bool((seen.confidence[seen.missing] == 0).all())
    off = (seen.keypoints - clip.rig(clip.joints).pixels).norm(dim=-1)
    inlier = ~(seen.missing | seen.outlier | seen.exchanged)
    assert float(off[inlier].square().mean().sqrt()) == pytest.approx(math.sqrt(2) * 4, rel=0.03)


def test_bursts_last_as_long_as_they_should():
    on = bursts((4000, 20), 0.1, 10.0, torch.Generator().manual_seed(0))
    begun = (on[1:] & ~on[:-1]).sum()
    assert float(on.double().mean()) == pytest.approx(0.1, abs=0.01)
    assert float(on.sum() / begun) == pytest.approx(10, rel=0.1)


def test_triangulation_is_exact_and_leaves_a_wild_camera_out(clean):
    keypoints = clean.seen.keypoints.clone()
    keypoints[:, 1] += 80
    found = triangulate_subsets(clean.rig, keypoints, clean.seen.confidence)
    assert float((found.points - clean.joints).abs().max()) < 1e-8
    assert bool((found.used.sum(1) == 3).all()) and not bool(found.used[:, 1].any())
    assert bool(found.points.isfinite().all())


def test_pixels_have_the_derivatives_of_autograd(clean):
    points = clean.joints[0]
    pixels, slope = project_one(clean.rig, 2, points)
    assert torch.allclose(pixels, clean.rig(points).pixels[2])
    each = torch.func.vmap(torch.func.jacrev(lambda x: project_one(clean.rig, 2, x)[0]))(points)
    assert torch.allclose(slope, each)


@pytest.mark.parametrize("name", PEERS)
def test_peers_find_joints_without_noise(name, clean):
    seen = clean.seen
    estimate = METHODS[name](clean.rig, seen.keypoints, seen.confidence, clean.fps)
    scored = score(estimate, clean)
    assert scored.error < (25 if name == "points-filter" else 12)
    assert scored.without == 0


def test_gaps_are_filled():
    values = torch.tensor([math.nan, 1.0, math.nan, 3.0, math.nan], dtype=torch.float64)[:, None]
    assert interpolated(values)[:, 0].tolist() == [1, 1, 2, 3, 3]
    assert held(values)[1:, 0].tolist() == [1, 1, 3, 3]


def test_one_wild_frame_becomes_the_median():
    values = torch.arange(20, dtype=torch.float64).square()[:, None].expand(20, 2).clone()
    wild = values.clone()
    wild[9, 1] = 900
    found = without_outliers(wild)
    assert torch.equal(found[:, 0], values[:, 0])
    assert found[9, 1] == 100


def test_scores_of_known_estimates(clean):
    moved = clean.joints + torch.tensor([0.03, 0.0, 0.04], dtype=torch.float64)
    covariance = 0.05**2 / 3 * torch.eye(3, dtype=torch.float64).expand(*moved.shape, 3)
    scored = score(Estimate(moved, covariance), clean)
    assert scored.error == pytest.approx(50)
    assert (scored.rigid, scored.similar) == pytest.approx((0, 0), abs=1e-6)
    assert (scored.inside_50, scored.inside_90) == (0, 100)  # 3 is between 2.37 and 6.25
    assert scored.jitter == pytest.approx(1)
    assert scored.bones == pytest.approx(scored.true_bones)
    larger = score(Estimate(1.1 * clean.joints), clean)
    assert larger.similar == pytest.approx(0, abs=1e-6)
    assert larger.rigid > 10
    assert score(Estimate(moved), clean.of_cameras(1)).error == pytest.approx(0, abs=1e-9)
    moved[:10, 3] = math.nan
    assert score(Estimate(moved), clean).without == pytest.approx(
        1000 / clean.joints[..., 0].numel()
    )


def test_bones_of_two_lengths_have_a_spread():
    joints = torch.randn(1, 15, 3, dtype=torch.float64)
    assert bone_spread(torch.cat([joints, 3 * joints])) == pytest.approx(50)


def test_a_lifted_body_is_put_where_its_keypoints_are(clean):
    alone = clean.of_cameras(1)
    local = (alone.joints - alone.joints[:, [0]]) @ alone.rig.rotation[0].T
    found = placed(local, alone.rig, alone.seen.keypoints, alone.seen.confidence)
    assert float((found - alone.joints).abs().max()) < 1e-4


def test_persons_of_a_kinect_stand_before_it_with_their_left_at_the_right():
    data = data_with(KINECT)
    (clip,) = read_kinect(data, KINECT_SCORED[:1], faults=CLEAN)
    pixels = clip.seen.keypoints[:, 0]
    left, right, head, hip = (
        pixels[:, BODY_15.joint(n)] for n in ("left_shoulder", "right_shoulder", "head", "left_hip")
    )
    assert bool((left[:, 0] > right[:, 0]).all()) and bool((head[:, 1] < hip[:, 1]).all())
    assert 2 < float(clip.joints[:, 0, 2].mean()) < 4
    assert bool(((pixels > 0) & (pixels < torch.tensor([WIDTH, HEIGHT]))).all())


def test_a_real_camera_is_predicted_from_the_others():
    filmed = read_filmed(data_with("multicam_pose2sim"))
    errors = predicted(METHODS["pose2sim"], filmed, 3)
    assert 5 < float(errors.nanmedian()) < 30


@pytest.mark.slow
def test_quick_run_prints_every_peer(run_here, tmp_path):
    data = data_with("mocap_cmu_walk", ACTIONS, KINECT, OTHER_KINECT, MHAD, "multicam_pose2sim")
    weights = tmp_path / "lifters.safetensors"
    names = [*PEERS, "gru", "mlp", "mean-pose"]
    options = ("--data", str(data), "--out", str(tmp_path), "--lifters", str(weights))
    printed = run_here("keypoint_bodies.__main__", "--quick", *options, "--methods", *names)
    assert weights.is_file()
    assert printed.count("| pose2sim |") == 4
    assert printed.count("| gru * |") == 4
    assert "persons of a Kinect" in printed
    assert "person of another Kinect" in printed
    assert (tmp_path / "keypoint_bodies.md").read_text().split() == printed.split()


@pytest.fixture
def quick(run_here):
    """What a quick run prints with some options: quick("--desk", ...)."""

    def run(*options):
        data = str(data_with(MHAD, WALKS, ACTIONS, KINECT))
        return run_here("keypoint_bodies.__main__", "--data", data, "--quick", *options)

    return run


def test_quick_run_prints_people_who_sit(quick):
    printed = quick("--sitting", "--methods", "kalman", "pose2sim")
    for row in ("front", "oblique", "side"):
        assert f"| kalman *, {row} |" in printed and f"| kalman *, {row}, no knees |" in printed
    assert "pose2sim" not in printed  # takes several cameras


def test_quick_run_prints_people_who_lie(quick):
    printed = quick("--lying", "--methods", "kalman")
    for row in ("lying, across", "upside down", "camera on its side", "standing, level camera"):
        assert f"| kalman *, {row} |" in printed


@pytest.mark.slow
def test_quick_run_prints_cameras_that_are_tilted(quick):
    printed = quick("--uncalibrated", "--methods", "kalman")
    for row in ("level", "told", "found"):
        assert printed.count(f"| kalman *, {row} |") == 6
    assert "Tilt found, persons of a Kinect" in printed


@pytest.mark.slow
def test_quick_run_prints_people_behind_a_desk(quick):
    printed = quick("--desk", "--methods", "kalman", "pose2sim")
    for row in ("kalman", "mean pose", "still"):
        assert f"| {row}, {WALKS} |" in printed and f"| {row}, all |" in printed
    assert "pose2sim" not in printed  # knows nothing of joints that no camera sees


@pytest.mark.slow
def test_quick_run_prints_joints_that_are_hidden(quick):
    printed = quick("--hidden")
    for row in ("seen", "hand, 6 frames", "everything, 6 frames"):
        assert f"| 2 cameras, {row} |" in printed


def test_gaps_hide_left_and_right_in_turn_and_end_before_the_clip():
    gaps = gaps_of("arm", 15, 92)
    assert [gap[:2] for gap in gaps] == [(20, 35), (53, 68)]
    names = [[BODY_15.names[joint] for joint in gap.joints] for gap in gaps]
    assert names == [["left_elbow", "left_wrist"], ["right_elbow", "right_wrist"]]


def test_guesses_and_lines_are_exact_for_joints_that_move_evenly():
    t = torch.arange(10, dtype=torch.float64)[:, None, None]
    joints = torch.zeros(10, 15, 3, dtype=torch.float64) + t  # all move alike
    hand = BODY_15.joint("left_wrist")
    joints[:, hand] += t[:, 0] ** 2
    gap = Gap(4, 7, (hand,))
    room, pelvis, before = guesses(joints, gap)
    assert room[:, 0, 0].tolist() == [12.0] * 3
    assert pelvis[:, 0, 0].tolist() == before[:, 0, 0].tolist() == [13.0, 14.0, 15.0]
    straight, relative = lines(joints, gap)
    assert straight[:, 0, 0].tolist() == relative[:, 0, 0].tolist() == [23.0, 34.0, 45.0]
    joints[5, BODY_15.joint("left_elbow")] += 1.0  # the joint before moves by itself
    assert guesses(joints, gap)[2][:, 0, 0].tolist() == [13.0, 15.0, 15.0]
    everything = gap._replace(joints=tuple(range(15)))
    assert all(torch.equal(one, joints[3].expand(3, -1, -1)) for one in guesses(joints, everything))


def test_turned_rings_see_the_same_body_from_other_sides(walker):
    ahead, beside = (see(walker, faults=CLEAN, turn=turn) for turn in (0.0, 90.0))
    first, second = (clip.rig.rotation[0, 2] for clip in (ahead, beside))
    angle = math.degrees(math.acos(float(first @ second)))
    assert 60 < angle < 110
    torch.testing.assert_close(ahead.joints, beside.joints)


@pytest.mark.slow
def test_the_network_that_lifts_is_fitted_to_those_who_train_and_knows_their_size(tmp_path):
    data = data_with(WALKS, KINECT)
    fit_shipped(data, quick=True).save(tmp_path / "lifting.safetensors")
    network = LiftingNetwork.load(tmp_path / "lifting.safetensors")
    assert network.info.recordings == ("mocap_cmu_walk/s02_*", "kinect_utd_mhad/s01_*")
    assert 0.6 < network.info.legs < 1.0


def test_the_network_of_upper_bodies_goes_on_from_that_of_whole_bodies():
    data = data_with(WALKS, KINECT)
    fitted, whole = fit_upper_body(data, quick=True), shipped_lifting_network()
    assert (fitted.info.name, whole.info.name) == ("upper-body", "whole-body")
    change = (fitted.places.weight - whole.places.weight).abs().max()
    assert 0 < float(change) < 0.1  # of one step


def test_people_are_put_into_seats_with_their_bones_and_their_arms(walker):
    joints, up = walker.joints.float()[None].repeat(50, 1, 1, 1), walker.up.float().expand(50, 3)
    found = seated(joints, up, torch.Generator().manual_seed(0))
    again = seated(joints, up, torch.Generator().manual_seed(0))
    assert torch.equal(found, again) and not torch.equal(found[0], found[1])
    for joint, parent in enumerate(BODY_15.parents):
        if parent >= 0:
            lengths = [(x[..., joint, :] - x[..., parent, :]).norm(dim=-1) for x in (found, joints)]
            torch.testing.assert_close(*lengths, atol=1e-4, rtol=1e-4)
    hip, knee, ankle = (BODY_15.joint(f"left_{name}") for name in ("hip", "knee", "ankle"))
    across = joints[:, :, hip] - joints[:, :, BODY_15.joint("right_hip")]
    ahead = torch.linalg.cross(across, up[:, None].expand_as(across))
    thigh, shank = (found[:, :, b] - found[:, :, a] for a, b in ((hip, knee), (knee, ankle)))
    assert bool(((thigh * ahead).sum(-1) > 0).all())  # knees are in front
    low, under = ((bone * up[:, None]).sum(-1) / bone.norm(dim=-1) for bone in (thigh, shank))
    assert -0.3 < float(low.mean()) < 0.1
    assert float(under.mean()) < -0.8
    path = found[:, :, BODY_15.joint("pelvis")]
    torch.testing.assert_close(path, path[:, :1].expand_as(path))


def test_nobody_sits_unless_seats_are_asked_for_and_then_desks_hide_more_legs(walker):
    sets = [(1.0, [walker])]
    ankle, pelvis = BODY_15.joint("left_ankle"), BODY_15.joint("pelvis")
    standing, sitting = (LiftingExamples(sets, 0, seats) for seats in (0.0, 1.0))
    drops, hidden = [], []
    for draw in (standing, sitting):
        pieces = [draw() for _ in range(4)]
        seen, joints = (torch.cat(values) for values in zip(*pieces, strict=True))
        drops.append((joints[:, :, ankle] - joints[:, :, pelvis])[..., 1].mean())
        there = seen[..., 2 * len(BODY_15.names) + ankle]
        hidden.append((there == 0).all(1).float().mean())
    assert drops[0] > 0.7 > 0.55 > drops[1]  # metres, downwards in the image
    assert hidden[0] < 0.25 < 0.35 < hidden[1]


def test_frame_rates_of_pieces_are_drawn_if_that_is_asked_for(walker):
    own, any_rate = (LiftingExamples([(1.0, [walker])], 0, any_rate=x)()[0] for x in (False, True))
    rates = [60 * seen[..., -1] for seen in (own, any_rate)]
    assert rates[0].unique().tolist() == [walker.fps]
    assert len(rates[1][:, 0].unique()) > 10
    assert bool((rates[1] == rates[1][:, :1]).all())


@pytest.mark.parametrize("step", [0.5, 2.0])
def test_a_piece_at_another_rate_is_of_the_recording_in_the_same_time(walker, step):
    recording = _recording(walker)
    piece = _at_rate(recording, 3, walker.fps / step)
    last = len(recording.joints) - 1
    first = min(3, max(0, last - math.ceil(47 * step)))
    place = (first + step * torch.arange(48)).clamp_max(last)
    whole = place == place.round()
    torch.testing.assert_close(piece[whole], recording.joints[place[whole].long()])
    middle = place[~whole].long()
    between = (recording.joints[middle] + recording.joints[middle + 1]) / 2
    torch.testing.assert_close(piece[~whole], between)


def test_heights_of_cameras_are_told_rightly_and_wrongly(walker):
    """The room is that of the recording, in which up is any axis that the tracker takes."""
    clip, told = begun(see(walker, faults=CLEAN), 5).of_cameras(1), []

    def method(rig, keypoints, confidence, fps, **options):
        told.append(options)
        return Estimate(clip.joints)

    report = Report("heights")
    add_height_table(report, {"kalman": method}, [clip], "rings")
    add_height_table(report, {"mlp": method}, [clip], "known", height=2.0)
    add_height_table(report, {"kalman": method}, [clip], "known too", height=2.0)
    centre = -(clip.rig.rotation[0].mT @ clip.rig.translation[0])
    up = "xyz"[int(clip.up.argmax())]
    known = [pytest.approx(float(centre @ clip.up) + off) for off in (0, 0.05, -0.05, 0.1, -0.1)]
    expected = [{}, *({"up": up, "camera_height": height} for height in known)]
    assert told[:7] == [*expected, {}]
    assert [one.get("camera_height") for one in told[7:9]] == [None, 2.0]
    assert len(report.tables["rings"].rows) == 6 and len(report.tables["known"].rows) == 1
