"""Training states: which frames are used, how often, from where, with which neck."""

import math
import re
from collections import namedtuple
from dataclasses import replace

import pytest
import torch

from tests.priors.poses import lowered_neck, poses, recording
from torchpose.camera import ViewRange, lift
from torchpose.demo import performer
from torchpose.errors import InputError, PriorError
from torchpose.learning import TRAINING_VIEWS, fit_upper_body_prior
from torchpose.learning._recipes import UpperBodyRecipe, calibration
from torchpose.learning._recipes.calibration import MODES, _noisy_keypoints, track_held_out
from torchpose.learning._samplers import all_samples
from torchpose.learning._training import arm_sources, collect_poses, short_paths
from torchpose.math import euler_to_matrix as rotate
from torchpose.metrics import align
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import UpperBodyTracker

Fitted = namedtuple("Fitted", "left right facts")
NECK = UPPER_BODY.index("neck")
MATRIX = torch.tensor([[525.0, 0, 319.5], [0, 525.0, 239.5], [0, 0, 1]], dtype=torch.float64)


def states(*recordings, seed=0, **options):
    sources = arm_sources(collect_poses(recordings), MATRIX, seed, **options)
    right = None if sources.right is None else all_samples(sources.right).states
    return Fitted(all_samples(sources.left).states, right, sources.facts)


def body_of(state):
    """Joints [N, 5, 3] that the states were made from."""
    rotation = rotate(state[:, 15:18])
    return lift(state[:, :15].reshape(-1, 5, 3), MATRIX, rotation, state[:, 18:])


def test_states_hold_the_poses_centred_on_the_neck():
    joints = poses(50)
    fitted = states(recording(joints), mirror=False, views_per_pose=1)
    expected = (joints - joints[:, 4:5]).sort(0).values
    torch.testing.assert_close(body_of(fitted.left).sort(0).values, expected[:, :5])
    torch.testing.assert_close(body_of(fitted.right).sort(0).values, expected[:, [7, 6, 5, 3, 4]])


def test_mirrored_arms_are_pooled():
    fitted = states(recording(poses(50)), views_per_pose=2)
    assert fitted.right is None and len(fitted.left) == 200
    assert fitted.facts["mirrored"] and fitted.facts["n_samples"] == 200
    assert float(body_of(fitted.left)[:, 2, 0].min()) > 0  # all shoulders are left shoulders


def test_views_lie_within_their_limits_and_fill_them():
    fitted = states(recording(), n_samples=5000)
    view = fitted.left[:, 15:]
    limit = torch.tensor([math.radians(15)] * 3, dtype=torch.float64)
    assert bool((view[:, :3].abs() <= limit).all())
    low, high = view[:, 3:].min(0).values, view[:, 3:].max(0).values
    for axis, (least, most) in enumerate((TRAINING_VIEWS.tx, TRAINING_VIEWS.ty, TRAINING_VIEWS.tz)):
        assert least <= float(low[axis]) < least + 0.01
        assert most - 0.01 < float(high[axis]) <= most


def test_every_pose_is_used_as_often_as_any_other():
    fitted = states(recording(poses(7)), mirror=False, n_samples=24)
    hands = body_of(fitted.left)[:, 0].round(decimals=6)
    counts = hands.unique(dim=0, return_counts=True)[1]
    assert len(counts) == 7 and set(counts.tolist()) == {3, 4}


def test_frames_with_missing_joints_are_left_out_and_counted():
    joints = poses(20)
    joints[:5, 0] = torch.nan  # left hand
    joints[3:10, 7] = torch.nan  # right hand
    fitted = states(recording(joints), views_per_pose=1)
    assert len(fitted.left) == 15 + 13
    assert fitted.facts["extra"]["frames_left_out"] == {"left": 5, "right": 7}
    assert fitted.facts["n_frames"] == 18
    joints[:, 3] = torch.nan
    with pytest.raises(InputError, match="left arm"):
        states(recording(joints))


@pytest.mark.parametrize("seed", [-1, 1.5, None])
def test_other_seeds_are_refused(seed):
    with pytest.raises(InputError, match="seed must be a whole number from 0 on"):
        fit_upper_body_prior([recording(poses(10))], 2, seed, n_samples=20)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("mirror_share", 2.0, "mirror_share must lie in 0..1, got 2"),
        ("body_size", -0.3, "body_size must lie in 0..0.9"),
        ("bone_lengths", 1.0, "bone_lengths must lie in 0..0.9"),
        ("pose_tol", float("nan"), "pose_tol must be finite"),
    ],
)
def test_settings_out_of_range_are_refused(name, value, said):
    """They gave priors of bodies inside out, and of windows that all are mirrored."""
    with pytest.raises(InputError, match=re.escape(said)):
        UpperBodyRecipe(**{name: value})


def test_facts_name_persons_sources_and_frame_rate():
    parts = [recording(poses(10), "b", fps=30.0), recording(poses(30), "a", fps=25.0),
             recording(poses(5), "b", source="")]  # fmt: skip
    facts = collect_poses(parts).facts
    assert facts["persons"] == ("#b", "site:set#a", "site:set#b") or len(facts["persons"]) == 3
    assert "site:set@1" in facts["sources"]
    assert facts["fps"] == 25.0 and facts["neck"] == "neck" and facts["hand"] == "hand"


def test_rates_of_jittering_time_stamps_count_as_one():
    stamped = [recording(poses(10), fps=30.0 + 0.01 * i) for i in range(6)]
    facts = collect_poses([*stamped, recording(poses(20), fps=120.0)]).facts
    assert facts["fps"] == pytest.approx(30.0, abs=0.06)


@pytest.mark.slow
def test_held_out_persons_are_tracked_at_the_rates_of_their_recordings(monkeypatch):
    """A person who is recorded at both rates has the errors of both recordings by themselves."""
    people = [recording(film(40, seed), f"p{seed}") for seed in range(3)]
    recipe = UpperBodyRecipe(
        n_components=2, n_samples=400, pose_steps=3, window_components=2, window_samples=200,
        window_steps=2, calibration_folds=0,
    )  # fmt: skip
    prior = recipe.fit(people)
    slow, fast = recording(film(45, 5), "new"), recording(film(90, 7, 60.0), "new", fps=60.0)

    def held_out(*recordings, drawn=0):
        poses_of = recipe.poses([*people, *recordings])
        return track_held_out(prior, poses_of, {recordings[0].person_id}, 0, drawn)

    both, apart = held_out(slow, fast), (held_out(slow), held_out(fast))
    for mode in MODES:
        wanted = torch.cat([part[mode].errors for part in apart])
        torch.testing.assert_close(both[mode].errors, wanted)
    test = recipe.poses([fast])
    keypoints, truth, inside = _noisy_keypoints(prior, [test.joints], 0)
    track = UpperBodyTracker(
        prior, prior.camera, calibrated=False, fps=60.0, method="window-mixture"
    )
    found = align(track(keypoints, lengths=inside.sum(1)).joints3d[0], truth[0]).points - truth[0]
    torch.testing.assert_close(apart[1]["causal"].errors, found)
    monkeypatch.setattr(calibration, "DRAWN", {"mkf_sampled": {"method": "mkf-sampled"}})
    monkeypatch.setattr(calibration, "_SHORT", 20)
    assert len(held_out(fast, drawn=1)["mkf_sampled"].errors) == 40  # as long as 20 of the prior


def test_errors_of_the_mean_pose_on_held_out_persons():
    """Of somebody who stands in it, turned, and of somebody whose left hand is 8 cm elsewhere."""
    prior = fit_upper_body_prior([recording()], 2, n_samples=400)
    mean = prior.mean_pose().double()
    turned = mean @ rotate(torch.tensor([0.1, -0.2, 0.3]).double()).mT
    other = mean.clone()
    other[0, 2] += 0.08
    people = [
        recording(pose.expand(n, 8, 3), who)
        for who, pose, n in (("a", turned, 20), ("b", other, 30))
    ]
    of_all = collect_poses(people)
    found = calibration.still_poses(prior, of_all, {"site:set#a", "site:set#b"})
    assert found.persons.count("site:set#b") == 30
    errors = found.error_by_person()
    assert errors["site:set#a"] == pytest.approx(0.0, abs=1e-9)
    assert errors["site:set#b"] == pytest.approx(0.01, abs=1e-9)  # of eight joints
    assert calibration.still_poses(prior, of_all, {"nobody"}) is None


def film(n_frames, seed, fps=30.0):
    """The performer of the demonstration, in front of the camera."""
    return performer(n_frames, fps=fps, seed=seed).body.double()


def test_low_necks_are_converted():
    joints = poses()
    high, low = recording(joints), recording(lowered_neck(joints))
    together = collect_poses([high, low])
    assert together.facts["neck"] == "neck"
    assert together.facts["extra"]["frames_with_converted_neck"] == 300
    whole, converted = together.joints.split(300)
    residual = together.facts["extra"]["neck_offset"]["residual"]
    # hands relative to the neck differ by no more than the necks do
    gap = (whole - converted)[:, 0].norm(dim=-1).square().mean().sqrt()
    assert float(gap) == pytest.approx(residual, rel=1e-6) and residual < 0.03


def test_one_kind_of_neck_stays_and_an_unknown_one_is_refused():
    low = recording(lowered_neck(poses()))
    alone = collect_poses([low])
    assert alone.facts["neck"] == "mid-shoulder" and "neck_offset" not in alone.facts["extra"]
    with pytest.raises(PriorError, match="neck offset"):
        collect_poses([low], neck="neck")
    with pytest.raises(PriorError, match="throat"):
        collect_poses([low], neck="throat")


def test_a_neck_that_these_lack_is_where_others_have_it():
    low, high = recording(lowered_neck(poses(seed=1))), recording(poses(seed=2))
    found = collect_poses([low], neck="neck", others=[low, high])
    together = collect_poses([low, high])
    assert torch.equal(found.joints, together.joints[:300]) and found.facts["neck"] == "neck"
    assert collect_poses([high], others=[low]).joints.equal(collect_poses([high]).joints)


@pytest.mark.parametrize("neck", [None, "neck"])
def test_held_out_persons_have_the_neck_of_the_others(neck, monkeypatch):
    """One person alone has a neck of the wanted kind; without that person the others keep their own."""
    people = [
        recording(lowered_neck(poses(60, seed=1)), "a"),
        recording(lowered_neck(poses(60, seed=2)), "b"),
        recording(poses(60, seed=3), "c"),
    ]
    asked = []
    monkeypatch.setattr(
        "torchpose.learning._recipes.upper_body.track_held_out",
        lambda prior, poses, *_: asked.append((prior.info.neck, poses)) or {},
    )
    recipe = UpperBodyRecipe(
        n_components=2, n_samples=300, pose_steps=2, window_components=0, neck=neck
    )
    recipe.hold_out(people, {people[2].person_id})
    recipe.hold_out(people, {people[0].person_id})
    assert [(kind, held.facts["neck"]) for kind, held in asked] == [
        ("mid-shoulder", "mid-shoulder"), ("neck", "neck")
    ]  # fmt: skip
    middle = asked[0][1].joints[-60:, [2, 5]].mean(1)  # of the person held out, centred on the neck
    assert float(middle.norm(dim=-1).max()) < 0.05
    without = [n for n in UPPER_BODY if n != "neck"]
    part = recording(poses(40)[:, [UPPER_BODY.index(n) for n in without]], "d", without)
    assert recipe.hold_out([people[2], part], {people[2].person_id}) == {} and len(asked) == 2


def test_missing_necks_are_placed():
    without = [n for n in UPPER_BODY if n != "neck"]
    index = [UPPER_BODY.index(n) for n in without]
    part = recording(poses(40)[:, index], names=without)
    together = collect_poses([recording(), part])
    assert bool(torch.isfinite(together.joints).all())


def test_hands_and_wrists_are_not_mixed():
    wrists = [n.replace("hand", "wrist") for n in UPPER_BODY]
    with pytest.raises(PriorError, match="hand and wrist"):
        collect_poses([recording(), recording(names=wrists)])


@pytest.mark.parametrize("centre", ["neck", "head", "sequence"])
def test_centre(centre):
    joints = collect_poses([recording(poses(40))], centre=centre).joints
    at = joints[:, 3 if centre == "head" else 4]
    assert float((at.mean(0) if centre == "sequence" else at).abs().max()) < 1e-12


def test_bad_settings_are_refused():
    with pytest.raises(InputError, match="at least one recording"):
        collect_poses([])
    with pytest.raises(PriorError, match="centre"):
        collect_poses([recording()], centre="hip")
    with pytest.raises(InputError, match="not both"):
        states(recording(), n_samples=10, views_per_pose=1)
    with pytest.raises(InputError, match="at least 1"):
        states(recording(), n_samples=0)
    with pytest.raises(InputError, match="tx"):
        states(recording(), view_range=ViewRange(tx=(0.0, 0.5)))


def walking(n_frames, step):
    """Somebody who goes on without moving a limb."""
    ahead = torch.arange(n_frames, dtype=torch.float64)[:, None, None] * step
    return recording(poses(1, 0) + ahead, person="walker", fps=30.0)


def test_long_paths_are_cut_into_short_ones():
    far, still = walking(100, torch.tensor([0.0, 0.0, -0.04])), walking(20, torch.zeros(3))
    gap = far.joints.clone()
    gap[30:35] = torch.nan
    whole = collect_poses([replace(far, joints=gap), still], centre="sequence")
    found = short_paths(whole, 0.4)
    assert sum(found.lengths) == 120 and found.lengths[-1] == 20
    assert len(found.rates) == len(found.persons) == len(found.lengths)
    parts = found.joints.split(found.lengths)
    for part in parts:
        necks = part[:, NECK]
        assert float((necks.nan_to_num().amax(0) - necks.nan_to_num().amin(0)).norm()) <= 0.4
        assert float(necks.nanmean(0).abs().max()) < 1e-12
    assert min(found.lengths[:-2]) >= 10  # no part is shorter than it has to be
    bodies = [set_of.joints - set_of.joints[:, NECK, None] for set_of in (found, whole)]
    torch.testing.assert_close(*bodies, equal_nan=True)


def test_somebody_who_walks_past_the_camera_has_steps_too():
    """Four metres towards the camera, whose usual place is two metres away."""
    step = torch.tensor([0.0, 0.0, -0.04])
    recipe = UpperBodyRecipe(
        2, 500, pose_steps=3, window_components=0, calibration_folds=0, mirror=False
    )
    prior = recipe.fit([walking(100, step), recording(person="other")])
    found = recipe.process_noise(prior, [walking(100, step)])["increment_cov_left"]
    # turned by the views' angles, and as long as it was; less than a thousandth more keeps Q regular
    assert float(found[18:, 18:].trace()) == pytest.approx(0.04**2, rel=1e-3)
