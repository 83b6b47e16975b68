"""Which estimator runs, which options it has, and what older programs meant."""

import warnings
from dataclasses import replace

import pytest
import torch

from torchpose import load_prior
from torchpose.demo import KEYPOINT_NAMES, demo_camera, noisy_keypoints, performer
from torchpose.errors import InputError, SkeletonError
from torchpose.filters import MixtureKalmanFilter
from torchpose.priors import UpperBodyPrior
from torchpose.priors._arm_lifter import ArmLifter
from torchpose.priors._arms import ArmPrior, shipped_arm_prior
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import (
    METHODS,
    PoseFilter,
    ProcessNoise,
    UpperBodyTracker,
    method_options,
    pixel_indices,
    register_method,
)
from torchpose.upper_body._estimator import arm_joints
from torchpose.upper_body._measured_joints import in_prior_pixels
from torchpose.upper_body._picked import pick_joints
from torchpose.upper_body._tracker_options import MethodOptions

NAMES = list(KEYPOINT_NAMES)


@pytest.fixture(scope="module")
def keypoints():
    return noisy_keypoints(performer(24, seed=0).joints, std_px=3.0)[None]


def poses(tracker, keypoints):
    draws = torch.Generator().manual_seed(0)
    return tracker(keypoints, names=NAMES, generator=draws)


def without_windows(prior):
    return UpperBodyPrior(prior.left, prior.right, prior.info, prior.noise)


def test_windows_and_bones_are_the_default_where_the_prior_has_windows(prior, keypoints):
    track = poses(UpperBodyTracker(prior, demo_camera()), keypoints)
    assert track.method == "multiple-model" and track.notes == ()
    named = poses(UpperBodyTracker(prior, demo_camera(), "multiple-model"), keypoints)
    assert torch.equal(track.joints3d, named.joints3d)


@pytest.mark.parametrize("asked", [{"steady": True}, {"likelihood_power": 0.5}, {"window": True}])
@pytest.mark.filterwarnings("ignore:window=True is deprecated")
def test_what_is_asked_of_windows_alone_chooses_windows(prior, asked):
    assert UpperBodyTracker(prior, demo_camera(), **asked).method == "window-mixture"


@pytest.fixture(scope="module")
def seen():
    """All eight joints of the performer, [1, 8, 8, 2]."""
    rays = performer(8, seed=0).joints @ demo_camera().matrix.mT
    return (rays[..., :2] / rays[..., 2:])[None]


def test_bones_are_the_default_where_wrists_are_measured(prior, seen):
    tracker = UpperBodyTracker(prior, demo_camera())
    assert tracker.method == "multiple-model" and tracker(seen).method == "multiple-model"
    names = [name.replace("hand", "wrist") for name in UPPER_BODY]
    whole = tracker(seen, names=names)
    assert whole.method == "articulated"
    rows = [UPPER_BODY.index(name) for name in ("hand_left", "neck", "hand_right")]
    assert tracker(seen[:, :, rows], names=[names[i] for i in rows]).method == "articulated"
    _, track = tracker.advance(tracker.init(1, names), seen)
    assert track.method == "articulated"
    torch.testing.assert_close(track.joints3d, whole.joints3d, rtol=0, atol=1e-9)


def test_bones_are_the_default_where_they_are_known_and_no_other_method_is_asked_for(prior, seen):
    names = [name.replace("hand", "wrist") for name in UPPER_BODY]
    for options in ({"height": 1.7}, {"bone_lengths": {"forearm": 0.3}}):
        assert UpperBodyTracker(prior, demo_camera(), **options)(seen).method == "articulated"
    for options in ({"steady": False}, {"likelihood_power": 0.5}):
        tracker = UpperBodyTracker(prior, demo_camera(), **options)
        assert tracker(seen, names=names).method == "window-mixture"


def test_bones_are_the_default_of_all_joints_where_no_window_suits(prior, seen):
    late = UpperBodyTracker(prior, demo_camera(), smoothing=1)
    assert late.method == "mkf-fixed" and late.notes
    track = late(seen)
    assert track.method == "articulated" and track.notes == ()
    hidden = seen.clone()
    hidden[:, :, [UPPER_BODY.index(f"elbow_{side}") for side in ("left", "right")]] = torch.nan
    assert late(hidden).method == "mkf-fixed"


@pytest.mark.parametrize("smoothing", [None, 3, "full"])
def test_single_poses_are_the_default_without_windows(prior, keypoints, smoothing):
    bare = without_windows(prior)
    track = poses(UpperBodyTracker(bare, demo_camera(), smoothing=smoothing), keypoints)
    assert track.method == "mkf-fixed" and track.notes == ()
    named = poses(
        UpperBodyTracker(bare, demo_camera(), "mkf-fixed", smoothing=smoothing), keypoints
    )
    assert torch.equal(track.joints3d, named.joints3d) and named.notes == ()
    with pytest.raises(InputError, match=r"brings no mixtures .* use method 'mkf-fixed'"):
        UpperBodyTracker(bare, demo_camera(), "window-mixture", smoothing=smoothing)


def test_a_prior_without_the_window_that_is_needed_says_so(prior, keypoints):
    causal = {"causal": prior.windows["causal"]}
    own = UpperBodyPrior(prior.left, prior.right, prior.info, prior.noise, causal)
    assert UpperBodyTracker(own, demo_camera()).method == "multiple-model"
    track = poses(UpperBodyTracker(own, demo_camera(), smoothing="full"), keypoints)
    assert track.method == "mkf-fixed"
    assert "brings no mixtures over windows for smoothing" in track.notes[0]


def test_a_lag_that_ends_before_the_window_does_leaves_single_poses(prior, keypoints):
    ahead = prior.windows["full"].layout.at_rate(30.0).ahead
    for lag, method in ((ahead - 1, "mkf-fixed"), (ahead, "multiple-model")):
        track = poses(UpperBodyTracker(prior, demo_camera(), smoothing=lag), keypoints)
        assert track.method == method
        assert any(f"look {ahead} frames ahead" in n for n in track.notes) == (lag < ahead)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_says_its_own_name(prior, keypoints, method):
    options = {"n_particles": 20} if "n_particles" in method_options(method) else {}
    tracker = UpperBodyTracker(prior, demo_camera(), method, **options)
    assert tracker.method == poses(tracker, keypoints).method == method


VALUES = {
    "process_cov": 50 * torch.ones(21), "n_tracks": 2, "uniform_weight": 0.2, "subspace": 3,
    "initial_cov": 1e3 * torch.ones(21), "transition": "stationary", "gamma": 0.5, "burn_in": 20,
    "resample_threshold": 1.0, "burn_in_scale": 7.0, "likelihood_power": 0.01, "weighting": "frame",
    "reset_below": 1e6, "dtype": torch.float32, "n_particles": 30, "resampling": "multinomial",
    "start": "prior", "bone_lengths": {"upper_arm": 0.32}, "height": 1.9,
}  # fmt: skip
BESIDE = {
    "subspace": {"transition": "ou", "gamma": 0.5},
    "gamma": {"transition": "ou", "gamma": 0.9},
    "burn_in_scale": {"burn_in": 20},
}
OF_PARTICLES = {"resample_threshold": 0.0}  # so few are resampled in every frame by default
WALKS = ("pf-walk", "pf-walk-unscaled")


@pytest.fixture(scope="module")
def values(tmp_path_factory):
    """Return a value of each option that is not its default."""
    seen = performer(8, seed=0).joints @ demo_camera().matrix.mT
    tall = UpperBodyTracker(load_prior("kinect-upper-body-small"), demo_camera(), height=2.0)
    person = tall((seen[..., :2] / seen[..., 2:])[None])
    shipped, file = shipped_arm_prior(), tmp_path_factory.mktemp("arms") / "long.safetensors"
    ArmPrior(shipped.directions, 1.2 * shipped.lengths, shipped.spread).save(file)
    return VALUES | {"arms": str(file), "lifter": ArmLifter(), "person": person}


@pytest.mark.parametrize("method", METHODS)
def test_an_option_changes_the_poses_or_is_refused(prior, keypoints, method, values):
    few = {"n_particles": 40} if "n_particles" in method_options(method) else {}

    def joints(**options):
        tracker = UpperBodyTracker(prior, demo_camera(), method, **(few | options))
        return poses(tracker, keypoints[:, :8]).joints3d.double()

    plain = joints()

    for name, value in (values | (OF_PARTICLES if few else {})).items():
        beside = BESIDE.get(name, {})
        if name not in method_options(method):
            with pytest.raises(InputError, match=f"{name}|{next(iter(beside), name)}"):
                joints(**(beside | {name: value}))
        elif method in WALKS and name in ("transition", "gamma", "subspace"):
            with pytest.raises(InputError, match="'paper'"):  # (BL 26) holds for no other
                joints(**(beside | {name: value}))
        else:
            change = joints(**(beside | {name: value})) - (joints(**beside) if beside else plain)
            assert change.abs().max() > 1e-9, name
    assert set(method_options(method)) <= set(values)


def test_a_joint_that_no_arm_has_is_named():
    assert pixel_indices(["elbow", "hand"]) == [3, 4, 0, 1]
    with pytest.raises(SkeletonError, match=r"joints must be among hand, elbow, .*, got 'wrist'"):
        pixel_indices(["hand", "wrist"])


def test_editors_know_the_options_of_all_methods():
    known = {name for method in METHODS for name in method_options(method)}
    assert set(MethodOptions.__annotations__) == known


def test_a_gamma_that_the_prior_brings_is_left_out_with_another_transition(prior, keypoints):
    noise = prior.noise | {"gamma": torch.tensor(0.9, dtype=torch.float64)}
    info = replace(prior.info, transition="ou")
    brings = UpperBodyPrior(prior.left, prior.right, info, noise)
    paper = UpperBodyTracker(brings, demo_camera(), "mkf-fixed", transition="paper")
    plain = UpperBodyTracker(prior, demo_camera(), "mkf-fixed")
    assert torch.equal(poses(paper, keypoints).joints3d, poses(plain, keypoints).joints3d)


@pytest.mark.parametrize("method", [None, "mkf-fixed", "mkf-split"])
@pytest.mark.parametrize("window", [True, False])
def test_window_means_what_it_meant(prior, keypoints, method, window):
    with pytest.warns(DeprecationWarning, match="mkf-fixed"):
        older = UpperBodyTracker(prior, demo_camera(), method, window=window, steady=True)
    single = "mkf-fixed" if method != "mkf-split" else "mkf-split"
    name = "window-mixture" if window and method != "mkf-split" else single
    assert older.method == name
    newer = UpperBodyTracker(prior, demo_camera(), name)
    assert torch.equal(poses(older, keypoints).joints3d, poses(newer, keypoints).joints3d)


def test_options_of_single_poses_without_a_method_still_mean_single_poses(prior, keypoints):
    with pytest.warns(DeprecationWarning, match="pass method='mkf-fixed'"):
        older = UpperBodyTracker(prior, demo_camera(), transition="ou", gamma=0.9)
    options = {"transition": "ou", "gamma": 0.9}
    newer = UpperBodyTracker(prior, demo_camera(), "mkf-fixed", **options)
    assert torch.equal(poses(older, keypoints).joints3d, poses(newer, keypoints).joints3d)


def test_a_method_is_registered_under_a_new_name_only(monkeypatch):
    monkeypatch.setattr("torchpose.upper_body.METHODS", dict(METHODS))
    with pytest.raises(InputError, match="'mkf-fixed' exists"):
        register_method("mkf-fixed", METHODS["mkf-split"])
    register_method("mkf-fixed", METHODS["mkf-fixed"])  # itself once more


@pytest.mark.parametrize("smoothing", [None, 2])
def test_a_registered_filter_is_a_method_like_the_others(prior, keypoints, monkeypatch, smoothing):
    """The bank of fixed tracks under another name, with one option less, and what comes with it."""
    own = PoseFilter(
        MixtureKalmanFilter, {"uniform_weight": 1e-3}, defaults={"transition": "stationary"},
        noise=ProcessNoise(100.0), smooths=True,
    )  # fmt: skip
    monkeypatch.setitem(METHODS, "own", own)
    assert "transition" in method_options("own") and "uniform_weight" not in method_options("own")
    settings = {"smoothing": smoothing, "burn_in": 3}
    tracker = UpperBodyTracker(prior, demo_camera(), "own", **settings)
    same = UpperBodyTracker(
        prior, demo_camera(), "mkf-fixed", transition="stationary", uniform_weight=1e-3, **settings
    )
    found, expected = poses(tracker, keypoints), poses(same, keypoints)
    assert found.method == "own"
    assert torch.equal(found.joints3d, expected.joints3d)
    with pytest.raises(InputError, match=r"'uniform_weight' .* 'own'"):
        UpperBodyTracker(prior, demo_camera(), "own", uniform_weight=0.1)
    with pytest.raises(InputError, match=r"one of .*own"):
        UpperBodyTracker(prior, demo_camera(), "owl")


@pytest.mark.parametrize("method", METHODS)
def test_forward_of_an_estimator_is_its_advance(prior, keypoints, method, capsys):
    few = {"n_particles": 40} if "n_particles" in method_options(method) else {}
    tracker = UpperBodyTracker(prior, demo_camera(), method, **few)
    estimator, cov = tracker.estimator, tracker.measurement_cov
    picked = pick_joints(len(NAMES), NAMES, None, prior.info.neck, prior.info.hand)
    measured = in_prior_pixels(
        keypoints.double(), None, None, None, picked, prior, demo_camera(), cov
    )
    joints = arm_joints([i >= 0 for i in picked.indices])

    def draws():
        return {side: torch.Generator().manual_seed(i) for i, side in enumerate(joints)}

    whole = estimator.forward(measured, joints, draws())
    state, start = estimator.init(1, joints, draws()), 0
    for n in (1, 9, 30):
        rows = slice(start, start + n)
        part = measured._replace(uv=measured.uv[:, rows], mask=measured.mask[:, rows])
        state, found = estimator.advance(state, part, progress=n == 30)
        for arm, expected in zip(found[:2], whole[:2], strict=True):
            torch.testing.assert_close(arm.mean, expected.mean[:, rows], rtol=1e-9, atol=1e-9)
            torch.testing.assert_close(
                arm.log_evidence,
                expected.log_evidence[:, rows],
                rtol=1e-9,
                atol=1e-9,
                equal_nan=True,
            )
        start += n
        assert ("frame" in capsys.readouterr().err) is (n == 30)  # the bar


def test_what_is_no_method_is_not_registered():
    with pytest.raises(InputError, match="a subclass of Estimator or a PoseFilter, got 3"):
        register_method("three", 3)
    assert "three" not in METHODS


def test_windows_that_are_named_and_denied_are_refused(prior):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        with pytest.raises(InputError, match="contradict"):
            UpperBodyTracker(prior, demo_camera(), "window-mixture", window=False)


def test_a_window_without_a_motion_stage_cannot_be_steadied(prior):
    ratios = ("joint_ratio", "pixel_ratio", "placement_ratio")
    window = prior.windows["causal"]
    kept = {k: v for k, v in window.settings.items() if k not in ratios}
    bare = type(window)(window.left, window.right, window.layout, kept)
    own = UpperBodyPrior(prior.left, prior.right, prior.info, prior.noise, {"causal": bare})
    assert not UpperBodyTracker(own, demo_camera()).steady
    with pytest.raises(InputError, match="steady=True needs"):
        UpperBodyTracker(own, demo_camera(), steady=True)
