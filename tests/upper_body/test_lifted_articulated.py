"""Arms of bones averaged with those that a network lifts: whole, live and smoothed."""

import pytest
import torch

import torchpose
from tests.upper_body.lifters import UNSURE, Told
from tests.upper_body.test_articulated import CAMERA, body, bones, pixels, tracker
from torchpose.errors import InputError
from torchpose.priors._arm_lifter import shipped_arm_lifter
from torchpose.upper_body import UpperBodyTracker


@pytest.fixture(scope="module")
def joints():
    return body(40)


@pytest.fixture(scope="module")
def uv(joints):
    return pixels(joints, 2.0)[None]


def from_shoulders(joints):
    return torch.cat([bone for side in ("left", "right") for bone in bones(joints, side)], -1)


@pytest.mark.parametrize("smoothing", [None, 5, "full"])
def test_arms_come_nearer_to_a_network_that_knows_them(joints, uv, smoothing):
    alone, told = (
        tracker(smoothing=smoothing, lifter=lifter)(uv) for lifter in (UNSURE, Told(joints))
    )
    off = [
        (from_shoulders(track.joints3d[0]) - from_shoulders(joints)).norm(dim=-1).mean()
        for track in (alone, told)
    ]
    assert float(off[1]) < 0.8 * float(off[0])
    torch.testing.assert_close(told.joints2d, alone.joints2d, atol=3.0, rtol=0)


def test_covariances_and_lengths_are_those_of_bones(joints, uv):
    alone, told = (tracker(lifter=lifter)(uv) for lifter in (UNSURE, Told(joints)))
    for name in ("covariance3d", "bone_lengths", "bone_covariance"):
        assert torch.equal(getattr(told, name), getattr(alone, name))


def test_a_stream_gives_the_numbers_of_the_whole_recording(uv):
    whole, live = tracker()(uv), tracker()
    state, found = live.init(1), []
    for part in uv.split([1, 1, 7, 31], 1):
        state, track = live.advance(state, part)
        found.append(track.joints3d)
    torch.testing.assert_close(torch.cat(found, 1), whole.joints3d)


def test_frames_past_the_length_of_a_sequence_repeat_its_last(uv):
    both = tracker()(uv.expand(2, -1, -1, -1), lengths=torch.tensor([40, 25]))
    alone = tracker()(uv[:, :25])
    torch.testing.assert_close(both.joints3d[1, :25], alone.joints3d[0])
    assert torch.equal(both.joints3d[1, 25:], both.joints3d[1, 24:25].expand(15, -1, -1))


def test_the_network_may_come_from_a_file(tmp_path, uv):
    file = tmp_path / "arms.safetensors"
    shipped_arm_lifter().save(file)
    found = [tracker(lifter=own)(uv[:, :5]).joints3d for own in (None, file, UNSURE)]
    assert torch.equal(found[0], found[1])
    assert not torch.allclose(found[0], found[2])
    with pytest.raises(InputError, match="lifter must be a network that lifts arms"):
        tracker(lifter=3)


def test_a_network_alone_means_arms_of_bones():
    prior = torchpose.load_prior("kinect-upper-body-small")
    tracker = UpperBodyTracker(prior, CAMERA, fps=30.0, lifter=UNSURE)
    assert tracker.method == "articulated"
