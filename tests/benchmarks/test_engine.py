"""The engine of the benchmarks: what is run again, what tables hold, what settings are chosen."""

import csv
import json
import math
from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.engine import (
    Experiment,
    Grid,
    Results,
    Row,
    Setting,
    Tuning,
    bootstrap,
    choose_setting,
    describe,
    kept_prior,
    mean,
    mean_of,
    pivot,
    plot_by_condition,
    pooled_std,
    read_settings,
    search_setting,
    source_hash,
    spread,
    worst,
    write_csv,
)
from torchpose.errors import FileFormatError, InputError
from torchpose.evaluation import Report
from torchpose.priors import load_prior

SHARES = (0.04, 0.06, 0.1, 0.16, 0.25, 0.4)


class Throw(NamedTuple):
    """One run of an experiment with dice."""

    eyes: Tensor


def eyes(run):
    """The measure of a throw."""
    return run.eyes.sum()


def dice(made, sources=()):
    """Subjects are numbers of dice, methods numbers of faces."""

    def make(n_dice, n_faces, seeds):
        made.append((n_dice, n_faces, tuple(seeds)))
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        return [Throw(torch.randint(1, n_faces + 1, (n_dice,), generator=g)) for g in generators]

    return Experiment(Throw, make, lambda n_dice, n_faces: [n_dice, n_faces], sources)


GRIDS = {
    "table": Grid({"one": 1, "three": 3}, {"cube": 6, "coin": 2}),
    "floor": Grid({"one": 1, "three": 3}, {"cube": 6, "coin": 2, "other": 20}),
}


def test_a_grid_is_run_in_its_order_with_batches_of_seeds(tmp_path):
    made = []
    runs = dice(made).run(GRIDS, (3, 4), tmp_path)
    places = [row[:4] for row in runs.rows]
    assert places == [
        (condition, subject, method, seed)
        for condition, grid in GRIDS.items()
        for subject in grid.subjects
        for method in grid.methods
        for seed in (3, 4)
    ]
    # cells of the second condition that are the same runs are not made again
    assert made == [(n, f, (3, 4)) for n, f in ((1, 6), (1, 2), (3, 6), (3, 2), (1, 20), (3, 20))]
    expected = torch.randint(1, 7, (3,), generator=torch.Generator().manual_seed(4))
    (row,) = runs.where(condition="floor", subject="three", method="cube", seed=4).rows
    assert bool((row.run.eyes == expected).all())
    assert len(list(tmp_path.glob("run-*.npz"))) == 12


def test_what_is_kept_is_not_made_again_unless_it_is_damaged_or_depends_on_more(tmp_path):
    made = []
    experiment = dice(made)
    first = experiment.run(GRIDS, (0, 1), tmp_path)
    path = sorted(tmp_path.glob("run-*.npz"))[0]
    path.write_bytes(path.read_bytes()[:20])
    made.clear()
    again = experiment.run(GRIDS, (0, 1), tmp_path)
    assert len(made) == 1 and len(made[0][2]) == 1  # the damaged one alone
    assert [float(eyes(r)) for r in again.runs] == [float(eyes(r)) for r in first.runs]
    made.clear()
    experiment.run({"table": GRIDS["table"]}, (0, 1, 2), tmp_path)
    assert {seeds for _, _, seeds in made} == {(2,)}
    made.clear()
    dice(made, ("benchmarks/engine/kept.py",)).run({"table": GRIDS["table"]}, (0,), tmp_path)
    assert len(made) == 4  # of another source


def test_the_hash_of_a_source_changes_with_a_constant(tmp_path):
    names = ("filters", "unscented.py")

    def written(root, constant):
        (root / "filters").mkdir(parents=True)
        (root / "filters" / "tracker.py").write_text(f"_LEAST = {constant}\n")
        (root / "unscented.py").write_text("_D = 3\n")
        return source_hash(*names, root=root)

    one = written(tmp_path / "one", 0.02)
    assert one == written(tmp_path / "same", 0.02) != written(tmp_path / "other", 0.03)
    (tmp_path / "one" / "docs.py").write_text("not among them")
    source_hash.cache_clear()
    assert source_hash(*names, root=tmp_path / "one") == one


def test_a_prior_is_fitted_again_for_other_facts_or_after_damage(tmp_path):
    made = []

    def kept(*facts):
        def make():
            made.append(facts)
            return load_prior("kinect-upper-body-small")

        return kept_prior(tmp_path, "poses", facts, make)

    first, again = kept("tiny", 0), kept("tiny", 0)
    assert torch.equal(first.left.means, again.left.means)
    kept("tiny", 1)
    assert made == [("tiny", 0), ("tiny", 1)]
    for path in tmp_path.glob("poses-*.safetensors"):
        path.write_bytes(b"damaged")
    kept("tiny", 0)
    assert len(made) == 3


# --- tables ---------------------------------------------------------------------------------------


@pytest.fixture
def runs():
    """Two conditions, two methods, two subjects, three seeds, and their values."""
    rng = np.random.default_rng(0)
    values = rng.normal(10, 3, (2, 2, 2, 3))
    rows = [
        Row(c, q, m, s, Throw(torch.tensor([values[i, j, k, s]])))
        for i, c in enumerate(("near", "far"))
        for k, q in enumerate(("ann", "bob"))
        for j, m in enumerate(("a", "b"))
        for s in range(3)
    ]
    return Results(tuple(rows)), values


def test_a_pivot_table_holds_numpy_s_statistics(runs):
    results, values = runs
    report = Report("x")
    cells = {"{}": mean(eyes), "± {}": spread(eyes), "worst {}": worst(eyes)}
    table = pivot(report, "t", "T", results, ["condition"], cells, columns="method",
                  more={"both": mean(eyes)}, label=str.upper)  # fmt: skip
    assert table.columns == ("A", "± A", "worst A", "B", "± B", "worst B", "both")
    for i, condition in enumerate(("near", "far")):
        for j, method in enumerate("AB"):
            assert table[condition, method] == pytest.approx(values[i, j].mean())
            assert table[condition, f"worst {method}"] == pytest.approx(values[i, j].max())
            pooled = np.sqrt(values[i, j].var(axis=1, ddof=1).mean())
            assert table[condition, f"± {method}"] == pytest.approx(pooled)
        assert table[condition, "both"] == pytest.approx(values[i].mean())
    far = results.where(condition="far")
    table = pivot(
        report, "u", "U", far, ["subject", "method"], {"mean": mean(eyes, 100)}, total="all"
    )
    assert list(table.rows) == ["ann, a", "ann, b", "bob, a", "bob, b", "all, a", "all, b"]
    assert table["bob, a", "mean"] == pytest.approx(100 * values[1, 0, 1].mean())
    assert table["all, b", "mean"] == pytest.approx(100 * values[1, 1].mean())
    assert math.isnan(spread(eyes)(far.where(seed=0)))
    with pytest.raises(InputError, match="expected runs of method 'c', there are none of 12 runs"):
        far.where(method="c")


def test_things_are_described_and_runs_written(runs, tmp_path):
    results, values = runs
    table = describe(Report("x"), "k", "K", {"x": 2, "y": 3}, {"square": lambda n: n * n})
    assert table.rows == {"x": (4,), "y": (9,)}
    columns = {
        "who": lambda row: row.subject,
        "how": lambda row: row.method,
        "n": lambda row: row.seed,
    }
    near = results.where(condition="near")
    write_csv(tmp_path / "runs.csv", near, columns | {"eyes": lambda row: float(eyes(row.run))})
    with (tmp_path / "runs.csv").open() as stream:
        lines = list(csv.DictReader(stream))
    assert [line["how"] for line in lines] == ["a"] * 6 + ["b"] * 6
    assert [float(line["eyes"]) for line in lines] == pytest.approx(values[0].ravel().tolist())


def test_a_picture_has_a_line_for_each_method_and_a_panel_for_each_measure(runs):
    results, values = runs
    figure = plot_by_condition(
        results, {"eyes": eyes, "twice": lambda run: 2 * eyes(run)}, "x", places=[10, 1000]
    )
    one, two = figure.axes
    assert [len(ax.lines) for ax in (one, two)] == [2, 2]
    np.testing.assert_allclose(one.lines[0].get_xdata(), [10, 1000])
    np.testing.assert_allclose(one.lines[1].get_ydata(), values[:, 1].mean((1, 2)))
    np.testing.assert_allclose(two.lines[0].get_ydata(), 2 * values[:, 0].mean((1, 2)))


def test_bootstrap_intervals_hold_what_they_say():
    """Intervals of the difference of two means cover the true one, and of spreads as well."""
    generator = torch.Generator().manual_seed(0)
    covered = 0
    for trial in range(60):
        draw = torch.randn(2, 6, 8, generator=generator, dtype=torch.float64)
        value, low, high = bootstrap(mean_of, draw[0] + 1, draw[1], seed=trial, draws=400)
        assert low <= value <= high
        covered += low <= 1.0 <= high
    assert covered >= 50
    wide = 3 * torch.randn(6, 8, generator=generator, dtype=torch.float64)
    narrow = torch.randn(6, 8, generator=generator, dtype=torch.float64)
    _, _, high = bootstrap(pooled_std, narrow, wide)
    assert high < 0


# --- settings -------------------------------------------------------------------------------------


def test_the_scale_is_chosen_first_and_then_the_value():
    def error(setting):
        if setting.value == 3.0:
            return math.nan
        return 10 * abs(setting.scale - 2.0) + abs(setting.value - 5.0)

    found = choose_setting(error, 1.0, (1.0, 3.0, 5.0), (1.0, 2.0))
    assert found.setting == Setting(5.0, 2.0) and found.error == 0
    assert found.tried == ((1.0, 1.0), (1.0, 2.0), (3.0, 2.0), (5.0, 2.0))
    assert found.error_of(Setting(1.0, 1.0)) == 14 and math.isnan(found.error_of(Setting(9.0)))
    assert found.text().startswith("1 x 1, 14; 1 x 2, 4") and Tuning(Setting(1.0)).text() == "-"


def test_settings_are_those_of_the_report(tmp_path):
    path = tmp_path / "report.json"
    with pytest.raises(InputError, match="no such file"):
        read_settings(path, ["sir"])
    chosen = {"sir": {"value": 30.0, "scale": 1.4}, "apf": {"value": 0.7, "scale": 2.0}}
    path.write_text(json.dumps({"settings": {"settings": chosen}}))
    for given in (path, tmp_path, str(tmp_path)):
        assert read_settings(given, ["apf"]) == {"apf": Setting(0.7, 2.0)}
    for damaged in ("no json", "[]", '{"settings": {"settings": {"500 at 160x120": {"sir": 1}}}}'):
        path.write_text(damaged)
        with pytest.raises(FileFormatError, match=r"expected the report\.json"):
            read_settings(tmp_path, ["sir"])


def bowl(value, scale):
    """An error that is smallest at this setting, which the two may trade for each other."""

    def error(setting):
        a, b = math.log(setting.value / value), math.log(setting.scale / scale)
        return 50 + (a + 0.5 * b) ** 2 + b**2

    return error


@pytest.mark.parametrize(
    ("value", "scale"), [(0.17, 1.3), (0.03, 4.5), (0.3, 0.4), (0.02, 0.3), (0.36, 1.0)]
)
def test_what_is_chosen_lies_between_worse_settings(value, scale):
    error = bowl(value, scale)
    rows = SHARES
    found = search_setting(error, Setting(0.16, 1.4), 0.926, rows, 2 / 114)
    assert found.error == min(found.errors) == error(found.setting)
    values = [s.value for s in found.tried if s.scale == found.setting.scale]
    scales = [s.scale for s in found.tried if s.value == found.setting.value]
    assert min(values) < found.setting.value < max(values)
    assert min(scales) < found.setting.scale < max(scales)
    assert min(values) >= 2 / 114 and max(values) < 1
    assert 0.926 in {s.value for s in found.tried}
    # within a step of the truth: a ratio of at most 2.4 for the survival, 2 for the diffusion
    assert abs(math.log(found.setting.scale / scale)) < math.log(1.5)
    assert abs(math.log(found.setting.value / value)) < math.log(2.4)


def test_survival_that_cannot_be_is_never_tried():
    def falling(setting):
        return 40 + setting.value

    found = search_setting(falling, Setting(0.16, 1.4), 0.926, SHARES, 2 / 114)
    assert min(s.value for s in found.tried) >= 2 / 114
    assert found.setting.value < 2 * 2 / 114, "the least of the row that can be"
    never = search_setting(
        lambda s: math.nan if s.value < 0.2 else 1.0,
        Setting(0.16, 1.4),
        0.926,
        (0.1, 0.16, 0.25),
        0.02,
    )
    assert never.setting.value > 0.2
