"""`torchpose fit`: the prior, its card and its picture, and what it refuses."""

import shutil

import numpy as np
import pytest
import torch

from torchpose.cli._fit import command
from torchpose.io import read_recordings
from torchpose.learning import fit_upper_body_prior
from torchpose.learning._curation import curate
from torchpose.learning._recipes import UpperBodyRecipe
from torchpose.priors import UpperBodyPrior, load_prior

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
    assert "kept     2 recordings of 2 persons, 900 frames" in done.out
    assert "persons  2, named in the file and its card: recordings#p1, recordings#p2" in done.out
    assert out.with_suffix(".md").read_text().startswith("# mine")
    assert {p.name for p in out.parent.iterdir()} == {
        "mine.safetensors", "mine.md", ".torchpose-fit-mine.json"
    }  # fmt: skip


def test_picture_and_name(torchpose, files, tmp_path):
    pytest.importorskip("matplotlib")
    out = tmp_path / "p.safetensors"
    args = ("--out", out, *QUICK[:-2], "--name", "both")
    done = torchpose("fit", *sorted((files / "recordings").iterdir()), *args)
    assert done.code == 0, done.err
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert load_prior(out).info.name == "both"


RECIPE = (
    "--components",
    2,
    "--samples",
    500,
    "--window-components",
    0,
    "--drawn-pieces",
    0,
    "--pictures",
    "false",
)


def test_the_recipe_holds_persons_out_and_says_what_to_expect(torchpose, files, tmp_path):
    folder, out = tmp_path / "recordings", tmp_path / "p.safetensors"
    folder.mkdir()
    for path in (files / "recordings").iterdir():
        with np.load(path) as archive:
            np.savez(folder / path.name, **{**archive, "joints": archive["joints"][:150]})
    line = ("fit", folder, "--out", out, *RECIPE, "--seed", 2, "--licence", "CC0")
    done = torchpose(*line)
    assert done.code == 0, done.err
    prior = load_prior(out)
    recipe = UpperBodyRecipe(2, 500, window_components=0, calibration_folds=0, seed=2)
    wanted = recipe.fit(curate(read_recordings(folder)).recordings)
    torch.testing.assert_close(prior.left.means, wanted.left.means, rtol=0, atol=0)
    assert set(prior.info.extra["held_out"]["pose"]) == {"recordings#p1", "recordings#p2"}
    still = prior.info.extra["held_out_still"]
    assert set(still) == {"recordings#p1", "recordings#p2"} and min(still.values()) > 0.02
    assert prior.info.licence == "CC0" and "measurement_std" in prior.noise
    assert "kept     2 recordings of 2 persons, 300 frames" in done.out
    card = out.with_suffix(".md").read_text()
    assert "On persons that it was not fitted on" in card and "| recordings#p2 |" in card
    assert "| person | mean pose | single poses |" in card
    assert (
        f"expect   {50 * sum(still.values()):.1f} cm of the mean pose, without looking" in done.out
    )
    assert prior.info.extra["curation"]["after"]["frames"] == 300


def test_noise_is_learnt_anew_for_a_prior_that_is_there(torchpose, files, tmp_path):
    old, out = (tmp_path / name for name in ("old.safetensors", "new.safetensors"))
    recordings = curate(read_recordings(files / "recordings")).recordings
    made = UpperBodyRecipe(2, 500, window_components=0, calibration_folds=0, seed=2).fit(recordings)
    noise = {"process_cov": torch.ones(21).double(), "measurement_std": torch.full((5,), 3.0)}
    UpperBodyPrior(made.left, made.right, made.info, noise).save(old)
    line = ("fit", files / "recordings", "--out", out, "--noise-of", old, *RECIPE[6:])
    done = torchpose(*line, "--folds", 0)
    assert done.code == 0, done.err
    new = load_prior(out)
    assert torch.equal(new.left.means, made.left.means) and "process_cov" not in new.noise
    torch.testing.assert_close(
        new.noise["increment_cov_right"], made.noise["increment_cov_right"], rtol=0, atol=0
    )
    assert "--noise-of" in new.info.extra["noise"]["command"]
    assert "--noise-of" in out.with_suffix(".md").read_text()
    assert (new.info.name, new.info.licence) == (made.info.name, made.info.licence)
    done = torchpose(*line, "--folds", 0, "--name", "renewed", "--licence", "CC0")
    assert done.code == 0, done.err
    info = load_prior(out).info
    assert (info.name, info.licence) == ("renewed", "CC0")
    stranger = torchpose(*line, "--without", "recordings#p1")
    assert stranger.code != 0 and "recordings#p2" in stranger.err


def test_notes_stay_without_curation(torchpose, files, tmp_path):
    for path in (files / "recordings").iterdir():
        with np.load(path) as archive:
            np.savez(tmp_path / path.name, **{**archive, "joints": 1000 * archive["joints"]})
    done = torchpose(
        "fit", tmp_path, "--out", tmp_path / "p.safetensors", *QUICK, "--curate", "false"
    )
    assert done.code == 0, done.err
    assert "note     taken for millimetres" in done.out and "(2 recordings, " in done.out


def test_persons_are_left_out_by_name(torchpose, files, tmp_path):
    out = tmp_path / "p.safetensors"
    line = ("fit", files / "recordings", "--out", out, *RECIPE, "--without", "p2")
    done = torchpose(*line)
    assert done.code == 0, done.err
    prior = load_prior(out)
    assert prior.info.persons == ("recordings#p1",)
    assert "--without p2" in prior.info.command
    assert not any(name.startswith("calibration") for name in prior.noise)
    assert "no person was held out" in out.with_suffix(".md").read_text()
    refused = torchpose(*line[:-1], "p9")
    assert refused.code == 2 and "recordings#p1, recordings#p2" in refused.err
    nobody = torchpose(*line, "p1")
    assert nobody.code == 2 and "--without leaves nobody to fit to" in nobody.err


def test_what_jumps_is_left_out_and_said(torchpose, files, tmp_path):
    folder = tmp_path / "recordings"
    shutil.copytree(files / "recordings", folder)
    with np.load(folder / "p1.npz") as archive:
        arrays = dict(archive)
    arrays["joints"] = arrays["joints"].copy()
    arrays["joints"][100, 0] += 1.5  # a hand that is somewhere else for one frame
    np.savez(folder / "p1.npz", **arrays)
    quick = (*RECIPE, "--noise", "none")[2:]
    quick = tuple(q for q in quick if q not in ("--window-components", "--drawn-pieces", 0))
    done = torchpose("fit", folder, "--out", tmp_path / "p.safetensors", *quick)
    assert done.code == 0, done.err
    assert "jump:" in done.out and "hand_left in 1 frame 100" in done.out
    left_out = load_prior(tmp_path / "p.safetensors").info.extra["frames_left_out"]
    assert left_out == {"left": 1, "right": 0}
    plain = torchpose(
        "fit", folder, "--out", tmp_path / "q.safetensors", *quick, "--curate", "false"
    )
    assert plain.code == 0 and "jump:" not in plain.out


def test_files_that_are_not_read_are_said(torchpose, files, tmp_path):
    """A folder with one recording as .npz and another one as a table is not read in full."""
    folder = tmp_path / "recordings"
    shutil.copytree(files / "recordings", folder)
    (folder / "b.csv").write_text("frame,HeadPosX,HeadPosY,HeadPosZ\n0,0,0.7,2\n")
    done = torchpose("fit", folder, "--out", tmp_path / "p.safetensors", *QUICK)
    assert done.code == 0, done.err
    assert "holds recordings as .npz" in done.out and str(folder / "b.csv") in done.out


def test_many_paths_are_cut_short():
    given = command().given([f"r{i}.npz" for i in range(20)] + ["--out", "p.safetensors"])
    assert given.line("p.safetensors") == "torchpose fit r0.npz '...19 more' --out p.safetensors"


def test_config_file_round_trip(torchpose, files, tmp_path):
    out = tmp_path / "p.safetensors"
    printed = torchpose("fit", files / "recordings", "--out", out, *QUICK, "--print_config")
    (tmp_path / "fit.yaml").write_text(printed.out)
    done = torchpose("fit", "--config", tmp_path / "fit.yaml")
    assert done.code == 0, done.err
    assert load_prior(out).n_components == 2


def test_a_configuration_in_other_bytes_is_refused(torchpose, tmp_path):
    (tmp_path / "fit.yaml").write_bytes(b"name: Andr\xe9\n")
    refused = torchpose("fit", "--config", tmp_path / "fit.yaml")
    assert refused.code == 2 and "fit.yaml: expected text in UTF-8" in refused.err


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
    "no new mixtures": (
        ["{files}/recordings", "--noise-of", "kinect-upper-body", "--seed", "3"],
        "--seed is for new mixtures, and --noise-of keeps those of a prior; leave it out",
    ),
    "no calibration": (
        ["{files}/recordings", "--noise", "none", "--folds", "3"],
        "--folds is for the calibration, and --noise none does without; leave it out",
    ),
    "nothing curated": (
        ["{files}/recordings", "--curate", "false", "--harmonise", "true"],
        "--harmonise is for curated recordings",
    ),
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
