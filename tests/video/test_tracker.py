"""Persons of a video who leave, return and cross, rendered."""

import copy
import math
import sys
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from torchpose import PinholeCamera, VideoTracker, load_prior
from torchpose.demo import demo_camera, performer
from torchpose.errors import InputError
from torchpose.priors import UpperBodyPrior
from torchpose.upper_body._keypoint_files import TrackSettings
from torchpose.video._camera import CameraFrame

pytest.importorskip("matplotlib", reason="the performer's face comes from matplotlib")
FACE = 3  # the head, in `UPPER_BODY`


class Video(list):
    """Frames with a rate."""

    def __init__(self, frames, fps):
        super().__init__(frames)
        self.fps = fps


def rendered(*performances):
    from torchpose.demo._rendering import Scene, render_performance

    return list(
        render_performance(performances, demo_camera(), scene=Scene(clutter=False, exposure=0.0))
    )


@pytest.fixture(scope="module")
def one_person():
    """Two seconds of a performer."""
    return rendered(performer(60, distance=1.6))


@pytest.fixture(scope="module")
def pair():
    """Two performers who walk past each other."""
    from benchmarks._performances import crossing

    return crossing(70, seconds=3.0)  # they meet in frame 45


@pytest.fixture(scope="module")
def two_persons(pair):
    return rendered(*pair)


@pytest.mark.parametrize("wrong", [{"max_persons": 1.5}, {"seed": "a"}, {"seed": 1.5}])
def test_what_is_no_whole_number_is_refused(wrong):
    shipped = load_prior("kinect-upper-body-small")
    with pytest.raises(InputError, match="must be a whole number"):
        VideoTracker(shipped, demo_camera(), **wrong)


def test_bones_alone_track_unless_the_prior_knows_others():
    shipped = load_prior("kinect-upper-body-small")
    assert VideoTracker(shipped, demo_camera()).tracker.method == "articulated"
    assert VideoTracker(shipped, demo_camera(), smoothing="full").smoother.method == "articulated"
    assert VideoTracker(shipped, demo_camera(), height=1.7).tracker.method == "articulated"
    as_typed = TrackSettings().tracker_options()  # of the command without any
    assert VideoTracker(shipped, demo_camera(), **as_typed).tracker.method == "articulated"
    assert VideoTracker(shipped, demo_camera(), steady=True).tracker.method == "window-mixture"
    named = VideoTracker(shipped, demo_camera(), method="multiple-model")
    assert named.tracker.method == "multiple-model"
    for persons in ((), (*shipped.info.persons, "somebody else")):
        info = replace(shipped.info, persons=persons)
        own = UpperBodyPrior(shipped.left, shipped.right, info, windows=shipped.windows)
        assert VideoTracker(own, demo_camera()).tracker.method == "multiple-model"


@pytest.fixture
def with_gaps(one_person):
    """Frames 0 to 29, and every third one of the others, as of a camera whose reader became slow."""
    numbers = [*range(30), *range(32, 60, 3)]
    before = [-1, *numbers[:-1]]
    frames = [CameraFrame(one_person[at], at / 30, at) for at in numbers]
    for frame, last in zip(frames, before, strict=True):
        frame.missed = frame.index - last - 1
    return frames


@pytest.mark.slow
def test_missed_frames_take_their_time(prior, one_person, with_gaps):
    tracker = VideoTracker(prior, demo_camera(), method="mkf-fixed")
    shown = []
    (person,) = tracker(with_gaps, watch=lambda image, found, poses: shown.append((image, poses)))
    assert len(shown) == 60 and shown[30][0] is shown[32][0] is one_person[32]
    assert person.first_frame + len(person) == 60
    missed = torch.tensor([at >= 30 and at % 3 != 2 for at in range(person.first_frame, 60)])
    seen = person.keypoints.isfinite().flatten(1).any(1)
    assert not bool(seen[missed].any()) and bool(seen[~missed][5:].all())
    track = person.track
    assert bool(track.joints3d.isfinite().all()) and not bool(track.observed[0, missed].any())
    own = tracker.tracker(
        person.keypoints[None], None, tracker.measurer.names, covariance=person.covariance[None],
        absent=person.absent[None],
    )  # fmt: skip
    torch.testing.assert_close(track.joints3d, own.joints3d, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_step_of_a_frame_before_which_some_were_missed(prior, with_gaps):
    tracker = VideoTracker(prior, demo_camera(), method="mkf-fixed")
    state = tracker.init()
    for frame in with_gaps:
        state, people = tracker.step(state, frame)
    _, parts = tracker.advance(tracker.init(), with_gaps)
    ((number, pose, measured),) = people
    whole = parts[number][-1].poses
    assert pose.joints3d.shape == (1, 1, 8, 3) and len(measured.seen) == 1
    assert pose.lengths.tolist() == [1] and pose.failed_at.tolist() == [-1]
    torch.testing.assert_close(pose.joints3d, whole.joints3d[:, -1:], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_somebody_who_leaves_and_comes_back_is_the_same_person(prior, one_person):
    """Behind a curtain that is drawn, and opened at once."""
    shown = one_person
    closed = np.full_like(shown[0], 120)
    closed[:, np.arange(closed.shape[1]) % 80 < 30] = 60  # folds
    nobody = [shown[30].copy() for _ in range(80)]
    for t, frame in enumerate(nobody):
        frame[:, : 64 * t] = closed[:, : 64 * t]
    tracker = VideoTracker(prior, demo_camera(), method="mkf-fixed", max_gap=1.0)
    (person,) = tracker(shown[:30] + nobody + shown[30:])
    there = person.track.joints3d[0].isfinite().all(-1).all(-1)
    away = torch.nonzero(~there).flatten() + person.first_frame
    # for a second the face is followed blindly, for another one poses are inferred
    assert 90 <= int(away[0]) <= 97 and 108 <= int(away[-1]) <= 116
    assert len(away) == int(away[-1]) - int(away[0]) + 1
    assert person.first_frame + len(person) == 140
    assert person.track.failed_at.tolist() == [-1]


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"smoothing": "full"}, {"candidates": True}])
def test_all_begins_anew_where_the_video_cuts_to_another_scene(prior, one_person, options):
    """From there on the poses are those of the second scene alone."""
    tracker = VideoTracker(prior, demo_camera(), method="mkf-fixed", background=True, **options)
    aside = [np.ascontiguousarray(np.roll(frame, 160, 1)) for frame in one_person[10:30]]
    (alone,) = tracker(aside)
    (joined,) = tracker(one_person[:12] + aside)  # the cut is within a block
    assert joined.first_frame + len(joined) == 32
    own = len(alone)
    poses = joined.track.joints3d[0]
    assert not bool(poses[-own - alone.first_frame : -own].isfinite().any())
    torch.testing.assert_close(poses[-own:], alone.track.joints3d[0], rtol=0, atol=1e-9)
    assert any("another scene at frame 12:" in note for note in joined.track.notes)
    assert not any("another scene" in note for note in alone.track.notes)


def test_all_begins_anew_before_a_camera(prior, one_person):
    tracker = VideoTracker(prior, demo_camera(), method="mkf-fixed")
    aside = [np.ascontiguousarray(np.roll(frame, 160, 1)) for frame in one_person[10:16]]
    state, counts = tracker.init(), []
    for frame in one_person[:6] + aside:
        state, people = tracker.step(state, frame)
        counts.append(len(people))
    assert counts[5] == 1 and counts[6] == 0 and counts[-1] == 1
    assert (state.n_frames, state.cuts) == (12, (6,))
    assert any("another scene at frame 6:" in note for note in people[0].pose.notes)
    torch.testing.assert_close(
        people[0].pose.joints3d, live_poses(tracker, aside)[-1:], rtol=0, atol=1e-9
    )


def live_poses(tracker, frames):
    """Poses of all frames, one frame after the other."""
    state, found = tracker.init(), []
    for frame in frames:
        state, people = tracker.step(state, frame)
        found += [person.pose.joints3d for person in people]
    return torch.cat(found)


@pytest.mark.parametrize("hands", ["learnt", "mean-shift"])
def test_precisions_of_the_program_change_nothing(prior, one_person, hands):
    options = {"method": "mkf-fixed", "hands": hands}
    frames = one_person[:8]
    tracker = VideoTracker(prior, demo_camera(), **options)
    expected = live_poses(tracker, frames)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(live_poses(tracker, frames), expected)
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        found = live_poses(VideoTracker(prior, demo_camera(), **options), frames)
    finally:
        torch.set_default_dtype(before)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_two_who_cross_stay_who_they_are(prior, pair, two_persons):
    tracker = VideoTracker(prior, demo_camera(), method="mkf-fixed")
    people = tracker(two_persons)
    assert len(people) == 2
    camera = demo_camera()
    heads = [camera(walker.joints[:, FACE])[:, :2] for walker in pair]
    sides = torch.stack([heads[0][:, 0] > heads[1][:, 0]])
    assert bool(sides.any()) and not bool(sides.all())  # they do cross
    for person in people:
        rows = slice(person.first_frame, person.first_frame + len(person))
        found = person.keypoints[:, 0]
        apart = torch.stack([(found - head[rows]).norm(dim=1) for head in heads])
        seen = apart.isfinite().all(0)
        nearest = apart[:, seen].argmin(0)
        assert float((nearest == nearest.mode().values).double().mean()) > 0.95
    assert people[0].number != people[1].number


def test_only_the_largest_face_is_followed_if_asked_for(prior, two_persons):
    tracker = VideoTracker(prior, demo_camera(), method="mkf-fixed", max_persons=1)
    people = tracker(two_persons[:30])
    assert len(people) == 1


@pytest.mark.parametrize("edges", [False, True])
def test_images_are_held_for_edges_alone(prior, edges, monkeypatch):
    monkeypatch.setattr("torchpose.video._video_tracker.AHEAD", 4)  # small ones may wait in numbers
    there, held = set(), []

    def frames():
        for _ in range(40):
            image = np.full((48, 64, 3), 90, np.uint8)
            there.add(id(image))
            weakref.finalize(image, there.discard, id(image))
            held.append(len(there))
            yield image

    camera = PinholeCamera.from_image_size(64, 48)
    assert VideoTracker(prior, camera, method="mkf-fixed", edges=edges)(frames()) == []
    assert max(held) >= 32 if edges else max(held) <= 8


@pytest.mark.slow
def test_candidates_of_the_last_pose_reach_the_hands_live_and_offline(prior, one_person):
    shown = one_person[:30]
    tracker = VideoTracker(prior, demo_camera(), method="mkf-fixed", candidates=True)
    asked = []
    find = tracker.measurer.hand_tracker.find

    def spy(*arguments):
        asked.append(arguments[2])
        return find(*arguments)

    tracker.measurer.hand_tracker.__dict__["find"] = spy
    (person,) = tracker(shown)
    given = [e for e in asked if len(e.mean) and bool(e.mean.isfinite().all())]
    assert len(given) >= 25
    last = person.track.joints2d[0, -2, [0, 7]]
    torch.testing.assert_close(given[-1].mean[0], last)
    state, live = tracker.init(), []
    for image in shown:
        state, people = tracker.step(state, image)
        live += [found.pose.joints3d[0, 0] for found in people]
    whole = person.track.joints3d[0]
    torch.testing.assert_close(torch.stack(live[: len(whole)]), whole, rtol=1e-9, atol=1e-9)


def test_a_background_is_of_one_stream(prior):
    camera, image = PinholeCamera.from_image_size(64, 48), np.full((48, 64, 3), 90, np.uint8)
    tracker = VideoTracker(prior, camera, method="mkf-fixed", background=True)
    one, other = tracker.init(), tracker.init()
    one, _ = tracker.step(one, image)
    with pytest.raises(InputError, match="next frame is 1, got frame 0; make a tracker for each"):
        tracker.step(other, image)
    one, _ = tracker.step(one, image)
    copied, _ = copy.deepcopy(tracker).step(one, image)  # which learns the background anew
    assert copied.n_frames == tracker.step(one, image)[0].n_frames == 3
    assert tracker.step(tracker.init(), image)[0].n_frames == 1
    assert tracker([image] * 3) == []


def test_what_tracking_leaves_behind_serves_gradients(prior, one_person):
    from torchpose.measure._body_window import CELLS
    from torchpose.measure._grid_filter import read_out
    from torchpose.measure._hand_network import COARSE, HandNetwork

    forget_constants()  # those that other tests have made
    tracker, state = VideoTracker(prior, demo_camera(), method="mkf-fixed"), None
    watched = []
    for image in one_person[:8]:
        state, people = tracker.step(state or tracker.init(), image)
    tracker(one_person[:4], watch=lambda _, found, poses: watched.append((found, poses)))
    scale = torch.ones((), dtype=torch.float64, requires_grad=True)
    found, poses = watched[-1]
    for value in (
        people[0].pose.joints3d, people[0].pose.covariance2d, people[0].measured.size,
        poses[0].joints2d, found.keypoints, found.hands.covariance, found.faces,
    ):  # fmt: skip
        (value.nan_to_num() * scale).square().sum().backward()
    assert float(scale.grad) > 0
    network = HandNetwork()
    maps, colours = torch.rand(1, 4, *COARSE), torch.rand(1, 3, 4 * COARSE[0], 4 * COARSE[1])
    network(colours, maps, torch.tensor([[0.0, 0.0, 1.0]])).square().sum().backward()
    assert all(bool(weight.grad.isfinite().all()) for weight in network.parameters())
    belief = torch.rand(1, 2, *CELLS, requires_grad=True)
    read_out(belief, smooth=1.5, within=5.0).place.sum().backward()
    assert float(belief.grad.norm()) > 0
    leaf = people[0].measured.keypoints.clone()[None].requires_grad_()
    tracker.tracker(leaf, names=tracker.measurer.names).joints3d.sum().backward()
    assert float(leaf.grad.nan_to_num().norm()) > 0


def forget_constants():
    """Clear every cache of the package."""
    for name in [name for name in sys.modules if name.startswith("torchpose.")]:
        for value in vars(sys.modules[name]).values():
            if hasattr(value, "cache_clear"):
                value.cache_clear()


def test_no_smoothing_and_no_bound_may_be_numbers(prior):
    tracker = VideoTracker(prior, demo_camera(), smoothing=0, max_gap=math.inf)
    assert tracker.smoother is None and tracker.gap == sys.maxsize
    assert tracker.step(tracker.init(), np.zeros((480, 640, 3), np.uint8))[1] == []


@pytest.mark.parametrize("frames", ["clip.mp4", Path("clip.mp4"), None, 0])
def test_what_is_no_video_is_told_how_to_open_one(prior, frames):
    tracker = VideoTracker(prior, demo_camera())
    name = type(frames).__name__
    with pytest.raises(InputError, match=rf"frames must be .*, got {name}; .*open_video\(path\)"):
        tracker(frames)
    with pytest.raises(InputError, match="frames must be RGB images"):
        tracker.advance(tracker.init(), frames)


@pytest.mark.parametrize("fps", ["30", None, math.inf, math.nan, 0.01])
def test_rates_that_no_video_has_are_refused(prior, fps):
    with pytest.raises(InputError, match="fps must be"):
        VideoTracker(prior, demo_camera(), fps=fps)


@pytest.mark.parametrize("switch", ["background", "elbows", "edges", "candidates"])
def test_switches_are_no_texts(prior, switch):
    with pytest.raises(InputError, match=f"{switch} must be True or False, got 'no'"):
        VideoTracker(prior, demo_camera(), **{switch: "no"})


def test_bad_use_is_refused(prior):
    with pytest.raises(InputError, match="hands must be one of"):
        VideoTracker(prior, demo_camera(), hands="feet")
    with pytest.raises(InputError, match="candidates"):
        VideoTracker(prior, demo_camera(), hands="mean-shift", candidates=True)
    for max_gap in (0.0, "5", True):
        with pytest.raises(InputError, match="max_gap must be positive"):
            VideoTracker(prior, demo_camera(), max_gap=max_gap)
    for option in ({"measurement_std": 3.0}, {"neck": "neck"}, {"min_confidence": 0.5}):
        with pytest.raises(InputError, match=f"{next(iter(option))} is of keypoints"):
            VideoTracker(prior, demo_camera(), **option)
    tracker = VideoTracker(prior, demo_camera())
    small = np.zeros((20, 30, 3), np.uint8)
    with pytest.raises(
        InputError, match="30 x 20 pixels, and the camera is for images of 640 x 480"
    ):
        tracker([small])
    with pytest.raises(InputError, match="30 x 20 pixels"):
        tracker.step(tracker.init(), small)
    anywhere = VideoTracker(prior, PinholeCamera(525, 525, 320, 240))
    with pytest.raises(InputError, match="20 x 20 pixels, and those before are of 30 x 20"):
        anywhere([small, small[:, :20]])
    state, _ = anywhere.step(anywhere.init(), small)
    with pytest.raises(InputError, match="20 x 20 pixels, and those before are of 30 x 20"):
        anywhere.step(state, small[:, :20])
    for state in (None, anywhere.tracker.init(1)):
        with pytest.raises(
            InputError, match=r"state must be a VideoState, got .*; begin with init"
        ):
            anywhere.step(state, small)
    for missed in (-1, 2.5, None):
        frame = CameraFrame(small, 0.0, 0)
        frame.missed = missed
        with pytest.raises(InputError, match="missed must be a whole number of frames, 0 or more"):
            anywhere.step(anywhere.init(), frame)
    for image, got in ((None, "NoneType"), (small[..., 0], r"\[20, 30\] of uint8")):
        with pytest.raises(InputError, match=rf"a frame must be RGB.*, got {got}; cv2.cvtColor"):
            anywhere.step(anywhere.init(), image)
    for empty in (small[:0], torch.zeros(3, 0, 5, dtype=torch.uint8)):
        with pytest.raises(InputError, match="a frame must be RGB"):
            anywhere([empty])
    with pytest.raises(InputError, match=r"15\.08 frames per second, and the tracker is for 30"):
        tracker(Video([], 15.08))
    with pytest.raises(InputError, match="25 frames per second"):
        tracker.advance(tracker.init(), Video([], 25.0))
    assert tracker(Video([], 29.97)) == tracker(Video([], 0.0)) == []
    with pytest.raises(InputError, match="uint8"):
        tracker([np.zeros((20, 20, 3))])
    with pytest.raises(InputError, match="RGB tensor"):
        tracker(torch.zeros(1, 20, 20, 3, dtype=torch.uint8))
    smoother = VideoTracker(prior, demo_camera(), smoothing="full")
    with pytest.raises(InputError, match="smoothing"):
        smoother.step(smoother.init(), small)
    assert tracker([]) == []
