"""`torchpose track` on video: a rendered performer, nobody, a camera, and what is refused."""

import json
import os
import signal
import sys

import cv2
import numpy as np
import pytest
import torch

from tests.cli.pretended_camera import PretendedCamera, use_camera
from torchpose import demo
from torchpose.cli._common import UntilInterrupted
from torchpose.cli._track_output import notes_of_all
from torchpose.cli._track_video import _note_on_colours, _stopping
from torchpose.errors import OutputError
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import PoseTrack
from torchpose.video import VideoWriter, open_video
from torchpose.video._file import FileSource

N = 32
SUFFIXES = (".npz", ".csv", ".bvh")
LIST = ".torchpose-track.json"


def _no_space(*_, **__):
    raise OutputError("overlay.mp4: cannot be written (No space left on device)")


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """A second of a rendered performer, and where the joints are in it."""
    pytest.importorskip("matplotlib", reason="the performer's face comes from matplotlib")
    from torchpose.demo._rendering import render_video

    folder = tmp_path_factory.mktemp("clip")
    truth = render_video(folder / "clip.mp4", demo.performer(N), demo.demo_camera())[0]
    return folder / "clip.mp4", truth


@pytest.fixture
def track(torchpose, files, tmp_path):
    """The command with the small prior and no pictures."""

    def run(where, *options):
        out = tmp_path / "out"
        prior = files / "prior.safetensors"
        given = ("--prior", prior, "--pictures", "false", *options)
        return torchpose("track", where, "--out", out, *given), out

    return run


def test_a_video_gives_poses_overlay_and_report(clip, track):
    path, truth = clip
    done, out = track(path)
    assert done.code == 0, done.err
    expected = {*(f"poses{s}" for s in SUFFIXES), "overlay.mp4", "report.html", LIST}
    assert {p.name for p in out.iterdir()} == expected
    poses = PoseTrack.load(out / "poses.npz")
    n = poses.joints2d.shape[1]
    assert n >= N - 5 and poses.fps == 30.0
    measured = [UPPER_BODY.index(name) for name in ("head", "neck")]
    error = (poses.joints2d[0, -n:] - truth.joints2d[N - n :])[:, measured].norm(dim=-1)
    assert float(error.median()) < 12
    assert bool(poses.observed[0, :, measured].all())
    with open_video(out / "overlay.mp4") as overlay:
        assert overlay.size == (640, 480) and sum(1 for _ in overlay) == N
    page = (out / "report.html").read_text()
    assert "clip.mp4" in page and f"{poses.method}, filtered" in page
    assert "a focal length of 525 pixels" in done.out and "frames a second" in done.out


def test_options_reach_the_tracker(clip, track):
    path, _ = clip
    options = ("--smoothing", "full", "--edges", "true", "--elbows", "true", "--background", "true")
    done, out = track(path, *options, "--overlay", "false", "--camera", "525,525,319.5,239.5")
    assert done.code == 0, done.err
    assert {p.name for p in out.iterdir()} == {LIST, *(f"poses{s}" for s in SUFFIXES)}
    assert "smoothed" in done.out and "525" in done.out and "assumed" not in done.out
    elbows = PoseTrack.load(out / "poses.npz").observed[0, :, UPPER_BODY.index("elbow_left")]
    assert bool(elbows.any())


def test_a_folder_of_images_at_another_rate(clip, track, tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    with open_video(clip[0]) as source:
        for frame in source:
            if frame.index < 24:
                name = str(folder / f"{frame.index}.png")
                cv2.imwrite(name, cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))
    done, out = track(folder, "--fps", 25, "--hands", "mean-shift", "--overlay", "false")
    assert done.code == 0, done.err
    assert PoseTrack.load(out / "poses.npz").fps == 25.0


def test_a_folder_of_images_with_labels_is_video_and_no_place_for_results(torchpose, tmp_path):
    frames = tmp_path / "frames"
    frames.mkdir()
    for number in range(3):
        cv2.imwrite(str(frames / f"f{number}.png"), np.zeros((48, 64, 3), np.uint8))
    (frames / "labels.json").write_text("{}")
    done = torchpose("track", frames, "--out", tmp_path / "out", "--overlay", "false")
    assert done.code == 1 and "3 frames" in done.err, done.err
    done = torchpose("track", frames, "--out", frames)
    assert done.code == 2 and "is the folder of the images" in done.err, done.err
    assert "choose another folder, such as" in done.err and len(list(frames.iterdir())) == 4
    (frames / "f0_keypoints.json").write_text(json.dumps({"people": []}))
    done = torchpose("track", frames, "--out", tmp_path / "out")
    assert done.code == 2 and "nobody was found in any of 1 frame" in done.err, done.err


def test_a_video_without_a_face_has_no_poses(track, tmp_path):
    grey = tmp_path / "grey.mp4"
    with VideoWriter(grey, 30.0, (160, 120)) as writer:
        for _ in range(20):
            writer.write(np.full((120, 160, 3), 90, np.uint8))
    done, out = track(grey)
    assert done.code == 1
    assert "no face was seen for half a second or longer in the 20 frames (0.67 s)" in done.err
    assert not list(out.iterdir()) and "turned" not in done.out


def test_a_video_that_is_too_short_is_said_to_be(track, tmp_path):
    with VideoWriter(tmp_path / "short.mp4", 30.0, (160, 120)) as writer:
        for _ in range(5):
            writer.write(np.full((120, 160, 3), 90, np.uint8))
    done, _ = track(tmp_path / "short.mp4")
    assert done.code == 1
    assert "short.mp4 has 5 frames (0.17 s), too few for poses" in done.err


@pytest.mark.slow
@pytest.mark.parametrize("turns", [1, 2])
def test_a_video_on_its_side_is_said_to_be(clip, track, tmp_path, turns):
    side = tmp_path / "side.mp4"
    with open_video(clip[0]) as source:
        size = source.size if turns == 2 else source.size[::-1]
        with VideoWriter(side, 30.0, size) as writer:
            for frame in source:
                writer.write(np.ascontiguousarray(np.rot90(frame.image, turns)))
    done, _ = track(side, "--overlay", "false")
    assert f"turned by {90 * turns} degrees clockwise: turn it" in done.out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "light", "said"), [(0, 0.8, True), (1, 0.8, False), (2, 0.8, True), (0, 0.1, False)]
)
def test_a_video_without_colours_is_said_to_be(tmp_path, first, light, said):
    skin = np.full((48, 64, 3), (120, 150, 200), np.uint8)
    for number in range(3):  # the second one is in colour
        image = skin if number == 1 else np.repeat(skin[..., 1:2], 3, 2)
        cv2.imwrite(str(tmp_path / f"{number}.png"), (light * image).astype(np.uint8))
    with open_video(tmp_path) as source:
        notes = _note_on_colours(source, first)
    assert ["no colours" in note for note in notes] == [True] * said


def test_several_persons_and_then_one(clip, track, tmp_path):
    path, _ = clip
    wide = tmp_path / "wide.mp4"
    with open_video(path) as source, VideoWriter(wide, 30.0, (1000, 480)) as writer:
        for frame in source:
            both = [frame.image[:, 70:570], np.roll(frame.image[:, 70:570], 5, 0)]
            writer.write(np.concatenate(both, 1))
    out = tmp_path / "out"
    out.mkdir()
    mine = {"poses_p03.npz": b"of another video", "poses_p02_edited_by_me.csv": b"edited"}
    for name, content in mine.items():
        (out / name).write_bytes(content)
    done, out = track(wide)
    assert done.code == 0, done.err
    names = {p.name for p in out.iterdir()}
    assert {"poses.npz", "poses_p02.npz", "poses_p02.csv", "poses_p02.bvh"} <= names
    assert "person 1: frames" in done.out and "person 2: frames" in done.out
    first, second = (PoseTrack.load(out / f"poses{s}.npz") for s in ("", "_p02"))
    apart = first.joints2d[0, 20, 3] - second.joints2d[0, 20, 3]
    assert abs(abs(float(apart[0])) - 500) < 15

    (out / "poses_p02.csv").write_text("edited")
    done, out = track(path)
    assert done.code == 0, done.err
    names = {p.name for p in out.iterdir()}
    assert {n for n in names if n.startswith("poses_")} == {*mine, "poses_p02.csv"}
    assert (out / "poses_p02.csv").read_text() == "edited"
    assert {name: (out / name).read_bytes() for name in mine} == mine


def test_notes_of_all_persons_are_said_once_and_by_name_where_they_differ():
    notes = ("a focal length", "1 outlier", "cuts"), ("a focal length", "2 outliers", "cuts")
    assert notes_of_all(notes, ["person 1", "person 2"]) == (
        "a focal length", "cuts", "person 1: 1 outlier", "person 2: 2 outliers",
    )  # fmt: skip


@pytest.mark.slow
def test_the_report_has_the_notes_of_the_track(tmp_path, clip, track):
    path, _ = clip
    twice = tmp_path / "twice.mp4"
    with open_video(path) as source, VideoWriter(twice, 30.0, source.size) as writer:
        shown = [frame.image for frame in source]
        for frame in shown[:22] + [
            np.ascontiguousarray(np.roll(one, 160, 1)) for one in shown[:22]
        ]:
            writer.write(frame)
    done, out = track(twice)
    note = "the video cuts to another scene at frame 22:"
    assert note in done.out and note in (out / "report.html").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("full_disk", [False, True])
def test_a_camera_is_shown_recorded_and_stopped(clip, track, monkeypatch, full_disk):
    if full_disk:
        monkeypatch.setattr("torchpose.video.VideoWriter.write", _no_space)
    with open_video(clip[0]) as source:
        images = [cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR) for frame in source]
    use_camera(monkeypatch, PretendedCamera(images, missed=lambda left: left % 10 == 5))
    done, out = track("0")
    assert done.code == 0, done.err
    assert "live at http://127.0.0.1:" in done.out
    if full_disk:
        assert "tracking goes on without the overlay" in done.err
        assert not (out / "overlay.mp4").exists() and (out / "report.html").exists()
        return
    assert {"poses.npz", "overlay.mp4", "report.html"} <= {p.name for p in out.iterdir()}
    n_frames = N - 10 + 2  # after the camera has warmed up, with those missed
    with open_video(out / "overlay.mp4") as shown:
        assert sum(1 for _ in shown) == n_frames
    assert n_frames - 4 <= PoseTrack.load(out / "poses.npz").joints3d.shape[1] <= n_frames


def test_the_first_interruption_ends_the_recording_and_the_second_is_real():
    def frames():
        for index in range(10):
            if index == 4:
                os.kill(os.getpid(), signal.SIGINT)
            yield index

    before = signal.getsignal(signal.SIGINT)
    with UntilInterrupted(frames()) as items:
        assert list(items) == [0, 1, 2, 3]
        assert items.interrupted and items.count == 4
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
    with UntilInterrupted(range(4)) as items:
        assert list(items) == [0, 1, 2, 3]
        os.kill(os.getpid(), signal.SIGINT)
        assert not items.interrupted, "nothing is left out"
    with UntilInterrupted(range(10), stop=lambda: True) as items:
        assert list(items) == []


def test_other_signals_end_a_recording_too_where_they_are_named():
    def frames():
        yield 0
        os.kill(os.getpid(), signal.SIGTERM)
        yield 1

    before = signal.getsignal(signal.SIGTERM)
    with UntilInterrupted(frames(), signals=(signal.SIGINT, signal.SIGTERM)) as items:
        assert list(items) == [0] and items.interrupted
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signal")
def test_a_terminal_that_is_closed_ends_a_camera_once_unless_that_is_ignored():
    def frames():
        yield 0
        for _ in range(2):  # by the shell, and by the system
            os.kill(os.getpid(), signal.SIGHUP)
        yield 1

    before = signal.getsignal(signal.SIGHUP)
    assert signal.SIGHUP in _stopping()
    with UntilInterrupted(frames(), signals=_stopping()) as items:
        assert list(items) == [0] and items.interrupted
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    assert signal.SIGHUP not in _stopping()
    signal.signal(signal.SIGHUP, before)


def test_a_recording_that_was_stopped_says_so(clip, track, monkeypatch):
    read = FileSource._read

    def stopped(self):
        for frame in read(self):
            if frame.index == 22:  # at once: a signal reaches the main thread when that has time
                signal.getsignal(signal.SIGINT)(signal.SIGINT, None)
            yield frame

    monkeypatch.setattr(FileSource, "_read", stopped)
    done, out = track(clip[0], "--overlay", "false")
    assert done.code == 0, done.err
    said = f"stopped by Ctrl-C after 22 of {N} frames: the rest was not tracked"
    assert said in done.out and said in PoseTrack.load(out / "poses.npz").notes


def test_refusals(torchpose, files, clip, tmp_path):
    (tmp_path / "notes.mp4").write_text("no video")
    (tmp_path / "empty").mkdir()
    (tmp_path / "openpose").mkdir()
    (tmp_path / "openpose" / "0_keypoints.json").write_text(json.dumps({"people": []}))
    path = clip[0]
    for where, options, message in (
        (tmp_path / "notes.mp4", (), "keypoints are expected as .npz"),
        (tmp_path / "empty", (), "image"),
        (tmp_path / "nothing.mp4", (), "no such file"),
        (path, ("--nose-as-head", "true"), "--nose-as-head is for keypoints"),
        (path, ("--measurement-std", "3"), "--measurement-std is for keypoints"),
        (path, ("--hands", "feet"), "grid, mean-shift"),
        (path, ("--max-persons", "0"), "max_persons"),
        (path, ("--fps", "0"), "--fps must be positive"),
        (path, ("--method", "kf"), "mkf-fixed"),
        (path, ("--face-model", tmp_path / "no.tflite"), "no.tflite"),
    ):
        given = ("--prior", files / "prior.safetensors", *options)
        done = torchpose("track", where, "--out", tmp_path / "out", *given)
        assert done.code == 2 and message in done.err, (where, done.err)
        assert len(done.err.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_full_disk_is_told_and_leaves_nothing_half_written(clip, track, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("torchpose.video._recording._array", full)
    done, out = track(clip[0])
    assert done.code == 2 and "No space left" in done.err
    assert list(out.iterdir()) == []


@pytest.mark.slow
def test_poses_and_pictures_are_kept_when_the_overlay_does_not_fit(clip, track, monkeypatch):
    """Another process draws the pictures."""
    monkeypatch.setattr("torchpose.video.VideoWriter.write", _no_space)
    if sys.platform != "win32":
        monkeypatch.setattr("torchpose.cli._picture_process._is_sooner", lambda: True)
        monkeypatch.delattr("torchpose.cli._track_output.save_pictures")
    done, out = track(clip[0], "--pictures", "true")
    assert done.code == 2 and "No space left" in done.err
    pictures = ["pose_strip.png", "joint_curves.png"]
    kept = {LIST, *pictures, *(f"poses{s}" for s in SUFFIXES)}
    assert kept == {p.name for p in out.iterdir()}


@pytest.mark.slow
def test_torch_frames_are_frames(clip, files):
    from torchpose import VideoTracker
    from torchpose.priors import load_prior

    with open_video(clip[0]) as source:
        frames = np.stack([frame.image for frame in source][:25])
    tracker = VideoTracker(load_prior(files / "prior.safetensors"), demo.demo_camera())
    tensor = torch.from_numpy(frames).permute(0, 3, 1, 2)
    (one,), (other,) = tracker(frames), tracker(tensor)
    assert torch.equal(one.track.joints3d, other.track.joints3d)
    state, live = tracker.init(), []
    for frame in tensor:
        state, people = tracker.step(state, frame)
        live += [person.pose.joints3d[0, 0] for person in people]
    torch.testing.assert_close(
        torch.stack(live[: len(one)]), one.track.joints3d[0], rtol=1e-9, atol=1e-9
    )
