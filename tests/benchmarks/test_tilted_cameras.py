"""The table of cameras that look up or down, on a few frames."""

import math

import pytest
import torch

from benchmarks import bones
from benchmarks.tilted_cameras import told_view
from tests.data import data_with


@pytest.fixture(scope="module")
def data():
    return data_with("mocap_berkeley_mhad")


def test_a_tilted_view_is_the_level_one_turned_about_the_neck(data):
    level, tilted = (bones.mhad_views(data, 150, pitch)[0] for pitch in (0.0, 0.3))
    told = told_view(tilted, math.degrees(0.3))
    bone, seen = (view.truth.diff(dim=2) for view in (level, tilted))
    torch.testing.assert_close(seen @ told.camera.level_rotation.mT, bone)
    neck = list(level.names).index("neck")
    assert float((tilted.keypoints - level.keypoints)[:, neck].abs().max()) < 1e-9
    assert told_view(tilted, None) is tilted and tilted.camera.up is None


def test_quick_run_prints_every_way_to_tell(run_here, data, tmp_path):
    written = tmp_path / "table.md"
    printed = run_here("tilted_cameras", "--data", str(data), "--quick", "--out", str(written))
    rows = {line.split("|")[1].strip(): line.split("|")[2] for line in printed.splitlines()
            if "joints" in line}  # fmt: skip
    ways = ("unknown", "told", "off by 5 degrees", "chosen")
    assert list(rows) == [f"articulated, all joints, {way}" for way in ways]
    assert float(rows["articulated, all joints, told"]) < float(
        rows["articulated, all joints, unknown"]
    )
    assert written.read_text().split() == printed.split()
