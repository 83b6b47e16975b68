"""Action spaces fitted with Lightning: the same fit as the library's, several actions, bad input."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from torchpose.learning import fit_action_space

pytest.importorskip("lightning", reason="lightning is not installed; training needs it")

from tests.priors.performances import performances
from tests.recorded_bodies import write_body
from tests.train.scenes import check_refusals, make_hole, rewrite, run, scene_of
from torchpose.body import BODY_15, Body
from torchpose.learning._recipes import Performances
from torchpose.priors import ActionBank, ActionSpace
from torchpose.priors._actions.postures import posture_angles, posture_to_state


def write_recording(folder: Path, person: str, action: int) -> Path:
    """Somebody who does the same thing three times; joints of a body of their own."""
    body = Body.of_height(BODY_15, 1.6 + 0.05 * int(person[-1]))
    parts = performances(3, action, 30, noise=1.0, seed=int(person[-1]))
    angles = 0.4 * (torch.cat(parts) - parts[0].mean(0))
    rest = posture_angles(body.joints(torch.zeros(body.dim).double()))
    states = posture_to_state(body, (rest + angles).clamp(-80, 80), torch.zeros(body.dim).double())
    states[:, 1] += 0.9
    path = folder / f"{person}_{action}.npz"
    return write_body(path, body.joints(states), 30.0, person, f"action{action}")


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> SimpleNamespace:
    home = tmp_path_factory.mktemp("actions")
    folder = home / "recordings"
    folder.mkdir()
    for person in ("p0", "p1", "p2", "p3"):
        for action in (0, 1):
            write_recording(folder, person, action)
    options = {
        "--data.init_args.paths": f"['{folder}']",
        "--data.init_args.actions": "[action0]",
        "--data.init_args.held_out": "[p3]",
        "--data.init_args.postures": "joints",
        "--model.init_args.n_dimensions": 5,
        "--prior.pictures": "false",
    }
    return scene_of(home, "actions.yaml", options, folder=folder)


def test_it_is_the_fit_of_the_library(scene, capsys) -> None:
    assert run(scene, "one", "--prior.pictures", "true") == 0
    found = ActionSpace.load(scene.home / "one.safetensors")
    data = Performances.gather([str(scene.folder)], ["action0"], held_out=["p3"])
    assert len(data.train) == 9 and len(data.watched) == 3
    expected = fit_action_space([p.postures for p in data.train], 5, name="action0", fps=30.0)
    for name, value in expected.state_dict().items():
        assert torch.equal(found.state_dict()[name], value), name
    info = found.info
    assert info.name == "action0" and info.fps == 30.0 and info.sources == ("set",)
    assert info.persons == ("set#p0", "set#p1", "set#p2") and info.performances == 9
    assert "configs/actions.yaml" in info.command and "MHAD" in info.licence
    assert 0 <= info.extra["accepted"] <= 1 and info.extra["settings"]["n_dimensions"] == 5
    assert (scene.home / "one.png").is_file()
    said = capsys.readouterr().out
    assert "9 performances of 3 persons" in said and "of held-out postures pass the gate" in said
    log = (scene.home / "runs" / "one" / "version_0" / "metrics.csv").read_text().splitlines()
    assert "explained" in log[0] and "accepted" in log[0] and len(log) == 2


def test_several_actions_are_a_bank(scene) -> None:
    more = ["--data.init_args.actions", "[action1, action0]", "--model.init_args.gate_dimensions", "3",
            "--model.init_args.stay", "0.9", "--data.init_args.postures", "body"]  # fmt: skip
    assert run(scene, "two", *more) == 0
    bank = ActionBank.load(scene.home / "two.safetensors")
    assert bank.names == ("action1", "action0", "none") and bank.info.stay == 0.9
    assert bank.info.gate_dimensions == 3 and bank.info.fps == 30.0
    assert "MHAD" in bank.info.licence and bank.info.persons == ("set#p0", "set#p1", "set#p2")
    data = Performances.gather(
        [str(scene.folder)], ["action1", "action0"], held_out=["p3"], postures="body"
    )
    right = [
        bank.info.names[int(bank.recognise(p.postures).mean(0).argmax())] == p.action
        for p in data.watched
    ]
    assert all(right) and len(right) == 6


def test_recordings_are_resampled(scene) -> None:
    found = {}
    for fps in (30.0, 15.0):
        data = Performances.gather([str(scene.folder)], ["action0"], fps=fps)
        found[fps] = data.train
    assert len(found[15.0]) == len(found[30.0]) == 12
    for slow, fast in zip(found[15.0], found[30.0], strict=True):
        assert abs(2 * len(slow.postures) - len(fast.postures)) < 8


def test_on_one_body_it_makes_no_difference_where_the_shoulders_are(tmp_path) -> None:
    states = torch.zeros(60, 36, dtype=torch.float64)
    states[:, 3 + 3 * BODY_15.part("left_upper_arm")] = torch.linspace(0, 0.5, 60)
    states[:, 1] = 0.9
    straight = Body.of_height(BODY_15, 1.7)
    directions = torch.tensor(BODY_15.directions, dtype=torch.float64)
    for side in ("left", "right"):
        directions[BODY_15.joint(f"{side}_shoulder"), 1] -= 0.4
    sloping = Body(
        BODY_15, straight.bone_lengths, straight.radii,
        directions=torch.nn.functional.normalize(directions, dim=-1),
    )  # fmt: skip
    for person, body in (("p0", straight), ("p1", sloping)):
        write_body(tmp_path / f"{person}.npz", body.joints(states), 30.0, person, "action0")
    apart = {}
    for kind in ("joints", "body"):
        data = Performances.gather([str(tmp_path)], ["action0"], repeated=False, postures=kind)
        one, two = (p.postures for p in data.train)
        apart[kind] = float((one - two).abs().max())
    assert apart["joints"] > 10 and apart["body"] < 1e-3


def test_it_is_resumed_only_with_its_own_settings(scene, capsys) -> None:
    assert run(scene, "again") == 0
    first = (scene.home / "again.safetensors").read_bytes()
    assert run(scene, "again", "--ckpt_path", "auto") == 0
    assert (scene.home / "again.safetensors").read_bytes() == first
    checkpoint = str(scene.home / "runs" / "again" / "checkpoints" / "last.ckpt")
    assert (
        run(scene, "other", "--model.init_args.n_dimensions", "4", "--ckpt_path", checkpoint) == 2
    )
    assert "settings n_dimensions was 5, is 4" in capsys.readouterr().err


def test_bad_input_is_refused_in_one_line(scene, capsys) -> None:
    holes = scene.home / "holes"
    holes.mkdir(exist_ok=True)
    rewrite(write_recording(holes, "p6", 0), make_hole)
    timeless = scene.home / "timeless"
    timeless.mkdir(exist_ok=True)
    rewrite(write_recording(timeless, "p7", 0), lambda arrays: arrays.pop("fps"))
    short = scene.home / "short"
    short.mkdir(exist_ok=True)
    for person in ("p1", "p2"):
        path = write_recording(short, person, 0)
        rewrite(path, lambda arrays: arrays.update(joints=arrays["joints"][:3]))
    nobody = ["--data.init_args.held_out", "null"]
    check_refusals(
        scene, capsys,
        (["--data.init_args.persons", "[p9]"], "'p9' is nobody's name"),
        (["--data.init_args.actions", "[hop]"], "no recording of hop; there are action0, action1"),
        (["--data.init_args.actions", "[]"], "actions must be names"),
        (["--data.init_args.held_out", "[p0, p1, p2, p3]"], "nobody is left to learn from"),
        (["--data.init_args.fps", "0"], "fps must be positive"),
        (["--model.init_args.n_dimensions", "0"], "n_dimensions must be at least 1, got 0"),
        (["--data", "train.data.RecordingsDataModule"], "train.actions.ActionData"),
        ([*nobody, "--data.init_args.paths", f"['{holes}']"], "is missing in frame 9"),
        ([*nobody, "--data.init_args.paths", f"['{timeless}']"], "does not say its frame rate"),
        ([*nobody, "--data.init_args.paths", f"['{short}']", "--data.init_args.repeated", "false"],
         "has 3 frames, and key frames need at least 8"),
        ([*nobody, "--data.init_args.paths", f"['{short}']"], "or no repetition lasts 8 frames"),
        ([*nobody, "--data.init_args.persons", "[p0]", "--data.init_args.repeated", "false"],
         "expected two or more, got 1"),
    )  # fmt: skip
