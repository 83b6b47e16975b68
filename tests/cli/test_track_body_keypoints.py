"""`torchpose track-body` on keypoints: every kind of input, what is written, and what is refused."""

import json
import math
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from tests.cli.test_track_body import HEIGHT, WIDTH, N, arms_rise, looking_at
from torchpose import BodyTracker
from torchpose.body import BODY_15, Body, fit_state
from torchpose.camera import CameraRig, PinholeCamera, load_cameras, save_cameras
from torchpose.cli._body_keypoint_inputs import read_body_keypoints
from torchpose.cli._track_body import command
from torchpose.cli._track_body_options import check_numbers
from torchpose.errors import InputError, NobodySeenError
from torchpose.io import Keypoints, write_keypoints
from torchpose.skeleton._joint_sets import SKELETONS
from torchpose.skeleton._mediapipe_landmarks import LANDMARKS
from torchpose.video import VideoWriter, open_video
from torchpose.whole_body import BodyTrack

FPS = 50.0
PLACES = {"front": (0.3, 3.2, 1.2), "left": (-3.0, 0.4, 1.4), "behind": (1.6, -2.7, 1.3)}
OPENPOSE = SKELETONS["openpose-25"].joints
IN_OPENPOSE = {"pelvis": "MidHip", "neck": "Neck"}
DETECTOR = """
import numpy as np

POINTS = np.load({points!r})


class front:
    names = {names!r}

    def __init__(self):
        self.at = 0

    def __call__(self, image):
        self.at += 1
        return POINTS[self.at - 1 : self.at], np.full((1, len(self.names)), 0.8)


class nobody(front):
    def __call__(self, image):
        return np.zeros((0, len(self.names), 2)), np.zeros((0, len(self.names)))
"""


def openpose_name(joint: str) -> str:
    side, _, kind = joint.rpartition("_")
    return IN_OPENPOSE.get(joint, side[:1].upper() + kind.capitalize())


def write_openpose(folder, *people) -> None:
    """Keypoints [T, 15, 2] of persons as OpenPose writes them, without the head, in an order that changes.

    Frames of NaN are without the person.
    """
    folder.mkdir()
    table = np.zeros((len(people[0]), len(people), len(OPENPOSE), 3))
    for j, joint in enumerate(BODY_15.names):
        if joint != "head":
            at = OPENPOSE.index(openpose_name(joint))
            table[:, :, at, :2] = np.stack([points[:, j] for points in people], 1)
            table[:, :, at, 2] = 0.9
    for t, frame in enumerate(table):
        there = [person for person in frame if np.isfinite(person).all()]
        people = [{"pose_keypoints_2d": person.ravel().tolist()} for person in there]
        content = {"people": people[::-1] if t % 2 else people}
        (folder / f"video_{t:012d}_keypoints.json").write_text(json.dumps(content))


def keypoints_of(points, **more) -> Keypoints:
    facts = {"fps": FPS, "image_size": (WIDTH, HEIGHT)} | more
    return Keypoints(points, BODY_15.names, None, **facts)


def write_cameras(folder) -> list[PinholeCamera]:
    """The cameras of the scenes, in cameras.toml."""
    cameras = [looking_at(name, place) for name, place in PLACES.items()]
    save_cameras(cameras, folder / "cameras.toml")
    return cameras


def write_grey(path, n_frames=N) -> None:
    """A video in which nothing is to be seen."""
    with VideoWriter(path, FPS, (WIDTH, HEIGHT)) as writer:
        for _ in range(n_frames):
            writer.write(np.full((HEIGHT, WIDTH, 3), 90, np.uint8))


def write_videos(folder) -> None:
    """Grey videos of all cameras."""
    for name in PLACES:
        write_grey(folder / f"{name}.mp4")


def on_files(torchpose, folder, *always):
    """The command on files of a folder: run(out, "front_json", ..., "--option") -> Result."""

    def run(out, *words):
        given = [folder / w if isinstance(w, str) and (folder / w).exists() else w for w in words]
        return torchpose("track-body", folder / "cameras.toml", *given, *always, "--out", out)

    return run


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A folder with cameras.toml, front_json/, left.csv and behind.npz, and the true joints [N, 15, 3]."""
    folder = tmp_path_factory.mktemp("keypoints")
    body = Body.of_height(BODY_15, 1.75)
    joints = body.joints(arms_rise(body))
    cameras = write_cameras(folder)
    generator = torch.Generator().manual_seed(0)
    points = CameraRig(cameras)(joints).pixels
    points = points + 0.3 * torch.randn(points.shape, generator=generator, dtype=points.dtype)
    write_openpose(folder / "front_json", points[:, 0].numpy())
    write_keypoints(folder / "left.csv", keypoints_of(points[:, 1]))
    write_keypoints(folder / "behind.npz", keypoints_of(points[:, 2]))
    write_keypoints(folder / "front.npz", keypoints_of(points[:, 0]))
    write_videos(folder)
    np.save(folder / "points.npy", points[:, 0].numpy())
    return folder, joints, points


@pytest.mark.parametrize("everybody", [False, True])
def test_keypoints_on_the_border_of_the_image_are_missing_and_a_note_counts_them(
    scene, tmp_path, everybody
):
    _, _, points = scene
    points = points[:3, 0].clone()
    points[1, BODY_15.joint("left_knee"), 1] = (
        HEIGHT  # as of a detector that clips what is beyond it
    )
    write_openpose(tmp_path / "json", points.numpy())
    camera = looking_at("front", PLACES["front"])
    found = read_body_keypoints([str(tmp_path / "json")], [camera], everybody=everybody)
    missing = (found.confidence.reshape(3, -1) == 0).sum(1).tolist()
    assert missing == [1, 2, 1]  # of the head there is no keypoint
    assert any("1 keypoint on the border of the image counts as missing" in n for n in found.notes)


def test_files_are_brought_in_step_by_their_numbers(scene, tmp_path):
    folder, _, points = scene
    cameras = list(load_cameras(folder / "cameras.toml").values())[:2]
    for i, name in enumerate(("whole", "cut", "elsewhere", "beside")):
        write_openpose(tmp_path / name, points[:, 0].numpy() + i)
    for path in sorted((tmp_path / "cut").iterdir())[:3]:
        path.unlink()
    for name in ("elsewhere", "beside"):
        for t, path in enumerate(sorted((tmp_path / name).iterdir())):
            path.rename(path.with_name(f"video_{5000 + t:012d}_keypoints.json"))

    def read(*names):
        return read_body_keypoints([str(tmp_path / name) for name in names], cameras)

    found = read("whole", "cut")
    assert len(found.points) == N
    assert found.points[:3, 1].isnan().all() and not found.confidence[:3, 1].any()
    torch.testing.assert_close(found.points[3:, 1], found.points[3:, 0] + 1, equal_nan=True)
    assert any("numbers 0, 3; frames of one number are taken as simult" in n for n in found.notes)
    found = read("whole", "elsewhere")
    torch.testing.assert_close(found.points[:, 1], found.points[:, 0] + 2, equal_nan=True)
    assert any("numbers 0, 5000; they are taken as simultaneous" in note for note in found.notes)
    assert any("frame 0 is number 5000" in note for note in read("elsewhere", "beside").notes)


def write_timed(path, points, times) -> None:
    """Keypoints [T, 15, 2] as a table with times in place of numbers."""
    header = ["time", *(f"{name}_{axis}" for name in BODY_15.names for axis in "xy")]
    rows = np.column_stack([times, points.reshape(len(points), -1)])
    np.savetxt(path, rows, delimiter=",", header=",".join(header), comments="", fmt="%.6f")


@pytest.mark.parametrize(("later", "same_clock"), [(3 / FPS, True), (500.0, False)])
def test_tables_are_brought_in_step_by_their_times(scene, tmp_path, later, same_clock):
    """The second camera begins three frames later, and its stamps say so, in milliseconds."""
    folder, _, points = scene
    cameras = list(load_cameras(folder / "cameras.toml").values())[:2]
    times = 12.3 + np.arange(N) / FPS
    write_timed(tmp_path / "a.csv", points[:, 0].numpy(), times)
    write_timed(tmp_path / "b.csv", points[3:, 1].numpy(), 1000 * (times[: N - 3] + later))
    found = read_body_keypoints([str(tmp_path / "a.csv"), str(tmp_path / "b.csv")], cameras)
    said = "frames of one time are taken as simult" if same_clock else "taken as simultaneous"
    assert any(f"times 12.3 s, {12.3 + later:.12g} s; " in n and said in n for n in found.notes)
    begun = 3 if same_clock else 0
    assert len(found.points) == N - 3 + begun
    assert found.points[:begun, 1].isnan().all()
    torch.testing.assert_close(found.points[begun:, 1], points[3:, 1], atol=1e-5, rtol=0)


def nobody_in(folder, kind):
    """An input in which a detector has found nobody."""
    if kind == "table":
        path = folder / "nobody.csv"
        path.write_text("frame,name,x,y,confidence\n")
        return path
    path = folder / kind
    path.mkdir()
    if kind == "json":
        for t in range(3):
            (path / f"v_{t:012d}_keypoints.json").write_text(json.dumps({"people": []}))
    return path


@pytest.mark.usefixtures("undoubted_here")
@pytest.mark.parametrize("kind", ["empty", "json", "table"])
def test_a_camera_that_sees_nobody_is_left_out(track, scene, tmp_path, kind):
    nobody = nobody_in(tmp_path, kind)
    done = track(tmp_path / "out", "front_json", nobody, "behind.npz", "--pictures", "false")
    assert done.code == 0, done.err
    assert f"camera left is not used: {nobody}" in done.out
    found = BodyTrack.load(tmp_path / "out" / "body.npz")
    assert found.details["inlier"].shape[:2] == (N, 3) and not found.details["inlier"][:, 1].any()
    assert float((found.joints3d - scene[1]).norm(dim=-1).mean()) < 0.03


def test_inputs_without_anybody_are_refused(scene, tmp_path):
    cameras = list(load_cameras(scene[0] / "cameras.toml").values())
    inputs = [str(nobody_in(tmp_path, kind)) for kind in ("empty", "json", "table")]
    with pytest.raises(NobodySeenError):
        read_body_keypoints(inputs, cameras)


@pytest.fixture
def track(torchpose, scene):
    return on_files(torchpose, scene[0])


MIXED = ("front_json", "left.csv", "behind.npz")
PLAIN = ("--pictures", "false")


def apart(poses, joints) -> float:
    return float((poses.joints3d - joints[: len(poses)]).norm(dim=-1).mean())


@pytest.mark.usefixtures("undoubted_here")
def test_poses_from_all_kinds_of_files(track, scene, tmp_path):
    out = tmp_path / "out"
    formats = ("--formats", "trc", "c3d", "bvh", "--up", "z")
    done = track(out, *MIXED, "--height", 1.75, "--smoothing", "full", *formats)
    assert done.code == 0, done.err
    assert "3 cameras, 50 fps" in done.out
    assert "kalman, smoothed" in done.out
    assert "front 9" in done.out  # per cent of its keypoints agree
    names = {path.name for path in out.iterdir() if not path.name.startswith(".")}
    assert names == {"body.npz", "joints.csv", "body.trc", "body.c3d", "body.bvh", "skeleton.png",
                     "report.html"}  # fmt: skip
    poses = BodyTrack.load(out / "body.npz")
    assert (len(poses), poses.fps, poses.method) == (N, FPS, "kalman")
    assert apart(poses, scene[1]) < 0.03 and "camera_turn" not in poses.details
    rows = (out / "joints.csv").read_text().splitlines()
    assert len(rows) == N + 1
    assert rows[0].startswith("frame,pelvis_x,pelvis_y,pelvis_z,pelvis_std,")
    # those of an earlier run that this one does not write are deleted
    assert track(out, *MIXED, *PLAIN).code == 0
    assert not (out / "body.trc").exists() and not (out / "skeleton.png").exists()


@pytest.mark.usefixtures("undoubted_here")
def test_feet_of_files_are_in_the_table_and_in_all_formats(torchpose, scene, tmp_path):
    folder, joints = scene[:2]
    cameras = CameraRig(list(load_cameras(folder / "cameras.toml").values()))
    toes = joints[:, BODY_15.joint("left_ankle")] + torch.tensor([0.0, 0.15, -0.08]).double()
    pixels = cameras(torch.cat([joints, toes[:, None]], 1)).pixels
    given = [tmp_path / f"{camera}.npz" for camera in cameras.names]
    for c, path in enumerate(given):
        write_keypoints(path, Keypoints(pixels[:, c], (*BODY_15.names, "left_big_toe"), fps=FPS))
    out = tmp_path / "out"
    options = ("--out", out, "--formats", "trc", "bvh")
    done = torchpose("track-body", folder / "cameras.toml", *given, *options)
    assert done.code == 0, done.err
    poses = BodyTrack.load(out / "body.npz")
    assert poses.feet is not None
    assert float((poses.feet.points3d[5:, 1] - toes[5:]).norm(dim=-1).mean()) < 0.03
    head, *rows = (row.split(",") for row in (out / "joints.csv").read_text().splitlines())
    assert head.index("left_heel_x") == 1 + 4 * 15
    assert head[-7:] == [*(f"{side}_ankle_{a}" for side in ("left", "right")
                           for a in ("flexion", "inversion", "rotation")), "coasting"]  # fmt: skip
    column = head.index("left_big_toe_x")
    found = [float(v) for v in rows[-1][column : column + 3]]
    assert found == pytest.approx(poses.feet.points3d[-1, 1].tolist(), abs=1e-3)
    assert "LBigToe" in (out / "body.trc").read_text()
    assert "left_foot" in (out / "body.bvh").read_text()
    assert "left big toe" in (out / "report.html").read_text()


def test_one_camera_is_enough(track, scene, tmp_path):
    given = ("--camera-names", "front", "--height", 1.75, *PLAIN)  # as well as [front]
    done = track(tmp_path, "front.npz", *given)
    assert done.code == 0, done.err
    assert len(BodyTrack.load(tmp_path / "body.npz")) == N
    assert "m by its bones, 1.75 m given" in done.out


def test_the_height_of_one_camera_is_an_option(track, scene, tmp_path):
    given = ("front.npz", "--camera-names", "front", *PLAIN)
    without = track(tmp_path / "without", *given, "--up", "y")
    done = track(tmp_path / "with", *given, "--up", "y", "--camera-height", 1.2)
    assert (without.code, done.code) == (0, 0), done.err
    assert "size of a person" in without.out and "size of a person" not in done.out
    refused = track(tmp_path, *given, "--camera-height", 1.2)
    assert refused.code == 2 and "give up as well" in refused.err
    refused = track(tmp_path, *MIXED, "--up", "y", "--camera-height", 1.2)
    assert refused.code == 2 and "there are 3 cameras" in refused.err


@pytest.mark.parametrize("without", [3, 2])
def test_cameras_without_poses_are_refused(torchpose, scene, tmp_path, without):
    cameras = list(load_cameras(scene[0] / "cameras.toml").values())
    for i, c in enumerate(cameras[:without]):
        cameras[i] = PinholeCamera.from_matrix(c.matrix, WIDTH, HEIGHT, c.name)
    save_cameras(cameras, tmp_path / "cameras.toml")
    inputs = [scene[0] / name for name in MIXED]
    done = torchpose("track-body", tmp_path / "cameras.toml", *inputs, "--out", tmp_path / "out")
    assert done.code == 2 and "'front' and 'left' are in the same place" in done.err


def test_cameras_are_chosen_by_their_names_too(torchpose, scene, tmp_path):
    text = (scene[0] / "cameras.toml").read_text()
    for i, name in enumerate(PLACES):
        text = text.replace(f"[{name}]", f"[cam_{i}]")
    (tmp_path / "anipose.toml").write_text(text)
    base = ("track-body", tmp_path / "anipose.toml", scene[0] / "front.npz", *PLAIN)
    done = torchpose(*base, "--camera-names", "front", "--out", tmp_path / "out")
    assert done.code == 0, done.err
    done = torchpose(*base, "--camera-names", "side", "--out", tmp_path / "out")
    assert "it holds cam_0 (front), cam_1 (left), cam_2 (behind)" in done.err


@pytest.mark.usefixtures("undoubted_here")
def test_the_body_is_drawn_into_videos(track, scene, tmp_path):
    videos = tuple(f"{name}.mp4" for name in PLACES)
    done = track(tmp_path, "front_json", "left.csv", "behind.npz", "--videos", *videos)
    assert done.code == 0, done.err
    for name in ("overlay_front.mp4", "overlay_behind.mp4", "overlay.png", "skeleton.png"):
        assert (tmp_path / name).stat().st_size > 1000
    assert "frame rate" not in done.out  # that of the other inputs
    assert "video ends" not in done.out


def test_a_camera_whose_name_no_file_can_have_gets_its_overlay(torchpose, scene, tmp_path):
    folder = scene[0]
    camera = load_cameras(folder / "cameras.toml")["front"]
    camera.name = "../rig/front"
    save_cameras([camera], tmp_path / "cameras.toml")
    done = torchpose("track-body", tmp_path / "cameras.toml", folder / "front.npz", "--videos",
                     folder / "front.mp4", "--height", 1.75, *PLAIN, "--out", tmp_path / "out")  # fmt: skip
    assert done.code == 0, done.err
    assert (tmp_path / "out" / "overlay_.._rig_front.mp4").stat().st_size > 1000


def test_the_body_is_drawn_as_a_turned_camera_sees_it(torchpose, scene, tmp_path, monkeypatch):
    folder = scene[0]
    cameras = list(load_cameras(folder / "cameras.toml").values())
    turn = torch.from_numpy(cv2.Rodrigues(np.array([0.0, math.radians(3.0), 0.0]))[0])
    in_world = cameras[1].rotation_matrix.mT @ turn @ cameras[1].rotation_matrix
    rotation, _ = cv2.Rodrigues((turn @ cameras[1].rotation_matrix).numpy())
    cameras[1].rotation.copy_(torch.from_numpy(rotation.ravel()))
    cameras[1].translation.copy_(turn @ cameras[1].translation)
    save_cameras(cameras, tmp_path / "cameras.toml")
    off = []

    def measured(image, joints, skeleton, keypoints, **_):
        off.append((joints - keypoints).norm(dim=-1))
        return image

    monkeypatch.setattr("torchpose.video._overlay.draw_body", measured)
    inputs = (folder / name for name in ("front.npz", "left.csv", "behind.npz"))
    videos = (folder / f"{name}.mp4" for name in PLACES)
    done = torchpose("track-body", tmp_path / "cameras.toml", *inputs, "--videos", *videos,
                     "--out", tmp_path / "out", "--overlay", "false")  # fmt: skip
    assert done.code == 0 and "camera left (by " in done.out, done.err + done.out
    assert float(torch.stack(off).max()) < 3  # pixels; by its calibration it is off by 8
    turns = BodyTrack.load(tmp_path / "out" / "body.npz").details["camera_turn"]
    assert turns.shape == (N, 3, 3, 3)
    torch.testing.assert_close(turns[-1, 1].double(), in_world, atol=0.01, rtol=0)


def test_overlays_go_on_where_the_video_of_one_camera_has_ended(track, tmp_path):
    write_grey(tmp_path / "short.mp4", 3)
    inputs, videos = ("front.npz", "behind.npz"), (tmp_path / "short.mp4", "behind.mp4")
    given = ("--camera-names", "[front,behind]", "--videos", *videos, "--height", "1.75")
    done = track(tmp_path / "out", *inputs, *given)
    assert done.code == 0, done.err
    assert "the video of camera front ends after 3 frames, so its overlay does not" in done.out
    assert "camera behind ends" not in done.out
    for name, n_frames in (("front", 3), ("behind", N)):
        with open_video(tmp_path / "out" / f"overlay_{name}.mp4") as shown:
            assert sum(1 for _ in shown) == n_frames
    assert (tmp_path / "out" / "overlay.png").exists()


@pytest.mark.usefixtures("undoubted_here")
def test_a_detector_finds_the_keypoints_in_videos(track, scene, tmp_path, monkeypatch):
    folder, joints, _ = scene
    text = DETECTOR.format(points=str(folder / "points.npy"), names=BODY_15.names)
    (tmp_path / "body_detectors.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    mixed = ("front.mp4", "left.csv", "behind.npz", *PLAIN)
    done = track(tmp_path / "a", *mixed, "--detector", "body_detectors:front")
    assert done.code == 0, done.err
    assert "by body_detectors:front" in done.out
    assert not (tmp_path / "a" / "overlay_front.mp4").exists()  # the other cameras have no video
    assert apart(BodyTrack.load(tmp_path / "a" / "body.npz"), joints) < 0.05
    alone = ("front.mp4", "--camera-names", "[front]", *PLAIN)
    done = track(tmp_path / "b", *alone, "--detector", "body_detectors:nobody")
    assert done.code == 1
    assert "no camera has a keypoint" in done.err
    assert not (tmp_path / "b" / "body.npz").exists()


def test_cuts_of_a_video_are_noted(track, scene, tmp_path, monkeypatch):
    text = DETECTOR.format(points=str(scene[0] / "points.npy"), names=BODY_15.names)
    (tmp_path / "cut_detectors.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    image[:, : WIDTH // 4] = 200
    with VideoWriter(tmp_path / "cut.mp4", FPS, (WIDTH, HEIGHT)) as writer:
        for t in range(N):
            writer.write(image if t < 4 else np.ascontiguousarray(image[:, ::-1]))
    alone = (tmp_path / "cut.mp4", "--camera-names", "[front]", *PLAIN)
    done = track(tmp_path / "out", *alone, "--detector", "cut_detectors:front")
    assert done.code == 0, done.err
    assert "cuts to another scene at frame 4, and bodies are tracked on" in done.out


@pytest.mark.usefixtures("undoubted_here")
def test_inputs_of_other_lengths_sizes_and_rates(track, scene, tmp_path):
    points = scene[2]
    write_keypoints(tmp_path / "short.npz", keypoints_of(points[:-2, 2]))
    done = track(tmp_path / "a", "front_json", "left.csv", tmp_path / "short.npz", *PLAIN)
    assert done.code == 0, done.err
    assert f"have {N}, {N}, {N - 2} frames; the first {N - 2}" in done.out
    assert len(BodyTrack.load(tmp_path / "a" / "body.npz")) == N - 2

    half = keypoints_of((points[:, 2] + 0.5) / 2 - 0.5, image_size=(WIDTH // 2, HEIGHT // 2))
    write_keypoints(tmp_path / "half.npz", half)
    done = track(tmp_path / "b", "front_json", "left.csv", tmp_path / "half.npz", *PLAIN)
    assert done.code == 0, done.err
    assert f"scaled from {WIDTH} x {HEIGHT} pixels to the {WIDTH // 2} x {HEIGHT // 2}" in done.out
    assert apart(BodyTrack.load(tmp_path / "b" / "body.npz"), scene[1]) < 0.05

    write_keypoints(tmp_path / "slow.npz", keypoints_of(points[:, 2], fps=25.0))
    slow = ("front_json", "left.csv", tmp_path / "slow.npz", *PLAIN)
    done = track(tmp_path / "c", *slow)
    assert (done.code, "one frame rate, got 25, 50 fps" in done.err) == (2, True)
    done = track(tmp_path / "c", *slow, "--fps", 50)
    assert (done.code, "25, 50 fps are taken at the given 50 fps" in done.out) == (0, True)


@pytest.mark.usefixtures("undoubted_here")
def test_joint_sets_may_differ_between_cameras(track, scene, tmp_path):
    """Of MediaPipe's landmarks the ears tell the head, and shoulders and hips neck and pelvis."""
    points = scene[2]
    marks = torch.full((N, len(LANDMARKS), 2), torch.nan, dtype=torch.float64)
    for j, joint in enumerate(BODY_15.names):
        if joint in LANDMARKS:
            marks[:, LANDMARKS.index(joint)] = points[:, 1, j]
    for ear, shift in (("left_ear", 2.0), ("right_ear", -2.0)):
        marks[:, LANDMARKS.index(ear)] = points[:, 1, BODY_15.joint("head")] + shift
    write_keypoints(tmp_path / "marks.npz", replace(keypoints_of(marks), names=LANDMARKS))
    found = read_body_keypoints([str(tmp_path / "marks.npz")], [load_camera(scene)])
    head = points[:, 1, BODY_15.joint("head")]
    torch.testing.assert_close(found.points[:, 0, BODY_15.joint("head")], head)
    assert bool(found.points.isfinite().all())
    assert found.notes == ()
    done = track(tmp_path / "out", "front_json", tmp_path / "marks.npz", "behind.npz", *PLAIN)
    assert done.code == 0, done.err
    assert apart(BodyTrack.load(tmp_path / "out" / "body.npz"), scene[1]) < 0.05


def load_camera(scene):
    return load_cameras(scene[0] / "cameras.toml")["left"]


@pytest.mark.usefixtures("undoubted_here")
def test_a_page_that_begins_late_says_so(track, scene, tmp_path):
    given = []
    for camera in (0, 2):
        points = scene[2][:, camera].clone()
        points[:3] = torch.nan
        given.append(tmp_path / f"{camera}.npz")
        write_keypoints(given[-1], keypoints_of(points))
    words = ("--camera-names", "front,behind", *PLAIN)
    assert track(tmp_path / "out", *given, *words).code == 0
    page = (tmp_path / "out" / "report.html").read_text()
    assert "<li>frame 0 of this page is frame 3 of the recording</li>" in page
    assert (tmp_path / "out" / "joints.csv").read_text().splitlines()[1].startswith("3,")
    assert track(tmp_path / "on-time", "front_json", "left.csv", "behind.npz", *PLAIN).code == 0
    assert "of this page is" not in (tmp_path / "on-time" / "report.html").read_text()


def test_lists_are_separated_by_blanks_or_commas():
    files = ["cameras.toml", "a.npz", "b.npz", "c.npz"]

    def read(*words):
        values = command().given([*map(str, words), "--out", "out"]).values
        return values["camera_names"], values["delays"], values["facing"], values["inputs"]

    expected = (["a", "b", "c"], [0, 3, 10], [-1.0, 0.0, 0.5], files[1:])
    for names, delays, facing in (
        (["a", "b", "c"], [0, 3, 10], [-1, 0, 0.5]), (["a,b,c"], ["0,3,10"], ["-1,0,0.5"]),
        (["[a, b, c]"], ["[0, 3, 10]"], ["[-1,0,0.5]"]),
        (["[a,", "b,", "c]"], ["0,", "3,", "10"], ["[-1", "0", ".5]"]),
    ):  # fmt: skip
        lists = ["--camera-names", *names, "--delays", *delays, "--facing", *facing]
        assert read(*files, *lists) == expected
    # a list of one word may stand before what is given by its place
    lists = ("--camera-names", "a,b,c", "--delays", "[0,3,10]", "--facing", "[-1,0,0.5]")
    assert read(*lists, *files) == read(files[0], *lists, *files[1:]) == expected
    assert read(*files[:2], "--camera-names", "a", "--delays", "12")[:2] == (["a"], [12])
    assert read(*files[:2], "--delays", "null")[1] is None


def test_lists_behind_a_config_are_separated_by_blanks_too(tmp_path):
    file = tmp_path / "track.yaml"
    file.write_text("cameras: cameras.toml\ninputs: [a.npz, b.npz]\nout: out\ndelays: [1, 0]\n")
    words = ["--config", str(file), "--camera-names", "a", "b", "--delays", "0", "3"]
    values = command().given(words).values
    assert (values["camera_names"], values["delays"]) == (["a", "b"], [0, 3])
    assert (values["cameras"], values["inputs"]) == ("cameras.toml", ["a.npz", "b.npz"])


def test_tables_that_are_no_cameras_are_said(torchpose, scene, tmp_path):
    text = (scene[0] / "cameras.toml").read_text() + "\n[charuco]\ncolumns = 4\n"
    (tmp_path / "config.toml").write_text(text)
    words = (scene[0] / "front.npz", "--camera-names", "front", *PLAIN)
    done = torchpose("track-body", tmp_path / "config.toml", *words, "--out", tmp_path / "out")
    assert done.code == 0, done.err
    assert "[charuco] is passed over: no camera" in done.out
    shown = torchpose("info", tmp_path / "config.toml")
    assert "[charuco] is passed over" in shown.out


def test_one_input_of_two_cameras_is_refused(track, scene, tmp_path):
    done = track(tmp_path / "a", "front_json", "front_json", "behind.npz", *PLAIN)
    assert done.code == 2 and "hold the same keypoints" in done.err
    shutil.copytree(scene[0] / "front_json", tmp_path / "copy")
    done = track(tmp_path / "b", "front_json", tmp_path / "copy", "behind.npz", *PLAIN)
    assert done.code == 2 and "hold the same keypoints" in done.err


@pytest.mark.parametrize("suffix", [".npy", ".json", ".h5"])
def test_data_of_another_kind_are_no_videos(track, tmp_path, suffix):
    path = tmp_path / f"keypoints{suffix}"
    path.write_bytes(b"[]")
    done = track(tmp_path / "out", "front_json", path, path)
    assert (
        done.code == 2 and f"folder of OpenPose JSON files, one per frame, got {suffix}" in done.err
    )


@pytest.mark.parametrize(
    ("inputs", "cameras", "camera"),
    [
        (["c1.mp4", "c10.mp4", "c2.mp4"], ["cam1", "cam2", "cam10"], "'cam2'"),
        (["2_json", "1_json"], ["cam_01", "cam_02"], "'cam_01'"),
        (["c1.mp4", "c2.mp4", "c10.mp4"], ["cam1", "cam2", "cam10"], None),
        (["c2.mp4", "c1.mp4"], ["cam_0", "cam_1"], None),
        (["a.mp4", "b.mp4"], ["cam_3", "cam_4"], None),
        (["left1.csv", "right1.csv"], ["cam_0", "cam_1"], None),
    ],
)
def test_inputs_in_the_order_of_a_shell_are_refused(inputs, cameras, camera):
    if camera is None:
        check_numbers(inputs, cameras)
        return
    with pytest.raises(InputError, match=f"is given for camera {camera}; .*--camera-names"):
        check_numbers(inputs, cameras)


@pytest.mark.slow
def test_cameras_that_do_not_agree_end_with_one(track, scene, tmp_path):
    """Keypoints of another room, in two cameras: the poses are those of one camera alone."""
    other = scene[2][:, 1].flip(0) * torch.tensor([0.3, 1.0]) + torch.tensor([40.0, 90.0])
    write_keypoints(tmp_path / "other.npz", keypoints_of(other))
    words = ("--camera-names", "front,left", *PLAIN)
    done = track(tmp_path / "out", "front_json", tmp_path / "other.npz", *words)
    assert done.code == 1 and "no two cameras agree" in done.err
    done = track(tmp_path / "right", "front_json", "left.csv", *words)
    assert done.code == 0 and "no two cameras agree" not in done.err


@pytest.mark.usefixtures("undoubted_here")
def test_delays_bring_cameras_in_step(track, scene, tmp_path):
    points = scene[2]
    late = torch.cat([points[:1, 1].expand(3, -1, -1), points[:, 1]])
    write_keypoints(tmp_path / "late.npz", keypoints_of(late))
    given = ("front_json", tmp_path / "late.npz", "behind.npz", *PLAIN)
    done = track(tmp_path / "a", *given, "--delays", "[0,3,0]")
    assert done.code == 0, done.err
    assert "frames; the first" not in done.out
    assert apart(BodyTrack.load(tmp_path / "a" / "body.npz"), scene[1]) < 0.05
    for delays in ("[0,11,0]", "[0,-1,0]"):
        done = track(tmp_path / "b", *given, "--delays", delays)
        assert (done.code, "from 0 to below the number of frames" in done.err) == (2, True)


@pytest.mark.slow
def test_cameras_are_refined_and_written(track, torchpose, scene, tmp_path):
    folder = scene[0]
    given = ("front_json", "left.csv", "behind.npz")
    cameras = list(load_cameras(folder / "cameras.toml").values())
    cameras[1].rotation += torch.tensor([0.0, 0.0, 0.08])
    save_cameras(cameras, tmp_path / "turned.toml")
    videos = [folder / f"{name}.mp4" for name in PLACES]
    done = torchpose(
        "track-body", tmp_path / "turned.toml", *(folder / one for one in given),
        "--refine", "extrinsics", "--videos", *videos, "--out", tmp_path / "out",
    )  # fmt: skip
    assert done.code == 0, done.err
    assert "refined: camera left was turned by" in done.out and " ± " in done.out
    refined = CameraRig.load(tmp_path / "out" / "refined_cameras.toml")
    turned = CameraRig(cameras)
    assert refined.names == turned.names

    def off(rig):
        poses = BodyTrack.load(tmp_path / "out" / "body.npz")
        return float((rig(poses.joints3d).pixels - scene[2])[:, 1].norm(dim=-1).median())

    assert off(refined) < 0.5 * off(turned)
    assert (tmp_path / "out" / "overlay_left.mp4").exists()
    assert track(tmp_path / "out", *given, *PLAIN).code == 0
    assert not (tmp_path / "out" / "refined_cameras.toml").exists()  # of an earlier run


def test_a_particle_filter_takes_keypoints_as_in_python(track, scene, tmp_path):
    given = ("--method", "sir", "--n-particles", 60, "--seed", 3, "--height", 1.75)
    done = track(tmp_path / "out", *MIXED, *given)
    assert done.code == 0, done.err
    assert "sir" in done.out and "60" in done.out and "average proportions" in done.out
    found = BodyTrack.load(tmp_path / "out" / "body.npz")
    assert (found.method, len(found)) == ("sir", N)
    assert apart(found, scene[1]) < 0.15
    assert (tmp_path / "out" / "skeleton.png").exists()

    again = ("--initial-pose", tmp_path / "out" / "body.npz", *PLAIN)
    assert track(tmp_path / "again", *MIXED, *given, *again).code == 0
    cameras = list(load_cameras(scene[0] / "cameras.toml").values())
    read = read_body_keypoints([str(scene[0] / name) for name in MIXED], cameras)
    tracker = BodyTracker(cameras, "sir", n_particles=60, height=1.75, fps=FPS)
    start = fit_state(tracker.body, found.joints3d[:1])[0]
    expected = tracker(
        None, start, keypoints=read.points, confidence=read.confidence,
        generator=torch.Generator().manual_seed(3),
    )  # fmt: skip
    repeated = BodyTrack.load(tmp_path / "again" / "body.npz")
    torch.testing.assert_close(repeated.joints3d, expected.joints3d)


def test_an_unknown_rate_is_said(track, tmp_path):
    done = track(tmp_path, "front_json", "--camera-names", "[front]", "--height", 1.75, *PLAIN)
    assert (done.code, "no input states a frame rate: 30 fps assumed" in done.out) == (0, True)


@pytest.mark.parametrize("overlay", ["false", "true"])
def test_videos_tell_the_rate_whether_or_not_they_are_drawn_into(track, tmp_path, overlay):
    words = ("--videos", "front.mp4", "--height", 1.75, "--overlay", overlay)
    done = track(tmp_path, "front_json", "--camera-names", "[front]", *words, *PLAIN)
    assert done.code == 0, done.err
    assert "30 fps assumed" not in done.out
    assert BodyTrack.load(tmp_path / "body.npz").fps == FPS


def test_images_tell_no_rate(track, tmp_path):
    (tmp_path / "images").mkdir()
    for t in range(N):
        cv2.imwrite(f"{tmp_path}/images/{t}.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    words = ("--videos", tmp_path / "images", "--height", 1.75, "--overlay", "false")
    done = track(tmp_path / "out", "front_json", "--camera-names", "[front]", *words, *PLAIN)
    assert (done.code, "no input states a frame rate: 30 fps assumed" in done.out) == (0, True)


@pytest.mark.parametrize(("n_shown", "shown"), [(N, range(N)), (2 * N, range(0, 2 * N, 2))])
def test_each_keypoint_is_drawn_into_its_frame_at_any_stated_rate(
    track, tmp_path, monkeypatch, n_shown, shown
):
    """A video of a frame for each of the keypoints, as slow motion, and one of twice their rate."""
    with VideoWriter(tmp_path / "slow.mp4", 2 * FPS, (WIDTH, HEIGHT)) as writer:
        for t in range(n_shown):
            writer.write(np.full((HEIGHT, WIDTH, 3), 5 * t, np.uint8))
    greys = []

    def measured(image, *_, **__):
        greys.append(float(image.mean()) / 5)
        return image

    monkeypatch.setattr("torchpose.video._overlay.draw_body", measured)
    words = ("--camera-names", "[front]", "--videos", tmp_path / "slow.mp4", "--height", 1.75)
    done = track(tmp_path / "out", "front.npz", *words, "--fps", FPS, "--pictures", "false")
    assert (done.code, "read frame by frame" in done.out) == (0, n_shown == N), done.err
    np.testing.assert_allclose(greys, list(shown), atol=0.5)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("front_json", "left.csv"), "a camera for each of the 2 inputs"),
        ((*MIXED, "--background", "a.png", "b.png", "c.png"), "--background is for silhouettes"),
        (
            (*MIXED, "--silhouettes", "true"),
            "--silhouettes true needs a particle filter by --method",
        ),
        ((*MIXED, "--silhouettes", "true", "--method", "sir"), "needs the videos of all cameras"),
        (("front.mp4", "left.mp4", "behind.mp4", "--silhouettes", "true"), "is for keypoints"),
        ((*MIXED, "--manifold", "walk"), "--manifold is for particle filters, and keypoints are"),
        (
            (*MIXED, "--n-particles", 300),
            "--n-particles is for particle filters, and keypoints are",
        ),
        ((*MIXED, "--initial-pose", "a.npz"), "--initial-pose is for particle filters"),
        ((*MIXED, "--facing", "[1,0,0]"), "--facing is for silhouettes"),
        (
            (*MIXED, "--method", "apf", "--smoothing", "full"),
            "--smoothing is for kalman, and --method apf",
        ),
        (
            (*MIXED, "--method", "apf", "--refine", "both"),
            "--refine is for kalman, and --method apf",
        ),
        (
            (*MIXED, "--method", "sir", "--persons", "all"),
            "--persons is for kalman, and --method sir",
        ),
        (
            (*MIXED, "--method", "sir", "--motion", "whole-body"),
            "--motion is for kalman, and --method",
        ),
        (
            (*MIXED, "--method", "sir", "--up", "z"),
            "--up is for kalman on keypoints and for the files",
        ),
        ((*MIXED, "--method", "sir", "--rows", 80), "--rows is for silhouettes"),
        ((*MIXED, "--method", "mrpf"), "needs manifold"),
        ((*MIXED, "--method", "ekf"), "must be one of kalman, mrpf, apf"),
        ((*MIXED, "--detector", "a.onnx"), "all inputs are keypoints"),
        ((*MIXED, "--min-confidence", 0.5), "--min-confidence is for --detector"),
        ((*MIXED, "--videos", "front.mp4"), "--videos needs 3 entries, one for each camera, got 1"),
        ((*MIXED, "--delays", "[1]"), "--delays needs 3 entries, one for each camera, got 1"),
        ((*MIXED, "--delays", "[0,1.5,0]"), "--delays must be whole numbers of frames, such as"),
        ((*MIXED, "--videos", "a.mp4", "b.mp4", "c.mp4"), "a.mp4: no such file"),
        ((*MIXED, "--formats", "fbx"), "--formats must be one of trc, c3d, bvh"),
        (
            ("front.mp4", "left.mp4", "behind.mp4", "--up", "z"),
            "--up is for kalman on keypoints and for the files",
        ),
        ((*MIXED, "--motion", "gone"), "gone"),
        ((*MIXED, "--smoothing", "5"), "--smoothing must be one of none, full"),
        ((*MIXED, "--refine", "all"), "--refine must be one of none, delays"),
        (("front.npz", "--camera-names", "[front]", "--refine", "both"), "needs two or more"),
        (("front.mp4", "left.mp4", "behind.mp4", "--refine", "both"), "--refine is for keypoints"),
        ((*MIXED, "--keypoint-std", -1), "--keypoint-std must be positive"),
        (("front.mp4", "left.csv", "behind.npz"), "--detector finds the keypoints in videos"),
        (("gone", "left.csv", "behind.npz"), "and is not there"),
        (("front.mp4", "left.mp4", "behind.mp4", "--method", "kalman"), "takes keypoints"),
        (("front.mp4", "left.mp4", "behind.mp4", "--smoothing", "full"), "is for keypoints"),
        (("front.mp4", "left.mp4", "behind.mp4", "--motion", "whole-body"), "is for keypoints"),
    ],
)
def test_what_does_not_go_together_is_refused(track, tmp_path, words, said):
    done = track(tmp_path / "out", *words)
    assert done.code == 2 and said in done.err, done.err
    assert len(done.err.splitlines()) == 1


def test_bad_files_are_refused(track, torchpose, scene, tmp_path):
    folder, _, points = scene
    for name in ("empty", "nothing", "none"):
        (tmp_path / name).mkdir()
    done = track(tmp_path / "out", *(tmp_path / name for name in ("empty", "nothing", "none")))
    assert (done.code, "the folder is empty" in done.err) == (2, True)
    done = track(tmp_path / "out", tmp_path / "empty", "left.mp4", "behind.mp4")
    assert (done.code, "the folder is empty" in done.err) == (2, True)

    done = track(tmp_path / "out", "front_json", "left.csv", "0")
    assert (done.code, "0 is taken for a camera" in done.err) == (2, True)

    wide = keypoints_of(points[:, 2], image_size=(2 * WIDTH, HEIGHT))
    write_keypoints(tmp_path / "wide.npz", wide)
    done = track(tmp_path / "out", "front_json", "left.csv", tmp_path / "wide.npz")
    assert (done.code, "images of another shape are cut" in done.err) == (2, True)

    arms = replace(keypoints_of(points[:, 2, :6]), names=BODY_15.names[:6])
    write_keypoints(tmp_path / "arms.npz", arms)
    done = track(tmp_path / "out", "front_json", "left.csv", tmp_path / "arms.npz")
    assert (done.code, "arms.npz: a whole body needs shoulders and hips" in done.err) == (2, True)

    cameras = list(load_cameras(folder / "cameras.toml").values())
    for camera in cameras:
        camera.translation *= 1000
    save_cameras(cameras, tmp_path / "millimetres.toml")
    done = torchpose("track-body", tmp_path / "millimetres.toml", *(folder / m for m in MIXED),
                     "--out", tmp_path / "out")  # fmt: skip
    assert (done.code, "cameras must be given in metres" in done.err) == (2, True)
    assert not (tmp_path / "out" / "body.npz").exists()
