"""Windows and arms of bones averaged by clues which of them knows the person."""

import copy
import functools
import math

import numpy as np
import pytest
import torch

from tests.upper_body.lifters import UNSURE, Told
from tests.upper_body.test_articulated import CAMERA, ROW, body, pixels
from torchpose import PinholeCamera
from torchpose.demo import KEYPOINT_NAMES, demo_camera, noisy_keypoints, performer
from torchpose.errors import InputError
from torchpose.filters._outputs import FilterOutput
from torchpose.math import euler_to_matrix
from torchpose.priors import UpperBodyPrior
from torchpose.priors._arm_lifter import shipped_arm_lifter
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import UpperBodyTracker, _multiple_models
from torchpose.upper_body._estimator import Estimates, SeenPoses
from torchpose.upper_body._fusion import ReadOut, in_body_axes, in_camera_axes, put_at
from torchpose.upper_body._lifted_ends import Ends
from torchpose.upper_body._measured_joints import MeasuredJoints
from torchpose.upper_body._multiple_models import _averaged, _clues, _log_odds

BOTH = ("window-mixture", "articulated")
FEW = ("head", "neck", "hand_left", "hand_right")
WITHOUT_LIFTED = {name: {"lifter": UNSURE} for name in ("multiple-model", "articulated")}
INFERRED = [
    UPPER_BODY.index(f"{kind}_{side}")
    for kind in ("shoulder", "elbow")
    for side in ("left", "right")
]


@pytest.fixture(scope="module")
def of_performer():
    return noisy_keypoints(performer(40, seed=0).joints, std_px=3.0)[None]


def of_stranger(n_frames=40):
    return pixels(body(n_frames), 2.0)[None][:, :, [ROW[name] for name in FEW]]


def tracked(prior, keypoints, method, names=FEW, camera=CAMERA, **options):
    tracker = UpperBodyTracker(prior, camera, method, fps=30.0, **options)
    return tracker(keypoints, names=list(names))


def averaged(prior, keypoints, *args, **options):
    """Return the average of windows and bones alone."""
    return tracked(prior, keypoints, "multiple-model", *args, lifter=UNSURE, **options)


def shares(prior, keypoints, names=FEW, camera=CAMERA, **options):
    """Return the weight of windows in each frame [T], and how far joints are from that average."""

    def joints(method, rows=slice(None), **options):
        own = WITHOUT_LIFTED.get(method, {})
        track = tracked(prior, keypoints, method, names, camera, **own, **options)
        return track.joints3d[0][:, rows].flatten(1)

    if options.get("smoothing") is None:
        mixed, windows, bones = (joints(m, **options) for m in ("multiple-model", *BOTH))
    else:  # half of the windows without later frames; then hands are put on their rays
        mixed, later, bones = (joints(m, INFERRED, **options) for m in ("multiple-model", *BOTH))
        windows = (later + joints(BOTH[0], INFERRED, **(options | {"smoothing": None}))) / 2
    apart = windows - bones
    share = ((mixed - bones) * apart).sum(1) / apart.square().sum(1)
    return share, (bones + share[:, None] * apart - mixed).abs().max()


@pytest.fixture(scope="module")
def smoothed_shares(prior):
    """`shares` of the stranger by the smoothing, each once."""
    return functools.cache(
        lambda smoothing: shares(prior, of_stranger(30), smoothing=smoothing, steady=False)
    )


@pytest.mark.parametrize("smoothing", [None, 20, "full"])
def test_poses_are_the_average_of_both_methods(smoothed_shares, smoothing):
    share, off = smoothed_shares(smoothing)
    assert float(off) < 1e-9
    assert bool(((share > 0) & (share < 1)).all())


def test_windows_inside_are_not_steadied_where_nobody_wants_that(prior, of_performer):
    """Whole and live; each frame of windows stands by itself then, and joints shake more."""
    args = prior, of_performer, KEYPOINT_NAMES, demo_camera()
    steady, plain = averaged(*args), averaged(*args, steady=False)
    shaking = [track.joints3d[0].diff(n=2, dim=0).norm(dim=-1).mean() for track in (steady, plain)]
    assert float(shaking[1]) > 1.1 * float(shaking[0])
    tracker = UpperBodyTracker(
        prior, demo_camera(), "multiple-model", fps=30.0, steady=False, lifter=UNSURE
    )
    state = tracker.init(1, names=list(KEYPOINT_NAMES))
    _, live = tracker.advance(state, of_performer)
    torch.testing.assert_close(live.joints3d, plain.joints3d)


def test_the_body_that_windows_do_not_know_has_less_of_them(prior, of_performer):
    stranger, _ = shares(prior, of_stranger())
    known, _ = shares(prior, of_performer, KEYPOINT_NAMES, demo_camera())
    assert float(known[-1]) > float(stranger[-1]) + 0.1


def test_the_odds_begin_alike_and_rest_on_the_frames_before(prior):
    keypoints = of_stranger(28)
    changed = keypoints.clone()
    changed[:, 20:, 2:] += 40.0
    other, _ = shares(prior, changed, outliers=False)
    same, _ = shares(prior, keypoints, outliers=False)
    torch.testing.assert_close(other[:20], same[:20])
    assert not torch.allclose(other[20:], same[20:])
    assert len(same) == 28


@pytest.mark.parametrize("size", [1, 7])
def test_a_stream_gives_the_numbers_of_the_whole_recording(prior, size):
    keypoints = of_stranger(21)
    tracker = UpperBodyTracker(prior, CAMERA, "multiple-model", fps=30.0)
    whole = tracker(keypoints, names=list(FEW))
    state = tracker.init(1, names=list(FEW))
    parts = []
    for part in keypoints.split(size, 1):
        state, track = tracker.advance(state, part)
        parts.append(track)
    for name in ("joints3d", "covariance3d", "joints2d", "log_evidence"):
        together = torch.cat([getattr(part, name) for part in parts], 1)
        torch.testing.assert_close(together, getattr(whole, name), atol=1e-8, rtol=1e-6)


def test_sequences_of_a_batch_do_not_know_of_each_other(prior):
    keypoints = torch.cat([of_stranger(30), of_stranger(30) + 15.0])
    keypoints[0, 20:] = 0.0
    lengths = torch.tensor([20, 30])
    tracker = UpperBodyTracker(prior, CAMERA, "multiple-model", fps=30.0, smoothing="full")
    both = tracker(keypoints, names=list(FEW), lengths=lengths)
    alone = tracker(keypoints[:1, :20], names=list(FEW))
    torch.testing.assert_close(both.joints3d[:1, :20], alone.joints3d, atol=1e-8, rtol=1e-6)


USUAL = torch.tensor([1.0, *5 * [0.0], 0.06**2, 0.06**2], dtype=torch.float64)


def test_smoothed_odds_rest_on_clues_before_and_after(prior, monkeypatch):
    """Their evidence is not that of windows with later frames in them, which predict any person well."""
    found = []

    def spied(*args):
        found.append(_clues(*args))
        return found[-1]

    monkeypatch.setattr(_multiple_models, "_clues", spied)
    smoothed, _ = shares(prior, of_stranger(30), smoothing="full", steady=False)
    filtered, _ = shares(prior, of_stranger(30), steady=False)
    later, earlier = (x[0] for x in found)
    torch.testing.assert_close(later[:, :2], earlier[:, :2])
    ahead = torch.arange(30)[:, None] - torch.arange(30)
    weights = torch.exp(-ahead.abs().double() / 120)
    begun = torch.exp(-torch.arange(1, 31).double() / 120)[:, None] * 7.5 * USUAL
    for share, sums in ((filtered, weights.tril() @ earlier), (smoothed, weights @ later)):
        expected = torch.sigmoid(_log_odds(begun + sums))
        torch.testing.assert_close(share, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize(("depth", "nearer"), [(0.1, 0.0), (-0.04, 0.6), (-0.2, 1.2)])
def test_log_odds_are_those_of_the_equation(depth, nearer):
    generator = torch.Generator().manual_seed(0)
    d, n, *x = 0.2 * torch.randn(4, 50, generator=generator, dtype=torch.float64) - 0.1
    y = torch.full_like(d, depth)
    weights = torch.exp(-torch.arange(50).flip(0) / 120).double()
    clues = torch.stack([torch.ones(50).double(), d, n, y, *x, *(part**2 for part in x)], -1)
    mean_d, mean_n = (np.average(part, weights=weights) for part in (d, n))
    varied = np.mean([np.cov(part, aweights=weights, ddof=0) for part in x])
    expected = 1.0 + 0.5 * mean_d - 2.0 * mean_n - math.log1p(varied / 0.1**2)
    assert float(_log_odds(weights @ clues)) == pytest.approx(expected - nearer)


def clues_of(ours, theirs):
    """Return the clues of poses whose keypoints are as likely by both models."""
    n = ours.shape[1]
    arm = FilterOutput(*3 * [torch.ones(1, n, dtype=torch.float64)], None, torch.full((1,), -1))
    seen = MeasuredJoints(
        torch.zeros(1, n, 8, 2), torch.ones(1, n, 8, dtype=torch.bool), torch.eye(2)
    )
    windows, bones = (SeenPoses(joints, *6 * [joints]) for joints in (ours, theirs))
    nothing = torch.full((1, n, 2, 2), math.inf, dtype=torch.float64)
    ends = Ends(nothing.new_zeros(1, n, 2, 2, 3), nothing, seen.mask[..., :2], nothing)
    return _clues(Estimates(arm, arm), Estimates(arm, arm, None, bones), windows, ends, seen)


def test_arms_that_change_their_length_and_small_bodies_tell_against_windows():
    pose = torch.rand(1, 1, 8, 3, dtype=torch.float64) + 2.0
    same = pose.expand(1, 20, 8, 3)
    neck = same[:, :, ROW["neck"], None]
    changing = neck + (same - neck) * (1.0 + 0.3 * (torch.arange(20) % 2))[:, None, None]
    cases = (same, changing, 0.9 * same, 1.1 * same)
    odds = [float(_log_odds(clues_of(ours, same).sum(1))) for ours in cases]
    assert odds[1] < odds[0] - 0.5 and odds[2] == pytest.approx(odds[0] - 1.2)
    assert odds[3] == pytest.approx(odds[0])


def test_what_was_told_an_hour_ago_tells_nothing():
    assert float(_log_odds(math.exp(-900) * 7.5 * USUAL)) == 1.0


@pytest.mark.slow
def test_a_lag_that_reaches_the_end_is_full_smoothing(prior, of_performer):
    few = of_performer[:, :26]
    full, longer, short = (
        tracked(prior, few, "multiple-model", KEYPOINT_NAMES, demo_camera(), smoothing=lag)
        for lag in ("full", 100, 20)
    )
    torch.testing.assert_close(longer.joints3d, full.joints3d, rtol=0, atol=1e-9)
    last = short.joints3d[:, -1:], full.joints3d[:, -1:]
    torch.testing.assert_close(*last, rtol=0, atol=0.02)


@pytest.mark.parametrize("smoothing", [None, 20])
def test_frames_without_arms_leave_the_odds_and_how_far_both_models_are_apart(prior, smoothing):
    keypoints = of_stranger(30)
    keypoints[:, 10:, 2:] = torch.nan
    mixed, bones = (
        of(prior, keypoints, smoothing=smoothing, steady=False).joints3d[0]
        for of in (averaged, functools.partial(tracked, method="articulated", lifter=UNSURE))
    )
    apart = (mixed - bones)[:, INFERRED]
    torch.testing.assert_close(apart[10:], apart[9].expand(20, 4, 3), atol=1e-6, rtol=1e-6)
    assert float(apart[9].abs().max()) > 0.01


def test_before_an_arm_is_measured_windows_are_themselves(prior):
    keypoints = of_stranger(12)
    keypoints[:, :8, 2:] = torch.nan
    share, off = shares(prior, keypoints)
    assert float(off) < 1e-9 and bool(((share > 0.05) & (share < 1)).all())


def test_a_stream_holds_windows_as_the_whole_recording_does(prior):
    keypoints = of_stranger(16)
    keypoints[:, [0, 1, 5, 6, 12], 2:] = torch.nan
    tracker = UpperBodyTracker(prior, CAMERA, "multiple-model", fps=30.0)
    whole = tracker(keypoints, names=list(FEW))
    state, parts = tracker.init(1, names=list(FEW)), []
    for part in keypoints.split(6, 1):
        state, track = tracker.advance(state, part)
        parts.append(track.joints3d)
    torch.testing.assert_close(torch.cat(parts, 1), whole.joints3d, atol=1e-8, rtol=1e-6)


def poses(seed, angles=None):
    """Poses in camera axes of one frame."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    covs, uv_covs = (x @ x.mT for x in (draw(1, 1, 8, 3, 3), draw(1, 1, 8, 2, 2)))
    angles = 0.3 * draw(1, 1, 3) if angles is None else torch.tensor([[angles]]).double()
    reading = ReadOut(draw(1, 1, 8, 3), covs, angles, draw(1, 1, 3), draw(1, 1, 8, 2), uv_covs)
    return reading, in_camera_axes(reading, "zxy")


@pytest.mark.parametrize(("share", "which"), [(1.0, 0), (0.0, 1)])
def test_all_the_weight_is_one_of_the_two(share, which):
    two = poses(0)[1], poses(1)[1]
    mixed = _averaged(torch.tensor([[share]], dtype=torch.float64), *two)
    for name in ("joints", "covs", "place", "uv", "uv_covs", "rotation"):
        torch.testing.assert_close(getattr(mixed, name), getattr(two[which], name))


def test_poses_go_to_the_camera_and_back():
    reading, seen = poses(0)
    back = in_body_axes(seen)
    torch.testing.assert_close(back.joints, reading.joints)
    torch.testing.assert_close(back.covs, reading.covs)
    elsewhere = put_at(seen, torch.tensor([0.1, 0.2, 3.0]))
    torch.testing.assert_close(in_body_axes(elsewhere).joints, reading.joints)


def test_covariances_are_those_of_a_mixture():
    two, share = (poses(0)[1], poses(1)[1]), 0.3
    seen = [*two, _averaged(torch.tensor([[share]], dtype=torch.float64), *two)]
    generator = torch.Generator().manual_seed(2)
    n = 400_000
    first = torch.rand(n, generator=generator) < share
    draws = []
    for part in seen[:2]:
        factor = torch.linalg.cholesky(part.covs[0, 0, ROW["head"]])
        noise = torch.randn(n, 3, generator=generator, dtype=torch.float64)
        draws.append(part.joints[0, 0, ROW["head"]] + noise @ factor.mT)
    drawn = torch.where(first[:, None], *draws)
    head = seen[2].joints[0, 0, ROW["head"]], seen[2].covs[0, 0, ROW["head"]]
    torch.testing.assert_close(head[0], drawn.mean(0), atol=0.02, rtol=0)
    torch.testing.assert_close(head[1], drawn.mT.cov(), atol=0.05, rtol=0.02)


def test_the_mean_rotation_is_half_way():
    two = (poses(0, [0.0, 0.0, x])[1] for x in (0.0, 0.8))
    mixed = _averaged(torch.tensor([[0.5]], dtype=torch.float64), *two)
    wanted = euler_to_matrix(torch.tensor([0.0, 0.0, 0.4], dtype=torch.float64), "zxy")
    torch.testing.assert_close(mixed.rotation[0, 0], wanted)


def test_covariances_of_windows_are_recalibrated_before(prior):
    with_noise = copy.deepcopy(prior)
    with_noise.set_noise("calibration_scale_causal", torch.full((8,), 4.0))
    with_noise.set_noise("calibration_floor_causal", torch.zeros(8))
    found = [averaged(own, of_stranger(12)).covariance3d for own in (with_noise, prior)]
    variances = [x.diagonal(dim1=-2, dim2=-1) for x in found]
    assert bool((variances[0] > variances[1]).all())


def test_covariances_are_narrower_where_both_models_have_weight(prior):
    found = [
        tracked(prior, of_stranger(12), "multiple-model", calibrated=c).covariance3d
        for c in (True, False)
    ]
    shrunk = found[0].diagonal(dim1=-2, dim2=-1).sum() / found[1].diagonal(dim1=-2, dim2=-1).sum()
    assert 0.25 < float(shrunk) < 1.0


def test_windows_that_a_network_has_elsewhere_count_less(prior):
    """A network that is sure of the arms of bones."""
    keypoints = of_stranger(30)
    seen = tracked(prior, keypoints, "articulated", lifter=UNSURE).joints3d[0]
    apart = {}
    for name in (None, *BOTH):
        own = WITHOUT_LIFTED.get(name, {})
        lifter = (
            UNSURE if name is None else Told(tracked(prior, keypoints, name, **own).joints3d[0])
        )
        mixed = tracked(prior, keypoints, "multiple-model", lifter=lifter).joints3d[0]
        apart[name] = float((mixed - seen)[20:, INFERRED].norm(dim=-1).mean())
    assert apart["articulated"] < 0.8 * apart[None] < 0.9 * apart["window-mixture"]


def test_what_is_no_network_is_refused(prior, tmp_path):
    for lifter, said in (
        (3, "lifter must be a network that lifts arms or the path of its file, got int"),
        (tmp_path / "none.safetensors", "none"),
    ):
        with pytest.raises(InputError, match=said):
            tracked(prior, of_stranger(3), "multiple-model", lifter=lifter)


def test_a_network_may_come_from_a_file_and_is_the_one_of_the_package_otherwise(prior, tmp_path):
    keypoints, file = of_stranger(6), tmp_path / "own.safetensors"
    UNSURE.save(file)
    plain, own, read, shipped = (
        tracked(prior, keypoints, "multiple-model", **options).joints3d
        for options in ({}, {"lifter": UNSURE}, {"lifter": file}, {"lifter": shipped_arm_lifter()})
    )
    torch.testing.assert_close(read, own, atol=1e-6, rtol=0)
    torch.testing.assert_close(shipped, plain)
    assert float((plain - own).abs().max()) > 1e-3


def test_a_prior_without_windows_is_refused(prior):
    bare = UpperBodyPrior(prior.left, prior.right, prior.info, prior.noise)
    with pytest.raises(InputError, match=r"multiple-model.*no mixtures over windows"):
        UpperBodyTracker(bare, PinholeCamera(525.0, 525.0, 319.5, 239.5), "multiple-model")


def test_all_joints_may_be_measured(prior):
    keypoints = pixels(body(10), 2.0)[None]
    track = tracked(prior, keypoints, "multiple-model", UPPER_BODY)
    assert bool(track.joints3d.isfinite().all()) and bool(track.bone_lengths.isfinite().all())


def test_gradients_are_finite(prior):
    keypoints = of_stranger(4).requires_grad_()
    track = tracked(prior, keypoints, "multiple-model")
    (slope,) = torch.autograd.grad(track.joints3d.square().sum(), keypoints)
    assert bool(slope.isfinite().all()) and bool((slope != 0).any())
