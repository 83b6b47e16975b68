from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.io.c3d_parser import parse_c3d
from torchpose.body import BODY_15, Body, centres_of
from torchpose.camera import PinholeCamera
from torchpose.errors import FileFormatError, InputError, SkeletonError
from torchpose.whole_body import BodyTrack, load_body

FIELDS = ("state", "state_std", "joints3d", "covariance3d", "log_evidence",
          "effective_sample_size", "coasting", "respread")  # fmt: skip


def poses(frames=4, frame="parent", seed=0):
    """Poses of a body with bones, limbs and centres of its own."""
    g = torch.Generator().manual_seed(seed)
    body = Body.of_height(BODY_15, 1.62, frame)
    states = 0.2 * torch.randn(frames, body.dim, generator=g, dtype=torch.float64)
    body = body.altered(radii=1.1 * body.radii, centres=centres_of(body, states))
    factor = torch.randn(frames, 15, 3, 3, generator=g, dtype=torch.float64)
    return BodyTrack(
        body, states, states.abs(), body.joints(states), factor @ factor.mT,
        torch.randn(frames, generator=g), torch.rand(frames, generator=g),
        torch.tensor([i == 1 for i in range(frames)]), torch.zeros(frames, dtype=torch.bool),
        50.0, ("a note",), 7,
    )  # fmt: skip


@pytest.mark.parametrize("frame", ["parent", "body"])
def test_what_is_saved_is_loaded(tmp_path, frame):
    before = poses(frame=frame)
    before.save(tmp_path / "body.npz")
    after = BodyTrack.load(tmp_path / "body.npz")
    for name in FIELDS:
        assert torch.equal(getattr(after, name), getattr(before, name)), name
    assert (after.fps, after.notes, after.first_frame) == (50.0, ("a note",), 7)
    torch.testing.assert_close(after.body.joints(after.state), before.joints3d)
    torch.testing.assert_close(
        after.body.limbs(after.state).start, before.body.limbs(before.state).start
    )
    torch.testing.assert_close(after.body.radii, before.body.radii)
    assert after.body.frame == frame


@pytest.mark.parametrize("method", ["kalman", "sir"])
def test_bones_of_kalman_may_have_adapted(tmp_path, method):
    """Its states have the bones of the whole track, far from those of frames that no person explains."""
    before = replace(poses(), method=method)
    before.joints3d[0] *= 1.8
    before.save(tmp_path / "body.npz")
    if method == "kalman":
        assert torch.equal(BodyTrack.load(tmp_path / "body.npz").joints3d, before.joints3d)
    else:
        with pytest.raises(FileFormatError, match="where state puts them"):
            BodyTrack.load(tmp_path / "body.npz")


def test_who_was_not_seen_for_a_second_is_missing_in_files_for_others(tmp_path):
    given = replace(poses(20), fps=5.0)
    frames = torch.arange(20)
    given = replace(given, coasting=(frames >= 5) & (frames < 16))
    for kind in ("trc", "c3d", "bvh"):
        given.export(tmp_path / f"body.{kind}")
    lines = (tmp_path / "body.trc").read_text().splitlines()[6:]
    empty = [not "".join(line.split("\t")[2:]) for line in lines]
    assert [t for t in range(20) if empty[t]] == [10, 11, 12, 13, 14, 15]
    residuals = parse_c3d(tmp_path / "body.c3d").points[..., 3]
    assert [t for t in range(20) if (residuals[t] < 0).all()] == [10, 11, 12, 13, 14, 15]
    motion = (tmp_path / "body.bvh").read_text().splitlines()[-20:]
    assert (
        all(motion[t] == motion[9] for t in range(9, 16)) and motion[8] != motion[9] != motion[16]
    )


def test_failures_are_told_as_in_a_pose_track():
    track = poses()
    assert (track.failed_at.tolist(), track.failed.tolist()) == (-1, False)
    track.respread[2:] = True
    at, failed = track.failed_at, track.failed
    assert (at.shape, at.dtype, at.tolist()) == ((), torch.int64, 2)
    assert (failed.shape, failed.dtype, failed.tolist()) == ((), torch.bool, True)
    # as a number, which it was
    assert (
        f"{at:03d}" == "002"
        and at == 2
        and track.joints3d[at:].shape[0] == 2
        and [5, 6, 7][at] == 7
    )


def test_details_are_saved_by_their_names(tmp_path):
    before = poses()
    before.details = {"actions": torch.rand(4, 3), "released": torch.tensor([True, False] * 2)}
    before.action_names = ("bend", "wave", "none")
    before.save(tmp_path / "body.npz")
    with np.load(tmp_path / "body.npz") as file:
        assert file["detail_released"].tolist() == [True, False, True, False]
        arrays = dict(file)
    after = BodyTrack.load(tmp_path / "body.npz")
    assert after.action_names == before.action_names
    assert after.details.keys() == before.details.keys()
    for name, value in before.details.items():
        assert torch.equal(after.details[name], value)
    np.savez(tmp_path / "short.npz", **(arrays | {"detail_released": np.zeros(3, dtype=bool)}))
    with pytest.raises(FileFormatError, match="detail_released of 4 frames"):
        BodyTrack.load(tmp_path / "short.npz")
    np.savez(tmp_path / "inlier.npz", **(arrays | {"detail_inlier": np.zeros((4, 2, 8))}))
    with pytest.raises(FileFormatError, match=r"\[T, C, 15\] of detail_inlier"):
        BodyTrack.load(tmp_path / "inlier.npz")
    # files of before there were details
    old = {k: v for k, v in arrays.items() if not k.startswith(("detail_", "action_names"))}
    np.savez(tmp_path / "old.npz", **old)
    assert BodyTrack.load(tmp_path / "old.npz").details == {}


def test_joints_in_the_axes_of_a_camera():
    before = poses()
    camera = PinholeCamera(
        500, 500, 320, 240, 640, 480, rotation=(0.3, -0.2, 0.9), translation=(0.1, 0.2, 3)
    )
    seen = before.seen_by(camera)
    K = camera.matrix
    uvl = camera(before.joints3d)
    pixels = seen.joints3d[0] @ K.T
    torch.testing.assert_close(pixels[..., :2] / pixels[..., 2:], uvl[..., :2])
    torch.testing.assert_close(seen.joints3d[0, ..., 2], uvl[..., 2])
    R = camera.rotation_matrix.numpy()
    expected = R @ before.covariance3d[2, 5].numpy() @ R.T
    np.testing.assert_allclose(seen.covariance3d[0, 2, 5].numpy(), expected, atol=1e-12)
    assert seen.observed.shape == (1, 4, 15)
    assert not seen.observed[0, 1].any()
    assert seen.observed[0, 0].all()


def test_joints_are_observed_where_a_camera_has_their_keypoint():
    track = poses()
    inlier = torch.ones(4, 2, 15)
    inlier[:, :, 3] = 0.0  # never detected
    inlier[2, :, 4] = torch.tensor([0.4, 0.9])  # by one of both cameras
    inlier[3, :, 4] = 0.3  # detections of something else
    track.details["inlier"] = inlier
    expected = torch.ones(4, 15, dtype=torch.bool)
    expected[1] = expected[:, 3] = expected[3, 4] = False
    camera = PinholeCamera(500, 500, 320, 240, 640, 480, rotation=(0, 0, 0), translation=(0, 0, 3))
    assert torch.equal(track.seen_by(camera).observed[0], expected)


def test_other_files_are_refused(tmp_path):
    with pytest.raises(InputError):
        BodyTrack.load(tmp_path / "none.npz")
    np.savez(tmp_path / "other.npz", joints=np.zeros((2, 15, 3)))
    with pytest.raises(FileFormatError, match="state"):
        BodyTrack.load(tmp_path / "other.npz")
    poses().save(tmp_path / "body.npz")
    with np.load(tmp_path / "body.npz") as z:
        arrays = dict(z)
    np.savez(tmp_path / "skeleton.npz", **(arrays | {"body_skeleton": np.array("body-99")}))
    with pytest.raises(SkeletonError, match="body-15"):
        load_body(tmp_path / "skeleton.npz")
    np.savez(tmp_path / "frame.npz", **(arrays | {"body_frame": np.array("moon")}))
    with pytest.raises(FileFormatError, match="moon"):
        load_body(tmp_path / "frame.npz")
