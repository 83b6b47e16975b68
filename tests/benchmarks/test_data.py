"""Benchmarks refuse a folder without their data sets, by the name of what they expected there."""

import sys

import pytest

from benchmarks._command import execute
from benchmarks._data import data_files, data_folder
from tests.benchmarks.test_documented_commands import main_of
from torchpose.errors import InputError

OF_DATA_SETS = (
    "body_keypoint_filters",
    "bones",
    "detector_fusion",
    "face_offsets",
    "fine_tuned_filter",
    "hand_network",
    "keypoint_bodies",
    "keypoint_cameras",
    "keypoint_feet",
    "keypoint_people",
    "mediapipe_front_end",
    "real_bends",
    "real_silhouettes",
    "speed.body_keypoints",
    "speed.gplvm",
    "speed.streamed_em",
    "ub_people_levers",
    "unseen_levels",
    "unseen_sets",
    "video_asl_hands",
    "video_asl_joints",
    "video_asl_skin",
    "video_borders",
    "video_detector",
    "video_faces",
)


@pytest.mark.parametrize("name", OF_DATA_SETS)
def test_missing_data_are_named(name, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [f"{name}.py"])  # names its table
    data = tmp_path / "data"
    data.mkdir()
    arguments = ["--data", str(data), "--out", str(tmp_path / "out")]
    assert execute(main_of(name), arguments) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("torchpose: error: ") and str(data) in error


def test_a_folder_of_a_data_set_is_itself_or_in_another(tmp_path):
    (tmp_path / "data" / "walks").mkdir(parents=True)
    assert data_folder(tmp_path / "data", "walks") == tmp_path / "data" / "walks"
    assert data_folder(tmp_path / "data" / "walks", "walks") == tmp_path / "data" / "walks"
    with pytest.raises(InputError, match="give the one that holds walks with --data"):
        data_folder(tmp_path / "none", "walks")


def test_files_come_pattern_by_pattern_and_every_pattern_has_some(tmp_path):
    for name in ("b1", "a2", "a1"):
        (tmp_path / name).touch()
    found = data_files(tmp_path, "b*", "a*")
    assert [path.name for path in found] == ["b1", "a1", "a2"]
    with pytest.raises(InputError, match=r"expected files c\*, found none"):
        data_files(tmp_path, "a*", "c*")
