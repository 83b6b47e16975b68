"""UB-people on a tiny data set, and on a few real sequences where they are there."""

import json
from dataclasses import replace

import pytest
import torch

from benchmarks import _gaps, ub_people
from benchmarks._people_tables import BASELINE, MAIN, MEAN_POSE, SMOOTHED, UNCALIBRATED
from tests.evaluation.recordings import small_recipe, write_people
from torchpose.errors import InputError, OutputError, OverlapError
from torchpose.priors import UpperBodyPrior


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_people(tmp_path_factory.mktemp("data") / "kinect_utd_mhad")


@pytest.fixture(scope="module")
def result(data, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_gaps, "_DURATION", 3.5)  # s: a second before, in and after the gap
        report = ub_people.run(
            data.parent, out, progress=False, quick=True, n_components=3, n_gap_sequences=1,
            recipe=small_recipe,
        )  # fmt: skip
    return report, out


@pytest.mark.slow
def test_tables_and_files(result):
    report, out = result
    errors = report["errors_3d"]
    for name in (MAIN, SMOOTHED, UNCALIBRATED, BASELINE, MEAN_POSE,
                 "MKF stationary, hand-set noise", "MKF ou 0.95, hand-set noise"):  # fmt: skip
        assert 0 < errors[name, "mean"] < 100
    assert errors[MAIN, "mean"] == pytest.approx(errors[UNCALIBRATED, "mean"])
    assert set(report["moving_root_3d"].rows) >= {MAIN, SMOOTHED, BASELINE, MEAN_POSE}
    assert "2 sequences of s7, s8, 40 frames" in report.settings["test"]
    read = json.loads((out / "report.json").read_text())
    assert read["tables"]["errors_3d"]["rows"][MAIN]["mean"] == errors[MAIN, "mean"]
    assert len(report.pictures) == 5
    assert all((out / name).stat().st_size > 1000 for name in report.pictures)
    assert MAIN in report.summary() and "| MKF filtered |" in report.to_markdown()


def test_calibration_widens_the_ellipsoids(result):
    table = result[0]["coverage"]
    for level in (50, 90):
        wide, narrow = (table[f"{n}, {level} %", "all"] for n in (MAIN, UNCALIBRATED))
        assert wide > narrow


def test_hidden_hand(result):
    report, _ = result
    gaps, jumps = report["gaps"], report["jumps"]
    assert "MKF, 1 s" in gaps.rows
    for name in jumps.rows:
        assert jumps[name, "body, largest"] < 1e-6  # the arms are independent there
        assert gaps[name, "hand during"] > 0


def test_a_prior_that_saw_a_test_person_is_refused(data, tmp_path):
    train, tested = ub_people.people(data)
    prior = small_recipe(train[:2])
    seen = replace(prior.info, persons=(tested[0].person_id,))
    with pytest.raises(OverlapError, match="#s7"):
        ub_people.run(
            data, tmp_path, progress=False, prior=UpperBodyPrior(prior.left, prior.right, seen)
        )


def test_bad_folders(data, tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        ub_people.run(tmp_path / "none", tmp_path / "out", progress=False)
    some = write_people(tmp_path / "some", persons=("s1", "s7"), n_sequences=1)
    with pytest.raises(InputError, match="none of s2, s3"):
        ub_people.run(some, tmp_path / "out", progress=False)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        ub_people.run(data, tmp_path / "file", progress=False)


@pytest.mark.data
@pytest.mark.slow
def test_real_persons(few_people, tmp_path):
    report = ub_people.run(
        few_people, tmp_path, progress=False, quick=True, n_gap_sequences=0, recipe=small_recipe
    )
    errors = report["errors_3d"]
    assert errors[BASELINE, "mean"] < 0.8 * errors[MEAN_POSE, "mean"]
    assert torch.tensor(report["moving_root_3d"][MAIN, "mean"]).isfinite()
