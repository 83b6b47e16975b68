"""Files of the user's and of earlier runs: what the commands replace, refuse, move and clear."""

import os
import signal
import subprocess
import sys
from types import ModuleType

import numpy as np
import pytest

from torchpose.evaluation import Report
from torchpose.evaluation._trials import add_picture
from torchpose.io._results import ResultsFolder
from torchpose.upper_body import PoseTrack
from torchpose.video import VideoWriter

POSES = ("poses.npz", "poses.csv", "poses.bvh")
LIST = ".torchpose-track.json"
KILLED = """
import os, signal, sys
import torchpose.upper_body._pose_files
torchpose.upper_body._pose_files.write_bvh = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
from torchpose.cli import main
main(sys.argv[1:])
"""


@pytest.fixture
def track(torchpose, files, tmp_path):
    """Track keypoints, without pictures, into tmp_path/out."""

    def run(*options, clip=files / "keypoints.npz", out=tmp_path / "out"):
        given = ("--prior", files / "prior.safetensors", "--pictures", "false", *options)
        return torchpose("track", clip, "--out", out, *given)

    return run


def content(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}


def refused(done, message):
    assert done.code == 2 and message in done.err, done.err
    assert len(done.err.splitlines()) == 1


@pytest.mark.parametrize("name", ["poses.npz", "poses_p02.csv", "other.npz"])
def test_keypoints_are_not_tracked_into_their_own_place(track, files, tmp_path, name):
    out = tmp_path / "out"
    out.mkdir()
    clip = out / name
    if name.endswith(".csv"):
        clip.write_text("frame,head_x,head_y\n0,1,2\n")
    else:
        clip.write_bytes((files / "keypoints.npz").read_bytes())
    if name == "other.npz":  # the place of a result, by a link
        (out / "poses.npz").symlink_to(clip)
    before = content(out)
    done = track("--camera", "525,525,320,240", clip=clip)
    assert done.code == 2
    if clip.suffix == ".npz":
        refused(done, "poses.npz: is an input of this run")
    assert content(out) == before


def test_a_video_is_not_drawn_over_itself(torchpose, files, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    with VideoWriter(out / "overlay.mp4", 30.0, (64, 48)) as writer:
        for _ in range(5):
            writer.write(np.zeros((48, 64, 3), np.uint8))
    (tmp_path / "link.mp4").symlink_to(out / "overlay.mp4")
    before = content(out)
    for where in (out / "overlay.mp4", tmp_path / "link.mp4"):
        done = torchpose("track", where, "--out", out, "--prior", files / "prior.safetensors")
        refused(done, "overlay.mp4: is an input of this run")
    assert content(out) == before


def test_again_into_the_same_folder(track, tmp_path):
    out = tmp_path / "out"
    assert track().code == 0
    first = content(out)
    done = track("--frame", "body")
    assert done.code == 0 and "note     what was" not in done.out
    second = content(out)
    assert second.keys() == first.keys() == {*POSES, LIST}
    assert all(second[name] != first[name] for name in (*POSES[:2], LIST))
    (out / "poses.csv").write_text("edited")
    refused(track(), "poses.csv: was changed since torchpose wrote it; move it away or choose")
    assert (out / "poses.csv").read_text() == "edited"
    assert (out / "poses.npz").read_bytes() == second["poses.npz"]


def test_results_of_a_version_that_kept_no_list(track, tmp_path):
    out = tmp_path / "out"
    assert track().code == 0
    (out / LIST).unlink()
    for name in ("overlay.mp4", "poses_p02.npz", "poses_p02_edited_by_me.csv", "notes.txt"):
        (out / name).write_bytes(b"old")
    old = content(out)
    done = track("--frame", "body")
    assert done.code == 0 and "were moved to" in done.out
    mine = {"poses_p02_edited_by_me.csv", "notes.txt"}
    assert content(out).keys() == {*POSES, LIST, *mine}
    assert content(out / "earlier-1") == {n: c for n, c in old.items() if n not in mine}
    assert PoseTrack.load(out / "poses.npz").frame == "body"
    assert track().code == 0 and not (out / "earlier-2").exists()


def test_a_folder_with_other_files_of_these_names(track, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "poses.csv").write_text("mine")
    refused(track(), "poses.csv: is there, and is not known to be written by this command")
    assert content(out) == {"poses.csv": b"mine"}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL")
def test_a_killed_run_leaves_the_results_of_the_one_before(track, files, tmp_path):
    out = tmp_path / "out"
    assert track().code == 0
    before = content(out)
    line = ["track", files / "keypoints.npz", "--out", out, "--frame", "body"]
    line += ["--prior", files / "prior.safetensors", "--pictures", "false"]
    done = subprocess.run([sys.executable, "-c", KILLED, *map(str, line)], capture_output=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert content(out) == before
    (left,) = (p for p in out.iterdir() if p.is_dir())
    assert {p.name for p in left.iterdir()} == {"poses.npz", "poses.csv"}
    assert track().code == 0
    assert not left.exists() and content(out).keys() == before.keys()


def test_two_runs_at_once(track, torchpose, tmp_path):
    out = tmp_path / "out"
    with ResultsFolder(out, "track", r"x", []):
        refused(track(), "another run is writing into this folder; wait until it ends")
        refused(torchpose("demo", "--out", out, "--input", "keypoints"), "another run")
    assert list(out.iterdir()) == []
    assert track().code == 0


@pytest.mark.parametrize("kind", ["keypoints", "video"])
def test_the_demo_spares_files_of_its_names(torchpose, files, tmp_path, kind):
    name = {"keypoints": "keypoints.npz", "video": "clip.mp4"}[kind]
    (tmp_path / name).write_bytes(b"mine")
    prior = files / "prior.safetensors"
    done = torchpose("demo", "--out", tmp_path, "--input", kind, "--prior", prior)
    refused(done, f"{name}: is there, and is not known")
    assert content(tmp_path) == {name: b"mine"}


def test_the_demos_keypoints_are_tracked_into_its_folder(torchpose, track, files, tmp_path):
    out = tmp_path / "out"
    options = ("--pictures", "false", "--seconds", 2, "--prior", files / "prior.safetensors")
    torchpose("demo", "--out", out, "--input", "keypoints", *options)
    clip = (out / "keypoints.npz").read_bytes()
    assert track(clip=out / "keypoints.npz").code == 0
    assert content(out).keys() == {*POSES, LIST, "keypoints.npz"}
    assert (out / "keypoints.npz").read_bytes() == clip


FIT = ("--noise", "none", "--components", 2, "--samples", 500, "--curate", "false")


def test_a_fit_spares_the_neighbours_of_its_file(torchpose, files, tmp_path):
    fit = ("fit", files / "recordings", *FIT)
    for name, mine in (("README", ".md"), ("photo", ".png"), ("weights", ".safetensors")):
        (tmp_path / f"{name}{mine}").write_bytes(b"mine")
        before = content(tmp_path)
        done = torchpose(*fit, "--out", tmp_path / f"{name}.safetensors")
        refused(done, f"{name}{mine}: is there, and is not known")
        assert content(tmp_path) == before


def test_a_fit_again_and_one_beside_it(torchpose, files, tmp_path):
    for name, seed in (("one", 0), ("one", 1), ("two", 0)):
        line = (*FIT, "--pictures", "false", "--seed", seed)
        done = torchpose(
            "fit", files / "recordings", "--out", tmp_path / f"{name}.safetensors", *line
        )
        assert done.code == 0, done.err
    names = {f"{name}{end}" for name in ("one", "two") for end in (".safetensors", ".md")}
    assert content(tmp_path).keys() == {
        *names, ".torchpose-fit-one.json", ".torchpose-fit-two.json"
    }  # fmt: skip
    assert not any(p.is_dir() for p in tmp_path.iterdir())
    os.unlink(tmp_path / ".torchpose-fit-one.json")  # as an earlier version left it
    card = (tmp_path / "one.md").read_bytes()
    done = torchpose("fit", files / "recordings", "--out", tmp_path / "one.safetensors", *line)
    assert done.code == 0 and "earlier-1" in done.out
    assert (tmp_path / "earlier-1" / "one.md").read_bytes() == card


@pytest.fixture
def protocol(monkeypatch):
    """A protocol that stands in for learning-curve, and writes a report with a picture."""
    figures = pytest.importorskip("matplotlib.figure")

    def run(data, out, *, seed=0, progress=True):
        report = Report("example", settings={"seed": seed})
        add_picture(report, out, "pcp.png", figures.Figure())
        report.save(out)
        return report

    module = ModuleType("torchpose.evaluation._learning_curve")
    module.run = run
    monkeypatch.setitem(sys.modules, "torchpose.evaluation._learning_curve", module)


def test_an_evaluation_spares_other_reports_and_moves_other_pictures(torchpose, protocol, tmp_path):
    line = ("evaluate", "learning-curve", "--data", tmp_path, "--out", tmp_path)
    (tmp_path / "report.md").write_bytes(b"mine")
    refused(torchpose(*line), "report.md: is there, and is not known")
    assert content(tmp_path) == {"report.md": b"mine"}
    (tmp_path / "report.md").unlink()
    (tmp_path / "pcp.png").write_bytes(b"mine")
    done = torchpose(*line)
    assert done.code == 0 and f"was moved to {tmp_path / 'earlier-1' / 'pcp.png'}" in done.out
    assert content(tmp_path / "earlier-1") == {"pcp.png": b"mine"}
    names = {"report.md", "report.json", "pcp.png", ".torchpose-evaluate.json"}
    done = torchpose(*line, "--seed", 1)
    assert done.code == 0 and "moved" not in done.out and content(tmp_path).keys() == names
    report = (tmp_path / "report.md").read_bytes()
    (tmp_path / ".torchpose-evaluate.json").unlink()  # as an earlier version left it
    assert torchpose(*line).code == 0
    assert (tmp_path / "earlier-1" / "report.md").read_bytes() == report
    assert (tmp_path / "report.md").read_bytes() != report
