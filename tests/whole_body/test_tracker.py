"""BodyTracker: what the stages give by hand, live as in one go, and what it refuses."""

import math
from functools import partial

import pytest
import torch

from tests.whole_body.filters.walking_body import HEIGHT, WIDTH, rig, walk, walker
from torchpose.body import BODY_15, Body
from torchpose.errors import CameraError, InputError, NobodySeenError, PriorError, ShapeError
from torchpose.learning import fit_limb_conditionals
from torchpose.priors._limb_conditionals import in_body_frame
from torchpose.whole_body import (
    METHODS,
    AnnealedParticleFilter,
    BodyTrack,
    BodyTracker,
    SilhouetteParticleFilter,
    SIRParticleFilter,
    default_step_std,
    find_first_pose,
    register_body_filter,
    render,
    reweight,
    track_body,
)
from torchpose.whole_body._filter_table import BodyTrackerOptions, choose_method, method_options
from torchpose.whole_body._filters.body_particles import BodyFilterOptions
from torchpose.whole_body._following import which_see


@pytest.fixture(scope="module")
def scene():
    """States of a walk, and what three cameras see of them."""
    states = walk(walker(), 8, phase=1.0)
    return states, render(walker(), states, rig(), HEIGHT, WIDTH)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def tensors(poses):
    return {
        name: getattr(poses, name)
        for name in (
            "state", "state_std", "joints3d", "covariance3d", "log_evidence",
            "effective_sample_size", "coasting", "respread",
        )
    }  # fmt: skip


def assert_same(a, b):
    for name, value in tensors(a).items():
        torch.testing.assert_close(
            value, tensors(b)[name], rtol=0, atol=0, equal_nan=True, msg=name
        )


def test_it_does_what_the_stages_do_by_hand(scene, monkeypatch):
    states, silhouettes = scene
    search = partial(find_first_pose, n_particles=600, n_tracking=100)  # a third of the usual
    monkeypatch.setattr("torchpose.whole_body._particle_follower.find_first_pose", search)
    seen = torch.cat([torch.zeros_like(silhouettes[:2]), silhouettes])
    poses = BodyTracker(rig(), body=walker(), n_particles=100, fps=12.0)(seen, generator=seeded())
    g = seeded()
    start = search(walker(), silhouettes[:6], rig(), None, g, fps=12.0).state
    step = default_step_std(walker()) * math.sqrt(60 / 12)
    model = AnnealedParticleFilter(walker(), 20, process_cov=step.square(), sharpness=100.0)
    by_hand = track_body(
        model, silhouettes, rig(), start, generator=g, initial_cov=(2 * step).square()
    )
    assert_same(poses, by_hand)
    assert (poses.first_frame, poses.method, poses.fps) == (2, "apf", 12.0)
    assert "first 2 frames" in poses.notes[-1]
    error = (poses.joints3d - walker().joints(states)).norm(dim=-1).mean()
    assert float(error) < 0.35


@pytest.mark.parametrize("method", ["sir", "apf"])
def test_live_gives_what_a_whole_run_gives(scene, method):
    states, silhouettes = scene
    tracker = BodyTracker(rig(), method, body=walker(), n_particles=60)
    whole = tracker(iter(silhouettes), states[0], generator=seeded())
    state = tracker.init(initial_state=states[0], generator=seeded())
    parts = []
    for frame in silhouettes[:3]:
        state, one = tracker.step(state, frame)
        assert (len(one), one.first_frame) == (1, len(parts))
        parts.append(one)
    parts.append(tracker.advance(state, silhouettes[3:])[1])
    for name, value in tensors(whole).items():
        torch.testing.assert_close(
            torch.cat([tensors(p)[name] for p in parts]), value, rtol=0, atol=1e-12, equal_nan=True
        )


def test_covariances_are_those_of_the_filter(scene):
    states, silhouettes = scene
    variances = torch.linspace(1e-4, 4e-4, 36, dtype=torch.float64)
    by_cov = BodyTracker(
        rig(), "sir", body=walker(), n_particles=60, process_cov=torch.diag(variances),
        initial_cov=4 * variances,
    )  # fmt: skip
    torch.testing.assert_close(by_cov.process_cov, variances)
    torch.testing.assert_close(by_cov.initial_cov, 4 * variances)
    with pytest.warns(DeprecationWarning, match="square as process_cov"):
        by_std = BodyTracker(rig(), "sir", body=walker(), n_particles=60, step_std=variances.sqrt())
    a, b = (t(silhouettes, states[0], generator=seeded()) for t in (by_cov, by_std))
    torch.testing.assert_close(a.state, b.state)
    full = torch.diag(variances) + 1e-6
    for bad, said in ((full, "must be diagonal"), (-variances, "must not be negative")):
        with pytest.raises(InputError, match=said):
            BodyTracker(rig(), "sir", process_cov=bad)
    with pytest.raises(InputError, match="leave one of them out"):
        BodyTracker(rig(), "sir", process_cov=variances, step_std=0.1)
    with pytest.raises(InputError, match="must be diagonal"):
        SIRParticleFilter(walker(), process_cov=full)
    one = SIRParticleFilter(walker(), process_cov=4e-4)
    torch.testing.assert_close(one.step_std, torch.full((36,), 0.02, dtype=torch.float64))


def test_models_put_the_body_into_their_frame(scene):
    states, silhouettes = scene
    moves = [walk(walker(), 40, seed=k, phase=k) for k in (1, 2)]
    limbs = fit_limb_conditionals(*in_body_frame([(walker(), moves)]), 30.0)
    tracker = BodyTracker(
        rig(), "root", body=walker(), conditionals=limbs, manifold="walk", n_particles=21 * 7
    )
    assert (tracker.method, tracker.filter.n_particles) == ("root", 21)
    assert (tracker.body.frame, tracker.upright.frame) == ("body", "parent")
    assert torch.equal(tracker.body.centres, limbs.centres)
    assert tracker.notes == (
        "the limbs' diffusion was learnt at 30 frames per second and rescaled to 60",
    )
    start = walker().convert(states[0], tracker.body)
    poses = tracker(silhouettes, start, generator=seeded())
    torch.testing.assert_close(poses.body.joints(poses.state), poses.joints3d)
    bodies = [m for m in tracker.modules() if isinstance(m, Body)]
    assert len(bodies) == 2
    with pytest.raises(PriorError, match="no such file"):
        BodyTracker(rig(), manifold="nowhere")


def test_results_keep_their_method_in_a_file(scene, tmp_path):
    states, silhouettes = scene
    tracker = BodyTracker(rig(), "sir", body=walker(), n_particles=30)
    poses = tracker(silhouettes, states[0], generator=seeded())
    assert not poses.joints3d.requires_grad
    assert int(poses.failed_at) == -1
    poses.save(tmp_path / "a.npz")
    found = BodyTrack.load(tmp_path / "a.npz")
    assert found.method == "sir"
    assert_same(found, poses)
    again = BodyTracker(rig(), body=tmp_path / "a.npz", n_particles=20)
    torch.testing.assert_close(again.body.bone_lengths, walker().bone_lengths)


def test_a_frame_counts_if_every_camera_sees_somebody():
    seen = torch.zeros(2, 10, 40, dtype=torch.bool)
    seen[0, 0, 0] = True
    assert which_see(seen).tolist() == [True, False]
    seen[1, 0, 0] = True
    assert which_see(seen).all()  # 1 of 400 pixels
    frames = torch.zeros(3, 3, HEIGHT, WIDTH, dtype=torch.bool)
    with pytest.raises(NobodySeenError, match="and by c0, c1, c2 in none; check"):
        BodyTracker(rig())(frames)
    frames[0, 0] = frames[1, 2] = True
    with pytest.raises(NobodySeenError, match="and by c1 in none; check"):
        BodyTracker(rig())(frames)
    frames[2, 1] = True
    with pytest.raises(NobodySeenError, match="in any frame; check"):
        BodyTracker(rig())(frames)
    with pytest.raises(CameraError, match="must be of 3 cameras"):
        BodyTracker(rig())(frames[:, :2])


@pytest.mark.parametrize(
    ("method", "options", "said"),
    [
        ("ekf", {}, "method must be one of kalman, mrpf, apf, sir, root, constrained"),
        ("mrpf", {}, "needs manifold, a manifold of the action's poses"),
        ("sir", {"action": "exercises"}, "leave it out or take method constrained"),
        ("sir", {"n_layers": 3}, "'n_layers' does nothing for method sir.*it is of apf"),
        ("root", {"conditionals": "walk", "sharpness": 3.0}, "'sharpness' does nothing for method"),
        ("apf", {"n_particles": 19}, "at least 20"),
        ("apf", {"n_particles": 23, "n_layers": 6}, "at least 24"),
        (None, {"action": "exercises", "conditionals": "walk"}, "choose by method root or constr"),
        (None, {"fps": 0.0}, "fps"),
        ("apf", {"n_layers": 0}, "n_layers must be at least 1"),
        ("apf", {"resample_threshold": 0.5}, "'resample_threshold' does nothing for method apf"),
        ("sir", {"limits": 3}, "limits must be a torchpose.body.JointLimits.* clamp, got int"),
        ("mrpf", {"manifold": 3}, "manifold must be a BackConstrainedGPLVM or the name"),
        ("root", {"conditionals": Body}, "conditionals must be a LimbConditionals or the name"),
        ("constrained", {"action": 3}, "action must be an ActionSpace or ActionBank or the name"),
        ("constrained", {"action": "exercises", "posture_body": 1.75}, "posture_body must be a"),
        ("constrained", {"action": "exercises", "max_redraws": 1.5}, "max_redraws must be a whole"),
        (None, {"fps": 1 / 30}, "1 / 0.0333 for frames that are 0.0333 s apart"),
    ],
)
def test_what_does_not_go_together_is_refused(method, options, said):
    with pytest.raises(InputError, match=said):
        BodyTracker(rig(), method, **options)
    with pytest.raises(InputError, match="got none"):
        BodyTracker(rig()).init()


def test_keypoints_are_given_by_name_and_as_tensors():
    frame = torch.full((2, 15, 2), 50.0)
    kalman, particles = BodyTracker(rig(), "kalman"), BodyTracker(rig(), "sir", n_particles=20)
    with pytest.raises(InputError, match="keypoints are given by name"):
        kalman.step(kalman.init(), frame)
    state = particles.init(initial_state=torch.zeros(36, dtype=torch.float64))
    for given, name in (
        ({"keypoints": frame.tolist()}, "keypoints"),
        ({"keypoints": frame, "confidence": frame[..., 0].numpy()}, "confidence"),
        ({"silhouettes": [[True]]}, "silhouettes"),
    ):
        with pytest.raises(InputError, match=f"{name} must be a tensor, got"):
            particles.step(state, **given)


def test_what_are_no_silhouettes_nor_a_pose_is_named(scene):
    states, silhouettes = scene
    tracker = BodyTracker(rig(), "sir", body=walker(), n_particles=20)
    for given, said in (
        (silhouettes.numpy(), "silhouettes must be a tensor, got ndarray"),
        ([frame.numpy() for frame in silhouettes], "silhouettes must be a tensor, got ndarray"),
        ("walk.mp4", "got str; read_silhouettes"),
        (8, "got int; read_silhouettes"),
        (silhouettes[:, 0], r"a frame of silhouettes must have shape \[C, H, W\]"),
    ):
        for run in (tracker, tracker.init):
            with pytest.raises((InputError, ShapeError), match=said):
                run(given)
    with pytest.raises(InputError, match="needs a frame of silhouettes, got none"):
        tracker.init(silhouettes[:0])
    with pytest.raises(InputError, match="initial_state must be a tensor, got ndarray"):
        tracker(silhouettes, states[0].numpy())
    with pytest.raises(InputError, match="lengths must be a tensor, got int"):
        tracker(silhouettes, states[0], lengths=3)


def test_a_direction_that_does_nothing_is_refused(scene):
    states, silhouettes = scene
    facing = torch.tensor([0.0, 0.0, 1.0])
    tracker = BodyTracker(rig(), "sir", body=walker(), n_particles=30)
    for run in (tracker, tracker.init):
        with pytest.raises(InputError, match="facing does nothing beside an initial_state"):
            run(silhouettes, states[0], facing=facing)
        with pytest.raises(InputError, match="facing does nothing where keypoints are given"):
            run(keypoints=torch.zeros(8, 3, 15, 2), facing=facing)


class Still(SilhouetteParticleFilter):
    """Particles that stay where they are."""

    def __init__(self, body, n_particles=10, *, gain=1.0, **options):
        super().__init__(body, n_particles, **options)
        self.gain = gain

    def move(self, state, frame, generator):
        return reweight(state.particles, state.log_weights, frame.score(state.particles))


def test_a_filter_of_ones_own_is_registered_in_one_line(scene):
    states, silhouettes = scene
    try:
        register_body_filter("still", Still)
        assert method_options("still")[0] == "gain"
        tracker = BodyTracker(rig(), "still", body=walker(), n_particles=12, gain=2.0)
        assert (tracker.filter.gain, tracker.filter.n_particles) == (2.0, 12)
        assert tracker(silhouettes, states[0], generator=seeded()).method == "still"
        with pytest.raises(InputError, match="choose another name"):
            register_body_filter("still", SIRParticleFilter)
    finally:
        METHODS.pop("still", None)
    with pytest.raises(InputError, match="subclass"):
        register_body_filter("body", Body)
    with pytest.raises(InputError, match="needs must be one of"):
        register_body_filter("other", Still, needs="a map")


def test_every_filter_has_the_options_of_the_base():
    shared = set(BodyFilterOptions.__annotations__)
    assert shared == set(method_options_of(SilhouetteParticleFilter))
    for name, (filter_class, _) in METHODS.items():
        assert shared - filter_class.unused - {"step_std"} <= set(method_options(name))


def method_options_of(filter_class):
    import inspect

    parameters = inspect.signature(filter_class).parameters.values()
    return [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]


def test_a_model_chooses_its_method():
    assert choose_method(None, ["action"]) == "constrained"
    assert choose_method("constrained", ["action", "manifold"]) == "constrained"


def test_past_its_length_a_sequence_holds_its_last_estimate(scene):
    states, silhouettes = scene
    model = SIRParticleFilter(walker(), 40, sharpness=100.0)
    both = torch.stack([silhouettes[:5], silhouettes[2:7]])
    starts = torch.stack([states[0], states[2]])
    cut = model(both, rig(), starts, generator=[seeded(1), seeded(2)], lengths=torch.tensor([3, 5]))
    alone = model(silhouettes[:3], rig(), states[0], generator=seeded(1))
    whole = model(both[1], rig(), states[2], generator=seeded(2))
    torch.testing.assert_close(cut.mean[0, :3], alone.mean)
    torch.testing.assert_close(cut.mean[0, 3:], alone.mean[2].expand(2, -1))
    assert bool((cut.log_evidence[0, 3:] == 0).all())
    torch.testing.assert_close(cut.element(1).mean, whole.mean)
    torch.testing.assert_close(cut.element(1).log_evidence, whole.log_evidence)
    assert cut.failed_at.tolist() == [-1, -1] and not cut.failed.any()
    with pytest.raises(InputError, match="from 1 to 5"):
        model(both, rig(), starts, lengths=torch.tensor([3, 6]))


def test_a_tracker_repeats_its_last_pose_past_the_length(scene):
    states, silhouettes = scene
    tracker = BodyTracker(rig(), "sir", body=walker(), n_particles=60)
    late = torch.cat([torch.zeros_like(silhouettes[:1]), silhouettes])
    alone = tracker(silhouettes[:3], states[0], generator=seeded())
    for given in (late, iter(late)):
        cut = tracker(given, states[0], generator=seeded(), lengths=torch.tensor([4]))
        assert (len(cut), cut.first_frame, cut.failed) == (8, 1, False)
        for name, value in tensors(cut).items():
            torch.testing.assert_close(value[:3], tensors(alone)[name], rtol=0, atol=0)
        assert (cut.joints3d[3:] == cut.joints3d[2]).all() and (cut.log_evidence[3:] == 0).all()
    for wrong in (0, 10):
        with pytest.raises(InputError, match="lengths must be"):
            tracker(late, states[0], generator=seeded(), lengths=torch.tensor([wrong]))


def test_former_arguments_give_the_same_poses(scene):
    states, silhouettes = scene
    tracker = BodyTracker(rig(), "sir", body=walker(), n_particles=60)
    now = tracker(silhouettes, states[0], generator=seeded())
    with pytest.warns(DeprecationWarning, match="generator, progress by name"):
        assert_same(tracker(silhouettes, states[0], seeded(), False), now)
    with pytest.warns(DeprecationWarning, match="root of initial_cov"):
        std = tracker.initial_std
    torch.testing.assert_close(std, tracker.initial_cov.sqrt())
    given = (tracker.filter, silhouettes, rig(), states[0])
    with pytest.warns(DeprecationWarning, match="initial_std of track_body is initial_cov"):
        assert_same(track_body(*given, generator=seeded(), initial_std=std), now)
    with pytest.warns(DeprecationWarning) as said:
        before = tracker.filter(silhouettes, rig(), states[0], seeded(), None, False, std)
    assert ["by name" in str(w.message) for w in said] == [True]
    torch.testing.assert_close(before.mean, now.state, rtol=0, atol=0)
    state = tracker.filter.init(states[:1])
    _, one = tracker.filter.step(state, silhouettes[:1], rig(), generator=seeded())
    with pytest.warns(DeprecationWarning, match="filter_frame of one"):
        _, same = tracker.filter.advance(state, silhouettes[:1], rig(), generator=seeded())
    torch.testing.assert_close(same.mean, one.mean, rtol=0, atol=0)


def test_options_of_the_tracker_are_those_of_the_filters():
    listed = set(BodyTrackerOptions.__annotations__) | {"process_cov"}
    assert listed - {"step_std"} == {o for name in METHODS for o in method_options(name)}


def test_the_average_body_has_the_height_that_was_given():
    assert BodyTracker(rig(), height=1.6).body.height == pytest.approx(1.6)
    assert BodyTracker(rig()).body.skeleton == BODY_15
