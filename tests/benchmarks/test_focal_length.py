"""The table of wrong focal lengths, on a few sequences."""

from tests.benchmarks.test_scripts_run import run
from tests.data import data_dir_or_skip


def test_the_true_focal_length_is_no_worse_than_a_wrong_one(tmp_path):
    folder = data_dir_or_skip("kinect_utd_mhad")
    written = tmp_path / "table.md"
    done = run("focal_length", "--quick", "--data", str(folder), "--out", str(written))
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [line.split("|")[1:-1] for line in written.read_text().splitlines() if "as it" in line]
    errors = {float(row[1]): float(row[2]) for row in rows}
    assert set(errors) == {0.7, 0.85, 1.0}
    assert errors[1.0] < 8 and errors[1.0] < errors[0.7]
    assert "HAS SEEN s7 and s8" in written.read_text()
    assert written.read_text() == done.stdout
