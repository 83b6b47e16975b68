"""The table of rendered performers, on a second of one of them."""

import pytest


@pytest.mark.slow
def test_true_pixels_beat_the_mean_pose_and_all_is_kept(run_here, tmp_path):
    options = ("--quick", "--out", str(tmp_path), "--only", "mean shift")
    printed = run_here("video_rendered", *options)
    table = [line.split("|")[1:-1] for line in printed.splitlines() if line.startswith("| ")]
    errors = {row[0].strip(): [float(cell) for cell in row[1:10]] for row in table[2:5]}
    assert set(errors) == {"mean shift", "true 2D", "mean pose"}
    assert all(0 < value < 60 for row in errors.values() for value in row)
    assert errors["true 2D"][-1] < errors["mean pose"][-1]
    assert (tmp_path / "video_rendered.md").read_text() == printed
    (video,) = tmp_path.glob("*.mp4")
    kept = {path.name for path in tmp_path.iterdir()}
    assert {f"{video.stem}.npz", "by_joint.png"} <= kept
    (run,) = tmp_path.glob("run-*.npz")
    made = run.stat().st_mtime_ns
    assert run_here("video_rendered", *options) == printed
    assert run.stat().st_mtime_ns == made
