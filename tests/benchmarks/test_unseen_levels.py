"""Distances that are chi-square have every level, and a quick run prints all tables."""

import pytest
import torch

from benchmarks.unseen_levels import LEVELS, METHODS, add_table
from tests.data import data_with
from torchpose.evaluation import Report


def chi_square(count, seed):
    generator = torch.Generator().manual_seed(seed)
    normal = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return normal.square().sum(-1)


def test_of_right_covariances_every_level_holds_its_share():
    sets = {name: [chi_square(20_000, seed) for seed in seeds]
            for name, seeds in {"a/b": (0, 1), "c": (2, 3), "d": (4,)}.items()}  # fmt: skip
    report = Report("")
    add_table(report, "right", sets)
    table = report["right"]
    for row in ("a", "c", "d"):
        *shares, half, most, own_most, last, least, middle, greatest = table.rows[row]
        assert shares == pytest.approx([100 * level for level in LEVELS], abs=1.0)
        assert (half, most, own_most, last) == pytest.approx((50, 90, 90, 99), abs=1.0)
        assert (least, middle, greatest) == pytest.approx((1, 1, 1), abs=0.03)


def test_a_factor_of_a_recording_is_told_and_taken_out():
    wide, narrow = 0.25 * chi_square(20_000, 0), 4.0 * chi_square(20_000, 1)
    report = Report("")
    add_table(report, "both", {"a": [wide, narrow], "b": [wide]})
    *_, half, most, own_most, last, least, middle, greatest = report["both"].rows["a"]
    assert (least, middle, greatest) == pytest.approx((0.25, 2.125, 4.0), rel=0.03)
    assert (own_most, last) == pytest.approx((90, 99), abs=1.0)
    assert half < 40 and most < 60  # with the radii of the set that needs small ones


def test_a_quick_run_prints_a_table_for_each_method(run_here, tmp_path):
    data = data_with("mocap_berkeley_mhad")
    printed = run_here("unseen_levels", "--quick", "--data", str(data), "--out", str(tmp_path))
    for method in METHODS:
        for measured in ("all joints", "neck, hands and head"):
            assert f"**{method}, {measured}**" in printed
    assert printed.count("| mocap_berkeley_mhad |") == 4
    assert (tmp_path / "unseen_levels.md").read_text().split() == printed.split()
