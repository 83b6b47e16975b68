"""Arms of bones that keep their lengths: exact geometry, streams, gaps, and what is not to be seen."""

import copy
import dataclasses
import math
from functools import partial

import pytest
import torch

import torchpose
from tests.data import data_dir_or_skip
from tests.upper_body.lifters import UNSURE
from tests.upper_body.seen import see_torso
from torchpose.errors import InputError
from torchpose.io import read_recordings
from torchpose.math import euler_to_matrix
from torchpose.priors._arms import LENGTHS, ArmPrior, shipped_arm_prior
from torchpose.skeleton import UPPER_BODY
from torchpose.skeleton._joint_sets import canonical_names
from torchpose.upper_body import UpperBodyTracker
from torchpose.upper_body._arm_chain import Arms
from torchpose.upper_body._articulated import ArticulatedFilter
from torchpose.upper_body._articulated_frame import LIMBS, SHOULDERS
from torchpose.upper_body._articulated_poses import _trust, _with_keypoints
from torchpose.upper_body._articulated_root import RootStep
from torchpose.upper_body._estimator import TrackerModel
from torchpose.upper_body._lean import roll
from torchpose.upper_body._measured_joints import MeasuredJoints
from torchpose.upper_body._root_grid import RootGrid
from torchpose.upper_body._torso_likelihood import half_widths

CAMERA = torchpose.PinholeCamera(525.0, 525.0, 319.5, 239.5)
ROW = {name: i for i, name in enumerate(UPPER_BODY)}
PRIOR = torchpose.load_prior("kinect-upper-body-small")
ARMS = tuple(
    f"{joint}_{side}" for joint in ("shoulder", "elbow", "wrist") for side in ("left", "right")
)


def body(n_frames=60, turn=0.0, depth=2.2, scale=1.0):
    """Return a stiff body that waves both arms in front of itself, camera axes, [T, 8, 3]."""
    time = torch.arange(n_frames, dtype=torch.float64) / 30
    joints = torch.zeros(n_frames, 8, 3, dtype=torch.float64)
    joints[:, ROW["head"], 1] = -0.185
    for side, sign in (("left", 1.0), ("right", -1.0)):
        joints[:, ROW[f"shoulder_{side}"]] = torch.tensor([sign * 0.165, 0.105, 0.0])
        lift = 0.6 + 0.5 * torch.sin(2 * time + sign)
        bend = 0.9 + 0.4 * torch.cos(3 * time)
        upper = torch.stack([sign * 0.35 + 0 * lift, lift.cos(), -lift.sin()], -1)
        lower = torch.stack([-sign * 0.2 + 0 * bend, (lift + bend).cos(), -(lift + bend).sin()], -1)
        bones = torch.nn.functional.normalize(torch.stack([upper, lower], 1), dim=-1)
        bones = bones * torch.tensor([0.2686, 0.2888])[:, None]
        ends = joints[:, ROW[f"shoulder_{side}"], None] + bones.cumsum(1)
        joints[:, ROW[f"elbow_{side}"]], joints[:, ROW[f"hand_{side}"]] = ends.unbind(1)
    angles = torch.tensor([0.0, 0.0, turn], dtype=torch.float64)
    turned = scale * joints @ euler_to_matrix(angles, "zxy").mT
    return turned + torch.tensor([0.05, -0.2, depth])


def pixels(joints, noise=0.0, seed=0):
    uv = 525.0 * joints[..., :2] / joints[..., 2:] + torch.tensor([319.5, 239.5])
    generator = torch.Generator().manual_seed(seed)
    return uv + noise * torch.randn(uv.shape, generator=generator, dtype=uv.dtype)


def tracker(**options):
    return UpperBodyTracker(PRIOR, CAMERA, "articulated", fps=30.0, **options)


def bones(joints, side):
    ends = [joints[..., ROW[f"{j}_{side}"], :] for j in ("shoulder", "elbow", "hand")]
    return ends[1] - ends[0], ends[2] - ends[1]


def test_a_waving_body_is_followed_in_space():
    joints = body()
    found = tracker()(pixels(joints, 2.0)[None]).joints3d[0]
    settled = slice(15, None)
    off = torch.linalg.vector_norm(found - joints, dim=-1)[settled]
    apart = found - found[:, [ROW["neck"]]] - (joints - joints[:, [ROW["neck"]]])
    still = torch.linalg.vector_norm(joints - joints[0], dim=-1)
    assert float(torch.linalg.vector_norm(apart, dim=-1)[settled].mean()) < 0.1
    assert float(off.mean()) < 0.35  # the scale of a body is not to be seen
    assert float(still.max()) > 0.2
    for side in ("left", "right"):
        for bone, true in zip(bones(found, side), bones(joints, side), strict=True):
            assert float((bone[settled, 2] * true[settled, 2] > 0).double().mean()) > 0.9


def test_bones_keep_their_lengths():
    found = tracker(lifter=UNSURE)(pixels(body(110), 3.0)[None]).joints3d[0, 50:]
    for side in ("left", "right"):
        for bone in bones(found, side):
            length = torch.linalg.vector_norm(bone, dim=-1)
            assert float(length.std() / length.mean()) < 0.02


TURNS = (-2.4, -0.9, 0.9, 3.0)


@pytest.fixture(scope="module")
def turned():
    """Joints of turned bodies, and those that are found in one batch, [len(TURNS), T, 8, 3]."""
    joints = torch.stack([body(45, turn=turn) for turn in TURNS])
    seen = torch.stack([pixels(one, 2.0) for one in joints])
    return joints, tracker()(seen).joints3d


@pytest.mark.parametrize("which", range(len(TURNS)), ids=map(str, TURNS))
def test_turned_bodies_are_seen_as_turned(turned, which):
    true, found = (
        x[which, -1, ROW["shoulder_left"]] - x[which, -1, ROW["shoulder_right"]] for x in turned
    )
    cosine = torch.nn.functional.cosine_similarity(found, true, dim=0)
    assert float(cosine) > math.cos(math.radians(25))


@pytest.mark.parametrize("hidden", [0, 4], ids=["at-once", "arms-later"])
@pytest.mark.parametrize("turn", [-1.2, 1.2, 1.6])
def test_a_body_seen_from_the_side_is_not_far_away(turn, hidden):
    """Shoulders that are one behind the other look like those of somebody far away; arms do not."""
    joints = body(8, turn=turn, depth=2.7)
    seen = pixels(joints, 2.0)[None]
    shoulders = [ROW["shoulder_left"], ROW["shoulder_right"]]
    seen[:, :, ROW["head"]] = torch.nan
    seen[:, :, ROW["neck"]] = seen[:, :, shoulders].mean(2)
    seen[:, :hidden, [ROW[name] for name in UPPER_BODY if "elbow" in name or "hand" in name]] = (
        torch.nan
    )
    found = tracker(neck="mid-shoulder", outliers=False)(seen).joints3d[0]
    depth, true = (x[:, shoulders, 2].mean(1) for x in (found, joints))
    after = hidden + 2 if hidden else 0  # the torso is updated in every third frame
    assert float((depth[after:] / true[after:]).log().abs().max()) < 0.25


def test_a_first_hand_that_is_an_outlier_does_not_bring_a_body_near():
    joints = body(8, depth=2.7)
    seen = pixels(joints, 2.0)[None]
    seen[0, 0, ROW["hand_left"]] = seen[0, 0, ROW["neck"]] - torch.tensor([90.0, 70.0])
    found = tracker(outliers=False)(seen).joints3d[0]
    assert float(found[-1, ROW["neck"], 2]) > 0.75 * 2.7


def test_depths_are_looked_through_only_where_arms_are_first_seen(monkeypatch):
    """It doubles the work of an update, and nothing is ruled out while no arm is seen."""
    looked, frame = [], 0
    whole = RootGrid.at_all_depths

    def look(*given):
        looked.append(frame)
        return whole(*given)

    monkeypatch.setattr(RootGrid, "at_all_depths", look)
    seen = pixels(body(12))
    seen[:6, [row for name, row in ROW.items() if "elbow" in name or "hand" in name]] = torch.nan
    live = tracker(outliers=False)
    state = live.init(1)
    for frame, keypoints in enumerate(seen):  # noqa: B007  # `look` reads it
        state, _ = live.step(state, keypoints[None])
    assert looked == [6]


def test_scale_and_depth_are_one():
    """A body twice as large at twice the distance has the same pixels, so the scale stays the prior's."""
    torch.testing.assert_close(pixels(2 * body(12)), pixels(body(12)))
    near, far = (
        tracker(lifter=UNSURE)(pixels(j)[None]).joints3d[0, -1]
        for j in (body(12), body(12, depth=4.4))
    )
    assert float(far[ROW["neck"], 2] / near[ROW["neck"], 2]) > 1.5
    upper = torch.linalg.vector_norm(bones(far, "left")[0])
    torch.testing.assert_close(upper, torch.linalg.vector_norm(bones(near, "left")[0]))


def test_the_prior_may_come_from_a_file(tmp_path):
    file = tmp_path / "arms.safetensors"
    shipped_arm_prior().save(file)
    uv = pixels(body(4), 3.0)[None]
    torch.testing.assert_close(
        tracker(arms=str(file))(uv).joints3d, tracker()(uv).joints3d, rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("arms", [3, ["arms.safetensors"], torch.zeros(5)])
def test_arms_of_another_kind_are_refused(arms):
    with pytest.raises(InputError, match="arms must be a prior over arms or the path of its file"):
        tracker(arms=arms)


@pytest.mark.parametrize("hidden", [False, True], ids=["all-seen", "some-hidden"])
def test_gradients_are_slopes(hidden):
    seen = pixels(body(6), 1.0)[None]
    if hidden:
        seen[:, 3, [ROW["shoulder_left"], ROW["elbow_left"], ROW["hand_right"]]] = torch.nan
    generator = torch.Generator().manual_seed(1)
    weight = torch.randn(1, 6, 8, 3, generator=generator, dtype=torch.float64)
    way = torch.randn(seen.shape, generator=generator, dtype=torch.float64)
    filter_ = tracker(outliers=False)

    def value(keypoints):
        return (filter_(keypoints).joints3d * weight).sum()

    keypoints = seen.clone().requires_grad_()
    value(keypoints).backward()
    assert bool(keypoints.grad.isfinite().all())
    step = 1e-4  # pixels; longer ones cross the jumps between hypotheses
    with torch.no_grad():
        slope = (value(seen + step * way) - value(seen - step * way)) / (2 * step)
    assert float((keypoints.grad * way).nansum()) == pytest.approx(float(slope), rel=1e-6)


def test_a_stream_gives_the_numbers_of_the_whole_recording():
    uv = pixels(body(20), 3.0)
    uv[5:9, ROW["elbow_left"]] = torch.nan
    uv[7:12, ROW["hand_right"]] = torch.nan
    uv[10] = torch.nan
    whole = tracker()(uv[None])
    live = tracker()
    state = live.init(1)
    for t, frame in enumerate(uv):
        state, pose = live.step(state, frame[None])
        torch.testing.assert_close(pose.joints3d, whole.joints3d[:, t], rtol=0, atol=1e-9)
        torch.testing.assert_close(pose.log_evidence, whole.log_evidence[:, t], rtol=0, atol=1e-9)
    assert bool(whole.joints3d.isfinite().all())


@pytest.mark.parametrize("fps", [12.0, 25.0, 60.0])
def test_frames_that_are_weighed_together_are_as_one_by_one(fps):
    """Torso and lengths are updated in other frames at each rate; axes of a leaning body change in all."""
    joints = body(14)
    neck = joints[:1, [ROW["neck"]]]
    uv = pixels((joints - neck) @ roll(torch.tensor([0.5]).double()).mT + neck, 3.0)
    uv[5:7, ROW["hand_right"]] = torch.nan
    own = UpperBodyTracker(PRIOR, CAMERA, "articulated", fps=fps)
    whole, state = own(uv[None]), own.init(1)
    for t, frame in enumerate(uv):
        state, pose = own.step(state, frame[None])
        torch.testing.assert_close(pose.joints3d, whole.joints3d[:, t], rtol=0, atol=1e-11)
        torch.testing.assert_close(pose.covariance3d, whole.covariance3d[:, t], rtol=0, atol=1e-11)


def test_arms_of_frames_between_updates_are_weighed_together(monkeypatch):
    """At 30 frames a second the torso changes in each third frame, and lengths after each sixth."""
    sizes, weigh = [], RootStep.arms

    def count(self, frame, *given):
        sizes.append(len(frame.rays))
        return weigh(self, frame, *given)

    monkeypatch.setattr(RootStep, "arms", count)
    seen = pixels(body(12))
    tracker()(seen[None])
    assert sizes == [1, 2, 3, 1, 2, 3]
    sizes.clear()
    seen[4, ROW["elbow_left"]] = torch.nan
    tracker()(seen[None])
    assert sizes == [1, 2, 1, 1, 1, 1, 2, 3]  # what is measured in a run is the same
    sizes.clear()
    tracker()(seen.expand(16, -1, -1, -1))
    assert sizes == 12 * [16]  # many sequences gain nothing by more frames


def test_sequences_of_a_batch_do_not_know_of_each_other():
    uv = torch.stack([pixels(body(18), 3.0), pixels(body(18, turn=0.5, depth=3.0), 3.0, seed=1)])
    uv[1, 6:, ROW["elbow_left"]] = torch.nan
    together = tracker()(uv, lengths=torch.tensor([18, 11]))
    for row, n in enumerate((18, 11)):
        alone = tracker()(uv[row : row + 1, :n])
        torch.testing.assert_close(together.joints3d[row, :n], alone.joints3d[0], rtol=0, atol=1e-7)
    last = together.joints3d[1, 10]
    torch.testing.assert_close(together.joints3d[1, 11:], last.expand(7, 8, 3), rtol=0, atol=0)


SUBSETS = (
    ("head", "neck", "hand_left", "hand_right"),
    ("neck", "hand_left", "hand_right"),
    ("shoulder_left", "shoulder_right", "elbow_left", "elbow_right"),
    ("head", "hand_left"),
)


@pytest.mark.parametrize("names", SUBSETS)
def test_any_subset_gives_poses_and_covariances(names):
    rows = [ROW[name] for name in names]
    poses = tracker()(pixels(body(8), 3.0)[None, :, rows], names=names)
    assert bool(poses.joints3d.isfinite().all())
    assert bool((torch.linalg.eigvalsh(poses.covariance3d) > 0).all())
    assert bool((torch.linalg.eigvalsh(poses.covariance2d) > 0).all())
    assert bool(poses.observed[..., [i for i in rows if i != ROW["neck"]]].all())


def test_hidden_joints_are_less_sure():
    uv = pixels(body(20), 3.0)
    rows = [i for i, name in enumerate(UPPER_BODY) if not name.startswith("elbow")]
    all_, some = (
        tracker()(uv[None, :, r], names=[UPPER_BODY[i] for i in r]) for r in (list(range(8)), rows)
    )
    elbows = [ROW["elbow_left"], ROW["elbow_right"]]
    trace = [p.covariance3d[0, :, elbows].diagonal(dim1=-2, dim2=-1).sum(-1) for p in (all_, some)]
    assert float(trace[0].mean()) < float(trace[1].mean())


def test_wrists_end_shorter_forearms_than_hands():
    uv = pixels(body(6), 3.0)[None]
    lengths = []
    for end in ("hand", "wrist"):
        names = [name.replace("hand", end) for name in UPPER_BODY]
        track = tracker()(uv, names=names)
        assert any("are the wrists" in note for note in track.notes) == (end == "wrist")
        lengths.append(float(torch.linalg.vector_norm(bones(track.joints3d[0, 0], "left")[1])))
    assert lengths[1] < 0.85 * lengths[0]


def test_shoulders_of_raised_arms_are_no_turn():
    """Raised arms bring the shoulders together, which must not be taken for a turned body."""
    joints = body(30)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        rows = [ROW[f"{j}_{side}"] for j in ("shoulder", "elbow", "hand")]
        shoulder = torch.tensor([sign * 0.12, 0.08, 0.0]) + joints[:, ROW["neck"]]
        up = torch.tensor([sign * 0.25, -1.0, -0.1], dtype=torch.float64)
        up = up / torch.linalg.vector_norm(up)
        ends = [shoulder, shoulder + 0.2686 * up, shoulder + (0.2686 + 0.2888) * up]
        joints[:, rows] = torch.stack(ends, 1)
    found = tracker()(pixels(joints, 2.0)[None]).joints3d[0, -1]
    across = found[ROW["shoulder_left"]] - found[ROW["shoulder_right"]]
    assert abs(math.degrees(float(torch.atan2(-across[2], across[0])))) < 25


def test_a_neck_in_the_middle_of_the_shoulders_is_put_there():
    """A prior whose neck is the middle of the shoulders gives the depth that one with Kinect's neck gives."""
    prior = copy.deepcopy(PRIOR)
    prior.info = dataclasses.replace(prior.info, neck="mid-shoulder")
    joints = body(12)
    lower = joints.clone()
    lower[:, ROW["neck"]] = lower[:, [ROW["shoulder_left"], ROW["shoulder_right"]]].mean(1)
    usual = tracker()(pixels(joints)[None]).joints3d[0, -1]
    other = UpperBodyTracker(prior, CAMERA, "articulated", fps=30.0, neck="mid-shoulder")
    found = other(pixels(lower)[None]).joints3d[0, -1]
    names = ("shoulder_left", "shoulder_right", "head")
    rows = [ROW[name] for name in names]
    torch.testing.assert_close(found[rows], usual[rows], rtol=0, atol=0.03)
    middle = found[[ROW["shoulder_left"], ROW["shoulder_right"]]].mean(0)
    torch.testing.assert_close(found[ROW["neck"]], middle, rtol=0, atol=0.02)


def test_given_lengths_are_kept_and_the_others_go_with_them():
    uv = pixels(body(30), 2.0)[None]
    usual, given = (tracker(bone_lengths=x)(uv).joints3d[0, -1] for x in (None, {"forearm": 0.25}))
    for side in ("left", "right"):
        upper, lower = (torch.linalg.vector_norm(x) for x in bones(given, side))
        assert float(lower) == pytest.approx(0.25, abs=0.005)
        before = torch.linalg.vector_norm(bones(usual, side)[0])
        assert float(upper) < float(before)
    assert float(given[ROW["neck"], 2]) < float(usual[ROW["neck"], 2])


@pytest.mark.parametrize("neck", ["neck", "mid-shoulder"])
def test_given_lengths_are_those_that_are_reported(neck):
    """Whatever neck is measured, so that a person's lengths may be handed back."""
    rows = [i for i, name in enumerate(UPPER_BODY) if not name.startswith("shoulder")]
    joints = body(2)
    if neck == "mid-shoulder":
        joints[:, ROW["neck"]] = joints[:, [ROW["shoulder_left"], ROW["shoulder_right"]]].mean(1)
    given = {"shoulder_width": 0.33, "head_height": 0.2}
    names = [UPPER_BODY[i] for i in rows]
    track = tracker(neck=neck, bone_lengths=given)(pixels(joints)[None, :, rows], names=names)
    torch.testing.assert_close(track.bone_lengths[0, 0, 2:], torch.tensor([0.33, 0.2]).double())
    again = dict(zip(("upper_arm", "forearm"), track.bone_lengths[0, 0].tolist(), strict=False))
    handed = tracker(neck=neck, bone_lengths=given | again)(
        pixels(joints)[None, :, rows], names=names
    )
    torch.testing.assert_close(handed.bone_lengths[0, 0], track.bone_lengths[0, 0])


@pytest.mark.parametrize(
    ("lengths", "said"),
    [({"thigh": 0.4}, "bone_lengths must be one of .*upper_arm"), ({"forearm": 25.0}, "between 0.05 and 1"),
     ({}, "at least one length"), (0.3, "a mapping of upper_arm")],
)  # fmt: skip
def test_lengths_that_nobody_has_are_refused(lengths, said):
    with pytest.raises(InputError, match=said):
        tracker(bone_lengths=lengths)


def test_shoulders_without_arms_keep_their_width_at_any_distance():
    uv = pixels(body(1, depth=0.6))
    rays = torch.cat([(uv - torch.tensor([319.5, 239.5])) / 525, torch.ones(1, 8, 1)], -1).double()
    shoulders = torch.tensor([[name.startswith("shoulder") for name in UPPER_BODY]])
    torso = see_torso(rays, shoulders, 0.006)
    depth = torch.tensor([[0.4, 0.6, 3.0]], dtype=torch.float64)
    assert float(torso.raised(depth).abs().max()) == 0.0
    width = torch.tensor([0.33], dtype=torch.float64)
    torch.testing.assert_close(
        half_widths(width, torso.raised(depth)), torch.full((1, 3, 2), 0.165).double()
    )


def test_lengths_are_reported_with_a_covariance_that_sharpens():
    track = tracker()(pixels(body(240), 2.0)[None])
    assert track.bone_names == ("upper_arm", "forearm_to_hand", "shoulder_width", "head_height")
    usual = shipped_arm_prior()
    rows = [LENGTHS.index(name) for name in track.bone_names]
    torch.testing.assert_close(track.bone_lengths[0, 0], usual.lengths[rows])
    first, last = (track.bone_covariance[0, t].diagonal().sqrt() for t in (0, -1))
    torch.testing.assert_close(first / track.bone_lengths[0, 0], usual.spread[rows])
    assert bool((last[1:] < 0.95 * first[1:]).all())
    assert float(last[0]) == pytest.approx(float(first[0]))  # the scale is not to be seen
    correlation = track.bone_covariance[0, -1, 0, 1] / (last[0] * last[1])
    assert 0.3 < float(correlation) < 1


def test_covariances_of_arms_that_are_measured_whole_are_calibrated():
    uv = pixels(body(4), 2.0)[None]
    own, as_they_are = (tracker(calibrated=c)(uv).covariance3d[0, -1] for c in (True, False))
    arms = [ROW[f"{joint}_{side}"] for joint in ("elbow", "hand") for side in ("left", "right")]
    ratio = own.diagonal(dim1=-2, dim2=-1) / as_they_are.diagonal(dim1=-2, dim2=-1)
    assert float(ratio[arms].min()) > 0.4 and float(ratio[arms].mean()) < 0.7
    others = [i for i in range(len(ratio)) if i not in arms]
    torch.testing.assert_close(ratio[others], torch.ones_like(ratio[others]))


@pytest.mark.parametrize("calibrated", [True, False])
def test_covariances_of_arms_hold_the_whole_spread_of_sizes_over_persons(calibrated):
    """A further spread t of the common scale adds t^2 x x^T to a joint at x from the neck."""
    arms, uv = shipped_arm_prior(), pixels(body(1), 2.0)[None]
    spread = (arms.spread.square() + 0.05**2).sqrt()
    varied = ArmPrior(arms.directions, arms.lengths, spread, arms.broad, arms.info, arms.together)
    options = {"lifter": UNSURE, "calibrated": calibrated}
    usual, wide = (tracker(arms=own, **options)(uv) for own in (arms, varied))
    torch.testing.assert_close(wide.joints3d, usual.joints3d)
    apart = usual.joints3d - usual.joints3d[:, :, [ROW["neck"]]]
    outer = apart[..., :, None] * apart[..., None, :]
    torch.testing.assert_close(wide.covariance3d - usual.covariance3d, 0.05**2 * outer)


def test_covariances_are_calibrated_by_what_is_measured_of_an_arm():
    everything = torch.ones(2, 8, dtype=torch.bool)
    exact = torch.tensor([True, False])

    def trust(*missing):
        known = everything.clone()
        known[:, [ROW[name] for name in missing]] = False
        limbs = known[:, list(LIMBS)].unflatten(1, (2, 2))
        return _trust(known[:, SHOULDERS], limbs, exact)

    whole, alone = float(trust()[0, 0]), float(trust("elbow_left")[0, 0])
    assert 0.4 < whole < alone < 1.0
    of_left = ("elbow_left",), ("shoulder_left",), ("hand_left",), ("elbow_left", "hand_left")
    for missing, wanted in zip(of_left, (alone, 1.0, 1.0, 1.0), strict=True):
        found = trust(*missing)
        torch.testing.assert_close(found, torch.tensor([[wanted, whole], [1.0, 1.0]]))


def test_the_next_recording_of_a_person_begins_with_their_lengths(tmp_path):
    uv = pixels(body(25), 2.0)[None]
    first = tracker(bone_lengths={"upper_arm": 0.31})(uv)
    first.save(tmp_path / "anna.npz")
    for person in (first, tmp_path / "anna.npz"):
        again = tracker(person=person)(uv)
        torch.testing.assert_close(again.bone_lengths[:, 0], first.bone_lengths[:, -1])
        torch.testing.assert_close(
            again.bone_covariance[:, 0].diagonal(dim1=-2, dim2=-1),
            first.bone_covariance[:, -1].diagonal(dim1=-2, dim2=-1),
        )


def test_forearms_to_the_wrist_are_not_taken_for_forearms_to_the_hand():
    uv = pixels(body(30), 2.0)[None]
    wrists = tracker(bone_lengths={"upper_arm": 0.24, "forearm": 0.10})
    person = wrists(uv, names=[name.replace("hand", "wrist") for name in UPPER_BODY])
    assert person.bone_names[1] == "forearm"
    lengths = tracker(person=person)(uv).bone_lengths[0, 0]
    assert float(lengths[0]) == pytest.approx(0.24) and float(lengths[1]) > 0.2


def test_poses_without_lengths_are_nobody():
    uv = pixels(body(5))[None]
    windows = UpperBodyTracker(PRIOR, CAMERA, "mkf-fixed")(uv)
    assert bool(windows.bone_lengths.isnan().all())
    with pytest.raises(InputError, match="which method 'articulated' gives, got 'mkf-fixed'"):
        tracker(person=windows)
    with pytest.raises(InputError, match="one sequence, got 2"):
        tracker(person=tracker()(uv.expand(2, -1, -1, -1)))
    with pytest.raises(InputError, match="a PoseTrack or the path"):
        tracker(person=3)


@pytest.mark.parametrize("smoothing", [None, "full"])
def test_a_known_height_scales_the_body_and_its_distance(smoothing):
    uv = pixels(body(40), 2.0)[None]
    small, usual = (tracker(height=h, smoothing=smoothing)(uv) for h in (1.02, 1.70))
    for name, factor in (("joints3d", 0.6), ("covariance3d", 0.36), ("bone_lengths", 0.6),
                         ("bone_covariance", 0.36), ("joints2d", 1.0), ("covariance2d", 1.0)):  # fmt: skip
        torch.testing.assert_close(getattr(small, name), factor * getattr(usual, name))


def test_given_lengths_scale_the_body_and_its_distance():
    uv = pixels(body(20), 2.0)[None]
    lengths = {"upper_arm": 0.27, "shoulder_width": 0.33}
    usual = tracker(bone_lengths=lengths)(uv)
    small = tracker(bone_lengths={name: 0.6 * metres for name, metres in lengths.items()})(uv)
    torch.testing.assert_close(small.joints3d, 0.6 * usual.joints3d)


def test_a_height_narrows_lengths_and_must_be_that_of_somebody():
    small = tracker(height=1.36)(pixels(body(2), 2.0)[None])
    spread = small.bone_covariance[0, 0].diagonal().sqrt() / small.bone_lengths[0, 0]
    assert bool((spread <= shipped_arm_prior().spread.max()).all())
    for height in (17.0, 0.0, float("nan"), "1.7"):
        with pytest.raises(InputError, match="height must lie between"):
            tracker(height=height)
    for metres in ((0.3, 0.01), "long", 30.0):
        with pytest.raises(InputError, match="bone_lengths must lie between"):
            tracker(bone_lengths={"upper_arm": metres})


def test_the_size_of_a_person_is_told_once():
    person = tracker()(pixels(body(3))[None])
    facts = {"person": person, "bone_lengths": {"upper_arm": 0.31}, "height": 1.9}
    for one, other in (
        ("person", "height"),
        ("bone_lengths", "height"),
        ("person", "bone_lengths"),
    ):
        with pytest.raises(InputError, match=f"{one} and {other} each tell how large"):
            tracker(**{one: facts[one], other: facts[other]})


def test_smoothing_sums_over_all_later_paths():
    model = TrackerModel(tracker(), PRIOR, tracker().measurement_cov, 30.0)
    chain = ArticulatedFilter(model).chain
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(4, 1, 2, 3, 2, 3, generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(directions, dim=-1).flatten(-2)
    said = torch.rand(4, 1, 2, 3, generator=generator, dtype=torch.float64)
    prior = torch.rand(4, 1, 2, 3, generator=generator, dtype=torch.float64)
    rays = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(1, 2, 1, 3)
    arms = [Arms(d[:, :, None], w.log()[:, :, None], p.log()[:, :, None], hand_rays=rays)
            for d, w, p in zip(directions, said, prior, strict=True)]  # fmt: skip
    hands = torch.tensor([[[1, 1]], [[1, 0]], [[0, 0]], [[1, 1]]]).bool()  # measured or not
    elbows = torch.tensor([[[1, 1]], [[0, 1]], [[0, 0]], [[1, 0]]]).bool()
    known = torch.stack([elbows, hands], -1)
    states = [chain.start(arms[0], known[0])]
    for arm, ends in zip(arms[1:], known[1:], strict=True):
        states.append(chain.update(states[-1], arm, ends))
    guessed = torch.tensor([[[0, 0]], [[1, 0]], [[0, 0]], [[0, 1]]]).bool()[..., None]
    assert [
        bool(((state.pull == 1) == ~own).all()) for state, own in zip(states, guessed, strict=True)
    ]

    def moves(t):
        pair = directions[t - 1 : t + 1].flatten(1, 2)
        walk, unseen = (chain._walk(*pair, step)[None] for step in (chain.step, chain.step_unseen))
        pull = states[t].pull[:, :, None]
        pulled = walk * pull / ((walk * pull) @ said[t, ..., None]) * (walk @ said[t, ..., None])
        seen, unseen = (
            (1 - anew) * moved + anew * prior[t, :, :, None]
            for moved, anew in ((pulled, chain.anew), (unseen, chain.anew_unseen))
        )
        return torch.where(hands[t, :, :, None, None], seen, unseen)

    def brute(first, last):
        """The weights of the hypotheses of frame `first`, given all frames up to `last`.

        Later frames count for a quarter where the hand is measured.
        """
        paths = states[first].weight[..., None]
        paths = torch.diag_embed(paths[..., 0])
        for t in range(first + 1, last + 1):
            paths = (paths @ moves(t)) * said[t, :, :, None]
        filtered = states[first].weight
        power = torch.where(hands[first], 0.25, 1.0)[..., None]
        total = filtered * (paths.sum(-1) / filtered) ** power
        return total / total.sum(-1, keepdim=True)

    for lag, lengths in ((None, None), (1, None), (2, None), (None, torch.tensor([3]))):
        end = 3 if lengths is None else 2
        found = chain.smoothed(states, lengths, lag)
        for t in range(end + 1):
            last = end if lag is None else min(end, t + lag)
            torch.testing.assert_close(found[t].weight, brute(t, last))


def test_elbows_that_nobody_sees_stay_where_people_have_them():
    """A random walk forgets the prior: elbows of hands before the other shoulder drift to the side."""
    joints = body(1)[0]
    bone = torch.tensor([[0.28, 0.84, -0.33], [-0.68, -0.44, -0.51]], dtype=torch.float64)
    bone = torch.nn.functional.normalize(bone, dim=-1) * torch.tensor([[0.2686], [0.2888]])
    for side, sign in (("left", 1.0), ("right", -1.0)):
        ends = (bone * bone.new_tensor([sign, 1.0, 1.0])).cumsum(0)
        places = joints[ROW[f"shoulder_{side}"]] + ends
        joints[ROW[f"elbow_{side}"]], joints[ROW[f"hand_{side}"]] = places
    names = ("head", "neck", "hand_left", "hand_right")
    seen = pixels(joints.expand(45, -1, -1), 2.0)[None][:, :, [ROW[name] for name in names]]
    found = tracker()(seen, names=names).joints3d[0, 30:]
    for side in ("left", "right"):
        off = bones(found, side)[0] - bones(joints, side)[0]
        assert float(off.norm(dim=-1).mean()) < 0.065  # the walk alone: 0.084 and 0.073


def test_the_pull_of_elbows_leaves_the_evidence_and_hands_as_they_are():
    """It is that of the elbow given the hand: hypotheses one by one as deep are not pulled at all."""
    chain = ArticulatedFilter(TrackerModel(tracker(), PRIOR, tracker().measurement_cov, 30.0)).chain
    generator = torch.Generator().manual_seed(0)
    draw = partial(torch.rand, generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(draw(1, 2, 1, 40, 2, 3) - 0.5, dim=-1).flatten(-2)
    prior, likelihood, rays = draw(1, 2, 1, 40), draw(1, 2, 1, 40), draw(1, 2, 1, 3)
    rays = torch.nn.functional.normalize(rays, dim=-1)
    arms = Arms(directions, likelihood.log(), prior.log(), hand_rays=rays)
    hand, both = (torch.tensor([[[elbow, 1]] * 2]).bool() for elbow in (0, 1))
    before = chain.start(arms, both)
    alone, pulled = (chain.update(before, arms, known) for known in (both, hand))
    assert bool((pulled.weight != alone.weight).all())
    torch.testing.assert_close(pulled.log_evidence, alone.log_evidence)
    few = Arms(
        directions[..., :1, :], likelihood[..., :1].log(), prior[..., :1].log(), hand_rays=rays
    )
    torch.testing.assert_close(chain.update(before, few, hand).pull, torch.ones(1, 2, 1).double())


def test_ellipsoids_grow_while_an_arm_is_not_measured():
    seen = pixels(body(60), 2.0)
    seen[30:50] = torch.nan
    covs = tracker(max_gap=None)(seen[None]).covariance3d[0, :, ROW["hand_left"]]
    std = covs.diagonal(dim1=-2, dim2=-1).mean(-1).sqrt()
    assert float(std[30] - std[29]) > 0.02
    assert bool((std[30:50].diff() > 0).all()) and float(std[49]) > 0.2
    assert float(std[55]) < 0.06


def test_a_hand_that_is_no_longer_measured_is_expected_where_it_was():
    seen = pixels(body(1), 2.0).expand(50, -1, -1).clone()
    hand = ROW["hand_left"]
    true = seen[0, hand].clone()
    seen[20:, hand] = torch.nan
    found = tracker()(seen[None], names=UPPER_BODY).joints2d[0, :, hand]
    away = (found - true).norm(dim=-1)
    assert float(away[29]) < 10 and float(away[49]) < 15


def test_smoothing_with_no_later_frame_is_filtering():
    uv = pixels(body(20), 2.0)[None]
    plain, lag, full = (tracker(smoothing=s)(uv).joints3d for s in (None, 0, "full"))
    torch.testing.assert_close(lag, plain)
    assert not torch.allclose(full, plain)
    lengths = torch.tensor([12, 20])
    both = uv.expand(2, -1, -1, -1).clone()
    both[0, 12:] = torch.nan
    short = tracker(smoothing="full")(both, lengths=lengths).joints3d[0, :12]
    torch.testing.assert_close(short, tracker(smoothing="full")(uv[:, :12]).joints3d[0])


def test_a_middle_of_the_shoulders_alone_is_seen_where_it_is():
    joints = body(40, depth=1.4)
    middle = joints[:, [ROW["shoulder_left"], ROW["shoulder_right"]]].mean(1, keepdim=True)
    seen = torch.cat([middle, joints[:, [ROW["hand_left"], ROW["hand_right"]]]], 1)
    names = ["neck", "left_hand", "right_hand"]
    track = tracker(neck="mid-shoulder")(pixels(seen)[None], names=names)
    shoulders = track.joints2d[0][:, [ROW["shoulder_left"], ROW["shoulder_right"]]].mean(1)
    torch.testing.assert_close(shoulders, pixels(middle)[:, 0], atol=4.0, rtol=0)
    found = track.joints3d[0]
    share = (found[:, ROW["neck"]] - found[:, ROW["head"]]).norm(dim=-1)
    whole = found[:, [ROW["shoulder_left"], ROW["shoulder_right"]]].mean(1) - found[:, ROW["head"]]
    torch.testing.assert_close(
        share / whole.norm(dim=-1), torch.full_like(share, 0.63), atol=0.02, rtol=0
    )


def test_limbs_that_nobody_sees_are_expected_nearer_than_their_lengths():
    keypoints = pixels(body(30), 2.0)[None]
    whole = tracker(lifter=UNSURE)(keypoints, names=list(UPPER_BODY))
    keypoints[:, 20:, ROW["elbow_left"]] = torch.nan
    track = tracker(lifter=UNSURE)(keypoints, names=list(UPPER_BODY))
    lengths = [
        torch.linalg.vector_norm(bones(x.joints3d[0], "left")[0], dim=-1) for x in (whole, track)
    ]
    torch.testing.assert_close(lengths[0], whole.bone_lengths[0, :, 0], atol=1e-6, rtol=0)
    torch.testing.assert_close(lengths[0][:20], lengths[1][:20])
    assert bool((lengths[1][20:] < track.bone_lengths[0, 20:, 0] - 1e-4).all())


@pytest.mark.slow
def test_more_frames_a_second_are_no_worse():
    """The walk of the hypotheses is not narrower than they are apart: they stuck at 120 frames a second."""
    clip = data_dir_or_skip("kinect_laban") / "Ges02_balancinghands.csv"
    (recording,) = read_recordings([clip])
    places = [canonical_names(recording.names).index(name) for name in ARMS]
    slow = recording.joints[:90, places].double()
    t = torch.arange(4 * (len(slow) - 1)) / 4
    first, share = t.long(), (t % 1)[:, None, None]
    fast = (1 - share) * slow[first] + share * slow[first + 1]
    off = {}
    for fps, joints in ((30.0, slow), (120.0, fast)):
        follow = UpperBodyTracker(PRIOR, CAMERA, "articulated", fps=fps)
        found = follow(pixels(joints, 3.0)[None], names=ARMS).joints3d[0]
        found = found[:, [ROW[name.replace("wrist", "hand")] for name in ARMS]]
        apart = (found - found[:, :2].mean(1, True)) - (joints - joints[:, :2].mean(1, True))
        off[fps] = float(torch.linalg.vector_norm(apart[:, 2:], dim=-1).mean())
    assert off[120.0] < 1.2 * off[30.0], off


def test_smoothing_averages_the_noise_of_keypoints():
    joints = body(30)
    seen = pixels(joints, 4.0)[None]
    filtered, smoothed = (tracker(smoothing=s)(seen).joints2d[0] for s in (None, "full"))
    rows = [ROW[f"elbow_{side}"] for side in ("left", "right")]
    off = [(found - pixels(joints))[:, rows].norm(dim=-1).mean() for found in (filtered, smoothed)]
    assert float(off[1]) < 0.8 * float(off[0])


def test_a_measured_hand_is_seen_near_its_keypoint_though_bones_do_not_reach_it():
    joints, hand = body(20), ROW["hand_left"]
    shoulder = joints[:, ROW["shoulder_left"]]
    joints[:, hand] = shoulder + torch.tensor([0.1, 0.5, 0.0])
    joints[:, ROW["elbow_left"]] = (shoulder + joints[:, hand]) / 2
    keypoints = pixels(joints, 2.0)
    short = {"upper_arm": 0.22, "forearm": 0.2, "shoulder_width": 0.38, "head_height": 0.3}
    found = tracker(bone_lengths=short)(keypoints[None], names=list(UPPER_BODY))
    away = (pixels(found.joints3d[0]) - keypoints)[:, hand].norm(dim=-1)
    seen = (found.joints2d[0] - keypoints)[:, hand].norm(dim=-1)
    assert float(away.mean()) > 30 and float(seen.mean()) < 9
    std = found.covariance2d[0, :, hand].diagonal(dim1=-2, dim2=-1).sqrt()
    assert 2.0 < float(std.mean()) < 3.0  # less than that of the keypoint


def test_pixels_of_measured_joints_are_products_of_two_gaussians():
    generator = torch.Generator().manual_seed(0)
    uv, z = torch.randn(2, 1, 5, 8, 2, generator=generator, dtype=torch.float64)
    roots = torch.randn(2, 1, 5, 8, 2, 2, generator=generator, dtype=torch.float64)
    covs, noise = roots @ roots.mT + 0.1 * torch.eye(2)
    mask = torch.rand(1, 5, 8, generator=generator) < 0.6
    mean, cov = _with_keypoints(uv, covs, MeasuredJoints(z, mask, noise))
    precise = torch.linalg.inv(torch.linalg.inv(covs) + torch.linalg.inv(noise))
    between = torch.linalg.solve(covs, uv[..., None]) + torch.linalg.solve(noise, z[..., None])
    expected = (precise @ between)[..., 0]
    torch.testing.assert_close(mean, torch.where(mask[..., None], expected, uv))
    torch.testing.assert_close(cov, torch.where(mask[..., None, None], precise, covs))
