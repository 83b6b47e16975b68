"""From keypoints to poses: the tracker on the animated performer, whom its small prior has not seen."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.priors.poses import recording
from torchpose.camera import PinholeCamera, map_pixels, project
from torchpose.camera._projection import arm_in_body_frame, arm_in_camera_frame
from torchpose.demo import KEYPOINT_NAMES, demo_camera, noisy_keypoints, performer
from torchpose.errors import (
    CameraError,
    CovarianceError,
    FileFormatError,
    InputError,
    OutputError,
    PriorError,
    ShapeError,
    SkeletonError,
)
from torchpose.learning import fit_upper_body_prior
from torchpose.learning._recipes import fit_calibration, fit_kinect_prior
from torchpose.math import euler_to_matrix
from torchpose.metrics import joint_errors_3d
from torchpose.priors import UpperBodyPrior
from torchpose.skeleton import UPPER_BODY
from torchpose.skeleton._torso import KINECT_NECK
from torchpose.upper_body import METHODS, PoseTrack, UpperBodyTracker
from torchpose.upper_body._measured_joints import MeasuredJoints, place_measured_neck
from torchpose.upper_body._single_poses import default_process_cov

NAMES = list(KEYPOINT_NAMES)
NECK_BY = ("shoulder_left", "shoulder_right")
N_FRAMES = 70


@pytest.fixture(scope="module")
def prior():
    """A small prior with windows, fitted on two performers of other sizes."""
    recordings = [recording(performer(240, seed=s).body, person=f"p{s}", fps=30.0) for s in (1, 2)]
    return fit_kinect_prior(
        recordings, 6, window_components=8, window_samples=2000, n_samples=4000, pose_steps=20,
        drawn_pieces=0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def scene():
    """Truth in camera axes, and noisy keypoints with a gap of one second."""
    truth = performer(N_FRAMES, seed=0).joints
    return truth, noisy_keypoints(truth, std_px=3.0, gap=("hand_right", 1.0, 1.0))


@pytest.fixture(scope="module")
def plain(prior, scene):
    """What the tracker makes of the scene as it comes."""
    return UpperBodyTracker(prior, demo_camera())(scene[1][None], names=NAMES)


def mean_error(track, truth):
    return float(joint_errors_3d(track.joints3d[0], truth).mean())


@pytest.mark.parametrize(
    "smoothing",
    [None, "full", *(pytest.param(lag, marks=pytest.mark.slow) for lag in (3, 20))],
)
@pytest.mark.parametrize("method", [None, "mkf-fixed"])
def test_the_performer_is_tracked_better_than_by_the_mean_pose(
    prior, scene, plain, method, smoothing
):
    truth, keypoints = scene
    tracker = UpperBodyTracker(prior, demo_camera(), method, smoothing=smoothing)
    usual = method is None and smoothing is None
    track = plain if usual else tracker(keypoints[None], names=NAMES)
    joints = prior.left.moments()[0][:15].view(5, 3), prior.right.moments()[0][:15].view(5, 3)
    uvl = torch.cat([joints[0], joints[1][:3].flip(0)])
    still = torch.stack([uvl[:, 0] - 319.5, uvl[:, 1] - 239.5, torch.full((8,), 525.0)], 1)
    still = (still * uvl[:, 2:] / 525.0).expand(len(truth), 8, 3)
    baseline = float(joint_errors_3d(still, truth).mean())
    assert mean_error(track, truth) < 0.8 * baseline
    assert track.joints2d.shape == (1, N_FRAMES, 8, 2)
    assert (track.observed[0, 30:60, 7] == 0).all() and track.observed[0, :30, 7].all()
    assert (torch.linalg.eigvalsh(track.covariance3d) > 0).all()
    pixels = project(truth, tracker.camera.matrix, torch.eye(3).double(), torch.zeros(3).double())
    measured = (track.joints2d[0, :, [0, 3, 4]] - pixels[:, [0, 3, 4], :2]).norm(dim=-1)
    assert measured.mean() < 8


@pytest.mark.parametrize("method", METHODS)
def test_every_method_runs_and_honours_generators(prior, scene, method):
    _, keypoints = scene
    options = {"n_particles": 200} if method.startswith("pf") else {}
    tracker = UpperBodyTracker(prior, demo_camera(), method=method, **options)
    batch = keypoints[None, :20].expand(2, -1, -1, -1)
    lengths = torch.tensor([20, 12])
    generators = [torch.Generator().manual_seed(b) for b in range(2)]
    track = tracker(batch, names=NAMES, generator=generators, lengths=lengths)
    assert track.joints3d.shape == (2, 20, 8, 3)
    assert torch.isfinite(track.joints3d).all()
    alone = tracker(batch[1:, :12], names=NAMES, generator=[torch.Generator().manual_seed(1)])
    tolerance = 1e-2 if method.startswith("pf") else 1e-9  # particles are float32
    torch.testing.assert_close(
        track.joints3d[1, :12], alone.joints3d[0], rtol=tolerance, atol=tolerance
    )
    for name in (
        "joints3d",
        "joints2d",
        "covariance3d",
        "covariance2d",
    ):  # the last pose is repeated
        values = getattr(track, name)[1]
        assert torch.equal(values[12:], values[11].expand(8, *values.shape[1:]))
    assert not track.log_evidence[1, 12:].nan_to_num().any()


@pytest.mark.parametrize("lengths", [[0, 20], [20, 21], [20.0, 12.0], [True, True]])
def test_lengths_that_no_sequence_has_are_refused(prior, scene, lengths):
    batch = scene[1][None, :20].expand(2, -1, -1, -1)
    with pytest.raises(InputError, match="lengths must be integers from 1 to 20"):
        UpperBodyTracker(prior, demo_camera())(batch, names=NAMES, lengths=torch.tensor(lengths))


@pytest.mark.parametrize("kind", [list, np.uint8, np.uint16, np.uint64])
def test_lengths_may_be_a_list_and_any_whole_numbers(prior, scene, kind):
    batch = scene[1][None, :20].expand(2, -1, -1, -1)
    tracker = UpperBodyTracker(prior, demo_camera(), "mkf-fixed")
    lengths = [20, 12] if kind is list else torch.as_tensor(np.array([20, 12], dtype=kind))
    found = tracker(batch, names=NAMES, lengths=lengths)
    assert torch.equal(found.lengths, torch.tensor([20, 12]))
    with pytest.raises(InputError, match="number of frames of each sequence, got 'all'"):
        tracker(batch, names=NAMES, lengths="all")


def test_names_may_come_in_any_order_and_subset(prior, scene, plain):
    keypoints = scene[1][:40]
    tracker = UpperBodyTracker(prior, demo_camera())
    expected = plain.joints3d[:, :40]
    eight = torch.full((1, 40, 8, 2), float("nan"), dtype=torch.float64)
    eight[0][:, [UPPER_BODY.index(n) for n in NAMES]] = keypoints
    torch.testing.assert_close(tracker(eight).joints3d, expected)
    order = [2, 0, 3, 1]
    spelled = ["LeftHand", "head", "rhand", "neck"]
    shuffled = tracker(keypoints[None][:, :, order], names=spelled).joints3d
    torch.testing.assert_close(shuffled, expected)
    hands = tracker(keypoints[None][:, :, 2:], names=NAMES[2:])
    assert torch.isfinite(hands.joints3d).all()
    assert not hands.observed[..., 3].any()


def test_elbows_are_measured_where_they_are_given(prior, scene):
    truth, _ = scene
    eight = project(truth, demo_camera().matrix, torch.eye(3).double(), torch.zeros(3).double())
    tracker = UpperBodyTracker(prior, demo_camera(), method="mkf-fixed")
    few = eight[None, ..., :2].clone()
    few[:, :, [1, 2, 5, 6]] = torch.nan
    assert mean_error(tracker(eight[None, ..., :2]), truth) < mean_error(tracker(few), truth)


def test_another_camera_is_mapped_to_the_priors(prior, scene):
    keypoints = scene[1][:40]
    near = demo_camera()
    other = PinholeCamera(1000.0, 990.0, 640.0, 360.0)
    moved = map_pixels(keypoints, near.matrix, other.matrix)
    first = UpperBodyTracker(prior, near, measurement_std=3.0)(keypoints[None], names=NAMES)
    scale = 1000.0 / 525.0
    second = UpperBodyTracker(prior, other, measurement_std=3.0 * scale)(moved[None], names=NAMES)
    torch.testing.assert_close(first.joints3d, second.joints3d, rtol=1e-2, atol=5e-3)
    mapped = map_pixels(first.joints2d, near.matrix, other.matrix)
    torch.testing.assert_close(mapped, second.joints2d, rtol=1e-2, atol=2.0)


def test_a_note_says_that_a_lens_is_not_straightened(prior, scene):
    def noted(camera):
        tracker = UpperBodyTracker(prior, camera, method="mkf-fixed")
        state = tracker.init(1, NAMES)
        _, live = tracker.advance(state, scene[1][None, :2])
        tracks = tracker(scene[1][None, :2], names=NAMES), live
        return ["distortions are not applied" in " ".join(track.notes) for track in tracks]

    numbers = (525.0, 525.0, 319.5, 239.5, 640, 480)
    assert noted(PinholeCamera(*numbers, distortions=[-0.2, 0.05])) == [True, True]
    assert noted(PinholeCamera(*numbers, distortions=[0.0] * 5)) == [False, False]


def test_confidence_zero_is_missing_and_low_confidence_counts_less(prior, scene):
    _, keypoints = scene
    tracker = UpperBodyTracker(prior, demo_camera(), method="mkf-fixed")
    ones = torch.ones(1, N_FRAMES, 4, dtype=torch.float64)
    plain = tracker(keypoints[None], names=NAMES)
    torch.testing.assert_close(tracker(keypoints[None], ones, NAMES).joints3d, plain.joints3d)
    hidden = ones.clone()
    hidden[:, 20:40, 2] = 0
    track = tracker(keypoints[None], hidden, NAMES)
    assert not track.observed[0, 20:40, 0].any()
    hidden[:, 20:40, 2] = torch.nan
    torch.testing.assert_close(tracker(keypoints[None], hidden, NAMES).joints3d, track.joints3d)
    low = ones.clone()
    low[:, :, 2] = 0.1
    wide = tracker(keypoints[None], low, NAMES)
    assert (wide.covariance2d[0, :, 0, 0, 0] > plain.covariance2d[0, :, 0, 0, 0]).all()


@pytest.mark.parametrize("method", ["window-mixture", "mkf-fixed"])
def test_the_same_covariance_everywhere_is_a_measurement_std(prior, scene, method):
    camera, keypoints = demo_camera(), scene[1]
    points = keypoints[None, :30]
    std = torch.tensor([4.0, 3.0, 3.0, 2.0, 5.0])
    usual = UpperBodyTracker(prior, camera, method, measurement_std=std)
    each = UpperBodyTracker(prior, camera, method)
    by_name = {"head": 2.0, "neck": 5.0, "hand": 4.0}
    own = torch.tensor([by_name[name.split("_")[0]] for name in NAMES], dtype=torch.float64)
    cov = (own.square()[:, None, None] * torch.eye(2)).expand(1, 30, 4, 2, 2)
    one, other = usual(points, names=NAMES), each(points, names=NAMES, covariance=cov)
    if method == "mkf-fixed":
        torch.testing.assert_close(one.joints3d, other.joints3d, rtol=1e-9, atol=1e-9)
        return
    # the hands of earlier frames keep the tracker's own noise
    assert (one.joints3d - other.joints3d).abs().max() < 0.02


def test_a_doubtful_hand_pulls_less(prior, scene):
    camera, keypoints = demo_camera(), scene[1]
    points = keypoints[None, :20].clone()
    points[:, 10, NAMES.index("hand_left")] += 60
    tracker = UpperBodyTracker(prior, camera, outliers=False)
    cov = torch.eye(2, dtype=torch.float64).repeat(1, 20, 4, 1, 1) * 9
    sure = tracker(points, names=NAMES, covariance=cov)
    cov[:, 10, NAMES.index("hand_left")] *= 100
    doubtful = tracker(points, names=NAMES, covariance=cov)
    hand = UPPER_BODY.index("hand_left")
    at = points[0, 10, NAMES.index("hand_left")]
    near = (sure.joints2d[0, 10, hand] - at).norm()
    assert (doubtful.joints2d[0, 10, hand] - at).norm() > near + 5


def test_a_covariance_that_is_none_is_refused(prior, scene):
    camera, keypoints = demo_camera(), scene[1]
    tracker = UpperBodyTracker(prior, camera)
    cov = -torch.eye(2, dtype=torch.float64).expand(1, 5, 4, 2, 2)
    with pytest.raises(CovarianceError, match="covariance"):
        tracker(keypoints[None, :5], names=NAMES, covariance=cov)
    with pytest.raises(ShapeError, match="covariance"):
        tracker(keypoints[None, :5], names=NAMES, covariance=cov[:, :4])


def test_covariances_grow_in_the_gap(prior, scene):
    _, keypoints = scene
    for method in ("window-mixture", "mkf-fixed"):
        track = UpperBodyTracker(prior, demo_camera(), method)(keypoints[None], names=NAMES)
        spread = track.covariance3d[0, :, 7].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
        assert spread[40:55].mean() > spread[10:28].mean()


def test_frames_and_the_static_camera(prior, scene, plain):
    truth, keypoints = (x[:50] for x in scene)
    body = UpperBodyTracker(prior, demo_camera(), frame="body")(keypoints[None], names=NAMES)
    still = UpperBodyTracker(prior, demo_camera(), static_camera=True)(keypoints[None], names=NAMES)
    camera = plain.joints3d[0, :50]
    assert abs(float(body.joints3d[0, :, 4].norm(dim=-1).mean())) < 0.1  # centred on the neck
    for other in (body, still):
        a, b = mean_error(other, truth), float(joint_errors_3d(camera, truth).mean())
        assert math.isclose(a, b, rel_tol=1e-6)  # the same pose, put elsewhere
    assert (camera[:, 4, 2] - truth[:, 4, 2]).abs().mean() < 0.5
    assert still.joints3d[0, :, 4].std(0).max() < camera[:, 4].std(0).max()


def test_process_noise_follows_the_frame_rate(prior):
    slow = UpperBodyTracker(prior, demo_camera(), fps=15.0, method="mkf-fixed")
    fast = UpperBodyTracker(prior, demo_camera(), fps=60.0, method="mkf-fixed")
    a, b = (t.estimator.filter("left", ("hand", "head", "neck")).process_cov for t in (slow, fast))
    torch.testing.assert_close(a, 4 * b)


def test_evidence_is_that_of_each_frame_and_zero_without_measurements(prior, scene):
    _, keypoints = scene
    eight = keypoints[None, :45].clone()
    eight[:, 30:40] = torch.nan
    for method in ("window-mixture", "mkf-fixed"):
        track = UpperBodyTracker(prior, demo_camera(), method)(eight, names=NAMES)
        assert (track.log_evidence[:, 30:40] == 0).all()
        assert (track.log_evidence[:, :30] != 0).all()


def test_results_are_saved_and_loaded(prior, scene, plain, tmp_path):
    single = plain
    single.save(tmp_path / "poses.npz")
    back = PoseTrack.load(tmp_path / "poses.npz")
    for name in ("joints2d", "joints3d", "covariance3d", "observed", "log_evidence", "lengths"):
        torch.testing.assert_close(getattr(back, name), getattr(single, name))
    assert back.names == UPPER_BODY and back.fps == single.fps and back.notes == single.notes
    assert back.method == single.method == "multiple-model"
    twice = scene[1][None, :30].expand(2, -1, -1, -1)
    tracker = UpperBodyTracker(prior, demo_camera())
    double = tracker(twice, names=NAMES, lengths=torch.tensor([30, 18]))
    double.save(tmp_path / "two.npz")
    assert len(PoseTrack.load(tmp_path / "two.npz")) == 2
    assert double.sequence(1).joints3d.shape == (1, 18, 8, 3)
    (tmp_path / "cut.npz").write_bytes((tmp_path / "poses.npz").read_bytes()[:500])
    with pytest.raises(FileFormatError, match="truncated"):
        PoseTrack.load(tmp_path / "cut.npz")
    with pytest.raises(OutputError):
        single.save(tmp_path / "poses.npz" / "inside.npz")


def test_files_of_older_releases_do_not_say_what_ran(prior, scene, tmp_path):
    track = UpperBodyTracker(prior, demo_camera())(scene[1][None, :20], names=NAMES)
    track.save(tmp_path / "poses.npz")
    arrays = dict(np.load(tmp_path / "poses.npz"))
    del arrays["method"]
    np.savez(tmp_path / "older.npz", **arrays)
    assert PoseTrack.load(tmp_path / "older.npz").method == "unknown"


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"camera": None}, CameraError, "a camera is needed"),
        ({"camera": "525,525,319.5,239.5"}, CameraError, "a PinholeCamera, got str"),
        ({"method": "mkf"}, InputError, "mkf-fixed"),
        ({"smoothing": "half"}, InputError, "smoothing"),
        ({"smoothing": -1}, InputError, "smoothing"),
        ({"smoothing": 2.5}, InputError, "a number of frames or 'full', got 2.5"),
        ({"smoothing": True}, InputError, "smoothing"),
        ({"neck": "Neck"}, InputError, "neck"),
        ({"smoothing": 3, "method": "mkf-split"}, InputError, "mkf-fixed"),
        ({"smoothing": 3, "method": "window-mixture"}, InputError, "look 16 frames ahead"),
        ({"frame": "body", "static_camera": True}, InputError, "static_camera"),
        ({"method": "mkf-fixed", "steady": True}, InputError, "steady=True needs"),
        ({"frame": "world"}, InputError, "camera"),
        ({"fps": 0.0}, InputError, "fps"),
        (
            {"fps": 1 / 30},
            InputError,
            r"at least 0.1 .* give 1 / 0.0333 for frames that are 0.0333 s",
        ),
        ({"measurement_std": 0.0}, InputError, "positive"),
        ({"measurement_std": [1.0, 2.0]}, ShapeError, "measurement_std"),
        ({"n_particles": 10}, InputError, "pf-mixture, pf-walk, pf-walk-unscaled"),
        ({"uniform_weight": 0.1}, InputError, "is of mkf-fixed"),
        ({"burn_in": 5}, InputError, "is of mkf-fixed, mkf-sampled, mkf-split"),
        ({"reset_below": -9.0}, InputError, "is of mkf-fixed"),
        ({"tracks": "split"}, InputError, "of no method"),
        ({"method": "mkf-sampled", "likelihood_power": 0.5}, InputError, "does not apply"),
        ({"method": "mkf-split", "reset_below": -9.0}, InputError, "does not apply"),
        ({"method": "mkf-fixed", "gamma": 0.9}, InputError, "transition 'paper'"),
        (
            {
                "method": "mkf-fixed",
                "transition": "ou",
                "gamma": 0.9,
                "process_cov": torch.ones(21),
            },
            InputError,
            "process_cov does not apply",
        ),
    ],
)
def test_bad_settings_are_refused(prior, options, error, message):
    with pytest.raises(error, match=message):
        UpperBodyTracker(prior, **{"camera": demo_camera(), **options})


def test_a_prior_of_another_kind_is_refused(prior):
    with pytest.raises(PriorError, match="UpperBodyPrior"):
        UpperBodyTracker(prior.left, demo_camera())


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"keypoints": torch.zeros(10, 4, 2)}, ShapeError, "keypoints"),
        ({"keypoints": np.zeros((1, 10, 4, 2))}, InputError, "got ndarray; convert it"),
        ({"keypoints": torch.zeros(1, 0, 4, 2)}, InputError, "at least one"),
        ({"keypoints": torch.full((1, 10, 4, 2), float("inf"))}, InputError, "finite"),
        (
            {"keypoints": torch.full((1, 10, 4, 2), float("nan"))},
            InputError,
            "no joint is measured",
        ),
        ({"names": ["head", "neck", "tail", "hand_left"]}, SkeletonError, "tail"),
        ({"names": ["head"]}, InputError, "4 keypoints"),
        ({"names": None}, InputError, "names may be left out"),
        ({"confidence": torch.ones(1, 10, 3)}, ShapeError, "confidence"),
        ({"confidence": torch.full((1, 10, 4), 7.0)}, InputError, r"\[0, 1\]"),
        ({"confidence": torch.full((1, 10, 4), -0.1)}, InputError, r"\[0, 1\]"),
        ({"mask": torch.ones(1, 9, 4, dtype=torch.bool)}, ShapeError, "mask"),
        ({"mask": torch.full((1, 10, 4), 0.1)}, InputError, r"mask must be bool .* torch\.float32"),
        ({"absent": torch.full((1, 10, 4), math.inf)}, InputError, "probabilities from 0 to 1"),
        ({"generator": 5}, InputError, r"torch\.Generator, or a list of them, got 5"),
        ({"generator": [torch.Generator()] * 2}, InputError, "must hold 1, one for each"),
    ],
)
def test_bad_keypoints_are_refused(prior, change, error, message):
    arguments = {"keypoints": torch.full((1, 10, 4, 2), 240.0), "names": NAMES}
    with pytest.raises(error, match=message):
        UpperBodyTracker(prior, demo_camera())(**{**arguments, **change})


def test_peaks_of_heat_maps_count_as_certain(prior):
    """Also of faces, and of the joints by which bones are lifted."""
    names = ["nose", "hip_left", *UPPER_BODY]
    keypoints = 240.0 + 80.0 * torch.rand(1, 3, 10, 2, generator=torch.Generator().manual_seed(0))
    tracker = UpperBodyTracker(prior, demo_camera(), "articulated")
    sure, high = torch.ones(1, 3, 10), torch.full((1, 3, 10), 1.3)
    assert torch.equal(
        tracker(keypoints, high, names).joints3d, tracker(keypoints, sure, names).joints3d
    )


def test_a_stretch_without_any_measurement_is_bounded(prior):
    keypoints = torch.full((1, 90, 4, 2), 240.0)
    keypoints[:, 15:72] = torch.nan
    tracker = UpperBodyTracker(prior, demo_camera(), fps=10.0)
    with pytest.raises(InputError, match="57 frames, from frame 15 on, longer"):
        tracker(keypoints, names=NAMES)
    for max_gap in (-1.0, math.nan, "5"):
        with pytest.raises(InputError, match="max_gap must be at least 0 seconds"):
            UpperBodyTracker(prior, demo_camera(), max_gap=max_gap)
    whole = UpperBodyTracker(prior, demo_camera(), fps=10.0, max_gap=None)
    assert torch.isfinite(whole(keypoints, names=NAMES).joints3d).all()


def test_a_neck_of_another_kind_is_left_out_and_said(prior):
    keypoints = torch.full((1, 10, 4, 2), 240.0)
    track = UpperBodyTracker(prior, demo_camera(), neck="low-neck")(keypoints, names=NAMES)
    assert not track.observed[..., 4].any()
    assert any("low-neck" in note and "not measured" in note for note in track.notes)


def test_a_neck_between_the_shoulders_is_put_where_the_prior_has_it(prior, scene, plain):
    truth, keypoints = (x[:70] for x in scene)
    lower = keypoints.clone()
    head, neck = NAMES.index("head"), NAMES.index("neck")
    share = KINECT_NECK.fraction
    lower[:, neck] = (keypoints[:, neck] - share * keypoints[:, head]) / (1 - share)
    tracker = UpperBodyTracker(prior, demo_camera(), neck="mid-shoulder")
    track = tracker(lower[None], names=NAMES)
    assert any("mid-shoulder" in note and "37 %" in note for note in track.notes)
    assert track.observed[0, :, 4].all()
    usual = float(joint_errors_3d(plain.joints3d[0, :70], truth).mean())
    # The same places, measured less surely.
    assert mean_error(track, truth) == pytest.approx(usual, rel=0.15)
    assert (track.covariance2d[0, 30:, 4] - plain.covariance2d[0, 30:70, 4]).diagonal(
        dim1=-2, dim2=-1
    ).mean() > 0
    hidden = lower.clone()
    hidden[:, head] = torch.nan
    upright = tracker(hidden[None], names=NAMES)
    assert upright.observed[..., 4].all()
    assert mean_error(upright, truth) < 1.5 * mean_error(track, truth)


def test_shoulders_stand_for_a_neck_that_is_not_there(prior, scene):
    truth, keypoints = (x[:30] for x in scene)
    eye, zeros = torch.eye(3).double(), torch.zeros(3).double()
    shoulders = project(truth, demo_camera().matrix, eye, zeros)[:, [2, 5], :2]
    wide = torch.cat([keypoints, shoulders], 1)[None]
    names = [*NAMES, *NECK_BY]
    keep = [i for i, name in enumerate(names) if name != "neck"]
    tracker = UpperBodyTracker(prior, demo_camera())
    track = tracker(wide[:, :, keep], names=[names[i] for i in keep])
    assert track.observed[0, :, 4].all()
    assert any("no neck among the keypoints" in note for note in track.notes)
    own = UpperBodyTracker(prior, demo_camera(), neck="low-neck")(wide, names=names)
    torch.testing.assert_close(own.joints3d, track.joints3d)
    torch.testing.assert_close(tracker(wide, names=names).notes, ())


def with_shoulders(scene, n_frames):
    """Keypoints of head, hands and shoulders, without a neck, and their names."""
    truth, keypoints = (x[:n_frames] for x in scene)
    shoulders = demo_camera()(truth)[:, [2, 5], :2]
    keep = [i for i, name in enumerate(NAMES) if name != "neck"]
    names = [*(NAMES[i] for i in keep), *NECK_BY]
    return torch.cat([keypoints[:, keep], shoulders], 1)[None], names


@pytest.mark.parametrize("method", ["window-mixture", "mkf-fixed"])
def test_a_neck_between_the_shoulders_is_as_sure_whoever_else_is_seen(prior, scene, method):
    """Shoulders are less sure here than a neck, and R changes from frame to frame for one body alone."""
    keypoints, names = with_shoulders(scene, 20)
    std = [3.0, 3.0, 10.0, 3.0, 3.0]
    tracker = UpperBodyTracker(prior, demo_camera(), method, measurement_std=std)
    alone = tracker(keypoints, names=names)
    confidence = torch.ones(2, 20, len(names))
    confidence[1, 10, 0] = 0.5
    both = tracker(keypoints.expand(2, -1, -1, -1), confidence, names)
    torch.testing.assert_close(both.joints3d[0], alone.joints3d[0], rtol=0, atol=1e-9)
    torch.testing.assert_close(both.covariance2d[0], alone.covariance2d[0], rtol=1e-6, atol=1e-6)


def test_noise_that_stays_is_shared_where_all_necks_are_put_alike():
    head, neck, left, right = (UPPER_BODY.index(n) for n in ("head", "neck", *NECK_BY))
    cov = torch.arange(1.0, 9.0).double()[:, None, None] * torch.eye(2)
    uv, mask = torch.zeros(1, 3, 8, 2).double(), torch.ones(1, 3, 8, dtype=torch.bool)
    share, spread = KINECT_NECK.fraction, KINECT_NECK.spread * 200.0

    def of_neck(known):
        cov_of = place_measured_neck(MeasuredJoints(uv, known, cov), 200.0).cov
        return cov_of[..., neck, :, :]

    def expected(middle):
        return (1 - share) ** 2 * middle + share**2 * cov[head] + spread**2 * torch.eye(2)

    by_point, by_shoulders = expected(cov[neck]), expected((cov[left] + cov[right]) / 4)
    without = mask.clone()
    without[..., neck] = False
    torch.testing.assert_close(of_neck(mask), by_point)
    torch.testing.assert_close(of_neck(without), by_shoulders)
    mixed = without.clone()
    mixed[:, 1, neck] = True
    torch.testing.assert_close(
        of_neck(mixed)[0], torch.stack([by_shoulders, by_point, by_shoulders])
    )
    unknown = without.clone()
    unknown[:, 1, left] = False
    torch.testing.assert_close(of_neck(unknown), by_shoulders)


@pytest.mark.parametrize("missing", ["confidence", "unknown confidence", "mask", "keypoint"])
@pytest.mark.parametrize("value", [0.0, torch.nan])
def test_the_covariance_of_what_is_not_measured_is_ignored(prior, scene, missing, value):
    keypoints = torch.cat([scene[1][None, :5], torch.full((1, 5, 1, 2), 400.0)], 2)
    names = [*NAMES, "hip_left"]
    cov = 9.0 * torch.eye(2, dtype=torch.float64).repeat(1, 5, 5, 1, 1)
    given = {"confidence": torch.ones(1, 5, 5)}
    if missing == "mask":
        given = {"mask": torch.ones(1, 5, 5, dtype=torch.bool)}
        given["mask"][0, 2, 3] = False
    elif missing == "keypoint":
        keypoints[0, 2, 3] = torch.nan
    else:
        given["confidence"][0, 2, 3] = 0.0 if missing == "confidence" else torch.nan
    tracker = UpperBodyTracker(prior, demo_camera(), "mkf-fixed")
    expected = tracker(keypoints, names=names, covariance=cov, **given).joints3d
    cov[0, 2, 3] = value
    cov[:, :, 4] = value  # no joint of the eight
    found = tracker(keypoints, names=names, covariance=cov, **given).joints3d
    assert torch.equal(found, expected)


def test_a_prior_without_noise_gets_a_default(prior):
    bare = UpperBodyPrior(prior.left, prior.right, replace(prior.info, extra={}))
    assert default_process_cov(bare).shape == (21,)
    track = UpperBodyTracker(bare, demo_camera())(torch.full((1, 5, 4, 2), 240.0), names=NAMES)
    assert torch.isfinite(track.joints3d).all()


def test_lifting_agrees_with_monte_carlo(prior):
    mean = prior.left.means[0]
    cov = prior.left.covariances[0] * 0.05
    matrix = prior.info.matrix
    draws = torch.distributions.MultivariateNormal(mean, cov).sample((40_000,))
    uvl = draws[:, :15].view(-1, 5, 3)
    camera = torch.cat([uvl[..., :2], torch.ones_like(uvl[..., :1])], -1)
    camera = (torch.linalg.inv(matrix) @ camera[..., None])[..., 0] * uvl[..., 2:]
    rotation = euler_to_matrix(draws[:, 15:18], "zxy")
    body = (rotation.mT[:, None] @ (camera - draws[:, None, 18:])[..., None])[..., 0]
    for points, (middle, spread) in (
        (camera, arm_in_camera_frame(mean, cov, matrix)),
        (body, arm_in_body_frame(mean, cov, matrix, "zxy")),
    ):
        scale = points.std(0)
        assert ((middle - points.mean(0)).abs() < 0.1 * scale + 5 * scale / 200).all()
        sampled = torch.stack([torch.cov(points[:, j].T) for j in range(5)])
        size = scale[:, :, None] * scale[:, None, :]
        # The neck is the origin of the body frame: hardly any variance is left to compare.
        assert ((spread - sampled).abs() < 0.2 * size + 1e-7)[:4].all()


def test_calibration_finds_scale_and_floor():
    g = torch.Generator().manual_seed(0)
    covs = torch.diag_embed(torch.rand(6000, 2, 3, generator=g, dtype=torch.float64) * 1e-3 + 1e-4)
    noise = torch.randn(6000, 2, 3, generator=g, dtype=torch.float64)
    true = torch.stack([2.0 * covs[:, 0], 0.5 * covs[:, 1]], 1)
    true = true + torch.eye(3) * torch.tensor([0.0, 4e-4])[:, None, None]
    errors = (torch.linalg.cholesky(true) @ noise[..., None])[..., 0]
    scale, floor = fit_calibration(errors, covs)
    fitted = scale[:, None, None] * covs + floor[:, None, None] * torch.eye(3)
    squared = (errors[..., None, :] @ torch.linalg.solve(fitted, errors[..., None])).squeeze()
    for level, bound in ((0.5, 2.366), (0.9, 6.251)):
        share = (squared < bound).double().mean(0)
        assert ((share - level).abs() < 0.03).all()
    with pytest.raises(InputError, match="at least one"):
        fit_calibration(errors[:0], covs[:0])


def test_what_the_recipe_made_is_saved(prior, tmp_path):
    prior.save(tmp_path / "prior.safetensors")
    back = UpperBodyPrior.load(tmp_path / "prior.safetensors")
    assert set(back.windows) == {"causal", "full"}
    assert {f"calibration_scale_{m}" for m in ("pose", "causal", "full")} <= set(back.noise)
    torch.testing.assert_close(back.windows["full"].left.means, prior.windows["full"].left.means)


@pytest.mark.slow
def test_the_recipe_is_repeatable(tmp_path):
    recordings = [recording(performer(12, seed=s).body, person=f"p{s}") for s in (1, 2)]
    for name in ("once", "again"):
        prior = fit_kinect_prior(
            recordings, 3, window_components=3, window_samples=1000, n_samples=1000, pose_steps=5,
            drawn_pieces=1,
        )  # fmt: skip
        assert set(prior.windows) == {"causal", "full"} and "calibration_scale_full" in prior.noise
        prior.save(tmp_path / name)
    assert (tmp_path / "once").read_bytes() == (tmp_path / "again").read_bytes()


def test_one_person_gives_a_prior_without_calibration():
    single = fit_kinect_prior(
        [recording(performer(120, seed=1).body)], 3, window_components=3, window_samples=1000,
        n_samples=1000, pose_steps=5,
    )  # fmt: skip
    assert not any(name.startswith("calibration") for name in single.noise)


def test_fitting_poses_alone_is_still_possible():
    bare = fit_upper_body_prior([recording(performer(120, seed=1).body)], 3, n_samples=1000)
    assert not bare.windows
