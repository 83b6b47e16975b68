"""Bodies start again where their first frame fits nobody."""

import pytest
import torch

import torchpose
from tests.upper_body.test_articulated import CAMERA, ROW, body, pixels, tracker
from torchpose.upper_body import UpperBodyTracker
from torchpose.upper_body._root_grid import RootGrid

SETTLED = 16  # frames: half a second


def exchanged(uv, joint, count):
    """Return keypoints of which those of both sides are exchanged in the first frames."""
    rows = [ROW[f"{joint}_left"], ROW[f"{joint}_right"]]
    uv = uv.clone()
    uv[:count, rows] = uv[:count, rows[::-1]]
    return uv


def moved(uv, joint, by):
    """Return keypoints of which one is elsewhere in the first frame, pixels."""
    uv = uv.clone()
    uv[0, ROW[joint]] += torch.tensor(by)
    return uv


BAD = {
    "hands": lambda uv: exchanged(uv, "hand", 1),
    "hands-of-three-frames": lambda uv: exchanged(uv, "hand", 3),
    "elbows": lambda uv: exchanged(uv, "elbow", 1),
    "shoulder-up": lambda uv: moved(uv, "shoulder_right", [0.0, -130.0]),
}


def spread_arms(n_frames=40):
    """Return a body that waves with its hands apart."""
    joints = body(n_frames)
    joints[:, ROW["hand_left"], 0] += 0.06
    joints[:, ROW["hand_right"], 0] -= 0.06
    return joints


def apart(found, wanted):
    """Return the mean distance of joints relative to their necks, metres, after half a second."""
    off = found - found[:, [ROW["neck"]]] - (wanted - wanted[:, [ROW["neck"]]])
    return float(torch.linalg.vector_norm(off[SETTLED:], dim=-1).mean())


@pytest.fixture(scope="module")
def found():
    """Poses of the body from keypoints that are right, and bad in each way: all in one batch."""
    clean = pixels(spread_arms(), 2.0)
    seen = torch.stack([clean, *(bad(clean) for bad in BAD.values())])
    return dict(zip(("right", *BAD), tracker(outliers=False)(seen).joints3d, strict=True))


@pytest.mark.parametrize("bad", BAD)
def test_a_bad_first_frame_is_forgotten(found, bad):
    # keypoints are averaged over frames, the bad one too
    assert apart(found[bad], found["right"]) < 0.04


def test_a_stream_starts_again_as_the_whole_recording_does():
    uv = BAD["hands"](pixels(spread_arms(12), 2.0))
    whole, live = tracker()(uv[None]).joints3d, tracker()
    state = live.init(1)
    for t, frame in enumerate(uv):
        state, pose = live.step(state, frame[None])
        torch.testing.assert_close(pose.joints3d, whole[:, t], rtol=0, atol=1e-9)


def test_others_of_a_batch_do_not_start_again():
    clean = pixels(spread_arms(20), 2.0)
    uv = torch.stack([clean, BAD["hands"](clean), BAD["shoulder-up"](clean)])
    together = tracker()(uv).joints3d
    for row, alone in enumerate(uv):
        found = tracker()(alone[None]).joints3d[0]
        torch.testing.assert_close(together[row], found, rtol=0, atol=1e-7)


def test_smoothed_poses_forget_it_too():
    clean = pixels(spread_arms(), 2.0)
    seen = torch.stack([BAD["hands"](clean), clean])
    found, wanted = tracker(smoothing="full")(seen).joints3d
    assert apart(found, wanted) < 0.04  # keypoints are averaged over frames, the bad one too


@pytest.mark.parametrize("bad", [False, True], ids=["good", "bad"])
def test_bodies_start_again_only_where_a_frame_does_not_fit(monkeypatch, bad):
    looked, frame = [], 0
    whole = RootGrid.at_all_depths

    def look(*given):
        looked.append(frame)
        return whole(*given)

    monkeypatch.setattr(RootGrid, "at_all_depths", look)
    uv = pixels(spread_arms(24), 2.0)
    live = tracker()
    state = live.init(1)
    for frame, keypoints in enumerate(BAD["hands"](uv) if bad else uv):  # noqa: B007  # `look` reads it
        state, _ = live.step(state, keypoints[None])
    assert looked[:2] == ([0, 3] if bad else [0])


def test_bodies_that_never_fit_start_for_half_a_second(monkeypatch):
    starts = []
    whole = RootGrid.at_all_depths
    monkeypatch.setattr(RootGrid, "at_all_depths", lambda *x: (starts.append(1), whole(*x))[1])
    uv = exchanged(pixels(spread_arms(30), 2.0), "hand", 30)
    found = tracker(outliers=False)(uv[None]).joints3d
    assert len(starts) == 6
    assert bool(found.isfinite().all())


def late(uv, count, n_frames):
    """Return keypoints of a body that comes after so many empty frames."""
    return torch.cat([torch.full_like(uv[:1].expand(count, -1, -1), torch.nan), uv])[:n_frames]


def test_bodies_that_come_late_are_tracked_from_their_first_frame():
    uv = pixels(spread_arms(24), 2.0)
    found = tracker()(torch.stack([late(uv, count, 24) for count in (0, 1, 2, 3)])).joints3d
    for count in (1, 2, 3):  # a torso is updated in every third frame
        off = (found[count, count:] - found[0, : 24 - count]).norm(dim=-1)
        assert float(off.max()) < 0.05
    for count, together in enumerate(found):
        alone = tracker()(late(uv, count, 24)[None]).joints3d[0]
        torch.testing.assert_close(together, alone, rtol=0, atol=1e-7)


def test_a_stream_finds_who_comes_late_as_the_whole_recording_does():
    uv = late(pixels(spread_arms(9), 2.0), 3, 9)
    others = [row for name, row in ROW.items() if name not in ("head", "neck", "hand_left")]
    uv[:, others], uv[:5, ROW["neck"]] = torch.nan, torch.nan  # one joint of the torso, then two
    whole, live = tracker()(uv[None]).joints3d, tracker()
    state = live.init(1)
    for t, frame in enumerate(uv):
        state, pose = live.step(state, frame[None])
        torch.testing.assert_close(pose.joints3d, whole[:, t], rtol=0, atol=1e-9)


@pytest.fixture(scope="module")
def windows():
    """The prior with windows."""
    return torchpose.load_prior("kinect-upper-body")


@pytest.mark.parametrize(
    ("method", "smoothing"),
    [("window-mixture", None), ("window-mixture", 20), ("multiple-model", None)],
)
def test_windows_begin_where_somebody_is_first_seen(windows, method, smoothing):
    uv = pixels(body(10, depth=1.3), 2.0)  # far from the prior's place
    seen = late(uv, 3, 13).repeat(2, 1, 1, 1)
    seen[0, :10], seen[0, 10:] = uv, torch.nan
    tracker = UpperBodyTracker(windows, CAMERA, method, fps=30.0, smoothing=smoothing)
    at_once, found = tracker(seen, lengths=torch.tensor([10, 13])).joints3d
    off = (found[3:] - at_once[:10]).norm(dim=-1)
    if method == "window-mixture":
        assert float(off.max()) < 1e-9
    else:  # bones update their torso in other frames
        assert float(off[:3].max()) < 0.03


@pytest.mark.parametrize("method", ["window-mixture", "multiple-model"])
def test_a_stream_of_windows_begins_there_too(windows, method):
    uv = pixels(spread_arms(9), 2.0)
    seen = torch.stack([late(uv, count, 9) for count in (0, 3, 7)])
    live = UpperBodyTracker(windows, CAMERA, method, fps=30.0)
    whole, state, found = live(seen).joints3d, live.init(3), []
    for part in seen.split([1, 1, 2, 5], 1):
        state, track = live.advance(state, part)
        found.append(track.joints3d)
    torch.testing.assert_close(torch.cat(found, 1), whole, rtol=0, atol=1e-9)
