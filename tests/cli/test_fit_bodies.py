"""`torchpose fit manifold|limbs|actions|body`: files of the training loop, without Lightning; going on."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.full_disk import files_up_to
from tests.priors.motions import motion
from tests.priors.performances import performances
from tests.recorded_bodies import write_body
from torchpose._core.tensor_file import format_of
from torchpose.body import BODY_15, Body
from torchpose.cli._fit_bodies import KINDS, command, recorded_command
from torchpose.errors import OutputError
from torchpose.learning._gplvm_fit import GPLVMFit
from torchpose.learning._recipes.manifold import (
    ManifoldFitting,
    ManifoldPoses,
    ManifoldRecipe,
    run_to_end,
)
from torchpose.priors import ActionBank, ActionSpace, BackConstrainedGPLVM
from torchpose.priors._actions.postures import posture_angles, posture_to_state
from torchpose.priors._body_motion import BodyMotion
from torchpose.priors._limb_conditionals import LimbConditionals
from torchpose.viz import _model_pictures

LOADERS = {
    "manifold": BackConstrainedGPLVM.load,
    "limbs": LimbConditionals.load,
    "actions": ActionBank.load,
    "body": BodyMotion.load,
}
QUICK = {
    "manifold": ("--frames", 60, "--steps", 3, "--start", 1, "--validation", 1),
    "limbs": ("--least-std", 0.02),
    "actions": ("--actions", "action1", "action0", "--n-dimensions", 5, "--gate-dimensions", 3),
    "body": ("--n-components", 4, "--n-samples", 200, "--acceleration-scale", 2),
}
DRAWN = ("manifold", "actions")
TRAINED = {
    "manifold": {"data.frames": 60, "data.validation": 1, "model.steps": 3, "model.start": 1},
    "limbs": {"model.least_std": 0.02},
    "actions": {
        "data.actions": "[action1,action0]", "model.n_dimensions": 5, "model.gate_dimensions": 3,
    },
    "body": {"model.n_components": 4, "model.n_samples": 200, "model.acceleration_scale": 2.0},
}  # fmt: skip


@pytest.fixture(scope="module")
def walks(tmp_path_factory) -> Path:
    """Three persons who walk on the spot three times."""
    folder = tmp_path_factory.mktemp("walks")
    for person in range(3):
        body = Body.of_height(BODY_15, 1.6 + 0.1 * person)
        for trial in range(3):
            poses = 0.4 * motion(
                80, phase=float(trial), seed=10 * person + trial, speed=0.5, noise=0.01
            )
            state = torch.zeros(80, body.dim, dtype=torch.float64)
            state[:, 1] = 0.9
            joints = body.joints(body.with_relative(state, poses))
            write_body(folder / f"p{person}_{trial}.npz", joints, 120.0, f"p{person}", "walk")
    return folder


@pytest.fixture(scope="module")
def exercises(tmp_path_factory) -> Path:
    """Three persons who do two things three times each."""
    folder = tmp_path_factory.mktemp("exercises")
    for person in range(3):
        body = Body.of_height(BODY_15, 1.6 + 0.1 * person)
        at_rest = torch.zeros(body.dim, dtype=torch.float64)
        rest = posture_angles(body.joints(at_rest))
        for action in range(2):
            parts = performances(3, action, 30, noise=1.0, seed=person)
            angles = rest + 0.4 * (torch.cat(parts) - parts[0].mean(0))
            states = posture_to_state(body, angles.clamp(-80, 80), at_rest)
            states[:, 1] += 0.9
            path = folder / f"p{person}_{action}.npz"
            write_body(path, body.joints(states), 30.0, f"p{person}", f"action{action}")
    return folder


def tensors_and_facts(kind, path):
    found = LOADERS[kind](path)
    facts = dict(vars(found.info))
    facts.pop("command")
    return found.state_dict(), facts


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_it_is_the_file_of_the_training_loop(kind, torchpose, walks, exercises, tmp_path):
    pytest.importorskip("lightning", reason="training needs the extra `train`")
    from train.cli import main as train

    folder = exercises if kind == "actions" else walks
    held_out = () if kind == "manifold" else ("--held-out", "p2")
    out = tmp_path / "mine.safetensors"
    done = torchpose("fit", kind, folder, "--out", out, *QUICK[kind], *held_out,
                     "--licence", "CC0", *(("--pictures", "false") if kind in DRAWN else ()))  # fmt: skip
    assert done.code == 0, done.err
    assert "mine.safetensors" in done.out and "mine.md" in done.out
    runs = str(tmp_path / "runs")
    given = {"data.paths": f"['{folder}']", "data.persons": "null", "data.held_out": "null",
             "data.without": "null", **TRAINED[kind]}  # fmt: skip
    if held_out:
        given["data.held_out"] = "[p2]"
    options = [
        text for key, value in given.items()
        for text in (f"--{key.replace('.', '.init_args.')}", str(value))
    ]  # fmt: skip
    other = tmp_path / "trained" / "mine.safetensors"
    config = Path(__file__).parents[2] / "configs" / f"{kind}.yaml"
    assert train(["fit", "--config", str(config), *options, "--prior.out", str(other),
                  "--prior.licence", "CC0", "--prior.pictures", "false",
                  "--trainer.default_root_dir", runs]) == 0  # fmt: skip
    (one, facts), (two, theirs) = (tensors_and_facts(kind, p) for p in (out, other))
    assert facts == theirs and facts["licence"] == "CC0"
    assert one.keys() == two.keys()
    assert all(torch.equal(value, two[name]) for name, value in one.items())


def test_persons_held_out_give_a_manifold_its_noise(torchpose, walks, tmp_path):
    out = tmp_path / "walk.safetensors"
    line = (
        "fit",
        "manifold",
        walks,
        "--out",
        out,
        "--frames",
        60,
        "--steps",
        2,
        "--pictures",
        "false",
    )
    done = torchpose(*line, "--held-out", "p2")
    assert done.code == 0, done.err
    manifold = BackConstrainedGPLVM.load(out)
    assert manifold.info.persons == ("set#p0", "set#p1") and len(manifold.lengths) == 6
    assert manifold.info.extra["held_out_persons"] == ["set#p2"]
    slower = manifold.at_rate(30.0)
    growth = manifold.info.extra["noise_growth"]
    assert torch.equal(slower.std_pose, manifold.std_pose) and slower.info.fps == 30.0
    torch.testing.assert_close(slower.std_step, manifold.std_step * 2 ** growth["step"])
    torch.testing.assert_close(slower.std_latent, manifold.std_latent * 2 ** growth["latent"])
    card = out.with_suffix(".md").read_text()
    assert card.startswith("# walk\n") and "2: p0, p1" in card and "set#p2" in card
    assert "--held-out p2" in card and "--out walk.safetensors " in card
    assert "cam2.mp4 --manifold walk.safetensors --out" in card  # "walk" is the one of the package


def test_a_fit_that_was_killed_goes_on_to_the_same_result(torchpose, walks, tmp_path, monkeypatch):
    line = ("fit", "manifold", walks, "--frames", 60, "--steps", 4, "--patience", 9, "--persons", "p0",
            "--name", "one", "--pictures", "false", "--out")  # fmt: skip
    whole, again = tmp_path / "whole.safetensors", tmp_path / "again.safetensors"
    assert torchpose(*line, whole).code == 0
    step = GPLVMFit.step

    def die(fit):
        if len(fit.history) == 2:
            raise KeyboardInterrupt
        return step(fit)

    def die_writing(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(GPLVMFit, "step", die)
        assert torchpose(*line, again).code == 130
    kept = tmp_path / "again.safetensors.partial"
    assert kept.is_file() and not again.exists()
    done = torchpose(*line, again, "--latent-dim", 1)
    assert done.code == 2 and "with other settings, that was interrupted" in done.err
    with monkeypatch.context() as patch:
        patch.setattr("torchpose.learning._fit_files.write_manifold_files", die_writing)
        assert torchpose(*line, again, "--steps", 3).code == 130  # after one more step
    assert kept.is_file() and not again.exists()  # until the manifold is written
    done = torchpose(*line, again)
    assert done.code == 0 and "going on after 3 steps" in done.out and not kept.exists()
    one, two = (tensors_and_facts("manifold", p) for p in (whole, again))
    assert one[1] == two[1]
    assert all(torch.equal(value, two[0][name]) for name, value in one[0].items())
    kept.write_bytes(b"something else")
    done = torchpose(*line, again)
    assert done.code == 2 and "is in the place where a fit is kept" in done.err
    assert kept.read_bytes() == b"something else"


def test_a_manifold_of_one_dimension_has_no_picture(torchpose, walks, tmp_path):
    out = tmp_path / "line.safetensors"
    done = torchpose("fit", "manifold", walks, "--out", out, "--frames", 40, "--steps", 1,
                     "--persons", "p0", "--latent-dim", 1)  # fmt: skip
    assert done.code == 0, done.err
    assert "note: there is no picture of one latent dimension" in done.out
    assert sorted(path.name for path in tmp_path.glob("line*")) == ["line.md", "line.safetensors"]


def test_fewer_dimensions_than_asked_for_are_a_note(torchpose, exercises, tmp_path):
    done = torchpose("fit", "actions", exercises, "--actions", "action0", "--out",
                     tmp_path / "one.safetensors", "--n-dimensions", 99, "--pictures", "false")  # fmt: skip
    assert done.code == 0 and "Warning" not in done.err, done.err
    assert "note: the postures of action0 span 31 dimensions, fewer than the 99" in done.out


def test_people_who_stand_still_have_no_action(torchpose, tmp_path):
    body = Body.of_height(BODY_15, 1.7)
    for number in range(3):
        states = torch.zeros(60, body.dim, dtype=torch.float64)
        states[:, 1], states[:, 3 + 3 * BODY_15.part("torso")] = 0.9, 0.1 * number
        write_body(tmp_path / f"p0_{number}.npz", body.joints(states), 50.0, "p0", "still")
    done = torchpose("fit", "actions", tmp_path, "--actions", "still", "--out",
                     tmp_path / "still.safetensors", "--fps", 30)  # fmt: skip
    assert done.code == 2 and "there is no motion to learn" in done.err


def test_one_action_is_a_space(torchpose, exercises, tmp_path):
    out = tmp_path / "one.safetensors"
    done = torchpose("fit", "actions", exercises, "--actions", "action0", "--out", out,
                     "--n-dimensions", 4, "--pictures", "false")  # fmt: skip
    assert done.code == 0, done.err
    assert format_of(out) == "torchpose-action-space"
    assert ActionSpace.load(out).info.extra["postures"] == "body"
    assert out.with_suffix(".md").read_text().startswith("# action0")


def test_pictures_of_a_bank_have_names_of_files_and_go_with_it(
    torchpose, exercises, tmp_path, monkeypatch
):
    """A slash ended the command after the bank was written, and pictures of another bank stayed."""
    figure = pytest.importorskip("matplotlib.figure").Figure
    monkeypatch.setattr(_model_pictures, "plot_action_space", lambda *_: figure((1, 1)))
    for path in exercises.glob("*.npz"):
        with np.load(path) as archive:
            action = str(archive["action"]).replace("action", "sit/stand ")
            np.savez(tmp_path / path.name, **{**archive, "action": action})
    line = ["fit", "actions", tmp_path, "--out", tmp_path / "bank.safetensors", "--n-dimensions", 4]
    done = torchpose(*line, "--actions", "sit/stand 0", "sit/stand 1")
    assert done.code == 0, done.err
    pictures = {"bank-sit_stand 0.png", "bank-sit_stand 1.png"}
    assert {path.name for path in tmp_path.glob("*.png")} == pictures
    assert torchpose(*line, "--actions", "sit/stand 0").code == 0
    assert [path.name for path in tmp_path.glob("*.png")] == ["bank.png"]


def test_the_motion_of_bodies_says_how_others_move(torchpose, walks, tmp_path):
    out = tmp_path / "body.safetensors"
    done = torchpose("fit", "body", walks, "--out", out, *QUICK["body"], "--held-out", "p2")
    assert done.code == 0, done.err
    assert "motion of 27 columns and 4 kinds of poses from" in done.out
    info = BodyMotion.load(out).info
    assert info.persons == ("set#p0", "set#p1") and info.actions == ("walk",) and info.fps == 30.0
    assert info.extra["settings"]["acceleration_scale"] == 2
    told = info.extra["held_out"]
    assert told["frames"] == 60 and 0.3 < told["acceleration"] < 0.7
    card = out.with_suffix(".md").read_text()
    assert card.startswith("# body\n") and "2: p0, p1" in card and "acceleration_scale 2" in card
    assert "--motion body.safetensors --out" in card
    said = torchpose("info", out).out
    for part in (
        "left_shank about x: ",
        "4 components over 21 angles",
        "accelerating 0.",
        "2: set#p0",
    ):
        assert part in said


def test_a_configuration_names_the_command(torchpose, walks, tmp_path):
    config = tmp_path / "limbs.yaml"
    printed = torchpose(
        "fit", "limbs", walks, "--out", tmp_path / "x.safetensors", "--print_config"
    )
    config.write_text(printed.out)
    assert torchpose("fit", "limbs", "--config", config).code == 0
    info = LimbConditionals.load(tmp_path / "x.safetensors").info
    assert info.command == f"torchpose fit limbs --config {config}"
    other = ("--out", tmp_path / "y.safetensors", "--fps", 30)
    assert torchpose("fit", "limbs", "--config", config, *other).code == 0
    info = LimbConditionals.load(tmp_path / "y.safetensors").info
    assert info.command == f"torchpose fit limbs --config {config} --fps 30"
    given = command("limbs").given([*(f"r{i}" for i in range(20)), "--out", "a/x.safetensors"])
    assert recorded_command(given) == "torchpose fit limbs r0 '...19 more' --out x.safetensors"


@pytest.mark.slow
def test_lightning_is_not_imported(walks, tmp_path):
    code = (
        "import sys; from torchpose.cli import main; "
        f"code = main(['fit', 'limbs', {str(walks)!r}, '--out', {str(tmp_path / 'l.safetensors')!r}]); "
        "sys.exit(code or any(name.partition('.')[0] in ('lightning', 'matplotlib', 'train') "
        "for name in sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ, capture_output=True, timeout=120
    )
    assert done.returncode == 0, done.stderr


def test_recordings_that_tell_no_action_are_counted(torchpose, walks, tmp_path):
    for number, name in enumerate(("p0_0", "p0_1")):
        with np.load(walks / f"{name}.npz") as archive:
            arrays = {key: archive[key] for key in archive if number or key != "action"}
        np.savez(tmp_path / f"{name}.npz", **arrays)
    done = torchpose(
        "fit", "limbs", tmp_path, "--actions", "hop", "--out", tmp_path / "l.safetensors"
    )
    assert "no recording of hop; there are walk, and 1 recording without `action` in" in done.err


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (("manifold", "{walks}", "--persons", "p9"), "'p9' is nobody's name"),
        (("manifold", "{walks}", "--held-out", "p0", "p1", "p2"), "nobody is left to learn from"),
        (("manifold", "{walks}", "--validation", 3), "3 of them are to be held out"),
        (("manifold", "{walks}", "--steps", 0), "steps must be at least 1"),
        (("manifold", "{walks}", "--without-files", "p0_7"), "no file named p0_7"),
        (("limbs", "$TORCHPOSE_NOT_SET/x"), "TORCHPOSE_NOT_SET is not set"),
        (("limbs", "{walks}", "--least-std", -1), "least_std must be zero or more"),
        (("limbs", "{walks}", "--axes", "up"), "--axes must be one of"),
        (("limbs", "{walks}", "--actions", "hop"), "no recording of hop; there are walk"),
        (("actions", "{walks}"), "--actions"),
        (("actions", "{walks}", "--actions", "walk", "--postures", "arms"), "body or joints"),
        (
            ("actions", "{walks}", "--actions", "walk", "--stay", 0.5),
            "--stay is for a bank of several",
        ),
        (
            ("manifold", "{walks}", "--held-out", "p2", "--validation", 1),
            "--validation is for fits without",
        ),
        (
            ("limbs", "{walks}", "--persons", "p0", "p2", "--held-out", "p2"),
            "to be fitted to as well",
        ),
        (
            (
                "limbs",
                "{walks}",
                "--without-files",
                *(f"p{i}_{j}" for i in range(3) for j in range(3)),
            ),
            "names all of the recordings",
        ),
        (("actions",), "missing: DIR"),
        (("body", "{walks}", "--n-components", 3), "n_components must be even"),
        (("body", "{walks}", "--fps", 0), "fps must be positive"),
        (("body", "{walks}", "--fps", 1), "add longer ones"),
    ],
)
def test_bad_input_is_refused_in_one_line(torchpose, walks, tmp_path, line, said):
    line = [str(part).format(walks=walks) for part in line]
    done = torchpose("fit", *line, "--out", tmp_path / "bad.safetensors")
    assert done.code == 2 and said in done.err and len(done.err.splitlines()) == 1, done.err
    assert not list(tmp_path.iterdir())


def test_held_out_persons_do_the_actions(torchpose, exercises, tmp_path):
    with np.load(exercises / "p2_1.npz") as values:
        np.savez(tmp_path / "a.npz", **{**values, "subject": "p3"})
    line = (
        "fit",
        "limbs",
        exercises,
        tmp_path / "a.npz",
        "--actions",
        "action0",
        "--held-out",
        "p3",
    )
    done = torchpose(*line, "--out", tmp_path / "out" / "x.safetensors")
    assert done.code == 2 and "(set#p3) did any of the actions" in done.err


@pytest.mark.parametrize("kind", ["manifold", "limbs", "actions", "body"])
def test_what_reading_assumed_is_told(kind, torchpose, walks, exercises, tmp_path):
    """Without this nothing says that bodies lie, or are mirrored."""
    folder, out = tmp_path / "recordings", tmp_path / "mine.safetensors"
    folder.mkdir()
    for path in (exercises if kind == "actions" else walks).iterdir():
        with np.load(path) as values:
            about_x = [[1, 0, 0], [0, np.cos(1.3), -np.sin(1.3)], [0, np.sin(1.3), np.cos(1.3)]]
            np.savez(
                folder / path.name,
                **{**values, "joints": 1000 * values["joints"] @ np.transpose(about_x)},
            )
    (folder / "more.csv").write_text("nothing")
    quiet = ("--pictures", "false") if kind in DRAWN else ()
    done = torchpose("fit", kind, folder, "--out", out, *QUICK[kind], *quiet)
    assert done.code == 0, done.err
    assert "note: by these axes the person lies" in done.out
    assert "note: taken for millimetres" in done.out
    assert (
        f"note: not read, since the folder holds recordings as .npz: {folder}/more.csv" in done.out
    )


def test_joints_that_are_never_there_are_told(torchpose, walks, tmp_path):
    """A head that no recording has was held still without a word."""
    for path in walks.iterdir():
        with np.load(path) as values:
            joints = values["joints"].copy()
            if path.stem.startswith("p2"):
                joints[:, BODY_15.joint("head")] = np.nan
            np.savez(tmp_path / path.name, **{**values, "joints": joints})
    line = ("fit", "limbs", tmp_path, "--out", tmp_path / "out" / "x.safetensors")
    done = torchpose(*line)
    assert done.code == 0, done.err
    assert "note: head: never there in recordings of 240 of 720 frames" in done.out
    shutil.copy(walks / "p2_1.npz", tmp_path / "p2_1.npz")
    done = torchpose(*line)
    assert done.code == 2
    assert "p2_0.npz: head is never there, and other recordings of set#p2 have it" in done.err


def test_a_full_disk_is_told(walks, tmp_path):
    poses = ManifoldPoses.gather([str(walks)], persons=["p0"], validation=1, frames=30)
    fitting = ManifoldFitting(poses, ManifoldRecipe(steps=1))
    with files_up_to(1000), pytest.raises(OutputError, match="kept: cannot be written"):
        run_to_end(fitting, tmp_path / "kept", False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["limbs", "body"])
def test_gaps_leave_the_rest_of_a_recording(kind, torchpose, walks, tmp_path):
    for path in walks.iterdir():
        with np.load(path) as values:
            arrays = dict(values)
        if path.stem == "p0_0":
            arrays["joints"][10, 4] = np.nan
            arrays["joints"][70:, 8] = np.nan
        np.savez(tmp_path / path.name, **arrays)
    out = tmp_path / "out" / "mine.safetensors"
    done = torchpose("fit", kind, tmp_path, "--out", out, *QUICK[kind])
    assert done.code == 0, done.err
    assert "note: 1 frame with missing joints is interpolated" in done.out
    assert "p0_0.npz: 10 of 80 frames are left out" in done.out
    assert LOADERS[kind](out).info.persons == ("set#p0", "set#p1", "set#p2")
