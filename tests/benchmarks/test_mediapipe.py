"""The benchmarks on the webcam clips, on one of them."""

import ast
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import mediapipe_landmarks
from tests.benchmarks.conftest import ROOT
from tests.data import data_with


def rows(text: str, title: str) -> dict[str, list[str]]:
    """Cells of a Markdown table by its first column."""
    block = text.split(f"**{title}", 1)[1].split("\n\n")[1]
    cells = [[c.strip() for c in line.strip("| ").split("|")] for line in block.splitlines()]
    return {row[0]: row[1:] for row in cells[2:]}


@pytest.mark.slow
def test_landmarks_as_the_front_end(run_here, tmp_path):
    written = tmp_path / "table.md"
    data = data_with("video_asl")
    options = ("--data", str(data), "--out", str(written), "--prior", "kinect-upper-body-small")
    run_here("mediapipe_front_end", "--quick", *options)
    text = written.read_text()
    jitter = {name: float(row[-1]) for name, row in rows(text, "Jitter in space").items()}
    assert jitter["all eight, smoothed"] < jitter["all eight, filtered"] < jitter["MediaPipe full"]
    inferred = {name: float(row[2]) for name, row in rows(text, "Joints that are not").items()}
    assert inferred["head and neck as read"] < 0.7 * inferred["ears as head"]
    gaps = rows(text, "A hand hidden")
    assert float(gaps["hold the last"][0]) > 0
    assert {"interpolation", "all eight, filtered, elbow hidden too"} <= gaps.keys()


@pytest.mark.slow
def test_joints_from_video(run_here, tmp_path):
    written, pictures = tmp_path / "joints.md", tmp_path / "joints"
    data = data_with("video_asl")
    options = ("--data", str(data), "--out", str(written), "--pictures", str(pictures))
    run_here("video_asl_joints", "--quick", "--prior", "kinect-upper-body-small", *options)
    text = written.read_text()
    means = rows(text, "Mean 2D distance")
    elbows = {name: float(row[2].split()[0]) for name, row in means.items()}
    assert all(0 < value < 80 for value in elbows.values())
    assert (pictures / "pcp.png").stat().st_size > 10_000
    assert "joints/pcp.png" in text
    assert "Eichner" in text


def test_the_landmark_script_needs_nothing_of_torchpose():
    tree = ast.parse(Path(ROOT / "benchmarks" / "mediapipe_landmarks.py").read_text())
    imported = {
        alias.name.split(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in ([ast.alias(node.module)] if isinstance(node, ast.ImportFrom) else node.names)
    }
    assert imported.isdisjoint({"torch", "torchpose"})


def test_the_landmark_script_says_what_is_missing_before_its_work(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(mediapipe_landmarks, "mediapipe", None)
    (tmp_path / "clip.mp4").touch()
    wanted = {
        ("none.mp4", "out.npz"): "none.mp4: no such video file",
        ("clip.mp4", "out"): "expected a name that ends in .npz",
        ("clip.mp4", "none/out.npz"): "in a folder that is there",
        ("clip.mp4", "out.npz"): "pip install mediapipe==0.10.21",
    }
    for (video, out), said in wanted.items():
        line = ["mediapipe_landmarks", str(tmp_path / video), "--out", str(tmp_path / out)]
        monkeypatch.setattr(sys, "argv", line)
        with pytest.raises(SystemExit) as stop:
            mediapipe_landmarks.main()
        assert stop.value.code == 2
        assert said in capsys.readouterr().err


def test_landmarks_are_written_whole_or_not_at_all(tmp_path):
    class Broken:
        def __array__(self, *_, **__):
            raise RuntimeError("broken")

    path = tmp_path / "landmarks.npz"
    mediapipe_landmarks.save(path, {"fps": 30.0})
    with pytest.raises(RuntimeError, match="broken"):
        mediapipe_landmarks.save(path, {"fps": 25.0, "joints2d": Broken()})
    with np.load(path) as arrays:
        assert float(arrays["fps"]) == 30.0
    assert list(tmp_path.iterdir()) == [path]
