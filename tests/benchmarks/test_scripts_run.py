"""Every benchmark runs on a tiny problem and finds that results agree; times are not tested."""

import sys

import pytest

from benchmarks._table_file import save_text, table_file
from benchmarks.speed._timing import Report
from tests.data import few_recordings
from torchpose.errors import InputError

SCRIPTS = (
    "speed.mixture_kalman_filter",
    "speed.kalman_step",
    "speed.expectation_maximisation",
    "speed.batch_memory",
    "speed.gradients",
    "speed.streamed_em",
    "speed.silhouettes",
    "speed.root_uncertainty",
    "speed.gplvm",
    "speed.tree_messages",
)


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_quick_run_agrees_and_is_written(script, run_here, tmp_path):
    written = tmp_path / "table.md"
    printed = run_here(script, "--quick", "--runs", "1", "--out", str(written))
    text = written.read_text()
    assert "Agreement" in text
    assert "| ---" in text
    assert text.split() == printed.split()


def test_a_table_goes_to_a_file_or_into_a_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/checkout/benchmarks/speed/gplvm.py"])
    (tmp_path / "v0.2").mkdir()
    wanted = {
        "new/table.md": "new/table.md", "folder": "folder/gplvm.md", "v0.2": "v0.2/gplvm.md",
    }  # fmt: skip
    for given, file in wanted.items():
        assert table_file(str(tmp_path / given)) == tmp_path / file
        assert (tmp_path / file).parent.is_dir() and not (tmp_path / file).exists()
    (tmp_path / "file.md").write_text("")
    (tmp_path / "folder" / "gplvm.md").mkdir()
    monkeypatch.setattr(sys, "argv", ["/checkout/benchmarks/bones/__main__.py"])
    assert table_file(tmp_path / "v0.2") == tmp_path / "v0.2" / "bones.md"
    monkeypatch.setattr(sys, "argv", ["/checkout/benchmarks/speed/gplvm.py"])
    for given in ("file.md/table.md", "folder"):
        with pytest.raises(InputError, match="file or a folder that can be"):
            table_file(str(tmp_path / given))


def test_a_table_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "table.md"
    save_text(path, "first ± 1\n")
    with pytest.raises(UnicodeEncodeError):
        save_text(path, "second\ud800")
    save_text(None, "nowhere")
    assert path.read_text(encoding="utf-8") == "first ± 1\n"
    assert list(tmp_path.iterdir()) == [path]


def test_a_peer_that_is_missing_is_named_with_how_to_install_it(capsys):
    report = Report("Speed", None, 1)
    report.leave_out("filterpy", ModuleNotFoundError("No module named 'filterpy'"))
    printed = capsys.readouterr().out
    assert "filterpy cannot be imported (No module named 'filterpy')" in printed
    assert "benchmarks/README.md" in printed


@pytest.mark.slow
def test_levers_run_without_the_test_persons_and_go_on_where_they_stopped(run_here, tmp_path):
    persons = tuple(f"s0{i}" for i in range(1, 7))
    recordings = few_recordings("kinect_utd_mhad", tmp_path, 6, persons)
    out = tmp_path / "levers"
    arguments = ("--quick", "--data", str(recordings), "--out", str(out), "--only")
    first = run_here("ub_people_levers", *arguments, "single")
    assert "| single poses, learnt Q and R " in first
    assert "log-evidence" in first
    fits = {path.name for path in out.glob("*.safetensors")}
    second = run_here("ub_people_levers", *arguments, "single", "default")
    rows = [line.split() for line in first.splitlines() if line.startswith("| single")]
    again = [line.split() for line in second.splitlines() if line.startswith("| single")]
    assert len(rows) == 6
    assert rows == again
    assert len({path.name for path in out.glob("*.safetensors")} - fits) == 2
    assert (out / "levers.md").read_text() == second


@pytest.mark.slow
def test_every_training_person_is_held_out_once(run_here, few_people, tmp_path):
    options = ("--quick", "--every", "3", "--data", str(few_people), "--out", str(tmp_path))
    printed = run_here("ub_people_by_person", *options)
    lines = [line for line in printed.splitlines() if line.startswith("|")]
    rows = [line.split("|")[1].strip() for line in lines[2:]]
    assert rows == ["s1", "s2", "s3", "s4", "s5", "s6", "mean", "standard deviation"]
    assert len(list(tmp_path.glob("*.safetensors"))) == 6


@pytest.mark.slow
def test_every_place_is_tracked_by_all_three(run_here, few_people, tmp_path):
    options = ("--quick", "--data", str(few_people), "--out", str(tmp_path))
    printed = run_here("ub_people_places", *options)
    rows = [line.split("|")[1:-1] for line in printed.splitlines()[2:]]
    assert len(rows) == 8
    assert all(0 < float(value) < 100 for row in rows for value in row[1:])
