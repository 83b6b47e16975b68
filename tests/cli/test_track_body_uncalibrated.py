"""`torchpose track-body` in one camera without a camera file."""

import math

import pytest
import torch

from tests.cli.test_track_body import HEIGHT, WIDTH, arms_rise
from tests.cli.test_track_body_keypoints import keypoints_of, write_grey, write_openpose
from torchpose.body import BODY_15, Body
from torchpose.camera import PinholeCamera, save_cameras
from torchpose.io import write_keypoints
from torchpose.whole_body import BodyTrack

PLAIN = ("--height", 1.75, "--pictures", "false", "--overlay", "false")
AXES = "the axes of the world are x right, y up"
HEAD, PELVIS, ANKLE = (BODY_15.joint(name) for name in ("head", "pelvis", "left_ankle"))


def level_camera() -> PinholeCamera:
    """The camera that is guessed by the size of the images."""
    guessed = PinholeCamera.from_image_size(WIDTH, HEIGHT)
    fx, cx, cy = (float(guessed.matrix[i, j]) for i, j in ((0, 0), (0, 2), (1, 2)))
    return PinholeCamera(fx, fx, cx, cy, WIDTH, HEIGHT, "camera", rotation=(torch.pi, 0, 0))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A folder with keypoints of one person, and the true joints [N, 15, 3] in the axes of a level camera."""
    folder = tmp_path_factory.mktemp("uncalibrated")
    body = Body.of_height(BODY_15, 1.75)
    standing = body.joints(arms_rise(body))  # z is up
    joints = torch.stack([standing[..., 0], standing[..., 2] - 1.0, -standing[..., 1] - 3.2], -1)
    camera = level_camera()
    pixels = camera(joints)[..., :2]
    write_keypoints(folder / "seen.npz", keypoints_of(pixels))
    write_keypoints(folder / "known.npz", keypoints_of(pixels, K=camera.matrix))
    tilted = level_camera().tilted(math.radians(12.0), math.radians(8.0)).in_level_world()
    write_keypoints(folder / "tilted.npz", keypoints_of(tilted(joints)[..., :2]))
    write_keypoints(folder / "seen.csv", keypoints_of(pixels, image_size=None))
    write_openpose(folder / "json", pixels.numpy())
    write_grey(folder / "clip.mp4")
    save_cameras([camera], folder / "cameras.toml")
    return folder, joints


@pytest.fixture
def track(torchpose, scene, tmp_path):
    """The command on an input of the folder: track(cameras, input, "--option") -> Result."""

    def run(cameras, *words):
        given = [
            scene[0] / w if isinstance(w, str) and (scene[0] / w).exists() else w for w in words
        ]
        return torchpose("track-body", cameras, *given, *PLAIN, "--out", tmp_path / "out")

    return run


def test_the_world_of_a_guessed_camera_is_upright(track, scene, tmp_path):
    joints = scene[1]
    done = track("uncalibrated", "seen.npz")
    assert done.code == 0, done.err
    assert "a focal length of 131 pixels" in done.out and AXES in done.out
    poses = BodyTrack.load(tmp_path / "out" / "body.npz").joints3d
    apart = (poses - joints).norm(dim=-1)
    assert float(apart.mean()) < 0.3
    above = poses[..., 1]
    assert bool(
        (above[:, HEAD] > above[:, PELVIS]).all() and (above[:, PELVIS] > above[:, ANKLE]).all()
    )
    assert bool((poses[..., 2] < -2.0).all())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cameras", "words"),
    [
        ("uncalibrated", ("known.npz",)),
        ("131.25,131.25,79.5,59.5", ("seen.npz",)),
        ("131.25,131.25,79.5,59.5", ("json", "--fps", 50)),
        ("uncalibrated", ("json", "--fps", 50, "--videos", "clip.mp4")),
        ("uncalibrated", ("seen.csv", "--fps", 50, "--videos", "clip.mp4")),
    ],
)
def test_poses_are_those_of_a_camera_file(track, scene, tmp_path, cameras, words):
    done = track(cameras, *words, "--tilt", 0)
    assert done.code == 0, done.err
    assert ("a focal length" in done.out) == (
        cameras == "uncalibrated" and "known.npz" not in words
    )
    poses = BodyTrack.load(tmp_path / "out" / "body.npz")
    assert track(scene[0] / "cameras.toml", *words, "--up", "y").code == 0
    same = BodyTrack.load(tmp_path / "out" / "body.npz")
    assert torch.allclose(poses.joints3d, same.joints3d, atol=1e-4)


@pytest.mark.parametrize(
    ("words", "said", "off"),
    [
        (
            ("--tilt", 12, "--roll", 8),
            "looks up by 12 degrees and is rolled by 8 clockwise",
            1e-6,
        ),
        ((), "degrees and is rolled by", math.radians(15.0)),
        (("--persons", "all"), "by how people stand", math.radians(15.0)),
    ],
)
def test_a_tilt_is_stated_or_found(track, scene, tmp_path, words, said, off):
    done = track("uncalibrated", "tilted.npz", "--fps", 12, *words)  # half a second is 6 frames
    assert done.code == 0, done.err
    assert "the camera looks" in done.out and said in done.out and AXES in done.out
    written = PinholeCamera.load(tmp_path / "out" / "camera.toml")
    true = level_camera().tilted(math.radians(12.0), math.radians(8.0)).in_level_world()
    up, true_up = written.rotation_matrix[:, 1], true.rotation_matrix[:, 1]
    assert float(up[0]) == pytest.approx(float(true_up[0]), abs=0.06)  # the roll
    assert math.acos(min(1.0, float(up @ true_up))) < off + 1e-6
    poses = BodyTrack.load(tmp_path / "out" / "body.npz").joints3d
    body = poses[:, HEAD] - poses[:, PELVIS]
    assert float((body[:, 1] / body.norm(dim=-1)).mean()) > math.cos(math.radians(15.0))


def test_the_camera_of_an_earlier_run_is_not_left_beside_poses_of_another_one(
    track, scene, tmp_path
):
    assert track("uncalibrated", "seen.npz", "--tilt", 0).code == 0
    own = tmp_path / "out" / "camera.toml"
    done = track(own, "seen.npz", "--up", "y")
    assert (done.code, own.exists()) == (0, True), done.err  # it is the camera of these poses too
    done = track(scene[0] / "cameras.toml", "seen.npz", "--up", "y")
    assert (done.code, own.exists()) == (0, False), done.err


def test_where_nobody_stands_the_camera_is_taken_to_be_level(track, scene, tmp_path):
    seen = scene[1].clone()
    seen[:, [BODY_15.joint(f"{side}_knee") for side in ("left", "right")]] = torch.nan
    pixels = level_camera()(seen)[..., :2]
    write_keypoints(tmp_path / "no_knees.npz", keypoints_of(pixels))
    done = track("uncalibrated", tmp_path / "no_knees.npz", "--fps", 12)
    assert done.code == 0, done.err
    assert "about level" in done.out and "nobody was seen to stand" in done.out


@pytest.mark.parametrize(
    ("cameras", "words", "said"),
    [
        ("uncalibrated", ("seen.npz", "--tilt", 5, "--up", "y"), "leave --up out"),
        ("uncalibrated", ("seen.npz", "--up", "z"), "the world of uncalibrated has y up"),
        ("uncalibrated", ("seen.npz", "--tilt", 80), "at most 60"),
        ("cameras.toml", ("seen.npz", "--roll", 5), "--roll is for a camera without a file"),
        ("uncalibrated", ("json",), "give the video by --videos, fx,fy,cx,cy"),
        ("uncalibrated", ("seen.npz", "seen.csv"), "stands for one camera, got 2 inputs"),
        ("uncalibrated", ("clip.mp4",), "silhouettes need a TOML file"),
        ("uncalibrated", ("seen.npz", "--camera-names", "front"), "--camera-names is for camera files"),
        ("131,131,79", ("seen.npz",), "four numbers fx,fy,cx,cy in pixels, got '131,131,79'"),
        ("0.8,0.8,0.5,0.5", ("seen.npz",), "a camera must be in pixels"),
        ("uncalibrated.toml", ("seen.npz",), "no such file"),
    ],
)  # fmt: skip
def test_what_one_camera_without_a_file_cannot_do_is_refused(
    track, scene, tmp_path, cameras, words, said
):
    there = scene[0] / cameras
    done = track(there if there.exists() else cameras, *words)
    assert done.code == 2 and said in done.err, done.err
    assert len(done.err.splitlines()) == 1
    assert not (tmp_path / "out").exists()
