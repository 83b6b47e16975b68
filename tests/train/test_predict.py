"""Batch tracking: the same poses as `torchpose track`, shared, resumed, nothing twice or lost."""

import copy
import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.full_disk import files_up_to
from tests.priors.poses import poses, recording
from torchpose._core.files import atomic_path
from torchpose.cli._track import command as track_command
from torchpose.cli._track import main as track
from torchpose.errors import InputError, OutputError, PriorError
from torchpose.learning import fit_upper_body_prior
from torchpose.priors._arms import shipped_arm_prior
from torchpose.upper_body import PoseTrack
from torchpose.upper_body._keypoint_files import TrackSettings
from train import predict as module
from train.predict import build, main, predict, process_rank
from train.predict_claims import Claims
from train.predict_recordings import content_of, find_keypoints, share
from train.predict_summary import COLUMNS
from train.predict_tracking import BatchTracker, read_origin

ROOT = Path(__file__).resolve().parents[2]
LENGTHS = {"a": 12, "b": 30, "c": 7, "sub/d": 20, "sub/e": 25, "f": 9}


def write_recording(path: Path, n_frames: int, seed: int = 0) -> None:
    """Head and hands of a person in front of a camera; the left hand is missing now and then."""
    joints = poses(n_frames, seed)[:, [3, 0, 7]].numpy()
    keypoints = 525 * joints[..., :2] / joints[..., 2:] + [319.5, 239.5]
    keypoints[::4, 1] = np.nan
    matrix = np.array([[525, 0, 319.5], [0, 525, 239.5], [0, 0, 1]])
    path.parent.mkdir(parents=True, exist_ok=True)
    names = np.array(["head", "hand_left", "hand_right"])
    np.savez(path, keypoints=keypoints, names=names, fps=30.0, K=matrix)


@pytest.fixture(scope="module")
def prior_file(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("prior") / "tiny.safetensors"
    fit_upper_body_prior([recording()], 2, n_samples=500, max_iter=5).save(path)
    return str(path)


@pytest.fixture
def data(tmp_path) -> Path:
    """Seven recordings of different lengths, one of which is cut short, and files that are none."""
    folder = tmp_path / "data"
    for seed, (name, n_frames) in enumerate(LENGTHS.items()):
        write_recording(folder / f"{name}.npz", n_frames, seed)
    cut = (folder / "a.npz").read_bytes()[:300]
    (folder / "broken.npz").write_bytes(cut)
    (folder / "notes.txt").write_text("no recording")
    np.savez(folder / "other.npz", joints=np.zeros((3, 8, 3)))
    return folder


def histories(out: Path) -> dict[str, Counter]:
    """How often each recording was started, finished and failed, over all runs."""
    counts = {}
    for file in (out / ".claims").glob("*.jsonl"):
        lines = [json.loads(line) for line in file.read_text().split("\n") if line]
        if lines:
            counts[lines[0]["recording"]] = Counter(line["event"] for line in lines)
    return counts


def rows(out: Path) -> dict[str, dict[str, str]]:
    with (out / "summary.csv").open() as stream:
        return {row["recording"]: row for row in csv.DictReader(stream)}


# --- one process ----------------------------------------------------------------------------------


def test_results_are_those_of_torchpose_track(data, prior_file, tmp_path) -> None:
    # poses without any motion from one to the next, whose hands are outliers to somebody who moves
    settings = TrackSettings(prior=prior_file, smoothing="full", outliers=False)
    outcomes = predict([data / "a.npz", data / "sub"], tmp_path / "out", settings)
    assert {name: o.state for name, o in outcomes.items()} == dict.fromkeys("ade", "made")
    arguments = [str(data / "a.npz"), "--out", str(tmp_path / "single"), "--prior", prior_file]
    options = ["--smoothing", "full", "--pictures", "false", "--outliers", "false"]
    assert track(arguments + options) == 0
    single = PoseTrack.load(tmp_path / "single" / "poses.npz")
    batch = PoseTrack.load(tmp_path / "out" / "a.npz")
    for name in ("joints2d", "joints3d", "covariance3d", "observed", "log_evidence"):
        torch.testing.assert_close(getattr(batch, name), getattr(single, name), rtol=0, atol=0)
    assert batch.notes == single.notes and batch.fps == single.fps == 30
    row = rows(tmp_path / "out")["a"]
    assert int(row["frames"]) == 12 and float(row["seconds"]) == pytest.approx(0.4)
    assert float(row["log_evidence"]) == pytest.approx(float(single.log_evidence.sum()), rel=1e-5)
    assert float(row["missing"]) == pytest.approx(3 / 36)  # every fourth left hand of 3 joints


def test_no_smoothing_is_said_as_on_the_command_line(data, prior_file, tmp_path) -> None:
    for said in ("none", None):
        predict(
            [data / "a.npz"], tmp_path / str(said), TrackSettings(prior=prior_file, smoothing=said)
        )
    found, expected = (PoseTrack.load(tmp_path / str(said) / "a.npz") for said in ("none", None))
    torch.testing.assert_close(found.joints3d, expected.joints3d, rtol=0, atol=0)


def test_settings_are_the_options_of_track() -> None:
    own = asdict(TrackSettings())
    theirs = vars(track_command().parser().get_defaults())
    assert {name: theirs[name] for name in own} == own
    of_video = {"hands", "background", "edges", "candidates", "elbows", "face_model", "overlay"}
    of_video |= {"max_persons", "detector", "min_confidence", "workers"}
    assert set(theirs) - set(own) == {"config", "input", "out", "pictures"} | of_video


def test_bad_recordings_are_listed_and_do_not_stop_the_others(data, prior_file, tmp_path, capsys):
    out = tmp_path / "out"
    write_recording(data / "twice.npz", 5)
    gap = dict(np.load(data / "b.npz")) | {"keypoints": np.full((30, 3, 2), np.nan)}
    np.savez(data / "empty.npz", **gap)
    arguments = [str(data), "--out", str(out), "--track.prior", prior_file]
    assert main(arguments) == 1
    said = capsys.readouterr()
    assert "9 recordings: 7 made, 2 failed" in said.out
    other, reason = str(data / "other.npz"), "expected an array keypoints or joints2d, got joints"
    lines = said.err.strip().splitlines()
    assert [line.split(": ")[2:4] for line in lines[:2]] == [
        ["failed", "broken"],
        ["failed", "empty"],
    ]
    assert lines[2:] == [f"train: warning: no recording: {other}: {reason}"]
    table = rows(out)
    assert (table[other]["state"], table[other]["error"]) == ("no recording", reason)
    assert list(table) == sorted(table) and tuple(table["a"]) == COLUMNS
    assert {name for name, row in table.items() if row["state"] == "failed"} == {"broken", "empty"}
    assert "broken.npz: expected an .npz file" in table["broken"]["error"]
    assert "no keypoint is measured" in table["empty"]["error"]
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.*") if path.is_file()}
    assert main(arguments) == 1
    assert "9 recordings: 7 made before or by others, 2 failed" in capsys.readouterr().out
    after = {path: path.stat().st_mtime_ns for path in before}
    assert {p.name for p in before if before[p] != after[p]} <= {"run.json"}  # nothing made again
    assert histories(out)["empty"] == {"started": 1, "failed": 1}
    main([*arguments, "--retry_failed", "true"])
    assert histories(out)["empty"] == {"started": 2, "failed": 2}


def test_other_input_prior_or_settings_are_made_again(data, prior_file, tmp_path) -> None:
    out, settings = tmp_path / "out", TrackSettings(prior=prior_file)
    files = [data / "a.npz", data / "c.npz"]

    def made(settings: TrackSettings = settings) -> set[str]:
        outcomes = predict(files, out, settings)
        return {name for name, outcome in outcomes.items() if outcome.state == "made"}

    assert made() == {"a", "c"} and made() == set()
    write_recording(files[1], 8, seed=5)
    assert made() == {"c"}
    assert made(TrackSettings(prior=prior_file, smoothing="full")) == {"a", "c"}
    copied = tmp_path / "copied.safetensors"
    copied.write_bytes(Path(prior_file).read_bytes())
    assert made(TrackSettings(prior=str(copied), smoothing="full")) == set()  # the same numbers
    fit_upper_body_prior([recording()], 2, 1, n_samples=500, max_iter=5).save(copied)
    assert made(TrackSettings(prior=str(copied), smoothing="full")) == {"a", "c"}
    (out / "a.npz").write_bytes((out / "a.npz").read_bytes()[:-200])  # damaged
    (out / "c.npz").unlink()
    assert made(TrackSettings(prior=str(copied), smoothing="full")) == {"a", "c"}


def test_what_a_killed_process_left_is_removed(data, prior_file, tmp_path) -> None:
    out = tmp_path / "out"
    with Claims(out / ".claims").claim("sub/e") as claim:
        claim.record("started", rank=0)
    (out / "sub").mkdir()
    dead, mine = out / "sub" / ".torchpose-tmp-abcdefgh.npz", out / "sub" / ".e-abcdefgh.npz"
    dead.touch()
    mine.touch()
    with atomic_path(out / "sub" / "f.npz") as alive:
        predict([data], out, TrackSettings(prior=prior_file))
        assert alive.exists() and mine.exists() and not dead.exists()


@pytest.mark.parametrize("whole", [True, False])
def test_foreign_files_are_not_overwritten(data, prior_file, tmp_path, whole) -> None:
    place = tmp_path / "out" / "a.npz"
    place.parent.mkdir()
    np.savez(place, mine=np.ones(3))
    if not whole:
        place.write_bytes(place.read_bytes()[:-30])
    before = place.read_bytes()
    outcomes = predict([data / "a.npz"], tmp_path / "out", TrackSettings(prior=prior_file))
    assert "was not written by this command" in outcomes["a"].error
    assert place.read_bytes() == before


def test_another_table_is_not_overwritten(data, prior_file, tmp_path) -> None:
    table = tmp_path / "out" / "summary.csv"
    table.parent.mkdir()
    table.write_text("mine\n")
    with pytest.raises(OutputError, match=r"summary\.csv: is there already"):
        predict([data / "a.npz"], tmp_path / "out", TrackSettings(prior=prior_file))
    assert table.read_text() == "mine\n" and not (tmp_path / "out" / "a.npz").exists()


def test_what_suits_no_recording_is_refused_before_any_work(data, prior_file, tmp_path, capsys):
    out = tmp_path / "out"
    with pytest.raises(InputError, match="method must be one of"):
        predict([data], out, TrackSettings(prior=prior_file, method="guess"))
    with pytest.raises(PriorError):
        predict([data], out, TrackSettings(prior="nobody"))
    with pytest.raises(InputError, match="device"):
        predict([data], out, TrackSettings(prior=prior_file), device="abacus")
    with pytest.raises(InputError, match="no such file or folder"):
        predict([data / "nowhere"], out)
    assert not list(out.glob("*.npz"))
    config = tmp_path / "wrong.yaml"
    config.write_text(f"recordings: ['{data}']\nout: {out}\ntrack:\n  smothing: full\n")
    assert main(["--config", str(config)]) == 2
    assert "wrong.yaml: there is no key track.smothing" in capsys.readouterr().err


REFUSED = {
    "camera": (["--track.camera_name", "left"], "--track.camera_name chooses one of several"),
    "tilt": (["--track.tilt", "200"], "--track.tilt must lie between -90 and 90"),
    "deviation": (["--track.measurement_std", "0"], "got 0.0; it is how far keypoints are off, in pixels"),
    "keypoints": (["--track.person", "{data}/a.npz"], "a.npz: expected poses of the person, got keypoints"),
    "recording": (["--track.person", "{data}/other.npz"], "; give the poses.npz of an earlier recording"),
    "unknown": (["--track.foo", "3"], "there is no key track.foo; `python -m train predict --print_config`"),
    "number": (["--track.roll", "much"], "train: error: track.roll: Expected a float, got much\n"),
    "list": (["--config", "{data}/one.yaml"], "one.yaml: recordings: expected a list, such as [keypoints/]"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_errors_name_options_as_they_are_typed(case, data, prior_file, tmp_path, capsys) -> None:
    (data / "one.yaml").write_text(f"recordings: {data}\n")
    options, message = REFUSED[case]
    options = [option.format(data=data) for option in options]
    line = [str(data / "a.npz"), "--out", str(tmp_path / "out"), "--track.prior", prior_file]
    line += ["--track.method", "articulated"] if "--track.person" in options else []
    assert main([*line, *options]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out" / "a.npz").exists()


def test_what_was_assumed_is_said_also_of_results_that_are_there(
    data, prior_file, tmp_path, capsys
):
    for name in ("a", "b"):
        arrays = {k: v for k, v in np.load(data / f"{name}.npz").items() if k != "fps"}
        np.savez(data / f"{name}.npz", **arrays)
    line = [str(data / "a.npz"), str(data / "b.npz"), "--out", str(tmp_path / "out")]
    for _ in range(2):
        assert main([*line, "--track.prior", prior_file]) == 0
        said = capsys.readouterr().out
        assert (
            "note     the keypoint file states no frame rate: 30 fps assumed (2 recordings)" in said
        )


def test_errors_of_a_recording_name_options_as_they_are_typed(data, prior_file, tmp_path) -> None:
    write_recording(data / "unknown.npz", 5)
    arrays = {
        k: v for k, v in np.load(data / "unknown.npz").items() if k not in ("K", "image_size")
    }
    np.savez(data / "unknown.npz", **arrays)
    settings = TrackSettings(prior=prior_file)
    (outcome,) = predict([data / "unknown.npz"], tmp_path / "out", settings).values()
    assert "expected --track.camera FILE or --track.camera fx,fy,cx,cy" in outcome.error


def test_the_config_in_the_repository_is_complete() -> None:
    options = build().parse_args(["--config", str(ROOT / "configs" / "predict.yaml")])
    assert options.recordings == ["keypoints/"] and options.track.smoothing == "full"


# --- what is found and shared ---------------------------------------------------------------------


def test_longest_first_and_each_once_over_any_number_of_processes(data) -> None:
    found = find_keypoints([data]).recordings
    assert [r.name for r in found] == ["b", "sub/e", "sub/d", "a", "f", "c", "broken"]
    assert [r.n_frames for r in found][:3] == [30, 25, 20]
    for world in (1, 2, 3, 9):
        own = [len(found[rank::world]) for rank in range(world)]
        lists = [share(found, rank, world) for rank in range(world)]
        assert all(sorted(names) == sorted(found) for names in lists)  # all, sooner or later
        mine = [r.name for rank, names in enumerate(lists) for r in names[: own[rank]]]
        assert sorted(mine) == sorted(r.name for r in found)  # own shares: each exactly once


def test_openpose_folders_csv_and_names_that_clash(tmp_path) -> None:
    folder = tmp_path / "clips" / "wave"
    folder.mkdir(parents=True)
    for frame in range(3):
        (folder / f"f{frame}_keypoints.json").write_text("{}")
    (tmp_path / "clips" / "k.csv").write_text("# fps = 30\nframe,head_x,head_y\n0,1,2\n")
    (tmp_path / "clips" / "t.csv").write_text("time,price\n0,1\n")
    (tmp_path / "clips" / "german.csv").write_text("time;frame_number;head_x;head_y\n0,5;0;1;2\n")
    (tmp_path / "clips" / "dlc.csv").write_text("scorer,a\nbodyparts,head\ncoords,x\n0,1\n")
    assert [r.name for r in find_keypoints([tmp_path / "clips"]).recordings] == [
        "dlc", "k", "wave", "german"
    ]  # fmt: skip
    for name in ("german", "dlc"):
        (tmp_path / "clips" / f"{name}.csv").unlink()
    found = find_keypoints([tmp_path / "clips"])
    assert [r.name for r in found.recordings] == ["k", "wave"]
    table = str(tmp_path / "clips" / "t.csv")
    assert found.others == {table: "expected a column frame, got time, price"}
    write_recording(tmp_path / "k.npz", 3)
    with pytest.raises(InputError, match=r"both results would be called k\.npz"):
        find_keypoints([tmp_path / "clips", tmp_path / "k.npz"])
    (tmp_path / "film.mp4").write_bytes(b"")
    with pytest.raises(InputError, match="`torchpose track` takes videos"):
        find_keypoints([tmp_path / "film.mp4"])
    (tmp_path / "clips" / "times.csv").write_text("time,name,x,y\n0,head,1,2\n")
    assert "times" in [r.name for r in find_keypoints([tmp_path / "clips"]).recordings]
    with pytest.raises(InputError, match="found none"):
        find_keypoints([tmp_path / "clips"], leave_out=tmp_path)
    with pytest.raises(
        InputError, match=r"clips: is the folder of the results.*choose another --out"
    ):
        find_keypoints([tmp_path / "clips"], leave_out=tmp_path / "clips")


def test_folders_of_other_programs_are_recordings(tmp_path) -> None:
    """As `torchpose track` takes them: they were passed over without a word."""
    for name, text in {"cam/c.0007": '{"people": []}', "azure/a1": '{"bone_list": []}'}.items():
        (tmp_path / name).parent.mkdir()
        (tmp_path / f"{name}.json").write_text(text)
    [found] = find_keypoints([tmp_path]).recordings
    assert (found.name, found.n_frames) == ("cam", 1)
    before = content_of(found.path)
    (tmp_path / "cam" / "c.0008.json").write_text('{"people": []}')
    assert content_of(found.path) != before
    assert find_keypoints([tmp_path / "cam"]).recordings == [found._replace(n_frames=2)]


@pytest.mark.parametrize("seed", [-1, 2**64])
def test_a_seed_that_torchpose_track_refuses_is_refused(prior_file, seed) -> None:
    with pytest.raises(InputError, match=r"track\.seed must be a whole number from 0 on"):
        BatchTracker(TrackSettings(prior=prior_file, seed=seed))


def test_what_files_of_settings_hold_is_part_of_the_task(prior_file, tmp_path) -> None:
    file, tasks = tmp_path / "arms.safetensors", []
    for name in ("one", "two"):
        arms = copy.copy(shipped_arm_prior())
        arms.info = replace(arms.info, name=name)
        arms.save(file)
        settings = TrackSettings(prior=prior_file, method="articulated", arms=str(file))
        tasks.append(BatchTracker(settings).task)
    moved = file.rename(tmp_path / "moved.safetensors")
    tasks.append(BatchTracker(replace(settings, arms=str(moved))).task)
    assert tasks[0] != tasks[1] == tasks[2]


def test_results_inside_the_recordings_are_no_recordings(data, prior_file) -> None:
    settings = TrackSettings(prior=prior_file)
    for _ in range(2):
        outcomes = predict([data], data / "out", settings)
        assert set(outcomes) == {*LENGTHS, "broken", str(data / "other.npz")}


def test_results_of_another_run_are_no_recordings(data, prior_file, tmp_path) -> None:
    settings = TrackSettings(prior=prior_file)
    predict([data / "a.npz"], data / "earlier", settings)
    assert (data / "earlier" / "a.npz").is_file()
    found = find_keypoints([data])
    assert len(found.recordings) == 7 and list(found.others) == [str(data / "other.npz")]


def test_a_folder_with_a_file_that_is_no_recording_is_not_done(data, prior_file, tmp_path, capsys):
    folder = tmp_path / "two"
    folder.mkdir()
    (data / "a.npz").rename(folder / "a.npz")
    arguments = [str(folder), "--out", str(tmp_path / "out"), "--track.prior", prior_file]
    assert main(arguments) == 0 and not capsys.readouterr().err
    for i in range(6):
        (folder / f"bad{i}.csv").write_text("time,price\n0,1\n")
    assert main(arguments) == 1
    said = capsys.readouterr()
    assert "1 recording: 1 made before" in said.out
    assert "bad4.csv: expected a column frame, got time, price" in said.err
    assert "no recording: 1 more, which the summary lists" in said.err
    (folder / "a.npz").unlink()
    assert main(arguments) == 2
    assert "found none in" in (said := capsys.readouterr().err) and "got time, price" in said


def test_ranks_come_from_torchrun_slurm_or_options(monkeypatch) -> None:
    for name in ("RANK", "WORLD_SIZE", "SLURM_PROCID", "SLURM_NTASKS"):
        monkeypatch.delenv(name, raising=False)
    assert process_rank() == (0, 1) and process_rank(1, 3) == (1, 3)
    monkeypatch.setenv("SLURM_PROCID", "2")
    monkeypatch.setenv("SLURM_NTASKS", "4")
    assert process_rank() == (2, 4)
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert process_rank() == (1, 2)
    with pytest.raises(InputError, match="go together"):
        process_rank(1, None)
    with pytest.raises(InputError, match=r"0\.\.1"):
        process_rank(2, 2)


# --- claims ---------------------------------------------------------------------------------------


def test_a_claim_is_held_by_one_and_remembers(tmp_path) -> None:
    claims, others = Claims(tmp_path / "c", alone=False), Claims(tmp_path / "c", alone=False)
    with claims.claim("a") as first, others.claim("a") as second, others.claim("b") as third:
        assert first is not None and second is None and third is not None
        first.record("started", rank=0)
    with claims.path("a").open("ab") as stream:
        stream.write(b'{"event": "fin')  # killed in the middle of a line
    with others.claim("a") as again:
        again.record("finished")
    with claims.claim("a") as last:
        assert [event["event"] for event in last.history] == ["started", "finished"]


def test_runs_with_other_settings_do_not_mix(tmp_path) -> None:
    claims, others = Claims(tmp_path, alone=False), Claims(tmp_path, alone=False)
    with claims.run("one") as run:
        with others.run("one") as joined:
            assert joined.id == run.id
        with pytest.raises(InputError, match="another run"), others.run("two"):
            pass
    with others.run("two") as later:
        assert later.id != run.id


def test_without_locks_only_a_single_process_works(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("train.predict_claims.fcntl", None)
    with Claims(tmp_path, alone=True).claim("a") as claim:
        assert claim is not None
    with pytest.raises(OutputError, match="files can be locked"), \
            Claims(tmp_path, alone=False).claim("a"):  # fmt: skip
        pass


def test_a_full_disk_ends_the_run_and_a_bug_is_named_with_its_recording(
    data, prior_file, tmp_path, monkeypatch
) -> None:
    settings = TrackSettings(prior=prior_file)
    calls = []

    def fail(tracker, found):
        calls.append(found.name)
        raise RuntimeError("numbers ran out")

    with monkeypatch.context() as patch:
        patch.setattr(BatchTracker, "__call__", fail)
        outcomes = predict([data / "a.npz"], tmp_path / "out", settings)
    assert outcomes["a"].error == "RuntimeError: numbers ran out" and not outcomes["a"].good
    assert predict([data / "a.npz"], tmp_path / "out", settings)["a"].good  # it may pass away

    def full(*_):
        raise OutputError("no space left")

    monkeypatch.setattr(module, "save_result", full)
    with pytest.raises(OutputError, match="no space"):
        predict([data / "c.npz"], tmp_path / "out", settings)


@pytest.mark.parametrize("stop", [KeyboardInterrupt, SystemExit, OutputError("no space left")])
def test_a_run_that_is_stopped_is_no_death(data, prior_file, tmp_path, monkeypatch, stop) -> None:
    """After three times Ctrl-C the longest recording was given up."""
    settings = TrackSettings(prior=prior_file)

    def end(*_):
        raise stop

    with monkeypatch.context() as patch:
        patch.setattr(BatchTracker, "__call__", end)
        for _ in range(3):
            with pytest.raises(stop if isinstance(stop, type) else OutputError):
                predict([data / "a.npz"], tmp_path / "out", settings)
    assert predict([data / "a.npz"], tmp_path / "out", settings)["a"].good


def test_claims_on_a_full_disk(data, prior_file, tmp_path) -> None:
    with files_up_to(0), pytest.raises(OutputError, match=r"\.claims: cannot be written"):
        predict([data / "a.npz"], tmp_path / "out", TrackSettings(prior=prior_file))


def test_what_kills_every_process_is_given_up(data, prior_file, tmp_path) -> None:
    out, settings = tmp_path / "out", TrackSettings(prior=prior_file)
    for _ in range(3):
        with Claims(out / ".claims").claim("a") as claim:
            claim.record("started", rank=0)
    for _ in range(2):
        outcome = predict([data / "a.npz"], out, settings)["a"]
        assert outcome.error.startswith("3 processes died at it")
    assert predict([data / "a.npz"], out, settings, retry_failed=True)["a"].good


# --- several processes ----------------------------------------------------------------------------

_STUCK = """
import sys, time
from pathlib import Path
from train.predict import main
from train.predict_tracking import BatchTracker
assert "lightning" not in sys.modules  # tracking needs none
call = BatchTracker.__call__
def stuck(tracker, recording):
    if recording.name in {names!r}:
        Path({flag!r}).touch()
        time.sleep(600)
    return call(tracker, recording)
BatchTracker.__call__ = stuck
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_killed_workers_lose_nothing_and_nothing_is_made_twice(data, prior_file, tmp_path) -> None:
    """A live process takes over from a killed one; after all are killed, torchrun does the rest."""
    out, flags = tmp_path / "out", [tmp_path / "stuck0", tmp_path / "stuck1"]
    arguments = [str(data), "--out", str(out), "--track.prior", prior_file]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    processes = []
    try:
        for rank, stuck in enumerate([["c", "f"], ["sub/e"]]):  # e is the first of rank 1
            code = _STUCK.format(names=stuck, flag=str(flags[rank]))
            command = [sys.executable, "-c", code, *arguments, "--rank", str(rank), "--world", "2"]
            processes.append(subprocess.Popen(command, env=environment, cwd=ROOT))
        for flag, process in zip(flags, processes, strict=True):
            _wait_for(flag, process)
        assert histories(out)["sub/e"] == {"started": 1}
        processes[1].kill()
        processes[1].wait()
        processes[0].kill()
    finally:
        for process in processes:
            process.kill()
            process.wait()
    done = {p.relative_to(out).with_suffix("").as_posix() for p in out.rglob("*.npz")}
    assert done and "sub/e" not in done
    made = {name: (out / f"{name}.npz").stat().st_mtime_ns for name in done}
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node"]
    command += ["2", "-m", "train", "predict", *arguments]
    finished = subprocess.run(
        command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=300
    )
    assert finished.returncode == 1, finished.stderr  # because of the broken one
    assert {name: (out / f"{name}.npz").stat().st_mtime_ns for name in made} == made
    counts = histories(out)
    assert set(counts) == {*LENGTHS, "broken"}
    assert all(counts[name]["finished"] == 1 for name in LENGTHS)
    twice = {name for name, count in counts.items() if count["started"] > 1}
    assert "sub/e" in twice and twice <= {"sub/e", "c", "f"}  # those that were being made
    table = rows(out)
    assert {name: row["state"] for name, row in table.items()} == {
        **dict.fromkeys(LENGTHS, "done"), "broken": "failed",
        str(data / "other.npz"): "no recording",
    }  # fmt: skip
    assert all(int(table[name]["frames"]) == n for name, n in LENGTHS.items())


@pytest.mark.slow
def test_a_live_process_takes_over_from_a_killed_one(data, prior_file, tmp_path) -> None:
    out, flag = tmp_path / "out", tmp_path / "stuck"
    arguments = [str(data), "--out", str(out), "--track.prior", prior_file]
    code = _STUCK.format(names=["sub/e"], flag=str(flag))
    command = [sys.executable, "-c", code, *arguments, "--rank", "1", "--world", "2"]
    process = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": str(ROOT)}, cwd=ROOT)
    try:
        _wait_for(flag, process)
        killer = subprocess.Popen(
            [sys.executable, "-c", f"import os, time; time.sleep(2); os.kill({process.pid}, 9)"]
        )
        outcomes = predict([data], out, TrackSettings(prior=prior_file), 0, 2)
    finally:
        process.kill()
        assert process.wait() == -signal.SIGKILL
    killer.wait()
    assert outcomes["sub/e"].state == "made"
    counts = histories(out)
    assert counts["sub/e"] == {"started": 2, "finished": 1}
    assert all(counts[name]["finished"] == 1 for name in LENGTHS)
    assert read_origin(out / "sub" / "e.npz")["facts"]["frames"] == LENGTHS["sub/e"]
    assert len(rows(out)) == 8


def _wait_for(flag: Path, process: subprocess.Popen, seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not flag.exists():
        assert process.poll() is None, "the process ended before it got there"
        assert time.monotonic() < end, f"{flag} did not appear"
        time.sleep(0.05)
