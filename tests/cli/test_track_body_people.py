"""`torchpose track-body --persons`: what is read of several people, written, drawn and said."""

import numpy as np
import pytest
import torch

from tests.cli.test_track_body import N, arms_rise
from tests.cli.test_track_body_keypoints import (
    DETECTOR,
    FPS,
    PLACES,
    PLAIN,
    keypoints_of,
    on_files,
    write_cameras,
    write_openpose,
    write_videos,
)
from torchpose.body import BODY_15, Body
from torchpose.camera import CameraRig
from torchpose.cli._body_keypoint_inputs import DetectorSettings, read_body_keypoints
from torchpose.io import read_keypoints, write_keypoints
from torchpose.io._formats.openpose import read_openpose_people
from torchpose.whole_body import BodyTrack

pytestmark = pytest.mark.usefixtures("undoubted_cameras")

BOTH = ("front_json", "left_json", "behind.npz")
ENTERS = 2  # frame from which on the second person is there


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A folder with two persons in front_json/ and left_json/, the first in behind.npz; true joints."""
    folder = tmp_path_factory.mktemp("people")
    body = Body.of_height(BODY_15, 1.75)
    joints = torch.stack([body.joints(arms_rise(body))] * 2, 1)
    joints[:, 0, :, 0] -= 0.5
    joints[:, 1, :, 0] += 0.5
    cameras = write_cameras(folder)
    pixels = torch.stack([CameraRig(cameras)(joints[:, p]).pixels for p in range(2)], 2)
    pixels[:ENTERS, :, 1] = torch.nan
    for c, name in enumerate(("front", "left")):
        write_openpose(folder / f"{name}_json", *pixels[:, c].movedim(1, 0).numpy())
    write_keypoints(folder / "behind.npz", keypoints_of(pixels[:, 2, 0]))
    write_videos(folder)
    np.save(folder / "points.npy", pixels[:, 0].numpy())
    return folder, joints, cameras


@pytest.fixture
def track(torchpose, scene):
    return on_files(torchpose, scene[0], "--fps", FPS, "--height", 1.75)


@pytest.mark.slow
def test_all_persons_are_tracked_written_and_drawn(track, scene, tmp_path):
    joints = scene[1]
    videos = ("--videos", *(f"{name}.mp4" for name in PLACES))
    done = track(tmp_path, *BOTH, "--persons", "all", *videos, "--formats", "trc")
    assert done.code == 0, done.err
    assert "persons      2\n" in done.out
    assert f"person 1     frames 0 to {N - 1}\n" in done.out
    assert f"person 2     frames {ENTERS} to {N - 1}\n" in done.out
    assert "front 100 %, left 100 %, behind 57" in done.out  # of the frames of both
    for place, suffix in enumerate(("", "_p02")):
        poses = BodyTrack.load(tmp_path / f"body{suffix}.npz")
        first = place * ENTERS
        assert (poses.first_frame, len(poses)) == (first, N - first)
        assert float((poses.joints3d - joints[first:, place]).norm(dim=-1).mean()) < 0.03
        for name in (f"joints{suffix}.csv", f"body{suffix}.trc", f"skeleton{suffix}.png"):
            assert (tmp_path / name).stat().st_size > 100
    for name in ("overlay_front.mp4", "overlay_behind.mp4", "overlay.png", "report.html"):
        assert (tmp_path / name).exists()
    assert "2 persons" in (tmp_path / "report.html").read_text(encoding="utf-8")
    # of the second person nothing is left by a run that tracks one
    assert track(tmp_path, *BOTH, *PLAIN).code == 0
    assert not list(tmp_path.glob("*_p02*"))


def test_both_bodies_are_drawn_into_one_video(track, scene, tmp_path):
    """Where each stands, in every camera, the picture is no longer gray."""
    from torchpose.video import open_video

    videos = ("--videos", *(f"{name}.mp4" for name in PLACES), *PLAIN)
    assert track(tmp_path, *BOTH, "--persons", 2, *videos).code == 0
    with open_video(tmp_path / "overlay_front.mp4") as source:
        image = list(source)[-1].image.astype(int)
    centre = CameraRig(scene[2])(scene[1][-1].mean(1, keepdim=True)).pixels[..., 0, :]
    for u, v in centre.reshape(-1, len(PLACES), 2)[:, 0].round().int().tolist():
        assert abs(image[v - 8 : v + 8, u - 8 : u + 8] - 90).max() > 60


def test_no_more_persons_than_asked_for(track, tmp_path):
    done = track(tmp_path, *BOTH, "--persons", 1, *PLAIN)
    assert done.code == 0, done.err
    assert "persons      1\n" in done.out
    assert not (tmp_path / "body_p02.npz").exists()


def test_without_persons_a_note_says_where_several_stand(track, tmp_path):
    done = track(tmp_path, *BOTH, *PLAIN)
    assert done.code == 0, done.err
    for name in ("front", "left"):
        said = f"camera {name}: several people, up to 2, from frame {ENTERS} on; one of them is tracked"
        assert said in done.out and "--persons all" in done.out
    assert "camera behind: several" not in done.out
    assert "several people" not in track(tmp_path, *BOTH, "--persons", "all", *PLAIN).out


def test_people_beyond_the_announced_number_are_said(track, tmp_path):
    said = "a camera shows up to 2 people at a time, in 75 % of the frames more than the 1 who may be tracked"
    for persons in (1, 2, "all"):
        done = track(tmp_path, *BOTH, "--persons", persons, *PLAIN)
        assert done.code == 0, done.err
        assert (said in done.out) == (persons == 1)


def test_nobody_on_whom_cameras_agree(track, scene, tmp_path):
    words = ("front_json", "--camera-names", "[front]", "--persons", "all", *PLAIN)
    assert track(tmp_path / "a", *words).code == 0  # one camera agrees with itself
    short = ("--delays", f"[{N - 2},{N - 2},{N - 2}]")  # two frames confirm nobody
    done = track(tmp_path / "b", *BOTH, "--persons", "all", *short, *PLAIN)
    assert done.code == 1
    assert "nobody was seen for long enough by cameras that agree" in done.err
    assert not (tmp_path / "b" / "body.npz").exists() and "earlier run" not in done.err
    done = track(tmp_path / "a", *BOTH, "--persons", "all", *short, *PLAIN)
    assert done.code == 1 and "body.npz is of an earlier run" in done.err


def test_a_detector_gives_everybody_in_videos(scene, tmp_path, monkeypatch):
    folder, _, cameras = scene
    text = DETECTOR.format(points=str(folder / "points.npy"), names=BODY_15.names)
    text += """

class crowd(front):
    def __call__(self, image):
        self.at += 1
        found = POINTS[self.at - 1]
        found = found[np.isfinite(found).all((1, 2))]
        return found, np.full(found.shape[:2], 0.8)
"""
    (tmp_path / "crowd_detectors.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    detector = DetectorSettings("crowd_detectors:crowd", None)
    inputs = [str(folder / "front.mp4"), str(folder / "left_json")]
    found = read_body_keypoints(inputs, cameras[:2], detector=detector, fps=FPS, everybody=True)
    assert found.points.shape == (N, 2, 2, 15, 2)
    count = (found.confidence > 0).any(-1).sum(-1)[:, 0].tolist()
    assert count[-3:] == [2, 2, 2]  # those whom a detector has just begun to find do not count yet
    alone = read_body_keypoints(inputs, cameras[:2], detector=detector, fps=FPS)
    assert alone.points.shape == (N, 2, 15, 2)
    assert any("of 2 persons the one in most frames" in note for note in alone.notes)


def test_everybody_in_openpose_files(scene):
    folder = scene[0] / "front_json"
    people = read_openpose_people(folder)
    points, confidence = people.keypoints, people.confidence
    assert points.shape == (N, 2, 25, 2) and len(people.names) == 25
    assert (confidence > 0).any(-1).sum(-1).tolist() == [1] * ENTERS + [2] * (N - ENTERS)
    assert np.isnan(points[:ENTERS, 1]).all()
    assert read_keypoints(folder).n_people.tolist() == [1] * ENTERS + [2] * (N - ENTERS)
    assert read_keypoints(scene[0] / "behind.npz").n_people is None


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            (*BOTH, "--persons", "all", "--refine", "both"),
            "--refine is for recordings of one person",
        ),
        ((*BOTH, "--persons", "some"), "--persons must be 'all' or a number of persons"),
        ((*BOTH, "--persons", 0), "--persons must be 'all' or a number of persons"),
        (("front.mp4", "left.mp4", "behind.mp4", "--persons", "all"), "--persons is for keypoints"),
    ],
)
def test_what_does_not_go_together_is_refused(track, tmp_path, words, said):
    done = track(tmp_path / "out", *words)
    assert done.code == 2 and said in done.err, done.err
