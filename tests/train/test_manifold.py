"""A manifold fitted with Lightning: the same fit, resumed, stopped early; what is refused."""

import math
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from torchpose.learning._manifolds import fit_target, gplvm_of_fit

pytest.importorskip("lightning", reason="lightning is not installed; training needs it")

from tests.priors.motions import motion
from tests.recorded_bodies import write_body
from tests.train.scenes import check_refusals, make_hole, rewrite, run, scene_of
from torchpose.body import BODY_15, Body
from torchpose.learning._gplvm_fit import GPLVMFit, median_gamma, run_fit
from torchpose.learning._recipes import ManifoldFitting
from torchpose.priors import BackConstrainedGPLVM
from train.manifold import ManifoldData


def write_trial(folder: Path, person: str, trial: int, frames: int) -> Path:
    """Somebody walks on the spot: joints of a body moved by a cyclic motion."""
    body = Body.of_height(BODY_15, 1.7 + 0.1 * int(person[-1]))
    poses = 0.4 * motion(frames, phase=float(trial), seed=trial, speed=0.5, noise=0.002)
    state = torch.zeros(frames, body.dim, dtype=torch.float64)
    state[:, 1] = 0.9
    joints = body.joints(body.with_relative(state, poses))
    return write_body(folder / f"{person}_{trial:02}.npz", joints, 120.0, person, "walk")


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> SimpleNamespace:
    home = tmp_path_factory.mktemp("manifold")
    folder = home / "recordings"
    folder.mkdir()
    for person in ("p0", "p1"):
        for trial in range(4):
            write_trial(folder, person, trial, 100)
    options = {
        "--data.init_args.paths": f"['{folder}']",
        "--data.init_args.persons": "[p0]",
        "--data.init_args.without": "[p0_03]",
        "--data.init_args.validation": 1,
        "--data.init_args.frames": 60,
        "--model.init_args.steps": 4,
        "--model.init_args.patience": 9,
        "--model.init_args.start": 1,
        "--prior.pictures": "false",
    }
    return scene_of(home, "manifold.yaml", options, folder=folder)


def fitted(scene, name: str) -> BackConstrainedGPLVM:
    return BackConstrainedGPLVM.load(scene.home / f"{name}.safetensors")


@pytest.fixture(scope="module")
def whole(scene) -> BackConstrainedGPLVM:
    assert run(scene, "whole", "--prior.pictures", "true") == 0
    return fitted(scene, "whole")


def test_it_is_the_fit_of_the_library(scene, whole) -> None:
    module = ManifoldData([str(scene.folder)], ["p0"], validation=1, without=["p0_03"], frames=60)
    module.setup("fit")
    data = module.gathered
    assert [len(part) for part in data.train] == [30, 30] and len(data.watched[0]) == 50
    poses = torch.cat(data.train)
    target = poses - poses.mean(0)
    assert whole.info.extra["settings"]["start"] == 1
    fit = GPLVMFit(target, 2, median_gamma(target), start=1)
    errors = []
    for step in range(1, 5):
        run_fit(fit, step, tolerance=-math.inf)
        one = gplvm_of_fit(fit, fit_target(data.train, (), False, None, 0))
        errors.append(float((data.watched[0] - one.reconstruct(data.watched[0])).square().mean()))
        if errors[-1] == min(errors):
            best = one
    torch.testing.assert_close(whole.latents, best.latents, rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(whole.log_kernel, best.log_kernel)
    assert whole.info.extra["steps"] == 1 + errors.index(min(errors))
    assert whole.info.extra["held_out_error"] == pytest.approx(min(errors) ** 0.5)


def test_the_file_says_what_it_is_of(scene, whole) -> None:
    info = whole.info
    assert info.name == "whole" and info.persons == ("set#p0",) and info.actions == ("walk",)
    assert info.sequences == ("p0_00", "p0_01") and info.fps == 60.0 and info.sources == ("set",)
    assert "configs/manifold.yaml" in info.command and "CMU" in info.licence
    assert bool(torch.isfinite(whole.std_pose).all())
    whole.check_for(Body.of_height(BODY_15, 1.6), fps=60.0)
    assert (scene.home / "whole.png").is_file()
    assert not [p for p in scene.home.glob(".*") if p.suffix != ".json"]
    log = (scene.home / "runs" / "whole" / "version_0" / "metrics.csv").read_text().splitlines()
    assert "held_out" in log[0] and "log_likelihood" in log[0] and len(log) == 5


def test_a_fit_that_died_goes_on_to_the_same_result(scene, whole, monkeypatch) -> None:
    step = GPLVMFit.step

    def die(fit):
        if len(fit.history) == 2:
            raise RuntimeError("the power is gone")
        return step(fit)

    with monkeypatch.context() as patch:
        patch.setattr(GPLVMFit, "step", die)
        with pytest.raises(RuntimeError, match="power"):
            run(scene, "resumed")
    assert not (scene.home / "resumed.safetensors").exists()
    assert run(scene, "resumed", "--ckpt_path", "auto") == 0
    one, two = fitted(scene, "resumed"), whole
    for name, value in two.state_dict().items():
        assert torch.equal(value, one.state_dict()[name]), name
    assert one.info.extra == two.info.extra


def test_a_checkpoint_of_something_else_is_refused(scene, whole, capsys) -> None:
    where = ["--ckpt_path", str(scene.home / "runs" / "whole" / "checkpoints" / "last.ckpt")]
    assert run(scene, "other", "--model.init_args.latent_dim", "3", *where) == 2
    assert "settings latent_dim was 2, is 3" in capsys.readouterr().err
    assert run(scene, "other", "--data.init_args.persons", "[p1]", *where,
               "--data.init_args.without", "[p1_03]") == 2  # fmt: skip
    error = capsys.readouterr().err
    assert "the checkpoint is of another fit" in error and error.count("\n") == 1
    broken = scene.home / "broken.ckpt"
    torch.save({"something": 1}, broken)
    assert run(scene, "other", "--ckpt_path", str(broken)) == 2
    assert "broken.ckpt" in capsys.readouterr().err
    assert not (scene.home / "other.safetensors").exists()


def test_it_ends_when_held_out_poses_come_back_no_better(scene, monkeypatch, capsys) -> None:
    errors = iter([0.05, 0.04, 0.06, 0.07, 0.08])
    monkeypatch.setattr(ManifoldFitting, "held_out_error", lambda _: next(errors))
    more = ["--model.init_args.steps", "9", "--model.init_args.patience", "2"]
    assert run(scene, "stopped", *more) == 0
    assert "best after 2 of 4 steps" in capsys.readouterr().out
    assert fitted(scene, "stopped").info.extra["steps"] == 2


def test_several_persons_are_pooled(scene) -> None:
    more = ["--data.init_args.persons", "null", "--model.init_args.steps", "1"]
    assert run(scene, "pooled", *more) == 0
    info = fitted(scene, "pooled").info
    assert not (scene.home / "pooled.png").exists()  # --prior.pictures was not heard
    assert info.persons == ("set#p0", "set#p1")
    assert info.sequences == ("set#p0",) * 2 + ("set#p1",) * 3


@pytest.mark.slow
def test_bad_input_is_refused_in_one_line(scene, capsys) -> None:
    holes = scene.home / "holes"
    holes.mkdir(exist_ok=True)
    for trial in range(2):
        rewrite(write_trial(holes, "p6", trial, 40), make_hole)
    everybody = ["--data.init_args.persons", "null", "--data.init_args.without", "null"]
    check_refusals(
        scene, capsys,
        (["--data.init_args.persons", "[p9]"], "'p9' is nobody's name"),
        (["--data.init_args.without", "[p0_09]"], "no file named p0_09"),
        (["--data.init_args.validation", "3"], "set#p0 has 3 recordings, and 3 of them are to be"),
        (["--data.init_args.frames", "3"], "frames at least 10"),
        (["--model.init_args.optimiser", "sgd"], "optimiser must be one of lbfgs, adam"),
        (["--model.init_args.steps", "0"], "steps must be at least 1, got 0"),
        (["--model.init_args.latent_dims", "2"], "latent_dims"),
        (["--trainer.precision", "16-true"], "double precision"),
        ([*everybody, "--data.init_args.paths", f"['{holes}']"], "frame 9"),
        (["--data", "train.data.RecordingsDataModule"], "train.manifold.ManifoldData"),
    )  # fmt: skip
