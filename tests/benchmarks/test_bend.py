"""The protocol Bend: who trains for whom, a hidden arm, statistics, decisions, and a whole small run."""

import csv
import json

import numpy as np
import pytest
import torch

from benchmarks.bend import actions as bend_actions
from benchmarks.bend import occlusion as bend_occlusion
from benchmarks.bend import protocol as bend
from benchmarks.bend import report as bend_report
from benchmarks.bend import tracking as bend_tracking
from benchmarks.bend.clips import action_clips, first_bend, leave_one_out, performances
from benchmarks.bend.variants import known_angles, perform, prepare
from benchmarks.bodies.views import Conditions
from benchmarks.engine import Results, Row
from tests.benchmarks.benders import bender, write_benders
from torchpose.body import BODY_15
from torchpose.errors import InputError
from torchpose.evaluation import Report
from torchpose.io import read_mocap

SMALL = {
    "progress": False, "quick": True, "size": "64x48", "at": 10, "frames": 5, "particles": (10,),
    "dimensions": (2,),
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_benders(tmp_path_factory.mktemp("mocap"), ("p1", "p2", "p3"))


@pytest.fixture(scope="module")
def clips(folder):
    return read_mocap(folder, 30.0)


@pytest.fixture(scope="module")
def bends(clips):
    return [clip for clip in clips if clip.action == "bend"]


@pytest.fixture(scope="module")
def done(folder, tmp_path_factory):
    """Everything but the actions."""
    out = tmp_path_factory.mktemp("out")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bend, "PARTS", ("particles", "dimensions", "occlusion"))
        return out, bend.run(folder, out, **SMALL)


# --- who trains for whom --------------------------------------------------------------------------


def test_nobody_trains_for_themselves(bends):
    for split in leave_one_out(bends, n_frames=20):
        assert {c.person for c in split.manifold} == {"p1", "p2", "p3"} - {split.person}
        assert {c.person for c in (*split.test, *split.body)} == {split.person}
        assert not {c.trial for c in split.test} & {c.trial for c in split.body}
        assert [len(c) for c in split.test] == [20] and len(split.manifold) == 2 * 2 * 3


def test_recordings_are_cut_where_people_stand_upright(bends):
    parts = performances(bends[0])  # three bends of 22 frames
    assert [len(p) for p in parts] == pytest.approx([23] * 3, abs=2)
    height = bends[0].joints[:, BODY_15.joint("neck"), 1]
    for part in parts:
        neck = part.joints[:, BODY_15.joint("neck"), 1]
        assert float(neck[0]) > 0.97 * float(height.max()) and float(neck[-1]) > 0.97 * height.max()
        assert float(neck.min()) < float(height.min()) + 0.02
    assert len(first_bend(bends[0], 1000)) == len(bends[0])
    torch.testing.assert_close(first_bend(bends[0], 9).joints, parts[0].joints[:9])


def test_splits_that_cannot_be_made(bends, clips):
    with pytest.raises(InputError, match="others train: expected two persons or more, got p1"):
        leave_one_out([c for c in bends if c.person == "p1"])
    with pytest.raises(InputError, match="expected more than 2 recordings"):
        leave_one_out(bends, n_clips=2)
    with pytest.raises(InputError, match="expected recordings of punch; there are bend, clap"):
        action_clips(clips, ["punch"])


# --- a hidden arm ---------------------------------------------------------------------------------


def test_an_arm_is_hidden_from_the_side_and_seen_from_ahead(bends):
    split = leave_one_out(bends, ["p1"], n_frames=12)[0]
    performed = {p: perform([c for c in bends if c.person == p]) for p in ("p1", "p2", "p3")}
    shares = {}
    for azimuth in (0.0, 90.0):
        conditions = Conditions((96, 128), 0.0, 1, azimuths=(azimuth,))
        tracked = prepare(split, performed, conditions)
        shares[azimuth] = bend_occlusion.visible_share(tracked, tracked.tests[0])
    assert float(shares[0.0][:3].min()) > 0.5  # upright, arms up
    assert float(shares[90.0].mean()) < 0.6 * float(shares[0.0].mean())
    lost = bend_occlusion.displaced(tracked, tracked.tests[0])
    true, moved = (tracked.body.joints(s) for s in (tracked.tests[0].initial_state, lost))
    gap = (moved - true).norm(dim=-1)
    arm = [BODY_15.joint(f"right_{j}") for j in ("elbow", "wrist")]
    others = [j for j in range(15) if j not in arm]
    assert float(gap[arm].min()) > 0.1 and float(gap[others].max()) < 1e-9
    assert bool(known_angles(bends[0]).all())


# --- statistics -----------------------------------------------------------------------------------


def made_up(seed, offset, condition="", method="constrained", n_seeds=3, n_frames=(5, 7)):
    """Runs of which everything is known."""
    rng = np.random.default_rng(seed)
    rows = []
    for q, n in enumerate(n_frames):
        for s in range(n_seeds):
            errors = torch.from_numpy(offset + rng.normal(0, 5, (n, 15)))
            errors[:, BODY_15.joint("head")] = torch.nan
            squared = torch.from_numpy(offset + rng.normal(0, 1, n))
            share = torch.full((n,), 0.5)
            run = bend_tracking.BendRun(
                errors, squared, torch.zeros(n, 36), share, share / 2, torch.zeros(n, 0),
                share * torch.nan, torch.zeros(n, dtype=torch.bool), torch.full((1,), 0.01),
            )  # fmt: skip
            rows.append(Row(condition, f"p{q}", method, s, run))
    return Results(tuple(rows))


def test_statistics_are_numpy_s():
    runs = made_up(0, 20.0)
    cells = [own.runs for own in runs.by("subject").values()]
    squared = [[r.squared.numpy().mean() for r in seeds] for seeds in cells]
    np.testing.assert_allclose(runs.values(bend_tracking.mean_squared).numpy(), squared)
    joints = [[np.nanmean(r.errors.numpy()) for r in seeds] for seeds in cells]
    np.testing.assert_allclose(runs.values(bend_report.JOINT_ERROR).numpy(), joints)
    roots = [[r.errors.numpy()[:, 0].mean() for r in seeds] for seeds in cells]
    np.testing.assert_allclose(runs.values(bend_report.root_error).numpy(), roots)
    arms = bend_occlusion.arm_errors(cells[0], "left").numpy()
    columns = [BODY_15.joint("left_elbow"), BODY_15.joint("left_wrist")]
    np.testing.assert_allclose(arms[1], cells[0][1].errors.numpy()[:, columns].mean(1))


@pytest.mark.parametrize(("offset", "word"), [(10.0, "no worse"), (40.0, "WORSE")])
def test_the_verdict_is_that_of_the_numbers(offset, word):
    runs = Results(())
    for n in (500, 2000, 10000):
        runs += made_up(n, offset, f"{n:,}") + made_up(n + 1, 25.0, f"{n:,}", "first order")
    report = Report("made up")
    bend_report.add_particles(report, runs)
    assert f"2,000 particles is {word} than unconstrained with 10,000" in report.findings[0]
    assert report["particles"]["500", "accepted (%)"] == pytest.approx(50.0)
    most = runs.where(condition="10,000", method="first order")
    expected = float(most.values(bend_tracking.mean_squared).mean())
    assert report["particles"]["10,000", "MSE, first order"] == pytest.approx(expected)


def test_a_confusion_table_counts_recordings():
    made = bend_actions.Recognised
    found = [
        made("p1", "bend", "bend", 1.0), made("p2", "bend", "punch", 0.2),
        made("p1", "punch", "punch", 0.9), made("p1", "clap", "none", 0.6),
        made("p2", "clap", "bend", 0.0),
    ]  # fmt: skip
    report = Report("made up")
    bend_actions.add_confusion(report, "actions", "Actions", found, ("bend", "punch", "none"))
    rows = report["actions"].rows
    assert rows["bend"][:3] == (1, 1, 0) and rows["punch"][:3] == (0, 1, 0)
    assert rows["clap (none of them)"] == (1, 0, 1, pytest.approx(30.0))
    assert "2 of 3 recordings" in report.findings[0] and "1 of 2 others" in report.findings[0]


# --- the whole of it ------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_writes_tables_and_pictures(done):
    out, report = done
    assert {"particles", "tuning", "sequences"} <= set(report)
    with (out / "runs.csv").open() as stream:
        lines = list(csv.DictReader(stream))
    assert len(lines) == 2 and {line["constrained"] for line in lines} == {"True", "False"}
    for line in lines:
        name = "constrained" if line["constrained"] == "True" else "first order"
        assert float(line["mse_degrees2"]) == pytest.approx(
            report["particles"]["10", f"MSE, {name}"], abs=1e-3
        )
    assert all((out / name).stat().st_size > 3000 for name in report.pictures)
    names = {"error-over-particles", "predictions", "action-space", "hidden-arm", "estimates"}
    assert {f"{name}.png" for name in names} < set(report.pictures)
    json.loads((out / "report.json").read_text())
    assert report["sequences"].rows["p1 p1_0_bend"][0] == 5
    dimensions = report["dimensions"]
    assert list(dimensions.rows) == ["0", "2"]
    assert dimensions["2", "at best (%)"] == pytest.approx(100 * 0.9545**2)
    occlusion = report["occlusion"]
    assert occlusion["first order", "lost, 0 s"] > occlusion["first order", "near"]


@pytest.mark.slow
def test_a_killed_run_goes_on_with_the_same_numbers(done, folder, monkeypatch):
    out, report = done
    for path in sorted(out.glob("run-*.npz"))[:2]:
        path.write_bytes(path.read_bytes()[:50])
    made, calls = bend_tracking.make_filter, []
    monkeypatch.setattr(bend_tracking, "make_filter", lambda *a: calls.append(1) or made(*a))
    monkeypatch.setattr(bend, "PARTS", ("dimensions",))
    again = bend.run(folder, out, **SMALL)
    assert len(calls) <= 2
    assert str(again["dimensions"].rows) == str(report["dimensions"].rows)  # some are NaN


@pytest.mark.slow
def test_gates_of_other_dimensions_are_told_in_the_report(done, folder, tmp_path):
    found = bend.run(folder, tmp_path, part="particles", **SMALL, gate_dimensions=3)
    assert found.settings["dimensions of the gates"] == 3
    accepted = found["particles"]["10", "accepted (%)"]
    assert accepted > done[1]["particles"]["10", "accepted (%)"]  # fewer let more through


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"part": "hands"}, "--part takes particles, dimensions"),
        ({"seeds": 0}, "expected --seeds and --clips of 1 or more"),
        ({"particles": (0,)}, "--particles must be one whole number or more"),
        ({"gate_dimensions": 0}, "--gate-dimensions must be one whole number or more"),
        ({"size": "large"}, "--size must be width x height"),
        ({"test_persons": ("p9",)}, "expected recordings of person p9"),
        ({"action": "run"}, "there are bend, clap"),
        ({"test_persons": ("p3",)}, "tracked or choose the settings, not both: p3"),
    ],
)
def test_refusals(folder, tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        bend.run(folder, tmp_path, **{"part": "particles", **SMALL, **options})


def test_two_persons_are_too_few(tmp_path):
    write_benders(tmp_path / "two", ("p1", "p2"), ())
    with pytest.raises(InputError, match="expected three persons or more, got p1, p2"):
        bend.run(tmp_path / "two", tmp_path, part="particles", **SMALL)


@pytest.mark.slow
def test_the_command_recognises_actions(folder, tmp_path, capsys):
    from benchmarks._protocols import execute_protocol

    line = ["--mocap", str(folder), "--out", str(tmp_path / "out")]
    line += ["--quick", "true", "--part", "actions", "--size", "64x48", "--at", "8"]
    line += ["--test-persons", "p2", "--frames", "4", "--validation-persons", "p3"]
    assert execute_protocol("bend", line) == 0
    text = capsys.readouterr().out
    assert "Actions from recorded joints" in text and "Tracked actions" in text


def test_benders_bend():
    joints = bender(2, 20)
    assert joints[0, 2, 1] - joints[10, 2, 1] > 0.25 and len(joints) == 41
