"""The tables of arms of strangers are printed, and geometry that is told everything is exact."""

import pytest
import torch

from benchmarks.bones import errors, lifted, mhad_views, openpose_views, true_lengths
from tests.data import data_with, few_recordings


@pytest.fixture(scope="module")
def data():
    return data_with("mocap_berkeley_mhad")


def test_views_are_projections_of_their_truth(data):
    for view in (mhad_views(data, 200)[0], *openpose_views(data)):
        ends = view.truth[:, :, 2] @ view.camera.matrix.T
        seen = ends[..., :2] / ends[..., 2:]
        off = torch.linalg.vector_norm(seen - view.keypoints[:, [0, 6]], dim=-1)
        assert float(off.median()) < (10 if view.fps == 30 else 40)


def test_errors_of_the_truth_are_none(data):
    view = mhad_views(data, 200)[0]
    chain = lifted(view, true_lengths(view), 2.5)
    true = chain._replace(upper=view.truth[:, :, 1] - view.truth[:, :, 0],
                          lower=view.truth[:, :, 2] - view.truth[:, :, 1])  # fmt: skip
    assert errors(true, view.truth)[:3] == pytest.approx([0.0, 0.0, 100.0], abs=1e-9)
    assert 2 < errors(chain, view.truth)[0] < 30


@pytest.mark.slow
def test_quick_run_prints_every_method(run_here, data, tmp_path):
    few, pictures = tmp_path / "data", tmp_path / "pictures"
    few_recordings("kinect_utd_mhad", few, 2, ("s07", "s08"))
    for name in ("mocap_berkeley_mhad", "multicam_pose2sim", "video_people", "video_asl"):
        (few / name).symlink_to(data / name)
    options = ("--data", str(few), "--out", str(tmp_path), "--pictures", str(pictures))
    printed = run_here("bones.__main__", "--quick", *options)
    assert len(list(pictures.glob("*.png"))) == 8
    for title in ("MHAD, seven joints", "Webcams, MediaPipe's 2D against its own 3D landmarks",
                  "MHAD, neck and wrists", "UTD-MHAD, eight joints",
                  "OpenPose, upper body and face, one of four views",
                  "UTD-MHAD, head, neck and hands"):  # fmt: skip
        assert f"**{title}**" in printed
    for row, times in (("articulated", 6), ("view 1, mkf-fixed", 1), ("hanging arms", 4)):
        assert printed.count(f"| {row} |") == times
    assert "nan" not in printed
    assert (tmp_path / "bones.md").read_text().split() == printed.split()
