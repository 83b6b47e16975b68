"""Fine-tuning with Lightning: resumed, shared, stopped early; what is written, what is refused."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("lightning", reason="lightning is not installed; training needs it")

from tests.priors.poses import poses
from tests.train.scenes import check_refusals, run, scene_of
from torchpose.errors import InputError
from torchpose.io import read_recordings
from torchpose.learning._recipes import UpperBodyRecipe
from torchpose.learning._training import collect_poses
from torchpose.priors import UpperBodyPrior, load_prior
from torchpose.priors._upper_body_prior import released_process_cov
from torchpose.skeleton import UPPER_BODY
from train.fine_tuning import FineTuning
from train.fine_tuning_batches import SequenceBatches, _complete, batches_of

ROOT = Path(__file__).resolve().parents[2]
N_FRAMES = 24


def write_recordings(folder: Path, persons: int) -> None:
    """A person moves about smoothly; another one does so in another way."""
    folder.mkdir()
    for person in range(persons):
        ends = poses(4, person)
        share = torch.linspace(0, 3, N_FRAMES, dtype=torch.float64)
        first = share.long().clamp_max(2)
        part = (share - first)[:, None, None]
        joints = (1 - part) * ends[first] + part * ends[first + 1]
        joints[:, [2, 5], 1] += 0.03  # a neck well above the shoulders
        np.savez(
            folder / f"p{person}.npz", joints=joints.numpy(), names=np.array(UPPER_BODY), fps=30.0,
            subject=f"p{person}", source="set", axes="camera",
        )  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> SimpleNamespace:
    """Three recordings, and a prior that has not seen the third person."""
    home = tmp_path_factory.mktemp("fine-tuning")
    write_recordings(home / "recordings", 3)
    (home / "recordings" / "more.csv").write_text("nothing")
    recipe = UpperBodyRecipe(
        n_components=2, n_samples=600, pose_steps=5, window_components=2, window_samples=400,
        window_steps=3, calibration_folds=0,
    )  # fmt: skip
    recordings = read_recordings([home / "recordings"])
    seen = [r for r in recordings if r.person_id != "set#p2"]
    recipe.fit(seen, name="windows").save(home / "windows.safetensors")
    base = load_prior(home / "windows.safetensors")
    info = replace(base.info, name="base", extra={"held_out_drawn": {"pf_walk": {"set#p0": 0.1}}})
    noise = base.noise | {"process_cov": released_process_cov()}  # far from the best
    noise |= {f"calibration_{kind}_pf_walk": torch.ones(8) for kind in ("scale", "floor")}
    UpperBodyPrior(base.left, base.right, info, noise).save(home / "base.safetensors")
    options = {
        "--model.init_args.prior": home / "base.safetensors",
        "--data.init_args.paths": f"['{home / 'recordings'}']",
        "--data.init_args.held_out": "[p2]",
        "--data.init_args.curation": "null",
        "--data.init_args.steps_per_epoch": 2,
        "--model.init_args.batch_size": 4,
        "--model.init_args.mixtures": "false",
        "--model.init_args.learning_rate": 0.05,
        "--model.init_args.epochs": 3,
        "--prior.pictures": "false",
    }
    return scene_of(home, "fine-tune.yaml", options, recordings=recordings)


def tuned(scene, name: str) -> UpperBodyPrior:
    return load_prior(scene.home / f"{name}.safetensors")


def difference(first: UpperBodyPrior, second: UpperBodyPrior) -> float:
    """Largest one, relative to the larger numbers of each tensor."""
    one, two = first.state_dict(), second.state_dict()
    assert one.keys() == two.keys()
    numbers = one.keys() - {"_extra_state"}
    return max(float((one[k] - two[k]).abs().max() / one[k].abs().max()) for k in numbers)


@pytest.fixture(scope="module")
def whole(scene) -> UpperBodyPrior:
    """Fine-tuned without interruption, by one process."""
    assert run(scene, "whole") == 0
    return tuned(scene, "whole")


@pytest.mark.slow
def test_noise_is_tuned_and_the_file_says_so(scene, whole) -> None:
    base = tuned(scene, "base")
    assert whole.info.name == "whole" and "fine-tune.yaml" in whole.info.command
    assert torch.equal(whole.left.means, base.left.means)
    assert not torch.equal(whole.noise["process_cov"], base.noise["process_cov"])
    assert (whole.noise["process_cov"] > 0).all()
    assert whole.info.persons == ("set#p0", "set#p1", "set#p2")
    assert whole.info.sources == ("set",)
    facts = whole.info.extra["fine_tuned"]
    assert facts["from"] == "base" and facts["held_out"] == ["set#p2"]
    assert facts["settings"]["part"] == "poses" and facts["steps"] in (2, 4, 6)
    assert facts["error_after"]["pose"] < facts["error_before"]["pose"]
    assert {"calibration_scale_pose", "calibration_floor_pose"} <= set(whole.noise)
    assert "calibration_scale_pf_walk" not in whole.noise  # of the prior to start from
    assert "held_out_drawn" not in whole.info.extra
    assert (scene.home / "whole.md").is_file()
    assert not [p for p in scene.home.glob(".*") if p.suffix != ".json"]
    log = (scene.home / "runs" / "whole" / "version_0" / "metrics.csv").read_text()
    assert "held_out" in log.splitlines()[0] and len(log.splitlines()) == 1 + 6 + 4


@pytest.mark.slow
def test_a_fit_that_died_goes_on_to_the_same_result(scene, whole, monkeypatch) -> None:
    loss, calls = SequenceBatches.loss, []

    def die(batches, module, step, share):
        calls.append((step, share))
        if step == 3:  # in the middle of the second epoch
            raise RuntimeError("the power is gone")
        return loss(batches, module, step, share)

    with monkeypatch.context() as patch:
        patch.setattr(SequenceBatches, "loss", die)
        with pytest.raises(RuntimeError, match="power"):
            run(scene, "resumed")
    assert calls == [(step, share) for step in range(3) for share in (0, 1)] + [(3, 0)]
    assert not (scene.home / "resumed.safetensors").exists()
    assert run(scene, "resumed", "--ckpt_path", "auto") == 0
    assert difference(tuned(scene, "resumed"), whole) == 0
    assert tuned(scene, "resumed").info.extra == whole.info.extra


def test_a_checkpoint_of_other_settings_is_refused(scene, whole, capsys) -> None:
    where = str(scene.home / "runs" / "whole" / "checkpoints" / "last.ckpt")
    other = ["--model.init_args.learning_rate", "0.1", "--ckpt_path", where]
    assert run(scene, "other", *other) == 2
    assert "learning_rate was 0.05, is 0.1" in capsys.readouterr().err


@pytest.mark.slow
def test_two_processes_make_the_same_prior(scene, whole) -> None:
    out = scene.home / "shared.safetensors"
    command = [sys.executable, "-m", "train", *scene.arguments, "--prior.out", str(out)]
    command += ["--prior.pictures", "false", "--trainer.devices", "2"]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    environment |= {"MASTER_ADDR": "127.0.0.1", "GLOO_SOCKET_IFNAME": "lo"}
    done = subprocess.run(
        command, env=environment, cwd=scene.home, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert difference(tuned(scene, "shared"), whole) < 1e-10
    assert tuned(scene, "shared").info.extra["fine_tuned"] == whole.info.extra["fine_tuned"]


@pytest.mark.slow
def test_it_ends_when_held_out_persons_are_tracked_no_better(scene, monkeypatch) -> None:
    worse = iter([0.05, 0.04, 0.06, 0.07, 0.08, 0.09])
    monkeypatch.setattr(SequenceBatches, "error", lambda *_: next(worse))
    assert run(scene, "stopped", "--model.init_args.patience", "2") == 0
    assert next(worse) == 0.08  # scored at the start and after three epochs
    assert tuned(scene, "stopped").info.extra["fine_tuned"]["steps"] == 2


def test_windows_are_tuned_with_their_mixtures(scene, capsys) -> None:
    more = ["--model.init_args.part", "causal", "--model.init_args.mixtures", "true"]
    more += ["--model.init_args.epochs", "1", "--model.init_args.learning_rate", "0.003"]
    more += ["--model.init_args.prior", str(scene.home / "windows.safetensors")]
    assert run(scene, "window", *more) == 0
    assert "note     not read, since the folder holds recordings as .npz" in capsys.readouterr().out
    base, prior = tuned(scene, "windows"), tuned(scene, "window")
    assert torch.equal(prior.left.means, base.left.means)
    assert torch.equal(prior.windows["full"].left.means, base.windows["full"].left.means)
    facts = prior.info.extra["fine_tuned"]
    assert facts["steps"] in (0, 2) and set(facts["error_after"]) == {"pose", "causal", "full"}


def test_a_share_depends_on_nothing_but_seed_step_and_number(scene) -> None:
    prior = load_prior(scene.home / "windows.safetensors")
    for part in ("poses", "full"):
        one, two = (
            batches_of(prior, part, scene.recordings[:2], scene.recordings[2:], 3, 5)
            for _ in range(2)
        )
        module = SimpleNamespace(loss=_first_tensor)
        first = one.loss(module, 4, 1)
        two.loss(module, 3, 0)
        assert torch.equal(two.loss(module, 4, 1).nan_to_num(), first.nan_to_num())
        assert not torch.equal(two.loss(module, 4, 0).nan_to_num(), first.nan_to_num())


def test_recordings_are_cut_where_a_joint_is_missing(scene) -> None:
    """One missing joint costs its frame, not the recording; the neck is where the training has it."""
    prior = load_prior(scene.home / "base.safetensors")
    whole, *_ = scene.recordings
    joints = whole.joints.clone()
    joints[3, 0] = joints[14, 5] = torch.nan
    parts = _complete(prior, [whole, replace(whole, joints=joints)])
    every = collect_poses([whole], prior.info.neck, prior.info.centre).joints
    assert [len(part) for part in parts] == [N_FRAMES, 10]
    assert torch.equal(parts[0], every) and torch.equal(parts[1], every[4:14])
    with pytest.raises(InputError, match="10 frames in a row"):
        _complete(prior, [replace(whole, joints=joints[:13])])
    low = whole.joints.clone()
    low[:, 4] = low[:, [2, 5]].mean(1)
    low_neck = [replace(r, joints=low) for r in scene.recordings[2:]]
    for part in ("poses", "full"):
        name = "base" if part == "poses" else "windows"
        prior = load_prior(scene.home / f"{name}.safetensors")
        batches_of(prior, part, scene.recordings[:2], low_neck, 3, 5)


def _first_tensor(batch, *_) -> torch.Tensor:
    return batch[0]["left"] if isinstance(batch[0], dict) else batch[0]


def test_bad_input_is_refused_in_one_line(scene, capsys) -> None:
    check_refusals(
        scene, capsys,
        (["--data.init_args.held_out", "[]"], "name at least one with --data.init_args.held_out"),
        (["--data.init_args.held_out", "[p1]"], "was fitted on set#p1"),
        (["--data.init_args.held_out", "[p9]"], "'p9' is nobody's name"),
        (["--model.init_args.part", "legs"], "part must be one of poses, got 'legs'"),
        (["--model.init_args.batch_size", "5"], "batch_size must be a multiple of shares = 2"),
        (["--model.init_args.learning_rate", "0"], "learning_rate must be positive"),
        (["--model.init_args.lerning_rate", "1"], "lerning_rate"),
    )  # fmt: skip


def test_a_prior_is_not_tuned_into_its_own_place(scene, capsys) -> None:
    base = scene.home / "base.safetensors"
    before = base.read_bytes()
    assert run(scene, "base") == 2
    assert f"{base}: is an input of this run" in capsys.readouterr().err
    assert base.read_bytes() == before


@pytest.mark.slow
def test_steps_without_a_finite_gradient_are_left_out(scene, monkeypatch, capsys) -> None:
    loss = SequenceBatches.loss

    def sometimes(batches, module, step, share):
        value = loss(batches, module, step, share)
        return value * torch.nan if step == 1 else value

    kept: list[FineTuning] = []
    end = FineTuning.finished_prior
    monkeypatch.setattr(SequenceBatches, "loss", sometimes)
    monkeypatch.setattr(
        FineTuning,
        "finished_prior",
        lambda self, **facts: (kept.append(self), end(self, **facts))[1],
    )
    once = ["--model.init_args.epochs", "1"]
    assert run(scene, "holes", *once) == 0
    assert kept[0].skipped == 1
    assert torch.isfinite(tuned(scene, "holes").noise["process_cov"]).all()
    capsys.readouterr()
    monkeypatch.setattr("train.fine_tuning._MOST_SKIPPED", 0)
    assert run(scene, "holes2", *once) == 2
    assert "lower --model.init_args.learning_rate" in capsys.readouterr().err
