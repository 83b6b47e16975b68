"""Fits on some persons scored on others: what is kept, who is refused, what arms do."""

import pickle
import time
from dataclasses import replace
from multiprocessing import active_children
from multiprocessing.reduction import ForkingPickler

import pytest
import torch

from tests.evaluation.recordings import poses, poses_to_score, small_recipe, write_one, write_people
from torchpose.camera import ViewRange, sample_viewpoints
from torchpose.errors import InputError, OverlapError, PriorError
from torchpose.evaluation import _person_recordings as persons_module
from torchpose.evaluation import _unseen as unseen
from torchpose.evaluation._completion import with_wrists
from torchpose.evaluation._person_tables import mean_error
from torchpose.evaluation._trials import CAMERA, centred_on_neck, make_test_set, track
from torchpose.io import read_recordings
from torchpose.metrics import joint_errors_3d
from torchpose.priors._arm_state import arm_states
from torchpose.skeleton import UPPER_BODY


@pytest.fixture(scope="module")
def persons(tmp_path_factory):
    folder = write_people(tmp_path_factory.mktemp("data") / "set", ("s1", "s2", "s10"))
    return persons_module.by_person(read_recordings(folder))


@pytest.fixture(scope="module")
def prior(persons):
    return small_recipe(persons["s1"] + persons["s2"], 2)


def counting_recipe(recordings, **options):
    """`small_recipe` that leaves a mark for every fit."""
    CALLS.append(len(recordings))
    options.pop("calibration_folds", None)
    return small_recipe(recordings, **options)


CALLS: list[int] = []


def test_persons_are_told_apart_and_in_order(persons, tmp_path):
    assert list(persons) == ["s1", "s2", "s10"]
    for name in ("a", "b"):
        write_people(tmp_path / name, ("s1",))
    recordings = [replace(r, source="") for n in ("a", "b") for r in read_recordings(tmp_path / n)]
    assert list(persons_module.by_person(recordings)) == ["a#s1", "b#s1"]


def test_scores_are_those_of_tracker_and_metrics(persons, prior):
    sequences = poses_to_score(persons["s10"], prior, persons["s1"])
    found = unseen.score_person(prior, sequences, 30.0, unseen.ScoreSettings(seed=2))
    test = make_test_set(sequences, CAMERA, 30.0, 2)
    expected = joint_errors_3d(track(prior, CAMERA, test).joints3d, test.truth3d)
    torch.testing.assert_close(found.filtered, expected[test.inside].float())
    assert mean_error(found) == pytest.approx(100 * float(expected.nanmean()), rel=1e-5)
    assert found.inside.shape == (30, 2, 8)
    assert bool((found.inside[:, 0] <= found.inside[:, 1]).all())
    views = sample_viewpoints(30, ViewRange(**prior.info.views), torch.Generator().manual_seed(2))
    left, right = arm_states(torch.cat(sequences), views, prior.info.matrix)
    both = torch.stack([prior.left.log_prob(left), prior.right.log_prob(right)])
    torch.testing.assert_close(found.log_likelihood, both.mean(0))


def test_sequences_are_tracked_at_their_own_rates(persons, prior, tmp_path):
    """The scores of a person at two rates are those of both recordings by themselves."""
    (slow,) = persons["s10"]
    both = [slow, replace(slow, fps=60.0)]
    known = persons["s1"] + persons["s2"]
    job = unseen.Job("s10", known, {"s10": both}, {"seed": 0, "n_components": 2}, small_recipe)
    (found,) = unseen.run_jobs([job], tmp_path)
    fitted = small_recipe(known, 2)
    sequences = poses_to_score([slow], fitted, known)
    apart = [unseen.score_person(fitted, sequences, rate, job.test) for rate in (30.0, 60.0)]
    torch.testing.assert_close(found["s10"].filtered, torch.cat([one.filtered for one in apart]))
    assert not apart[0].filtered.equal(apart[1].filtered)


def test_a_joint_that_does_not_count_changes_nothing(persons, prior):
    settings = unseen.ScoreSettings(unmeasured=("head",), unscored=("head",), likelihood=False)
    sequences = poses_to_score(persons["s10"], prior, persons["s1"])
    moved = [s.clone() for s in sequences]
    for s in moved:
        s[:, UPPER_BODY.index("head")] += 0.05
    first, second = (unseen.score_person(prior, s, 30.0, settings) for s in (sequences, moved))
    torch.testing.assert_close(first.filtered, second.filtered, equal_nan=True)
    head = UPPER_BODY.index("head")
    assert bool(first.filtered[:, head].isnan().all()) and bool(
        first.inside[..., head].isnan().all()
    )
    assert int(first.filtered.isfinite().sum()) == 30 * 7
    assert bool(first.log_likelihood.isnan().all())


def test_fits_and_scores_are_kept(persons, tmp_path, monkeypatch):
    job = unseen.Job(
        "s10", persons["s1"] + persons["s2"], {"s10": persons["s10"]},
        {"n_components": 2, "seed": 0, "calibration_folds": 0}, counting_recipe,
    )  # fmt: skip
    CALLS.clear()
    (first,) = unseen.run_jobs([job], tmp_path)
    monkeypatch.setattr(unseen, "score_person", lambda *_: pytest.fail("scored again"))
    (again,) = unseen.run_jobs([job], tmp_path)
    assert CALLS == [2]
    for a, b in zip(first["s10"], again["s10"], strict=True):
        torch.testing.assert_close(a, b, equal_nan=True, rtol=0, atol=0)
    monkeypatch.undo()
    for path in tmp_path.glob("scores-*.npz"):
        path.write_bytes(path.read_bytes()[:80])  # damaged
    (third,) = unseen.run_jobs([job], tmp_path)
    torch.testing.assert_close(third["s10"].filtered, first["s10"].filtered)
    other = replace(job, test=unseen.ScoreSettings(seed=1))
    (noisy,) = unseen.run_jobs([other], tmp_path)
    assert not torch.equal(noisy["s10"].filtered, first["s10"].filtered)


@pytest.mark.slow
def test_processes_find_the_same(persons, tmp_path):
    jobs = [
        unseen.Job(
            name, [r for n, g in persons.items() if n != name for r in g], {name: persons[name]},
            {"n_components": 2, "seed": 0}, small_recipe,
        )
        for name in ("s1", "s2")
    ]  # fmt: skip
    one = unseen.run_jobs(jobs, tmp_path)
    (tmp_path / "two").mkdir()
    two = unseen.run_jobs(jobs, tmp_path / "two", workers=2)
    for a, b in zip(one, two, strict=True):
        assert a.keys() == b.keys()
        for name in a:
            torch.testing.assert_close(a[name].filtered, b[name].filtered)


def test_jobs_are_sent_without_open_files(persons):
    """A thousand recordings were too many."""
    job = unseen.Job("a", persons["s1"], {}, {}, small_recipe)
    sent = bytes(ForkingPickler.dumps(unseen.AsBytes(job)))
    assert len(sent) > sum(r.joints.nbytes for r in persons["s1"])
    assert torch.equal(pickle.loads(sent).train[0].joints, persons["s1"][0].joints)


def failing_recipe(*_, **__):
    """A fit that fails while another one is at work."""
    time.sleep(1)
    raise InputError("a bad fit")


def endless_recipe(*_, **__):
    """A fit that takes longer than the test."""
    time.sleep(30)


@pytest.mark.slow
def test_what_ends_the_work_ends_all_processes(persons, tmp_path):
    """They finished their fits, of minutes, and those in their queue."""
    jobs = [
        unseen.Job(name, persons["s1"], {"s2": persons["s2"]}, {}, recipe)
        for name, recipe in (("a", failing_recipe), ("b", endless_recipe), ("c", endless_recipe))
    ]
    with pytest.raises(InputError, match="a bad fit"):
        unseen.run_jobs(jobs, tmp_path, workers=2)
    assert not active_children()


def test_a_person_of_the_training_set_is_refused(persons, tmp_path):
    job = unseen.Job(
        "leak", persons["s1"] + persons["s2"], {"s2": persons["s2"]},
        {"n_components": 2, "seed": 0}, small_recipe,
    )  # fmt: skip
    with pytest.raises(OverlapError, match="#s2"):
        unseen.run_jobs([job], tmp_path)
    mine = persons_module.renamed(persons["s2"], "first half")
    unseen.run_jobs([replace(job, train=mine)], tmp_path)  # said to be another one


def test_sequences_are_cut_where_joints_are_missing(persons, prior):
    (recording,) = persons["s10"]
    joints = recording.joints.clone()
    joints[12, recording.names.index("left_hand")] = torch.nan
    pieces = poses_to_score([replace(recording, joints=joints)], prior, persons["s1"])
    assert [len(p) for p in pieces] == [12, 17]
    joints[::8] = torch.nan
    with pytest.raises(InputError, match="s10: no 10 frames in a row"):
        poses_to_score([replace(recording, joints=joints)], prior, persons["s1"], "s10")


def test_necks_are_converted_and_wrists_refused(persons, prior, tmp_path):
    (other,) = read_recordings(write_one(tmp_path / "one"))
    joints = other.joints.clone()
    joints[:, 4] = (joints[:, 2] + joints[:, 5]) / 2
    low = replace(other, joints=joints, skeleton="")
    assert low.upper_body().neck == "mid-shoulder"
    (found,) = poses_to_score([low], prior, persons["s1"] + persons["s2"])
    middle = (found[:, 2] + found[:, 5]) / 2
    gap = (found[:, 4] - middle).norm(dim=-1)
    own = torch.cat([r.upper_body().joints for r in persons["s1"] + persons["s2"]])
    wanted = (own[:, 4] - (own[:, 2] + own[:, 5]) / 2).norm(dim=-1)
    assert float(gap.mean()) == pytest.approx(float(wanted.mean()), abs=0.02)
    assert bool((found[:, 4] == 0).all())
    with pytest.raises(PriorError, match="wrists"):
        poses_to_score([with_wrists(r) for r in persons["s10"]], prior, persons["s1"])


def test_what_arms_do():
    pose = centred_on_neck(poses(1, 0))[0]
    pose[[2, 5]] = torch.tensor([[0.2, 0.1, 0.0], [-0.2, 0.1, 0.0]]).double()

    def left(*hand):
        changed = pose.clone()
        changed[0] = torch.tensor(hand)
        return int(persons_module.pose_classes(changed[None])[0, 0])

    assert persons_module.POSE_CLASSES[left(0.2, 0.0, -0.3)] == "raised"
    assert persons_module.POSE_CLASSES[left(-0.1, 0.3, -0.3)] == "crossed"
    assert persons_module.POSE_CLASSES[left(0.25, 0.6, 0.0)] == "near the body"
    assert persons_module.POSE_CLASSES[left(0.2, 0.3, -0.5)] == "reaching out"
    pose[7] = torch.tensor([0.1, 0.3, -0.3])
    assert (
        persons_module.POSE_CLASSES[int(persons_module.pose_classes(pose[None])[0, 1])] == "crossed"
    )


def test_pooled_frames_and_spread(persons, prior):
    parts = [
        unseen.score_person(
            prior, poses_to_score(group, prior, persons["s1"]), 30.0, unseen.ScoreSettings()
        )
        for group in persons.values()
    ]
    whole = unseen.pooled(parts)
    assert len(whole.filtered) == sum(len(p.filtered) for p in parts)
    assert mean_error(whole) == pytest.approx(sum(map(mean_error, parts)) / 3, rel=1e-4)
    assert persons_module.spread([1.0, 3.0, float("nan")]) == (2.0, pytest.approx(2**0.5))
    assert persons_module.spread([2.0])[1] != persons_module.spread([2.0])[1]  # NaN
