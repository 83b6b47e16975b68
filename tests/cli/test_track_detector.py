"""`torchpose track --detector`: poses of everybody, and what is refused."""

import numpy as np
import pytest

from tests.cli.pretended_camera import PretendedCamera, use_camera
from torchpose import demo
from torchpose.errors import OutputError
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import PoseTrack
from torchpose.video import VideoWriter, draw_overlay
from torchpose.video._recording import PoseSpool

N = 36
DETECTOR = """
import numpy as np

NAMES = {names}
POINTS = np.load({points!r})


class two:
    names = NAMES

    def __init__(self):
        self.at = 0

    def __call__(self, image):
        one = POINTS[self.at]
        self.at += 1
        return np.stack([one - [90, 0], one + [110, 10]]), np.full((2, len(NAMES)), 0.8)


class passing(two):
    def __call__(self, image):
        there = [self.at < 18, self.at >= 4]
        return [found[there] for found in super().__call__(image)]


class nobody(two):
    def __call__(self, image):
        return np.zeros((0, len(NAMES), 2)), np.zeros((0, len(NAMES)))


class failing(two):
    def __call__(self, image):
        if self.at == 24:
            raise RuntimeError("the model is gone")
        return super().__call__(image)


class wrong(two):
    def __call__(self, image):
        return np.zeros((1, 2)), np.zeros(1)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A grey clip, and a module with detectors in the working directory."""
    points = demo.demo_camera()(demo.performer(N).joints)[..., :2]
    np.save(tmp_path / "points.npy", points.numpy())
    text = DETECTOR.format(names=UPPER_BODY, points=str(tmp_path / "points.npy"))
    (tmp_path / "some_detectors.py").write_text(text)
    with VideoWriter(tmp_path / "clip.mp4", 30.0, (640, 480)) as writer:
        for _ in range(N):
            writer.write(np.full((480, 640, 3), 90, np.uint8))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def track(torchpose, files, folder):
    prior = files / "prior.safetensors"

    def run(*options):
        given = ("--out", folder / "out", "--prior", prior, "--pictures", "false", *options)
        return torchpose("track", folder / "clip.mp4", *given)

    return run


def test_everybody_whom_a_detector_finds_has_poses(track, folder):
    done = track("--detector", "some_detectors:two", "--measurement-std", 2)
    assert done.code == 0, done.err
    names = {path.name for path in (folder / "out").iterdir()}
    assert {"poses.npz", "poses_p02.npz", "overlay.mp4", "report.html"} <= names
    assert "keypoints by some_detectors:two" in done.out
    first, second = (PoseTrack.load(folder / "out" / f"poses{s}.npz") for s in ("", "_p02"))
    assert bool(first.observed.all()) and first.joints2d.shape[1] == N - 2
    apart = (second.joints2d - first.joints2d).median(1).values[0, UPPER_BODY.index("neck")]
    assert apart.tolist() == pytest.approx([200.0, 10.0], abs=6)


@pytest.mark.parametrize("more", [(), ("--max-persons", "1")])
def test_a_height_of_several_persons_is_said(track, more):
    done = track("--detector", "some_detectors:two", "--height", "1.5", "--overlay", "false", *more)
    assert done.code == 0, done.err
    assert ("--height was taken for each of the 2 persons" in done.out) == (not more)


def test_persons_before_a_camera_have_the_names_that_they_had_while_it_ran(
    torchpose, files, folder, monkeypatch
):
    """The first one passes by, the second one stays for longer."""
    grey = np.full((480, 640, 3), 90, np.uint8)
    use_camera(monkeypatch, PretendedCamera([grey] * (N + 10)))
    shown = []

    def spy(image, poses, *others, labels=None, tints=None, **options):
        shown.append((labels, tints))
        return draw_overlay(image, poses, *others, labels=labels, tints=tints, **options)

    monkeypatch.setattr("torchpose.video._overlay.draw_overlay", spy)
    options = (
        "--prior",
        files / "prior.safetensors",
        "--pictures",
        "false",
        "--method",
        "mkf-fixed",
    )
    given = ("--detector", "some_detectors:passing", *options)
    done = torchpose("track", 0, "--out", folder / "out", *given)
    assert done.code == 0, done.err
    assert (["person 1", "person 2"], [0, 1]) in shown
    assert f"person 2: frames 6 to {N - 1}, in poses.npz" in done.out
    assert "person 1: frames 2 to 17, in poses_p02.npz" in done.out
    assert "of person 2:" in done.out
    page = (folder / "out" / "report.html").read_text()
    assert page.index('"label":"person 2"') < page.index('"label":"person 1"')


@pytest.fixture
def camera(torchpose, files, folder, monkeypatch):
    """The command before a camera, with the names of the results and one of the files."""
    grey = np.full((480, 640, 3), 90, np.uint8)
    use_camera(monkeypatch, PretendedCamera([grey] * (N + 10)))

    def run(detector):
        given = ("--prior", files / "prior.safetensors", "--pictures", "false")
        given += ("--method", "mkf-fixed", "--detector", f"some_detectors:{detector}")
        return torchpose("track", 0, "--out", folder / "out", *given)

    return run


def test_what_a_camera_gave_before_an_error_is_written_and_the_error_is_told(camera, folder):
    done = camera("failing")
    assert done.code == 2 and "RuntimeError: the model is gone" in done.err
    assert {"poses.npz", "poses_p02.npz", "overlay.mp4", "report.html"} <= {
        path.name for path in (folder / "out").iterdir()
    }
    track = PoseTrack.load(folder / "out" / "poses.npz")
    assert track.first_frame + track.joints3d.shape[1] == 24
    assert "an error ended the recording after 24 frames" in track.notes


def test_a_disk_that_fills_up_before_a_camera_has_room_for_poses_without_the_overlay(
    camera, folder, monkeypatch
):
    write = PoseSpool._write

    def full(spool):
        if any(folder.glob("out/.torchpose-track/*.mp4*")):
            raise OutputError("poses cannot be kept here (No space left on device)")
        write(spool)

    monkeypatch.setattr(PoseSpool, "_write", full)
    monkeypatch.setattr("torchpose.video._recording._WRITTEN", 20)
    done = camera("two")
    assert done.code == 2 and "No space left" in done.err
    names = {path.name for path in (folder / "out").iterdir()}
    assert {"poses.npz", "report.html"} <= names and "overlay.mp4" not in names
    assert PoseTrack.load(folder / "out" / "poses.npz").joints3d.shape[1] == 20


def test_tables_that_are_whole_are_kept_where_the_next_one_does_not_fit(
    camera, folder, monkeypatch
):
    def full(*_):
        raise OutputError("poses.bvh: cannot be written (No space left on device)")

    monkeypatch.setattr("torchpose.upper_body._pose_files.write_bvh", full)
    done = camera("two")
    assert done.code == 2 and "No space left" in done.err
    names = {path.name for path in (folder / "out").iterdir()}
    assert names == {"poses.npz", "poses.csv", ".torchpose-track.json"}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--detector", "model.pt"), "a detector must be an ONNX model"),
        (
            ("--detector", "absent.onnx"),
            "absent.onnx: expected a model file, there is no such file",
        ),
        (("--detector", "some_detectors:none"), "expected package:factory"),
        (("--detector", "some_detectors:wrong"), "must return keypoints [N, 8, 2]"),
        (("--detector", "some_detectors:two", "--hands", "mean-shift"), "hands is of the measurer"),
        (("--detector", "some_detectors:two", "--elbows", "false"), "elbows is of the measurer"),
        (("--detector", "some_detectors:two", "--face-model", "f.tflite"), "give one of them"),
        (("--detector", "some_detectors:two", "--nose-as-head", "true"), "is for keypoints"),
    ],
)
def test_refusals(track, options, said):
    done = track(*options)
    assert done.code == 2 and said in done.err, done.err
    assert len(done.err.splitlines()) == 1


def test_nobody_is_said(track):
    done = track("--detector", "some_detectors:nobody")
    assert done.code == 1
    assert f"no person was seen for half a second or longer in the {N} frames" in done.err
