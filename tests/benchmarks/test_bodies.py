"""What the protocols over whole bodies share: splits, cameras, true outlines, walks in a loop."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.bodies import clips as body_clips
from benchmarks.bodies.silhouettes import true_silhouettes
from tests.benchmarks.walkers import write_walkers
from torchpose.demo._rendering.clothed_body import TrueShape, true_limbs
from torchpose.errors import InputError
from torchpose.io import read_mocap


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    return read_mocap(write_walkers(tmp_path_factory.mktemp("mocap")))


# --- who is tracked with what ---------------------------------------------------------------------


def test_own_trials_train_but_never_the_tracked_one(clips):
    for split in body_clips.split_clips(clips, n_clips=2, manifold_frames=60):
        assert split.seen and [c.trial[-1] for c in split.test] == ["0", "1"]
        for part in (split.manifold, split.validation, split.body):
            assert part and {c.person for c in part} == {split.person}
            assert not {c.trial for c in part} & {c.trial for c in split.test}
        assert not {c.trial for c in split.manifold} & {c.trial for c in split.validation}
        assert sum(map(len, split.manifold)) == 60


def test_others_train_for_someone_unseen(clips):
    (split,) = body_clips.split_clips(clips, ["p1"], ["p2"])
    assert not split.seen and split.person == "p2"
    for part in (split.manifold, split.validation):
        assert {c.person for c in part} == {"p1"}
    assert {c.person for c in split.body} == {"p2"}
    assert not {c.trial for c in split.body} & {c.trial for c in split.test}


def test_too_few_trials_are_refused(clips):
    with pytest.raises(InputError, match="person p1: expected two trials or more"):
        body_clips.split_clips(clips, ["p1"], ["p1"], n_clips=3)


def renamed(clips, action):
    """The same motion under another action's name."""
    return [
        replace(clip, action=action, trial=clip.trial.replace("_", f"_{action}_")) for clip in clips
    ]


def test_an_unseen_action_is_tracked_with_a_manifold_of_another(clips):
    (split,) = body_clips.split_clips(
        clips, ["p1"], ["p1"], manifold_frames=60, tracked=renamed(clips, "run")
    )
    assert split.seen and [c.trial for c in split.test] == ["p1_run_0"]
    for part in (split.manifold, split.validation):
        assert {(c.person, c.action) for c in part} == {("p1", "walk")}
    assert split.body[0].action == "walk"
    assert "p1_run_0" not in {c.trial for c in split.body}
    (split,) = body_clips.split_clips(
        [c for c in clips if c.person == "p1"], ["p1"], ["p2"], tracked=renamed(clips, "run")
    )
    assert not split.seen and {c.person for c in split.manifold} == {"p1"}
    assert {(c.person, c.action) for c in split.body} == {("p2", "run")}
    assert not {c.trial for c in split.body} & {c.trial for c in split.test}


# --- cameras and truth ----------------------------------------------------------------------------


def test_cameras_stand_around_the_way_and_see_all_of_it(clips):
    clip = clips[0]
    rig = body_clips.place_cameras(clip)
    assert len(rig) == 3 and rig.size == (480, 640)
    assert body_clips.in_view(clip, rig).tolist() == [1.0, 1.0, 1.0]
    places = -(rig.rotation.mT @ rig.translation[..., None]).squeeze(-1)
    middle = clip.joints[:, 0, [0, 2]]
    middle = (middle.amin(0) + middle.amax(0)) / 2
    gap = places[:, [0, 2]] - middle
    np.testing.assert_allclose(gap.norm(dim=-1).numpy(), 3.8)
    bearing = torch.atan2(gap[:, 0], gap[:, 1]).rad2deg().remainder(360)  # +x is to the left of +z
    np.testing.assert_allclose(bearing.numpy(), body_clips.AZIMUTHS, atol=1e-6)
    up = rig.rotation @ clip.up
    assert bool((up[:, 1] < -0.9).all()) and bool((up[:, 0].abs() < 1e-9).all())  # upright
    centre = rig(torch.stack([middle[0], torch.tensor(0.95 + 0.1), middle[1]])[None]).pixels
    assert bool(((centre[:, 0] - torch.tensor([319.5, 239.5])).abs() < 25).all())


def test_someone_who_leaves_the_image_is_counted(clips):
    clip = clips[0]
    rig = body_clips.place_cameras(clip, focal=1500.0)
    view = rig(clip.joints)
    inside = (view.pixels >= -0.5).all(-1) & (view.pixels < torch.tensor([639.5, 479.5])).all(-1)
    expected = inside.double().mean((0, 2))
    torch.testing.assert_close(body_clips.in_view(clip, rig), expected)
    assert bool((expected < 0.9).any())


def test_true_silhouettes_cover_the_recorded_joints(clips):
    clip = clips[5].cut(0, 8)
    rig = body_clips.place_cameras(clip)
    seen = true_silhouettes(clip, TrueShape.draw(1), rig)
    pixels = rig(clip.joints).pixels.round().long()
    t = torch.arange(8)[:, None, None]
    c = torch.arange(3)[None, :, None]
    assert bool(seen[t, c, pixels[..., 1], pixels[..., 0]].all())
    height = clip.joints[..., 1].amax() - clip.joints[..., 1].amin()
    limbs = true_limbs(clip, TrueShape.draw(1))
    top = (limbs.start[..., 1] + limbs.radii[:, 0]).amax(1)
    assert bool((top - clip.joints[..., 1].amax(1) < 0.25 * height).all())


def test_true_bodies_differ_from_each_other_and_stay_the_same():
    one, again, other = TrueShape.draw(1), TrueShape.draw(1), TrueShape.draw(2)
    assert one == again and one != other
    factors = torch.tensor([list(TrueShape.draw(s).radii.values()) for s in range(200)]).log()
    assert float(factors.std()) == pytest.approx(0.12, abs=0.01)
    assert abs(float(factors.mean())) < 0.01


def test_faults_come_from_the_generator(clips):
    clip = clips[0].cut(0, 4)
    rig = body_clips.place_cameras(clip).scaled(48, 64)
    clean, first, second, third = (
        true_silhouettes(clip, TrueShape.draw(1), rig, faults, torch.Generator().manual_seed(seed))
        for faults, seed in ((0.0, 0), (1.0, 0), (1.0, 0), (1.0, 1))
    )
    assert bool((first == second).all())
    assert not bool((first == third).all()) and not bool((first == clean).all())


def test_a_looped_walk_goes_on_without_a_jump(clips):
    clip = clips[0]
    looped = body_clips.looped(clip, 3)
    assert len(looped) % 3 == 0 and "looped 3 times" in looped.trial
    length = len(looped) // 3
    assert length == pytest.approx(60, abs=2)  # the period of the first trial
    torch.testing.assert_close(looped.joints[:length], looped.joints[length : 2 * length])
    steps = (looped.joints[1:] - looped.joints[:-1]).norm(dim=-1).amax(1)
    assert float(steps.max()) < 1.3 * float(steps[10 : length - 10].max())
    pelvis = looped.joints[:, 0]
    assert float((pelvis - pelvis.mean(0)).norm(dim=-1).max()) < 0.05  # on the spot
    with pytest.raises(InputError, match="once or more"):
        body_clips.looped(clip, 0)
    with pytest.raises(InputError, match="a cycle needs"):
        body_clips.looped(clip.cut(0, 30), 2)
