"""`torchpose fit`: the prior, its card and its picture, and what it refuses."""

import sys
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
import torch

from torchpose.cli.fit import build, command_line
from torchpose.io import read_recordings
from torchpose.priors import fit_upper_body_prior, load_prior

QUICK = ("--components", 2, "--samples", 500, "--noise", "none", "--pictures", "false")


def test_prior_is_that_of_the_library(torchpose, files, tmp_path):
    out = tmp_path / "new" / "mine.safetensors"
    folder = files / "recordings"
    done = torchpose("fit", folder, "--out", out, *QUICK, "--seed", 3, "--licence", "CC0")
    assert done.code == 0, done.err
    prior = load_prior(out)
    wanted = fit_upper_body_prior(read_recordings(folder), 2, seed=3, n_samples=500)
    torch.testing.assert_close(prior.left.means, wanted.left.means, rtol=0, atol=0)
    torch.testing.assert_close(prior.right.covariances, wanted.right.covariances, rtol=0, atol=0)
    assert prior.info.name == "mine" and prior.info.licence == "CC0"
    assert prior.info.persons == ("recordings#p1", "recordings#p2")
    assert prior.info.command.startswith(f"torchpose fit {folder} --out {out} --components 2")
    assert "read     2 recordings of 2 persons, 900 frames" in done.out
    assert out.with_suffix(".md").read_text().startswith("# mine")
    assert {p.name for p in out.parent.iterdir()} == {"mine.safetensors", "mine.md"}


def test_picture_and_name(torchpose, files, tmp_path):
    pytest.importorskip("matplotlib")
    out = tmp_path / "p.safetensors"
    args = ("--out", out, *QUICK[:-2], "--name", "both")
    done = torchpose("fit", *sorted((files / "recordings").iterdir()), *args)
    assert done.code == 0, done.err
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert load_prior(out).info.name == "both"


def test_learnt_noise_comes_from_the_recipe(torchpose, files, tmp_path, monkeypatch):
    """A stand-in for the recipe, which takes minutes: what it is given, and that its prior is kept."""
    called = {}

    def fit_kinect_prior(recordings, n_components=30, seed=0, progress=False, name=""):
        called.update(persons=len(recordings), K=n_components, seed=seed, name=name)
        prior = load_prior(files / "prior.safetensors")
        prior.set_noise("measurement_std", torch.ones(5, dtype=torch.float64))
        prior.info = replace(prior.info, name=name)
        return prior

    recipes = ModuleType("torchpose.recipes")
    recipes.fit_kinect_prior = fit_kinect_prior
    monkeypatch.setitem(sys.modules, "torchpose.recipes", recipes)
    out = tmp_path / "p.safetensors"
    line = ("fit", files / "recordings", "--out", out, "--components", 5, "--seed", 2)
    done = torchpose(*line, "--pictures", "false", "--licence", "CC0")
    assert done.code == 0, done.err
    assert called == {"persons": 2, "K": 5, "seed": 2, "name": "p"}
    assert "measurement_std" in load_prior(out).noise
    assert load_prior(out).info.licence == "CC0"
    assert "noise    measurement_std" in done.out
    refused = torchpose(*line, "--samples", 100)
    assert refused.code == 2 and "only with --noise none" in refused.err


def test_many_paths_are_cut_short():
    args = build().parse_args([f"r{i}.npz" for i in range(20)] + ["--out", "p.safetensors"])
    assert command_line(args) == "torchpose fit r0.npz '...19 more' --out p.safetensors"


def test_config_file_round_trip(torchpose, files, tmp_path):
    out = tmp_path / "p.safetensors"
    printed = torchpose("fit", files / "recordings", "--out", out, *QUICK, "--print_config")
    (tmp_path / "fit.yaml").write_text(printed.out)
    done = torchpose("fit", "--config", tmp_path / "fit.yaml")
    assert done.code == 0, done.err
    assert load_prior(out).n_components == 2


BAD_INPUT = {
    "nothing": ([], "missing: DIR"),
    "no folder": (["{tmp}/none"], "no such file or folder"),
    "empty folder": (["{tmp}"], "found none"),
    "truncated": (["{tmp}/truncated.npz"], "truncated.npz: expected an .npz file"),
    "no joints": (["{files}/keypoints.npz"], "joints"),
    "other axes": (["{files}/recordings", "--axes", "up"], "camera, kinect, y-up, z-up"),
    "upside down": (["{files}/recordings", "--axes", "y-up"], "upside|axes are others"),
    "other noise": (["{files}/recordings", "--noise", "some"], "learnt, none"),
    "other neck": (["{files}/recordings", "--neck", "long"], "mid-shoulder"),
    "no components": (["{files}/recordings", "--components", "0"], "at least 1"),
    "no samples": (["{files}/recordings", "--samples", "0"], "at least 1"),
    "suffix": (["{files}/recordings", "--out", "{tmp}/p.npz"], "ends in .safetensors"),
    "folder": (["{files}/recordings", "--out", "{tmp}/d.safetensors"], "is a folder"),
    "below a file": (
        ["{files}/recordings", "--out", "{tmp}/truncated.npz/p.safetensors"],
        "folder",
    ),
}


@pytest.mark.parametrize("case", BAD_INPUT)
def test_refusals(case, torchpose, files, tmp_path):
    (tmp_path / "d.safetensors").mkdir()
    if case != "empty folder":
        (tmp_path / "truncated.npz").write_bytes((files / "keypoints.npz").read_bytes()[:300])
    before = sorted(tmp_path.rglob("*"))
    arguments, message = BAD_INPUT[case]
    given = [a.format(tmp=tmp_path, files=files) for a in arguments]
    given += [] if "--out" in given else ["--out", str(tmp_path / "p.safetensors")]
    done = torchpose("fit", *given, "--pictures", "false")
    assert done.code == 2, done.out
    assert any(part in done.err for part in message.split("|"))
    assert len(done.err.splitlines()) == 1 and done.out == ""
    assert sorted(tmp_path.rglob("*")) == before


def test_arrays_of_the_fixture_are_plain(files):
    """The recordings of these tests are what a user would write with numpy alone."""
    with np.load(files / "recordings" / "p1.npz", allow_pickle=False) as archive:
        assert {"joints", "names", "fps", "subject", "axes"} == set(archive.files)
