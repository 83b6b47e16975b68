"""The protocol Root uncertainty: conditions, displacements, tables, and a whole small run."""

import csv
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import torchpose
from benchmarks._protocols import PROTOCOLS
from benchmarks.bodies.clips import split_clips
from benchmarks.bodies.tracking import Run, generators_of, track_view
from benchmarks.bodies.views import Conditions, subjects_of
from benchmarks.engine import Results, Row, Setting, Tuning
from benchmarks.root_uncertainty import protocol as root_uncertainty
from benchmarks.root_uncertainty import recovery
from benchmarks.root_uncertainty import walkers as root_uncertainty_walkers
from benchmarks.root_uncertainty.recovery import (
    Displacement,
    Recovered,
    add_recovery,
    displaced,
)
from benchmarks.root_uncertainty.report import add_errors, add_order, add_rates
from benchmarks.root_uncertainty.walkers import (
    METHODS,
    SOURCES,
    TRACKING,
    Budget,
    Filter,
    make_filter,
    prepare,
    published,
    selected_among,
    slower,
    tune,
    with_cameras,
)
from tests.benchmarks.walkers import write_walkers
from torchpose.cli._evaluate import build
from torchpose.errors import InputError
from torchpose.evaluation import Report
from torchpose.evaluation._trials import settings_hash
from torchpose.io import read_mocap
from torchpose.math import quaternion_vector_to_matrix
from torchpose.whole_body import AnnealedParticleFilter, RootUncertaintyTracker

SMALL = {"progress": False, "quick": True, "size": "64x48", "frames": 8, "persons": ("p1",)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_walkers(tmp_path_factory.mktemp("mocap"))


@pytest.fixture(scope="module")
def walkers(folder):
    splits = split_clips(read_mocap(folder), ["p1", "p2"], ["p1", "p2"], 1, 40, 20)
    return prepare(splits, Conditions((48, 64), faults=0.0), 12, 6)


# --- who is tracked with what ---------------------------------------------------------------------


def test_everybody_shares_centres_and_models_of_trials_that_are_not_tracked(walkers):
    one, other = walkers
    assert one.body.frame == "body" and bool(one.body.centres[1:].any())
    torch.testing.assert_close(one.body.centres, other.body.centres)
    assert not torch.allclose(one.body.bone_lengths, other.body.bone_lengths)
    assert one.conditionals is other.conditionals and one.limits is other.limits
    one.conditionals.check_for(other.body)
    for walker in walkers:
        trained = {clip.trial for w in walkers for clip in w.split.manifold}
        assert walker.tests[0].clip.trial not in trained
        assert walker.validation[0][1].clip.trial not in trained | {walker.tests[0].clip.trial}
        at_start = walker.body.joints(walker.tests[0].initial_state)
        assert float((at_start - walker.tests[0].clip.joints[0]).norm(dim=-1).mean()) < 0.015
        assert walker.tests[0].floor < 15


def test_slower_cameras_see_every_third_frame_of_a_motion_learnt_at_that_rate(walkers):
    slow = slower(walkers[0], 3)
    view, whole = slow.tests[0], walkers[0].tests[0]
    assert slow.fps == view.clip.fps == slow.conditionals.info.fps == 20
    assert bool((view.silhouettes == whole.silhouettes[[0, 3, 6, 9]]).all())
    np.testing.assert_array_equal(view.clip.joints.numpy(), whole.clip.joints[::3].numpy())
    steps = [np.diff(states[::3, 6:].numpy(), axis=0) for states in walkers[0].training]
    expected = np.sqrt(np.mean(np.concatenate(steps) ** 2, axis=0))
    np.testing.assert_allclose(slow.step_std[6:].numpy(), expected, atol=1e-12)
    # a walk goes on: three frames are nearly three steps, where a random walk makes root 3
    along = float(slow.step_std[2] / walkers[0].step_std[2])
    assert along == pytest.approx(3, rel=0.02)
    assert slower(walkers[0], 1) is walkers[0]
    with pytest.raises(InputError, match="n at least 1"):
        slower(walkers[0], 0)


def test_fewer_cameras_are_the_first_ones(walkers):
    two = with_cameras(walkers[0], 2)
    view, whole = two.tests[0], walkers[0].tests[0]
    assert len(view.rig) == 2 and view.silhouettes.shape[1] == 2
    assert bool((view.silhouettes == whole.silhouettes[:, :2]).all())
    assert bool((view.rig.translation == whole.rig.translation[:2]).all())
    with pytest.raises(InputError, match="expected 1 to 3 cameras, got 4"):
        with_cameras(walkers[0], 4)


def test_every_filter_evaluates_the_same_number_of_likelihoods(walkers):
    slow = slower(walkers[0], 2)
    for name in METHODS:
        tracker = make_filter(name, slow, Setting(0.3, 2.0), Budget(800, leg_swap=0.2))
        if isinstance(tracker, RootUncertaintyTracker):
            points = 8 if tracker.weighting == "body" else 7
            assert tracker.n_particles == (100 if points == 8 else 114)
            assert tracker.n_particles * points in (798, 800)
            ratio = tracker.conditionals.diffusion / slow.conditionals.diffusion
            torch.testing.assert_close(ratio, torch.full_like(ratio, 4.0))
        elif isinstance(tracker, AnnealedParticleFilter):
            assert tracker.n_particles * tracker.n_layers == 800 and tracker.survival_rate == 0.3
        else:
            assert tracker.n_particles == 800
            assert tracker.survival_rate == 0.3
        assert tracker.n_particles == selected_among(name, Budget(800))
        torch.testing.assert_close(tracker.step_std, 2 * slow.step_std)
        assert tracker.limits is slow.limits and tracker.limit_mode == "discard"
        assert tracker.leg_swap == 0.2
        assert tracker.estimate == ("mean" if name == "apf" else "map")
    usual = published("sir", 30.0)
    plain = make_filter("sir", slow, usual, Budget(limits=False))
    assert plain.limits is None and plain.survival_rate == pytest.approx(0.01 ** (1 / 30))
    with pytest.raises(InputError, match="method must be among sir"):
        make_filter("kalman", slow, usual)
    with pytest.raises(InputError, match="particles must be at least 7"):
        make_filter("root", slow, usual, Budget(6))
    for name, least in (("sir", 2 / 800), ("apf", 2 / 160), ("root", 2 / 114)):
        make_filter(name, slow, Setting(least), Budget(800))
        with pytest.raises(InputError, match="fewer than 2"):
            make_filter(name, slow, Setting(0.9 * least), Budget(800))


# --- what validation chooses ----------------------------------------------------------------------


def test_a_search_starts_from_what_was_chosen_at_the_rate_above(walkers, tmp_path, monkeypatch):
    asked = []

    def tune(walkers, name, budget, folder, start):
        asked.append((walkers[0].fps, name, start))
        return Tuning(Setting(walkers[0].fps / 1000, 1.4))

    monkeypatch.setattr(root_uncertainty, "tune", tune)
    by_rate = {fps: [slower(walkers[0], n)] for fps, n in ((15.0, 4), (60.0, 1), (30.0, 2))}
    found = root_uncertainty._tunings(
        by_rate, ("sir", "root"), Budget(), tmp_path, "validation", False, False
    )
    above = {60.0: None, 30.0: Setting(0.06, 1.4), 15.0: Setting(0.03, 1.4)}
    assert asked == [(fps, name, above[fps]) for fps in above for name in ("sir", "root")]
    assert found[15.0]["root"].setting == Setting(0.015, 1.4)


def test_errors_of_validation_clips_are_what_a_search_goes_by(walkers, tmp_path, monkeypatch):
    """Runs with errors of a known landscape are put in place of those of filters."""
    errors = {0.06: 70.0, 0.1: 61.0, 0.16: 60.0, 0.25: 65.0, 0.926: 90.0}
    tracked = []

    def track(tracker, body, view, start, generators):
        scale = float((tracker.step_std / walkers[0].step_std)[0])
        tracked.append(view.clip.trial)
        error = errors[round(tracker.survival_rate, 3)] + 10 * abs(math.log(scale))
        state, flags = torch.zeros(5, 36), torch.zeros(5, dtype=torch.bool)
        return [Run(torch.full((5, 15), error), state, state, flags, flags, torch.ones(1))]

    monkeypatch.setattr(root_uncertainty_walkers, "track_view", track)
    first = tune([walkers[0]], "root", Budget(), tmp_path)
    assert first.setting == Setting(0.16, 1.0)
    assert any(round(s.value, 3) == 0.926 for s in first.tried)
    assert {*tracked} == {walkers[0].validation[0][1].clip.trial}
    count = len(tracked)
    again = tune([walkers[0]], "root", Budget(), tmp_path, Setting(0.1, 1.4))
    assert again.setting == Setting(0.16, 1.0) and all(s.value < 0.9 for s in again.tried)
    assert len(tracked) < count + len(again.tried)  # some were kept


def test_published_survival_is_that_of_a_second():
    for fps in (60.0, 15.0):
        assert published("root", fps).value ** fps == pytest.approx(0.01)
        assert published("apf", fps) == Setting(0.5, 1.0)


# --- displacements --------------------------------------------------------------------------------


def test_displaced_bodies_are_moved_and_turned_about_the_pelvis(walkers):
    body, view = walkers[0].body, walkers[0].tests[0]
    state, up = view.initial_state, view.clip.up
    before = body.joints(state).numpy()
    shift, turn = recovery._steps(Displacement(0.2), up, [0, 1, 2])
    np.testing.assert_allclose(shift.norm(dim=-1).numpy(), 0.2)
    np.testing.assert_allclose((shift @ up).numpy(), 0, atol=1e-12)
    assert not bool(turn.any()) and len({tuple(s) for s in shift.tolist()}) == 3
    moved = body.joints(displaced(state.expand(3, -1), shift, turn)).numpy()
    np.testing.assert_allclose(moved - before, shift[:, None].expand(3, 15, 3).numpy(), atol=1e-9)
    shift, turn = recovery._steps(Displacement(degrees=40.0), up, [0, 1, 2, 3])
    assert not bool(shift.any())
    angle = 2 * torch.asin(turn @ up).rad2deg()
    assert sorted({round(float(a), 6) for a in angle}) == [-40.0, 40.0]
    about = quaternion_vector_to_matrix(turn[0]).numpy()
    turned = body.joints(displaced(state, shift[0], turn[0])).numpy()
    np.testing.assert_allclose(turned, before[0] + (before - before[0]) @ about.T, atol=1e-9)


def test_a_displacement_in_the_middle_moves_particles_once(walkers):
    """Errors before it do not matter, and without one they are those of an ordinary run."""
    walker, view = walkers[0], walkers[0].tests[0]
    tracker = make_filter("apf", walker, published("apf", 60.0), Budget(50))
    after = recovery._after
    none, there = (
        after(tracker, walker.body, view, [0, 1], Displacement(metres), 4, 6)
        for metres in (0.0, 0.3)
    )
    assert none.shape == there.shape == (2, 6)
    generators = generators_of([0, 1])
    start = view.initial_state.expand(2, -1)
    runs = track_view(tracker, walker.body, view, start, generators)
    plain = torch.stack([run.errors[4:10].mean(-1) for run in runs])
    torch.testing.assert_close(none.float(), plain, atol=1e-3, rtol=1e-4)
    assert bool((there[:, 0] > none[:, 0] + 100).all())


# --- tables ---------------------------------------------------------------------------------------


def made_up(errors, condition=""):
    """Runs with these mean errors by method, sequence and seed."""
    state, flags = torch.zeros(5, 36), torch.zeros(5, dtype=torch.bool)
    return Results(tuple(
        Row(
            condition, f"sequence {q}", label, s,
            Run(torch.full((5, 15), float(e)), state, state, flags, flags, torch.ones(1)),
        )
        for label, rows in errors.items()
        for q, row in enumerate(rows)
        for s, e in enumerate(row)
    ))  # fmt: skip


def test_tables_are_numpy_s_and_findings_say_what_they_show():
    rows = {
        "SIR": [[100.0, 120.0], [90.0, 130.0]],
        "APF": [[60.0, 70.0], [150.0, 250.0]],
        "Root uncertainty": [[80.0, 84.0], [90.0, 92.0]],
    }
    runs, report = made_up(rows, "60"), Report("x")
    add_errors(report, "3 cameras", "title", runs)
    for label, found in rows.items():
        values = np.array(found)
        table = report["3 cameras"]
        persons = values.mean(1)
        assert table[label, "average"] == pytest.approx(persons.mean())
        assert table[label, "± persons"] == pytest.approx(persons.std(ddof=1))
        assert table[label, "worst person"] == pytest.approx(persons.max())
        assert table[label, "worst run"] == values.max()
        spread = np.sqrt(values.var(axis=1, ddof=1).mean())
        assert table[label, "± seeds"] == pytest.approx(spread)
    add_order(report, 3, runs)
    said = "\n".join(report.findings)
    assert "86.5 mm, at most the paper's 93.7 mm" in said
    assert "better than SIR on average, as in the paper: yes; 86.5 and 110.0 mm" in said
    assert "by the worst person yes (91.0 and 200.0 mm), by the worst run yes" in said
    assert "here for sequence 0." in said
    worse = made_up(rows | {"Root uncertainty": [[180.0, 184.0], [190.0, 292.0]]}, "15")
    report.findings.clear()
    add_order(report, 3, worse)
    said = "\n".join(report.findings)
    assert "ABOVE the paper's 93.7 mm" in said and "as in the paper: NO" in said
    report.findings.clear()
    add_rates(report, runs + worse)
    assert report["rates"]["15", "Root uncertainty"] == pytest.approx(211.5)
    assert "ahead of SIR at 60 of 60, 15 frames per second" in report.findings[0]


def test_recovered_are_runs_as_good_as_undisturbed_ones():
    last = [[55.0, 79.0], [81.0, 300.0]]
    rows = [
        Row(condition, f"p{q}", "APF", s, Recovered(torch.cat([torch.full((6,), 50.0), end])))
        for q in range(2)
        for s in range(2)
        for condition, end in (
            ("none, start", torch.full((6,), 50.0)),
            ("10 cm, start", torch.full((6,), last[q][s])),
        )
    ]
    report = Report("x")
    add_recovery(report, Results(tuple(rows)), 60.0, 1.0)
    table = report["recovery"]
    assert table["none, start", "back, APF (%)"] == 100
    assert table["10 cm, start", "APF"] == pytest.approx((55 + 79 + 81 + 300) / 4)
    assert table["10 cm, start", "back, APF (%)"] == 50


# --- the whole of it ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def done(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("result")
    return out, root_uncertainty.run(folder, out, **SMALL)


@pytest.mark.slow
def test_a_run_writes_tables_pictures_and_lines(done):
    out, report = done
    tables = {"3 cameras", "2 cameras", "differences", "rates", "recovery", "speed", "tuning"}
    assert tables | {"sequences"} <= set(report)
    labels = ["SIR", "APF", "Root uncertainty"]
    assert list(report["3 cameras"].rows) == labels
    assert list(report["rates"].rows) == ["60", "15"]
    assert report["tuning"]["APF, 15 fps", "survival"] == "0.5 (published)"
    assert report["tuning"]["Root uncertainty, 60 fps", "particles"] == pytest.approx(
        5 * 0.926, abs=0.01
    )
    assert set(report.settings["settings"]) == {"60", "15"}
    assert list(report["recovery"].rows) == ["none, start", "40 degrees, start"]
    pictures = {"predictions.png", "sigma-points.png", "diffusion.png", "samples.png", "poses.png"}
    pictures |= {"error-over-time-3-cameras.png", "error-over-rates.png"}
    assert pictures <= set(report.pictures)
    for name in (*report.pictures, "report.json", "report.md"):
        assert (out / name).stat().st_size > 300
    assert json.loads((out / "report.json").read_text())["settings"]["hypotheses"] == 5
    with (out / "runs-3-cameras.csv").open() as stream:
        lines = list(csv.DictReader(stream))
    assert {line["method"] for line in lines} == set(labels) and len(lines) == 6
    apf = [float(line["error_mm"]) for line in lines if line["method"] == "APF"]
    assert report["3 cameras"]["APF", "average"] == pytest.approx(np.mean(apf), abs=1e-3)
    assert report["rates"]["60", "APF"] == pytest.approx(np.mean(apf), abs=1e-3)
    assert all(value < 250 for value in apf)
    assert any("better than SIR" in line for line in report.findings)


@pytest.mark.slow
def test_parts_go_on_from_what_is_kept(done, folder, tmp_path, monkeypatch):
    out, report = done
    settings = {"settings": str(shutil.copytree(out, tmp_path / "earlier"))}  # what it chose

    def never(*arguments):
        raise AssertionError("a run that is kept was made again")

    monkeypatch.setattr(root_uncertainty_walkers, "track_view", never)
    monkeypatch.setattr(recovery, "make_filter", never)
    for part, table in (("rates", "rates"), ("recovery", "recovery")):
        again = root_uncertainty.run(folder, out, part=part, **SMALL)
        assert again[table].rows == report[table].rows and "3 cameras" not in again
    again = root_uncertainty.run(folder, out, part="rates", **settings, **SMALL)
    assert again["rates"].rows == report["rates"].rows
    with pytest.raises(InputError, match="of sir, apf, root at 20; there are none"):
        root_uncertainty.run(folder, out, part="rates", fps=(60.0, 20.0), **settings, **SMALL)


def test_runs_depend_on_their_options_and_sources(walkers, monkeypatch):
    (subject, *_) = subjects_of(walkers).values()
    how = Filter("root", published("root", 60.0), Budget(50))

    def facts():
        return settings_hash(TRACKING.facts(subject, how))

    before = facts()
    assert facts() == before
    other = METHODS["root"]._replace(options={"least_std": 0.05})
    monkeypatch.setitem(METHODS, "root", other)
    assert facts() != before
    for name in SOURCES:
        assert (Path(torchpose.__file__).parents[1] / name).exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": ("sir", "kalman")}, "--method takes sir, apf, root.*got kalman"),
        ({"part": "figures"}, "--part must be one of tables, rates, recovery, all"),
        ({"fps": (60.0, 25.0)}, "--fps takes whole parts of 60.*got 25"),
        ({"cameras_used": (4,)}, "--cameras-used takes 1, 2 and 3"),
        ({"displaced_at": (5.0,), "part": "recovery"}, "--displaced-at takes seconds from 0 to"),
        ({"seeds": 0}, "--seeds must be at least 1, got 0"),
        ({"persons": ("p9",)}, "expected recordings of person p9"),
        ({"size": "small"}, "--size must be width x height"),
    ],
)
def test_options_that_mean_nothing_are_refused(folder, tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        root_uncertainty.run(folder, tmp_path, **SMALL | options)


def test_words_of_the_command_line():
    words = "--mocap d --out o --cameras-used 3 2 --fps 60 15 --method sir root --part rates"
    args = build("benchmarks.root_uncertainty", PROTOCOLS["root_uncertainty"]).parse_args(
        words.split()
    )
    assert args.cameras_used == [3, 2] and args.fps == [60.0, 15.0]
    assert args.method == ["sir", "root"] and args.part == "rates" and args.particles == 800
