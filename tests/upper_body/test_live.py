"""Frame by frame the tracker says what it says about whole sequences."""

import copy

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from torchpose import PinholeCamera
from torchpose.camera._virtual_camera import Regression
from torchpose.demo import KEYPOINT_NAMES, demo_camera, noisy_keypoints, performer
from torchpose.errors import InputError, ShapeError, SkeletonError
from torchpose.priors import load_prior
from torchpose.upper_body import METHODS, UpperBodyTracker, method_options
from torchpose.upper_body._measured_joints import pixels_per_metre

NAMES = list(KEYPOINT_NAMES)
FIELDS = ("joints2d", "joints3d", "covariance2d", "covariance3d", "log_evidence")


@pytest.fixture(scope="module")
def keypoints():
    """Three performers who move about, with hidden hands, a hidden body and a late start."""
    frames = torch.stack(
        [noisy_keypoints(performer(44, seed=s).joints, std_px=3.0) for s in range(3)]
    )
    walk = torch.linspace(0, 150, 44, dtype=torch.float64)
    frames[0, ..., 0] += walk[:, None]
    frames[2] = 300 + (frames[2] - 300) * (1 + walk / 300)[:, None, None]
    frames[0, 30:36] = torch.nan
    frames[1, :4] = torch.nan
    frames[1, 12:38, 2] = torch.nan
    frames[2, 5:38, NAMES.index("head")] = torch.nan
    return frames


@pytest.fixture(scope="module")
def few(keypoints):
    """The first frames of these: for what is the same in every frame."""
    return keypoints[:, :12]


def stream(tracker, keypoints, generator=None, confidence=None, mask=None, names=NAMES):
    state = tracker.init(len(keypoints), names=names, generator=generator)
    poses = []
    for t in range(keypoints.shape[1]):
        given = (None if x is None else x[:, t] for x in (confidence, mask))
        state, pose = tracker.step(state, keypoints[:, t], *given)
        poses.append(pose)
    return state, poses


def in_units_of(whole, cov):
    """Covariances over the standard deviations of the whole track, whatever their unit."""
    std = whole.diagonal(dim1=-2, dim2=-1).sqrt()
    return cov / (std[..., :, None] * std[..., None, :])


def check_equal(poses, track, fields=FIELDS):
    for name in fields:
        live = torch.stack([getattr(pose, name) for pose in poses], 1)
        whole = getattr(track, name)
        if name.startswith("covariance"):
            live, whole = in_units_of(whole, live), in_units_of(whole, whole)
            # `forward` takes covariances as settled once a step changes them by less than 4e-13;
            # a camera that hardly moves comes to rest over a thousand such steps.
            torch.testing.assert_close(live, whole, rtol=0, atol=2e-9, equal_nan=True)
            continue
        torch.testing.assert_close(live, whole, rtol=1e-10, atol=1e-10, equal_nan=True)
    assert torch.equal(torch.stack([pose.observed for pose in poses], 1), track.observed)


@pytest.mark.parametrize("uncertain", [False, True])
@pytest.mark.parametrize("method", METHODS)
def test_steps_are_the_frames_of_forward(prior, keypoints, few, method, uncertain):
    options = {"n_particles": 100} if "n_particles" in method_options(method) else {}
    tracker = UpperBodyTracker(prior, demo_camera(), method=method, max_gap=None, **options)
    confidence = mask = None
    if uncertain:
        keypoints = few
        g = torch.Generator().manual_seed(3)
        confidence = torch.rand(keypoints.shape[:3], generator=g, dtype=torch.float64)
        mask = torch.rand(keypoints.shape[:3], generator=g) < 0.9
    generators = [[torch.Generator().manual_seed(b) for b in range(3)] for _ in range(2)]
    track = tracker(keypoints, confidence, NAMES, mask, generators[0])
    _, poses = stream(tracker, keypoints, generators[1], confidence, mask)
    check_equal(poses, track)


def test_noise_that_stays_is_computed_with_once(prior, few, monkeypatch):
    """Weights of the last second are those of the frame before; a confidence changes all that follow."""
    tracker, computed = UpperBodyTracker(prior, demo_camera(), method="window-mixture"), []
    weights = Regression.weights

    def counted(self, known, more):
        computed.append(len(known))
        return weights(self, known, more)

    frames = few[:, :1].expand(-1, 36, -1, -1).nan_to_num(250.0)
    sure = torch.ones(frames.shape[:3], dtype=torch.float64)
    sure[:, 34] = 0.5
    whole = tracker(frames, sure, NAMES)
    monkeypatch.setattr(Regression, "weights", counted)
    _, poses = stream(tracker, frames, confidence=sure)
    check_equal(poses, whole)
    assert computed == [1] * 31 + [3] * 2


@pytest.mark.parametrize("options", [{}, {"method": "mkf-fixed"}, {"method": "mkf-sampled"}])
def test_blocks_of_frames_are_those_of_forward(prior, keypoints, options):
    tracker = UpperBodyTracker(prior, demo_camera(), max_gap=None, **options)
    generators = [[torch.Generator().manual_seed(b) for b in range(3)] for _ in range(2)]
    noise = torch.tensor([2.0, 5.0], dtype=torch.float64)[
        torch.randint(0, 2, keypoints.shape[:3], generator=torch.Generator().manual_seed(4))
    ]
    cov = noise.square()[..., None, None] * torch.eye(2, dtype=torch.float64)
    track = tracker(keypoints, names=NAMES, generator=generators[0], covariance=cov)
    state = tracker.init(3, names=NAMES, generator=generators[1])
    parts, start = [], 0
    for length in (1, 7, 32, 4):
        rows = slice(start, start + length)
        state, part = tracker.advance(state, keypoints[:, rows], covariance=cov[:, rows])
        parts.append(part)
        start += length
    for name in (*FIELDS, "observed"):
        joined = torch.cat([getattr(part, name) for part in parts], 1)
        torch.testing.assert_close(joined, getattr(track, name), rtol=1e-9, atol=1e-9)
    assert state.unseen.tolist() == [0, 0, 0]
    state, _ = tracker.advance(state, torch.full((3, 4, 4, 2), torch.nan))
    state, _ = tracker.advance(state, torch.full((3, 3, 4, 2), torch.nan))
    assert state.unseen.tolist() == [7, 7, 7]


def test_one_generator_for_all_streams(prior, few):
    tracker = UpperBodyTracker(prior, demo_camera(), "pf-mixture", n_particles=50, max_gap=None)
    track = tracker(few, names=NAMES, generator=torch.Generator().manual_seed(1))
    check_equal(stream(tracker, few, torch.Generator().manual_seed(1))[1], track)


@pytest.mark.parametrize("frame", ["body", "static"])
def test_settings_of_the_tracker_count_here_too(prior, few, frame):
    options = {"static_camera": True} if frame == "static" else {"frame": "body"}
    tracker = UpperBodyTracker(prior, demo_camera(), fps=15.0, max_gap=None, **options)
    check_equal(stream(tracker, few)[1], tracker(few, names=NAMES))


def test_names_that_are_never_measured_change_nothing(prior, few):
    tracker = UpperBodyTracker(prior, demo_camera(), max_gap=None)
    empty = torch.full_like(few[:, :, :2], torch.nan)
    wide = torch.cat([empty, few], 2)
    names = ["elbow_left", "shoulder_right", *NAMES]
    check_equal(stream(tracker, wide, names=names)[1], tracker(few, names=NAMES))


def test_a_neck_of_another_kind_is_converted_here_too(prior, few):
    tracker = UpperBodyTracker(prior, demo_camera(), neck="mid-shoulder", max_gap=None)
    track = tracker(few, names=NAMES)
    state, poses = stream(tracker, few)
    check_equal(poses, track)
    assert state.picked.notes == state.notes == track.notes != ()
    assert tracker.advance(tracker.init(len(few), NAMES), few[:, :2])[1].notes == track.notes


def test_a_stream_says_what_it_assumes(prior, few):
    camera = PinholeCamera(525, 525, 319.5, 239.5, 640, 480, distortions=(-0.2, 0.05))
    tracker = UpperBodyTracker(prior, camera, "mkf-fixed", outliers=False)
    names = ["wrist_" + name[5:] if "hand" in name else name for name in NAMES]
    state = tracker.init(len(few), names)
    assert any("distortions are not applied" in note for note in state.notes)
    assert any("wrists" in note for note in state.notes)
    assert tracker.step(state, few[:, 0])[0].notes == state.notes == tracker(few, names=names).notes


def test_a_stream_goes_on_while_nothing_is_seen_and_says_for_how_long(prior, keypoints):
    tracker = UpperBodyTracker(prior, demo_camera(), fps=15.0, max_gap=1.0)
    state, poses = stream(tracker, keypoints[:1, :30])
    assert float(poses[-1].unseen) == 0
    hidden = torch.full((1, 4, 2), torch.nan, dtype=torch.float64)
    for _ in range(30):
        state, pose = tracker.step(state, hidden)
    assert float(pose.unseen) == pytest.approx(2.0)  # twice max_gap
    assert torch.isfinite(pose.joints3d).all() and not bool(pose.failed)
    spread = pose.covariance3d.diagonal(dim1=-2, dim2=-1).sum()
    assert spread > poses[-1].covariance3d.diagonal(dim1=-2, dim2=-1).sum()
    _, pose = tracker.step(state, keypoints[:1, 36])
    assert float(pose.unseen) == 0


@pytest.mark.parametrize("method", METHODS)
def test_poses_are_the_callers_to_write_to(prior, few, method):
    options = {"n_particles": 50} if "n_particles" in method_options(method) else {}
    tracker = UpperBodyTracker(prior, demo_camera(), method=method, max_gap=None, **options)
    few = few[:1, :8]
    state = tracker.init(1, NAMES, torch.Generator().manual_seed(0))
    for t in range(few.shape[1]):
        state, pose = tracker.step(state, few[:, t])
        found = pose.joints3d.clone()
        for value in pose:
            value.fill_(1)
    given = (few, None, NAMES, None)
    track = tracker(*given, torch.Generator().manual_seed(0))
    torch.testing.assert_close(found, track.joints3d[:, -1], rtol=1e-9, atol=1e-9)
    track.matrix.mul_(0.5)  # the camera matrix of a smaller image
    again = tracker(*given, torch.Generator().manual_seed(0))
    assert torch.equal(again.joints2d, track.joints2d)


def test_a_step_leaves_its_state_as_it_was(prior, keypoints):
    tracker = UpperBodyTracker(prior, demo_camera(), max_gap=None)
    state, _ = stream(tracker, keypoints[:, :10])
    first = tracker.step(state, keypoints[:, 10])[1]
    tracker.step(state, keypoints[:, 40])
    again = tracker.step(state, keypoints[:, 10])[1]
    torch.testing.assert_close(first.joints3d, again.joints3d, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"batch_size": 0}, InputError, "at least 1"),
        ({"names": None, "n": 4}, ShapeError, "keypoints"),
        ({"names": [*NAMES[:3], "tail"]}, SkeletonError, "tail"),
        ({"smoothing": "full"}, InputError, "smoothing=None"),
        ({"n": 3}, ShapeError, "keypoints"),
        ({"value": float("inf")}, InputError, "finite"),
        ({"confidence": torch.ones(2, 3)}, ShapeError, "confidence"),
        ({"mask": torch.ones(2, 3, dtype=torch.bool)}, ShapeError, "mask"),
        ({"rows": 1}, ShapeError, "keypoints"),
    ],
)
def test_bad_streams_are_refused(prior, change, error, message):
    tracker = UpperBodyTracker(prior, demo_camera(), smoothing=change.get("smoothing"))
    frame = torch.full((change.get("rows", 2), change.get("n", 4), 2), change.get("value", 240.0))
    with pytest.raises(error, match=message):
        state = tracker.init(change.get("batch_size", 2), change.get("names", NAMES))
        tracker.step(state, frame, change.get("confidence"), change.get("mask"))


def test_states_of_something_else_are_refused(prior, few):
    tracker, other = (UpperBodyTracker(prior, demo_camera(), m) for m in (None, "mkf-fixed"))
    for state in (None, (1, 2)):
        with pytest.raises(InputError, match=r"state must be a StreamState, got .*begin with init"):
            tracker.step(state, few[:, 0])
        with pytest.raises(InputError, match="state must be a StreamState"):
            tracker.advance(state, few)
    with pytest.raises(InputError, match=r"of method 'mkf-fixed', .* got one of 'multiple-model'"):
        other.step(tracker.init(len(few), NAMES), few[:, 0])


@pytest.mark.parametrize(
    ("method", "change", "message"),
    [
        ("mkf-fixed", {"fps": 15.0}, r"with fps=15.0, got .* with fps=30.0; begin with init"),
        ("articulated", {"height": 1.9}, "height=1.9, got .* height=None"),
        (
            "articulated",
            {"bone_lengths": {"forearm": 0.2}},
            "bone_lengths=.*got .* bone_lengths=None",
        ),
        ("multiple-model", {"steady": False}, "steady=False, got .* steady=True"),
        ("mkf-fixed", {"outliers": False}, "outliers=False, got .* outliers=True"),
        ("pf-walk", {"n_particles": 50}, "n_particles=50, got .* n_particles=None"),
    ],
)
def test_states_of_a_tracker_with_other_options_are_refused(prior, few, method, change, message):
    tracker = UpperBodyTracker(prior, demo_camera(), method, fps=30.0)
    other = UpperBodyTracker(prior, demo_camera(), method, **{"fps": 30.0, **change})
    state, _ = tracker.step(tracker.init(len(few), NAMES), few[:, 0])
    with pytest.raises(InputError, match=message):
        other.step(state, few[:, 1])
    with pytest.raises(InputError, match=message):
        other.advance(state, few)
    copy.deepcopy(tracker).step(state, few[:, 1])


def test_a_tracker_that_smooths_takes_no_state_of_one_that_does_not(prior, few):
    tracker, smoother = (
        UpperBodyTracker(prior, demo_camera(), "mkf-fixed", smoothing=s) for s in (None, 5)
    )
    state = tracker.init(len(few), NAMES)
    for call in (lambda: smoother.step(state, few[:, 0]), lambda: smoother.advance(state, few)):
        with pytest.raises(InputError, match="expected smoothing=None, got 5"):
            call()


def test_what_no_step_changes_is_computed_once(prior, few, monkeypatch):
    tracker = UpperBodyTracker(prior, demo_camera(), "articulated", neck="mid-shoulder")
    state, _ = tracker.step(tracker.init(len(few), NAMES), few[:, 0])

    def again(*_args, **_options):
        raise AssertionError("computed in every step")

    monkeypatch.setattr(torch.linalg, "inv", again)
    monkeypatch.setattr(type(prior.left), "moments", again)
    tracker.step(state, few[:, 1])


def test_the_scale_of_a_prior_follows_its_mean_pose(prior):
    own = copy.deepcopy(prior)
    before = pixels_per_metre(own)
    assert pixels_per_metre(own) == before == pixels_per_metre(prior)
    for mixture in (own.left, own.right):
        mixture.means[:, 14] *= 2
    assert pixels_per_metre(own) == pytest.approx(before / 2)


class Counter(TorchDispatchMode):
    """Counts the operations of torch."""

    count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count += 1
        return func(*args, **(kwargs or {}))


def test_a_step_is_a_bounded_number_of_operations(keypoints):
    """A step of one stream takes as long as its small operations: some 2.5 microseconds each."""
    prior = load_prior("kinect-upper-body")
    tracker = UpperBodyTracker(prior, prior.camera, fps=30.0)
    few, generator = keypoints[:1], torch.Generator().manual_seed(0)
    drawn = 0.5 + 0.5 * torch.rand(few.shape[:-1], generator=generator)
    for confidence, most in ((torch.ones_like(drawn), 2330), (drawn, 2485)):
        with torch.inference_mode():
            state, _ = stream(tracker, few[:, :12], confidence=confidence[:, :12])
            with Counter() as counter:
                for t in range(12, 18):  # the lengths of bones are learnt in one of six
                    state, _ = tracker.step(state, few[:, t], confidence[:, t])
        assert counter.count / 6 < most


def test_what_is_no_tensor_or_not_of_one_frame_is_named(prior, few):
    tracker = UpperBodyTracker(prior, camera=demo_camera(), method="mkf-fixed")
    state, frame = tracker.init(len(few), names=NAMES), few[:, 0]
    mask = torch.ones(len(few), len(NAMES), dtype=torch.bool)
    for given, said in (
        ({"keypoints": frame.tolist()}, "keypoints must be a tensor, got list"),
        ({"confidence": 0.5}, "confidence must be a tensor, got float"),
        ({"mask": mask.numpy()}, "mask must be a tensor, got ndarray"),
    ):
        with pytest.raises(InputError, match=said):
            tracker.step(state, **{"keypoints": frame, **given})
    whole = few.new_ones(few.shape[:3])
    for given, said in (
        (
            {"keypoints": few.to("meta")},
            "keypoints must hold numbers, got a tensor on the device meta",
        ),
        ({"keypoints": few.to(torch.complex64)}, "keypoints must be real"),
        ({"confidence": whole.to("meta")}, "confidence must hold numbers"),
        ({"covariance": few.to_sparse()}, "covariance must be a dense tensor"),
        ({"lengths": torch.ones(len(few), dtype=torch.complex64)}, "lengths must be real"),
    ):
        with pytest.raises(InputError, match=said):
            tracker(**{"keypoints": few, "names": NAMES, **given})
    with pytest.raises(InputError, match="mask must be a tensor, got ndarray"):
        tracker(few, mask=mask[:, None].expand(few.shape[:3]).numpy(), names=NAMES)
    with pytest.raises(ShapeError, match=r"confidence must have shape \[3, 4\], got \[4\]"):
        tracker.step(state, frame, confidence=torch.ones(4))


def left_and_came_back(seconds):
    """A performer, nobody for some seconds at 10 frames per second, and another one elsewhere."""
    first, second = (noisy_keypoints(performer(8, seed=s).joints, std_px=3.0) for s in (0, 1))
    nobody = torch.full((round(10 * seconds), *first.shape[1:]), torch.nan, dtype=first.dtype)
    return first, torch.cat([first, nobody, second + 120.0])[None], (second + 120.0)[None]


@pytest.mark.parametrize("method", ["articulated", "mkf-fixed"])
def test_a_stream_begins_anew_after_max_gap(method):
    tracker = UpperBodyTracker(
        load_prior("kinect-upper-body"), demo_camera(), method=method, fps=10.0, max_gap=1.0
    )
    _, frames, second = left_and_came_back(1.1)
    _, poses = stream(tracker, frames)
    _, fresh = stream(tracker, second)
    for ours, theirs in zip(poses[-len(fresh) :], fresh, strict=True):
        torch.testing.assert_close(ours.joints3d, theirs.joints3d, rtol=0, atol=0)
    state = tracker.init(1, names=NAMES)
    _, track = tracker.advance(state, frames)
    together = torch.stack([pose.joints3d for pose in poses], 1)
    torch.testing.assert_close(track.joints3d, together, rtol=1e-9, atol=1e-9)
    assert track.lengths.tolist() == [frames.shape[1]] and track.failed_at.tolist() == [-1]


@pytest.mark.parametrize(("seconds", "max_gap"), [(1.0, 1.0), (1.1, None)])
def test_a_stream_goes_on_after_a_shorter_gap(seconds, max_gap):
    tracker = UpperBodyTracker(
        load_prior("kinect-upper-body"),
        demo_camera(),
        method="articulated",
        fps=10.0,
        max_gap=max_gap,
    )
    _, frames, _ = left_and_came_back(seconds)
    _, poses = stream(tracker, frames)
    track = tracker(frames, names=NAMES)
    torch.testing.assert_close(poses[-1].joints3d, track.joints3d[:, -1], rtol=1e-9, atol=1e-9)


def test_streams_of_one_state_begin_anew_once_all_were_away():
    tracker = UpperBodyTracker(
        load_prior("kinect-upper-body"), demo_camera(), method="articulated", fps=10.0, max_gap=1.0
    )
    first, gone, _ = left_and_came_back(1.1)
    there = gone.clone()
    there[0, len(first) + 5] = first[-1]  # the other stream sees somebody in between
    _, poses = stream(tracker, torch.cat([gone, there]))
    _, alone = stream(tracker, gone)
    _, both = stream(tracker, torch.cat([gone, gone]))
    torch.testing.assert_close(both[-1].joints3d[:1], alone[-1].joints3d, rtol=1e-9, atol=1e-9)
    assert (poses[-1].joints3d[0] - alone[-1].joints3d[0]).norm(dim=-1).max() > 0.01
