"""`python -m train fit` in this process: the prior, its logs, and what it refuses."""

import csv
import errno
import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("lightning", reason="training needs the extra `train`")
pytest.importorskip("tensorboard", reason="training needs the extra `train`")

from lightning.pytorch import Callback

from tests.full_disk import files_up_to
from tests.train.people import RECIPE, WINDOWS, settings, write_recordings, write_settings
from torchpose._core.files import hold_folder
from torchpose.io import read_recordings
from torchpose.learning._curation import CurationSettings, curate
from torchpose.learning._recipes import UpperBodyRecipe
from torchpose.priors import load_prior
from train.cli import main

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    return write_recordings(tmp_path_factory.mktemp("people"))


@pytest.fixture(scope="module")
def fitted(recordings, tmp_path_factory):
    """Folder of a fit without windows, calibrated."""
    folder = tmp_path_factory.mktemp("fit")
    values = settings(recordings, folder) | {"pictures": {"every": 5, "n_shown": 2}}
    assert main(["fit", "--config", str(write_settings(folder, values))]) == 0
    return folder


def reference(recordings, **recipe):
    """The same work without Lightning."""
    people = curate(read_recordings(recordings), CurationSettings(person_frames=30)).recordings
    people = [r for r in people if r.person != "s3"]
    facts = {"name": "p", "command": "python -m train fit"}
    return UpperBodyRecipe(**RECIPE | recipe).fit(people, **facts)


def assert_same(prior, wanted, tolerance):
    ours, theirs = prior.state_dict(), wanted.state_dict()
    assert ours.keys() == theirs.keys()
    for name in theirs.keys() - {"_extra_state"}:  # the facts, which are compared by themselves
        value = theirs[name]
        torch.testing.assert_close(ours[name], value, rtol=tolerance, atol=tolerance, msg=name)


@pytest.mark.slow
def test_prior_is_that_of_torchpose_fit(fitted, recordings):
    prior, wanted = load_prior(fitted / "p.safetensors"), reference(recordings)
    assert_same(prior, wanted, 1e-8)
    assert "noise_calibration_scale_pose" in prior.state_dict()
    assert prior.info.persons == ("example/people#s1", "example/people#s2")
    assert prior.info.extra["held_out"].keys() == {"pose"}
    still = wanted.info.extra["held_out_still"]
    assert prior.info.extra["held_out_still"] == pytest.approx(still, abs=1e-5)
    fit, ours = wanted.info.extra["fit"], prior.info.extra["fit"]
    assert ours["iterations"] == fit["iterations"] == RECIPE["pose_steps"]
    assert ours["log_likelihood"] == pytest.approx(fit["log_likelihood"], abs=1e-8)


@pytest.mark.slow
def test_windows_and_a_first_pass(recordings, tmp_path):
    values = settings(recordings, tmp_path, **WINDOWS)
    assert main(["fit", "--config", str(write_settings(tmp_path, values))]) == 0
    prior = load_prior(tmp_path / "p.safetensors")
    assert prior.windows.keys() == {"causal", "full"}
    wanted = reference(recordings, **WINDOWS)
    wanted.save(tmp_path / "wanted.safetensors")  # numbers of single precision, as in the file
    assert_same(prior, load_prior(tmp_path / "wanted.safetensors"), 1e-6)
    line = ["fit", "--config", str(tmp_path / "fit.yaml"), "--model.first_pass", "true"]
    line += ["--data.recipe.window_components", "0", "--data.recipe.pose_steps", "1"]
    assert main([*line, "--prior.out", str(tmp_path / "first.safetensors")]) == 0
    first = load_prior(tmp_path / "first.safetensors").info.extra["fit"]
    assert first["iterations"] == 1


def test_files_and_logs(fitted):
    assert {p.name for p in fitted.iterdir()} == {
        "fit.yaml", "runs", "p.safetensors", "p.md", "p.png", ".torchpose-fit-p.json"
    }  # fmt: skip
    runs = fitted / "runs"
    assert {p.name for p in runs.iterdir()} == {"version_0", "checkpoints"}
    assert [p.name for p in (runs / "checkpoints").iterdir()] == ["last.ckpt"]
    log = runs / "version_0"
    assert any(p.name.startswith("events.out.tfevents") for p in log.iterdir())
    assert {p.name for p in (log / "pictures").iterdir()} == {
        "components-pose.png", "likelihood.png", "samples.png"
    }  # fmt: skip
    with (log / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["step"]) for row in rows] == list(range(1, RECIPE["pose_steps"] + 2))
    likelihoods = [float(row["log_likelihood/pose"]) for row in rows]
    assert likelihoods == sorted(likelihoods)
    assert all(row["held_out/pose"] and row["held_out"] for row in rows)
    last = load_prior(fitted / "p.safetensors").info.extra["fit"]["log_likelihood"]
    assert likelihoods[-1] == pytest.approx(last, abs=1e-5)
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(log)).Reload()
    assert {"log_likelihood/pose", "held_out/pose"} <= set(events.Tags()["scalars"])
    assert {"components-pose", "likelihood", "samples"} == set(events.Tags()["images"])
    assert [image.step for image in events.Images("likelihood")] == [5, 6]


def test_again_from_its_own_configuration_gives_the_same_bytes(fitted, tmp_path):
    config = fitted / "runs" / "version_0" / "config.yaml"
    out = ["--prior.out", str(tmp_path / "p.safetensors")]
    line = ["fit", "--config", str(config), *out, "--trainer.default_root_dir", str(tmp_path)]
    assert main([*line, "--pictures.every", "0", "--pictures.at_end", "false"]) == 0
    for name in ("p.safetensors", "p.md"):
        assert (tmp_path / name).read_bytes() == (fitted / name).read_bytes()


def test_resumed_after_the_last_step_gives_the_same_bytes(fitted, tmp_path):
    shutil.copytree(fitted / "runs", tmp_path / "runs")
    line = ["fit", "--config", str(fitted / "fit.yaml"), "--ckpt_path", "last"]
    line += ["--prior.out", str(tmp_path / "p.safetensors"), "--pictures.at_end", "false"]
    assert main([*line, "--trainer.default_root_dir", str(tmp_path / "runs")]) == 0
    assert (tmp_path / "p.safetensors").read_bytes() == (fitted / "p.safetensors").read_bytes()
    assert not (tmp_path / "runs" / "version_1" / "metrics.csv").exists()


def test_notes_stay_without_curation(recordings, tmp_path, capsys):
    with np.load(next(recordings.glob("*.npz"))) as archive:
        np.savez(tmp_path / "a.npz", **{**archive, "joints": 1000 * archive["joints"]})
    values = settings(tmp_path / "a.npz", tmp_path)
    values["data"]["init_args"] |= {"curation": None, "held_out": None}
    line = ["fit", "--config", str(write_settings(tmp_path, values)), "--trainer.max_epochs", "0"]
    assert main(line) == 2
    assert "note     taken for millimetres" in capsys.readouterr().out


def test_a_trial_of_one_step_replaces_no_prior(fitted, tmp_path, capsys):
    before = (fitted / "p.safetensors").read_bytes()
    line = ["fit", "--config", str(fitted / "fit.yaml"), "--trainer.fast_dev_run", "true"]
    assert main([*line, "--trainer.default_root_dir", str(tmp_path)]) == 0
    assert f"{fitted / 'p.safetensors'} is not written" in capsys.readouterr().out
    assert (fitted / "p.safetensors").read_bytes() == before
    assert not list(tmp_path.rglob("*.ckpt"))


OTHER = {
    "recipe": (["--data.recipe.n_components", "4"], "recipe n_components was 3, is 4"),
    "persons": (["--data.held_out", "[s2]"], "recordings persons was"),
    "model": (["--model.first_pass", "true"], "first pass was False, is True"),
    "no checkpoint": (["--ckpt_path", "{tmp}/none.ckpt"], "none.ckpt: no such checkpoint"),
    "truncated": (["--ckpt_path", "{tmp}/short.ckpt"], "short.ckpt: expected a checkpoint"),
    "foreign": (["--ckpt_path", "{tmp}/other.ckpt"], "other.ckpt: expected a checkpoint"),
}


@pytest.mark.parametrize("case", OTHER)
def test_other_checkpoints_are_refused(case, fitted, tmp_path, capsys):
    last = fitted / "runs" / "checkpoints" / "last.ckpt"
    (tmp_path / "short.ckpt").write_bytes(last.read_bytes()[:1000])
    torch.save({"state_dict": {}}, tmp_path / "other.ckpt")
    before = {p: p.read_bytes() for p in fitted.glob("p.*")}
    changes, message = OTHER[case]
    line = ["fit", "--config", str(fitted / "fit.yaml"), "--ckpt_path", str(last)]
    code = main([*line, *(c.format(tmp=tmp_path) for c in changes)])
    printed = capsys.readouterr().err.strip()
    assert code == 2 and message in printed
    assert len(printed.splitlines()) == 1 and printed.startswith("train: error: ")
    assert {p: p.read_bytes() for p in fitted.glob("p.*")} == before


@pytest.mark.skipif(sys.platform == "win32", reason="locks of POSIX")
def test_two_fits_do_not_share_checkpoints(fitted, recordings, tmp_path, capsys):
    """Each wrote over the other's, and neither could be resumed."""
    shutil.copytree(fitted / "runs", tmp_path / "runs")
    last = tmp_path / "runs" / "checkpoints" / "last.ckpt"
    before = last.read_bytes()
    line = ["fit", "--config", str(write_settings(tmp_path, settings(recordings, tmp_path)))]
    handle, _ = hold_folder(last.parent)
    try:
        assert main(line) == 2
    finally:
        os.close(handle)
    assert "another fit is writing its checkpoints there" in capsys.readouterr().err
    assert last.read_bytes() == before and not (tmp_path / "p.safetensors").exists()
    assert main([*line, "--trainer.max_epochs", "0"]) == 2  # let in again, and again after an error
    assert main([*line, "--trainer.max_epochs", "0"]) == 2
    assert "the trainer took no step" in capsys.readouterr().err


@pytest.mark.slow
def test_a_fit_begun_anew_keeps_the_checkpoint_of_the_earlier_one(recordings, tmp_path, capsys):
    values = settings(recordings, tmp_path, calibration_folds=0)
    line = ["fit", "--config", str(write_settings(tmp_path, values)), "--trainer.max_epochs"]
    folder = tmp_path / "runs" / "checkpoints"
    assert main([*line, "1"]) == 0
    assert main([*line, "2", "--ckpt_path", "last"]) == 0  # goes on, and writes over its own
    assert [p.name for p in folder.iterdir()] == ["last.ckpt"]
    before = (folder / "last.ckpt").read_bytes()
    capsys.readouterr()
    assert main([*line, "1"]) == 0
    kept = folder / "earlier-1" / "last.ckpt"
    assert kept.read_bytes() == before != (folder / "last.ckpt").read_bytes()
    assert f"the checkpoint of an earlier fit was moved to {kept}" in capsys.readouterr().out


def test_early_stopping_on_held_out_persons_stays_stopped(recordings, tmp_path):
    stopping = {
        "class_path": "lightning.pytorch.callbacks.EarlyStopping",
        "init_args": {"monitor": "held_out", "mode": "max", "patience": 1, "min_delta": 1000.0},
    }
    values = settings(recordings, tmp_path, calibration_folds=0)
    values["trainer"] |= {"callbacks": [stopping], "max_epochs": 20}
    line = ["fit", "--config", str(write_settings(tmp_path, values))]
    assert main(line) == 0
    first = (tmp_path / "p.safetensors").read_bytes()
    assert load_prior(tmp_path / "p.safetensors").info.extra["fit"]["iterations"] == 2
    assert main([*line, "--ckpt_path", "auto"]) == 0
    assert (tmp_path / "p.safetensors").read_bytes() == first


REFUSED = {
    "key": ({"data": {"init_args": {"heldout": ["s3"]}}}, [], "fit.yaml: there is no key data.heldout"),
    "key of the recipe": (
        {"data": {"init_args": {"recipe": {"components": 3}}}}, [],
        "fit.yaml: there is no key data.recipe.components",
    ),
    "key of the trainer": ({"trainer": {"gpus": 2}}, [], "fit.yaml: there is no key trainer.gpus"),
    "top key": ({"seed": 1}, [], "fit.yaml: there is no key seed"),
    "option": ({}, ["--data.recipe.k", "3"], "there is no key data.recipe.k"),
    "kind of value": (
        {"data": {"init_args": {"recipe": {"n_components": "many"}}}}, [],
        "fit.yaml: data.recipe.n_components: ",
    ),
    "value": ({}, ["--data.recipe.n_components", "0"], "n_components must be at least 1, got 0"),
    "class": ({"data": {"class_path": "train.data.Foo"}}, [], "fit.yaml: data: "),
    "variable": ({}, ["--data.paths", "[$TORCHPOSE_NOT_SET/x]"], "TORCHPOSE_NOT_SET is not set"),
    "folder": ({}, ["--data.paths", "[/none/at/all]"], "/none/at/all: no such file or folder"),
    "person": ({}, ["--data.held_out", "[s9]"], "'s9' is nobody's name"),
    "leak": ({}, ["--data.persons", "[s3, s1]"], "people#s3: held out, but to be fitted"),
    "everybody held out": ({}, ["--data.held_out", "[s1, s2, s3]"], "nobody is left"),
    "suffix": ({}, ["--prior.out", "p.npz"], "ends in .safetensors"),
    "precision": ({}, ["--trainer.precision", "16-true"], "double precision"),
    "strategy": ({}, ["--trainer.strategy", "none"], "invalid strategy"),
    "components": ({}, ["--data.recipe.n_components", "9001"], "mixture 'pose': "),
    "seed": ({}, ["--seed_everything", "-1"], "seed_everything: -1 is not in bounds"),
    "two seeds": (
        {}, ["--seed_everything", "1", "--data.recipe.seed", "2"],
        "seed_everything is 1, and data.init_args.recipe.seed is 2; leave one",
    ),
    "no step": ({}, ["--trainer.max_epochs", "0"], "the trainer took no step, so that nothing was"),
    "logs": (
        {}, ["--trainer.default_root_dir", "{tmp}/fit.yaml"],
        "fit.yaml: results cannot be written to this folder (File exists); choose another with "
        "--trainer.default_root_dir",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_refusals(case, recordings, tmp_path, capsys):
    changes, options, message = REFUSED[case]
    values = settings(recordings, tmp_path)
    merge(values, changes)
    options = [option.format(tmp=tmp_path) for option in options]
    line = ["fit", "--config", str(write_settings(tmp_path, values)), *options]
    code = main(line)
    printed = capsys.readouterr().err.strip()
    assert code == 2 and message in printed, printed
    assert len(printed.splitlines()) == 1 and printed.startswith("train: error: ")
    assert not list(tmp_path.glob("p.*"))


SEEDS = {
    "default": ([], 0),
    "everything": (["--seed_everything", "7"], 7),
    "own": (["{own}", "7"], 7),
    "both alike": (["--seed_everything", "7", "{own}", "7"], 7),
}


@pytest.mark.parametrize("case", SEEDS)
@pytest.mark.parametrize("config", ["newcomer", "fine-tune", "manifold", "actions", "body"])
def test_one_seed(config, case, monkeypatch):
    """It reaches what is fitted, whichever key names it."""
    options, wanted = SEEDS[case]
    own = "--data.recipe.seed" if config == "newcomer" else "--model.init_args.seed"
    found = []

    def stop(command):
        recipe = getattr(command.datamodule, "recipe", None)
        found.append(command.model.hparams["seed"] if recipe is None else recipe.seed)
        raise SystemExit(0)

    monkeypatch.setattr("train.command._Command.before_fit", stop)
    options = [option.format(own=own) for option in options]
    assert main(["fit", "--config", str(ROOT / "configs" / f"{config}.yaml"), *options]) == 0
    assert found == [wanted]


def test_what_cannot_be_read_or_written_is_said(recordings, tmp_path, monkeypatch, capsys):
    (tmp_path / "latin.yaml").write_bytes(b"prior:\n  out: \xe9.safetensors\n")
    assert main(["fit", "--config", str(tmp_path / "latin.yaml")]) == 2
    assert "latin.yaml: expected UTF-8" in capsys.readouterr().err

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device", "metrics.csv")

    monkeypatch.setattr("lightning.pytorch.loggers.CSVLogger.save", full)
    config = write_settings(tmp_path, settings(recordings, tmp_path))
    assert main(["fit", "--config", str(config)]) == 2
    printed = capsys.readouterr().err
    assert printed == (
        "train: error: metrics.csv: cannot be read or written (No space left on device); once there is room, "
        "run the same command again, as no step was finished\n"
    )


def test_a_disk_that_fills_up_with_logs_is_said_once(recordings, tmp_path, capfd):
    values = settings(recordings, tmp_path, calibration_folds=0)
    line = ["fit", "--config", str(write_settings(tmp_path, values))]

    class FillsUp(Callback):
        def on_train_epoch_end(self, trainer, module):
            writer = trainer.loggers[1].experiment
            with files_up_to(10):
                writer.add_text("notes", 1000 * "x")
                writer.flush()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("train.command.StopAtOnce", FillsUp)
        assert main(line) == 2
    printed = capfd.readouterr().err
    assert "Traceback" not in printed
    assert (
        "train: error: logs: cannot be read or written (File too large); once there is room, run"
        in printed
    )


def test_a_neighbour_of_another_kind_is_not_replaced(recordings, tmp_path, capsys):
    values = settings(recordings, tmp_path)
    (tmp_path / "p.md").write_text("mine")
    code = main(["fit", "--config", str(write_settings(tmp_path, values))])
    printed = capsys.readouterr().err
    assert code == 2 and "p.md: is there, and is not known" in printed
    assert len(printed.splitlines()) == 1
    assert {p.name for p in tmp_path.glob("*")} <= {"p.md", "fit.yaml", "runs"}
    assert (tmp_path / "p.md").read_text() == "mine"


def merge(values, changes):
    for key, value in changes.items():
        if isinstance(value, dict):
            merge(values.setdefault(key, {}), value)
        else:
            values[key] = value


def test_missing_options(capsys):
    assert main(["fit", "--prior.out", "p.safetensors"]) == 2
    assert "missing: data.paths" in capsys.readouterr().err
    assert main(["fit", "--config", "nowhere.yaml"]) == 2
    assert "nowhere.yaml" in capsys.readouterr().err
    assert main(["train"]) == 2 and "known are fit, select and predict" in capsys.readouterr().err


def test_select_prints_the_table_and_the_option(recordings, tmp_path, capsys):
    values = settings(recordings, tmp_path) | {"ckpt_path": "auto"}
    line = ["select", "--config", str(write_settings(tmp_path, values))]
    assert main([*line, "--candidates", "[1, 3]"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[-1].startswith("--data.recipe.n_components ")
    assert [row.split()[0] for row in printed[-4:-1]] == ["components", "1", "3"]
    assert main([*line, "--candidates", "[1]", "--data.held_out", "[]"]) == 2
    assert "name some with --data.held_out" in capsys.readouterr().err
