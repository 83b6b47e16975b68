"""The protocol Silhouette: filters, statistics, and a whole small run."""

import csv
import json
import math
from functools import partial

import numpy as np
import pytest
import torch

from benchmarks.bodies import clips as body_clips
from benchmarks.bodies.tracking import PARTS, Run, drift, part_error
from benchmarks.bodies.views import Conditions
from benchmarks.engine import Results, Row, Setting, Tuning, pooled_std, read_settings
from benchmarks.engine.tuning import SCALES
from benchmarks.silhouette import filters
from benchmarks.silhouette import protocol as silhouette
from benchmarks.silhouette.filters import METHODS, make_filter, prepare
from tests.benchmarks.walkers import write_walkers
from torchpose.body import BODY_15
from torchpose.camera import save_cameras
from torchpose.errors import InputError
from torchpose.io import read_mocap
from torchpose.whole_body import AnnealedParticleFilter, SIRParticleFilter
from torchpose.whole_body._sharpness import SharpnessFit

SMALL = {
    "progress": False, "frames": 8, "particles": (20,), "seeds": 2, "size": ("64x48",), "faults": 0.5,
    "sharpness": 100.0,
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_walkers(tmp_path_factory.mktemp("mocap"))


@pytest.fixture(scope="module")
def clips(folder):
    return read_mocap(folder)


@pytest.fixture(scope="module")
def tracked(clips):
    (split,) = body_clips.split_clips(clips, ["p1"], ["p1"], 1, 60, 60)
    return prepare(split, Conditions((48, 64), faults=0.0), 12, 10)


# --- filters --------------------------------------------------------------------------------------


def test_every_filter_evaluates_the_same_number_of_likelihoods(tracked):
    for name, method in METHODS.items():
        tracker = make_filter(name, tracked, Setting(0.5, 2.0), 100)
        layers = tracker.n_layers if isinstance(tracker, AnnealedParticleFilter) else 1
        assert layers * tracker.n_particles == 100
        torch.testing.assert_close(tracker.step_std, 2 * tracked.step_std)
        for key, value in method.options.items():
            assert getattr(tracker, key) == value
    assert isinstance(make_filter("sir", tracked, Setting(30.0)), SIRParticleFilter)
    with pytest.raises(InputError, match="method must be among sir"):
        make_filter("kalman", tracked, Setting(1.0))


def test_what_a_person_is_tracked_with(tracked):
    (view,) = tracked.tests
    assert view.silhouettes.shape == (12, 3, 48, 64) and view.floor < 15
    assert 0.5 < view.overlap < 1 and view.in_view == 1.0
    at_start = 1000 * (tracked.body.joints(view.initial_state) - view.clip.joints[0]).norm(dim=-1)
    assert float(at_start.mean()) < 15
    level = tracked.step_std[[0, 2]]
    assert float(level[0]) == pytest.approx(float(level[1]))  # no heading is known beforehand
    assert tracked.manifold.info.fps == 60 and tracked.manifold.info.persons == ("p1",)
    (_, validation) = tracked.validation[0]
    assert validation.clip.trial not in {view.clip.trial, *tracked.manifold.info.sequences}


def test_validation_chooses_the_scale_first_and_then_the_exponent(tracked, tmp_path, monkeypatch):
    """Errors of a known landscape are put in place of those of filters."""
    tried = []

    def fit(make_filter, sequences, values, seeds):
        tracker = make_filter(values[0])
        scale = float((tracker.step_std / tracked.step_std)[0])
        tried.append((tracker.sharpness, round(scale, 6)))
        error = abs(math.log(scale / 1.4)) + 0.1 * abs(math.log(tracker.sharpness / 30))
        return SharpnessFit(values[0], tuple(values), (error,))

    monkeypatch.setattr(filters, "fit_sharpness", fit)
    found = filters.tune([tracked], "sir", 20, "bidirectional", tmp_path)
    assert found.setting == Setting(30.0, 1.4) and found.error == pytest.approx(0.0, abs=1e-6)
    assert tried[: len(SCALES)] == [(100.0, scale) for scale in SCALES]
    assert {scale for _, scale in tried[len(SCALES) :]} == {1.4}
    assert len(tried) == len(set(tried)) == len(found.tried)
    count = len(tried)
    again = filters.tune([tracked], "sir", 20, "bidirectional", tmp_path)
    assert len(tried) == count and again == found  # kept
    budgets = {len({*SCALES}) + len(m.values) - (m.first in m.values) for m in METHODS.values()}
    assert len(budgets) == 1


# --- statistics -----------------------------------------------------------------------------------


def made_up(seed, method, n_frames=(30, 40), n_seeds=4, offset=50.0):
    """Runs with errors of which everything is known."""
    rng = np.random.default_rng(seed)
    rows = []
    for q, n in enumerate(n_frames):
        for s in range(n_seeds):
            errors = offset + 10 * q + rng.normal(0, 5, (n, 15)) + rng.normal(0, 3)
            errors += 0.5 * np.arange(n)[:, None]
            errors[:, BODY_15.joint("head")] = np.nan
            state = torch.zeros(n, 36)
            flags = torch.zeros(n, dtype=torch.bool)
            run = Run(torch.from_numpy(errors), state, state, flags, flags, torch.ones(1))
            rows.append(Row("", f"sequence {q}", method, s, run))
    return Results(tuple(rows))


def test_statistics_are_numpy_s():
    runs = made_up(0, "sir") + made_up(1, "mrpf", offset=40.0)
    sir = runs.where(method="sir")
    every = [[r.errors.numpy().copy() for r in own.runs] for own in sir.by("subject").values()]
    whole = sir.values(part_error())
    expected = [[np.nanmean(e) for e in seeds] for seeds in every]
    np.testing.assert_allclose(whole.numpy(), expected)
    legs = [BODY_15.joint(f"{s}_{j}") for s in ("left", "right") for j in ("knee", "ankle")]
    np.testing.assert_allclose(
        sir.values(part_error("legs")).numpy(),
        [[e[:, legs].mean() for e in seeds] for seeds in every],
    )
    assert bool(sir.values(part_error("head")).isnan().all())
    slopes = [
        [np.polyfit(np.arange(len(e)) / 60, np.nanmean(e, 1), 1)[0] for e in seeds]
        for seeds in every
    ]
    np.testing.assert_allclose(sir.values(drift(60.0)).numpy(), slopes)
    sir.runs[0].errors[5:8] = torch.nan  # the truth was lost for three frames
    kept = np.delete(every[0][0], slice(5, 8), 0)
    slope = np.polyfit(np.delete(np.arange(30), slice(5, 8)) / 60, np.nanmean(kept, 1), 1)[0]
    assert float(sir.values(drift(60.0))[0, 0]) == pytest.approx(slope)
    spread = math.sqrt(np.mean([np.var(row, ddof=1) for row in expected]))
    assert float(pooled_std(whole)) == pytest.approx(spread)
    joints = [name for names in PARTS.values() for name in names]
    assert sorted(joints) == sorted(BODY_15.names)


# --- the whole of it ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def done(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("result")
    options = {"test_persons": ("p1",), "train_persons": ("p1",), **SMALL}
    return out, options, silhouette.run(folder, out, **options)


@pytest.mark.slow
def test_a_run_writes_tables_pictures_and_lines(done):
    out, _, report = done
    assert list(report["errors"].rows) == ["p1 p1_0", "all"]
    assert {"errors", "parts", "pooled", "differences", "tuning", "sequences"} <= set(report)
    assert report["tuning"]["APF", "chosen"] == 0.5 and report["tuning"]["SIR", "chosen"] == 100
    for name in (*report.pictures, "report.json", "report.md", "runs.csv"):
        assert (out / name).stat().st_size > 300
    json.loads((out / "report.json").read_text())
    with (out / "runs.csv").open() as stream:
        lines = list(csv.DictReader(stream))
    assert len(lines) == 6 and {line["method"] for line in lines} == {"sir", "apf", "mrpf"}
    sir = [float(line["error_mm"]) for line in lines if line["method"] == "sir"]
    assert report["errors"]["all", "SIR"] == pytest.approx(np.mean(sir), abs=1e-3)
    assert report["errors"]["all", "± SIR"] == pytest.approx(np.std(sir, ddof=1), abs=2e-3)
    assert all(float(v) < 200 for v in sir)
    assert any("paper's order" in line for line in report.findings)


@pytest.mark.slow
def test_a_killed_run_goes_on_with_the_same_numbers(done, folder, monkeypatch):
    out, options, report = done
    for path in sorted(out.glob("run-*.npz"))[:2]:
        path.write_bytes(path.read_bytes()[:50])  # damaged
    kept = {p: p.stat().st_mtime_ns for p in sorted(out.glob("run-*.npz"))[2:]}
    repaired, filtered = [], filters.track_view

    def watched(*arguments):
        repaired.extend(arguments[-1])  # a generator for each run
        return filtered(*arguments)

    monkeypatch.setattr(filters, "track_view", watched)
    again = silhouette.run(folder, out, **options)
    for table in ("errors", "parts", "differences"):
        assert again[table].rows == report[table].rows
    assert len(repaired) == 2
    assert {p: p.stat().st_mtime_ns for p in kept} == kept


@pytest.mark.slow
def test_other_conditions(folder, tmp_path, clips, monkeypatch):
    """Cameras of a file, one camera, a published exponent, a looped walk, a found first pose."""
    search = partial(filters.find_first_pose, n_particles=200, n_tracking=50)
    monkeypatch.setattr(filters, "find_first_pose", search)  # with a ninth of the particles
    rig = body_clips.place_cameras(clips[4])  # p2's first trial
    from torchpose.camera import PinholeCamera

    save_cameras(
        [
            PinholeCamera(
                450.0, 450.0, 319.5, 239.5, 640, 480, rig.names[i],
                rotation=_rotvec(rig.rotation[i]), translation=rig.translation[i].tolist(),
            )
            for i in range(3)
        ],
        tmp_path / "cameras.toml",
    )  # fmt: skip
    report = silhouette.run(
        folder, tmp_path / "out", cameras=str(tmp_path / "cameras.toml"), cameras_used=1,
        train_persons=("p1",), test_persons=("p2",), method=("sir",),
        **{**SMALL, "seeds": 1, "faults": 0.0, "sharpness": 1.0},
    )  # fmt: skip
    assert report["sequences"]["p2 p2_0", "own manifold"] == "no"
    assert report["sequences"]["p2 p2_0", "in view (%)"] > 99
    assert report["tuning"]["SIR", "chosen"] == 1.0
    report = silhouette.run(
        folder, tmp_path / "loop", loop=1, train_persons=("p1",), test_persons=("p1",),
        method=("mrpf",), initial="found", **{**SMALL, "seeds": 1},
    )  # fmt: skip
    assert report["sequences"].rows["p1 p1_0 looped 1 times"][0] > 50


@pytest.mark.slow
def test_several_conditions_with_the_settings_of_an_earlier_run(done, folder, tmp_path):
    """One table over particles and sizes; a row of it is the run of that condition alone."""
    earlier, _, _ = done
    options = {"train_persons": ("p1",), "test_persons": ("p1",), "method": ("sir", "mrpf")}
    options |= {**SMALL, "sharpness": None, "settings": str(earlier), "faults": 0.0, "frames": 3}
    several = {**options, "particles": (20, 40), "size": ("64x48", "80x60")}
    report = silhouette.run(folder, tmp_path / "out", **several)
    names = [f"{n} likelihoods, {size}" for size in ("64x48", "80x60") for n in (20, 40)]
    assert list(report["conditions"].rows) == names
    assert report["tuning"]["MRPF", "chosen"] == 100 and len(report["tuning"].rows) == 2
    assert {f"errors, {name}" for name in names} | {"sequences, 80x60"} <= set(report)
    assert (tmp_path / "out" / "runs-40-80x60.csv").is_file()
    alone = silhouette.run(folder, tmp_path / "one", **{**options, "particles": (40,)})
    row = report["conditions"].rows["40 likelihoods, 64x48"]
    assert row[0] == alone["errors"]["all", "SIR"] and row[5] == alone["errors"]["all", "± MRPF"]
    expected = alone["differences"].rows["MRPF - SIR"]
    assert report["differences"].rows["40 likelihoods, 64x48: MRPF - SIR"] == expected
    settings = json.loads((tmp_path / "out" / "report.json").read_text())["settings"]
    assert settings["settings"] == {m: {"value": 100.0, "scale": 1.0} for m in ("sir", "mrpf")}
    assert settings["particles"] == [20, 40]
    with pytest.raises(InputError, match="none of apf, only of sir, mrpf"):
        read_settings(tmp_path / "out", ["sir", "apf"])


@pytest.mark.slow
def test_the_settings_of_each_condition_where_validation_chose_them(folder, tmp_path, monkeypatch):
    """Sharpness 30 is put in place of what validation chooses with 20 particles, else 300."""

    def tune(tracked_persons, method, n, likelihood, out):
        found = Setting(30.0 if n == 20 else 300.0, 1.4)
        return Tuning(found, (found,), (50.0,))

    monkeypatch.setattr(silhouette, "tune", tune)
    report = silhouette.run(
        folder, tmp_path, train_persons=("p1",), test_persons=("p1",), method=("sir",),
        **{**SMALL, "sharpness": None, "particles": (20, 25), "seeds": 1, "frames": 3},
    )  # fmt: skip
    assert report["tuning"]["20 likelihoods: SIR", "chosen"] == 30.0
    assert report["tuning"]["25 likelihoods: SIR", "chosen"] == 300.0
    assert report.settings["settings"]["25 at 64x48"]["sir"]["value"] == 300.0
    assert "differences" not in report  # nothing to compare with


@pytest.mark.slow
def test_an_unseen_action_by_name(tmp_path):
    folder = write_walkers(tmp_path / "mocap", ("p1",), 4, 30)
    path = folder / "p1_3.npz"
    with np.load(path) as archive:
        content = dict(archive)
    np.savez(path, **{**content, "action": "run"})
    options = {**SMALL, "seeds": 1, "frames": 4, "method": ("mrpf",), "actions": ("walk",)}
    options |= {"train_persons": ("p1",)}
    report = silhouette.run(folder, tmp_path / "out", test_actions=("run",), **options)
    assert report["sequences"]["p1 p1_3", "own manifold"] == "yes, of walk"
    assert report.settings["tracked actions"] == ["run"] and report.settings["actions"] == ["walk"]
    assert "one seed" in report.findings[0]
    with pytest.raises(InputError, match="the manifold is of this action as well"):
        silhouette.run(folder, tmp_path / "out", test_actions=("walk",), **options)


def _rotvec(R):
    import cv2

    return cv2.Rodrigues(R.numpy())[0].ravel().tolist()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": ("kalman",)}, "--method takes sir, apf, mrpf"),
        ({"seeds": 0}, "--seeds must be at least 1"),
        ({"size": ("large",)}, "--size must be width x height"),
        ({"initial": "guessed"}, "--initial must be given or found"),
        ({"test_persons": ("p9",)}, "expected recordings of person p9"),
        ({"actions": ("run",)}, "there are walk"),
        ({"cameras_used": 4}, "4 cameras are asked for"),
        ({"settings": "x"}, "leave --sharpness out"),
        ({"particles": (20, 0)}, "--particles must be 1 or more"),
        ({"particles": (20, 20)}, "--particles takes each value once"),
    ],
)
def test_refusals(folder, tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        silhouette.run(folder, tmp_path, **{**SMALL, **options})


def test_cameras_of_another_room_are_refused(clips):
    rig = body_clips.place_cameras(clips[0])
    rig.translation[:, 2] -= 1000.0  # behind them all
    split = body_clips.split_clips(clips, ["p1"], ["p1"])[0]
    with pytest.raises(InputError, match="no camera sees the person"):
        prepare(split, Conditions((48, 64), rig=rig), 8, 8)


def test_several_actions_are_refused(tmp_path):
    write_walkers(tmp_path / "a", ("p1",), 2, 20)
    path = tmp_path / "a" / "p1_1.npz"
    with np.load(path) as archive:
        content = dict(archive)
    np.savez(path, **{**content, "action": "run"})
    with pytest.raises(InputError, match="of run, walk: choose with --actions"):
        silhouette.run(tmp_path / "a", tmp_path / "out")


def test_the_command(command, folder, tmp_path):
    line = ["--mocap", str(folder), "--out", str(tmp_path / "out")]
    line += ["--method", "sir", "mrpf", "--test-persons", "p1", "--train-persons", "p1"]
    line += ["--size", "64x48", "--particles", "10", "20", "--sharpness", "100", "--frames", "5"]
    code, text = command([*line, "--quick", "true"])
    assert code == 0 and "20 likelihoods: MRPF - SIR" in text
    code, text = command(["--mocap", "none", "--out", "o"])
    assert code == 2 and "--mocap none: no such folder" in text


@pytest.fixture
def command(capsys):
    from benchmarks._protocols import execute_protocol

    def call(arguments):
        code = execute_protocol("silhouette", arguments)
        captured = capsys.readouterr()
        return code, captured.out + captured.err

    return call
