"""Limb conditionals fitted with Lightning: what they are of, who is held out, bad input."""

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchpose.learning import fit_limb_conditionals

pytest.importorskip("lightning", reason="lightning is not installed; training needs it")

from tests.recorded_bodies import write_body
from tests.train.scenes import check_refusals, make_hole, rewrite, run, scene_of
from torchpose.body import BODY_15, Body
from torchpose.learning._recipes import LimbStates
from torchpose.learning._recipes.limbs import held_out_spread
from torchpose.priors._limb_conditionals import LimbConditionals

SWING = {"left_thigh": (0.3, 0.0), "left_shank": (0.2, 0.35), "right_thigh": (0.3, 0.0),
         "right_shank": (0.2, 0.35), "left_upper_arm": (0.2, 0.0), "right_forearm": (0.1, -0.4)}  # fmt: skip
HERTZ = 1.0


def write_trial(
    folder: Path, person: str, trial: int, fps: float = 120.0, scale: float = 1.0
) -> Path:
    """Somebody whose limbs swing forwards and backwards, each by a radian of its own."""
    frames = int(2 * fps)
    body = Body.of_height(BODY_15, 1.65 + 0.05 * int(person[-1]))
    phase = 2 * math.pi * HERTZ * torch.arange(frames, dtype=torch.float64) / fps + trial
    states = torch.zeros(frames, body.dim, dtype=torch.float64)
    states[:, 1] = 0.9
    for i, (part, (size, rest)) in enumerate(SWING.items()):
        angle = rest + scale * size * (phase + i).sin()
        states[:, 3 + 3 * BODY_15.part(part)] = (angle / 2).sin()
    path = folder / f"{person}_{trial}.npz"
    return write_body(path, body.joints(states), fps, person, f"walk{trial}")


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> SimpleNamespace:
    home = tmp_path_factory.mktemp("limbs")
    folder = home / "recordings"
    folder.mkdir()
    for person in ("p0", "p1"):
        for trial in (0, 1):
            write_trial(folder, person, trial, fps=(120.0, 60.0)[trial])
    write_trial(folder, "p2", 0, scale=1.5)
    options = {
        "--data.init_args.paths": f"['{folder}']",
        "--data.init_args.held_out": "[p2]",
    }
    return scene_of(home, "limbs.yaml", options, folder=folder)


def of_edge(conditionals: LimbConditionals, below: str) -> int:
    parts = [conditionals.info.parts[j] for j in conditionals.edges[:, 1].tolist()]
    return parts.index(below)


def test_limbs_come_back_as_they_were_moved(scene, capsys) -> None:
    assert run(scene, "walk") == 0
    said = capsys.readouterr().out
    assert "9 limbs from 480 frames of 2 persons at 60 frames per second" in said
    found = LimbConditionals.load(scene.home / "walk.safetensors")
    for part in ("left_shank", "right_shank", "right_forearm"):
        covariance = found.covariance[of_edge(found, part)]
        expected = SWING[part][0] / math.sqrt(2)  # root mean square of the angle
        angle = 2 * float(torch.linalg.eigvalsh(covariance)[-1].sqrt())
        assert angle == pytest.approx(expected, rel=0.03)
        assert float(torch.linalg.eigvalsh(covariance)[:2].max()) < 2e-4
    # a thigh turns against the root, which stands still, by so many radians from frame to frame
    speed = SWING["left_thigh"][0] / math.sqrt(2) * 2 * math.pi * HERTZ / 60
    step = found.diffusion[BODY_15.part("left_thigh")].trace().sqrt()
    assert 2 * float(step) == pytest.approx(speed, rel=0.03)
    info = found.info
    assert info.name == "walk" and info.fps == 60.0 and info.sources == ("set",)
    assert info.persons == ("set#p0", "set#p1") and info.actions == ("walk0", "walk1")
    assert "configs/limbs.yaml" in info.command and "CMU" in info.licence
    told = info.extra["held_out"]
    assert told["frames"] == 120 and 1.1 < told["deviation"] < 1.6 and 1.3 < told["speed"] < 1.6
    log = (scene.home / "runs" / "walk" / "version_0" / "metrics.csv").read_text().splitlines()
    assert "deviation" in log[0] and "speed" in log[0] and len(log) == 2


def test_it_is_the_fit_of_the_library_on_one_body(scene) -> None:
    data = LimbStates.gather([str(scene.folder)], held_out=["p2"], actions=["walk0"])
    assert data.body.frame == "body" and len(data.train) == 2 and len(data.watched) == 1
    one = fit_limb_conditionals(data.body, data.train, 60.0)
    one.check_for(data.body)
    same = held_out_spread(one, data.body, data.train)
    assert same.deviation == pytest.approx(1, abs=0.15)  # the floor of the twist counts as spread
    assert same.speed == pytest.approx(1) and same.frames == 240
    assert run(scene, "one", "--data.init_args.actions", "[walk0]") == 0
    found = LimbConditionals.load(scene.home / "one.safetensors")
    for name, value in one.state_dict().items():
        assert torch.equal(found.state_dict()[name], value), name


@pytest.mark.slow
def test_it_is_resumed_only_with_its_own_settings(scene, capsys) -> None:
    assert run(scene, "again", "--data.init_args.held_out", "null") == 0
    assert "persons held out" not in capsys.readouterr().out
    first = (scene.home / "again.safetensors").read_bytes()
    more = ["--data.init_args.held_out", "null", "--ckpt_path", "auto"]
    assert run(scene, "again", *more) == 0
    assert (scene.home / "again.safetensors").read_bytes() == first
    assert run(scene, "again", "--model.init_args.least_std", "0.02", *more) == 2
    assert "settings least_std was 0.01, is 0.02" in capsys.readouterr().err


def test_notes_tell_of_gaps_and_unread_files(scene, capsys) -> None:
    folder = scene.home / "gaps"
    folder.mkdir()

    def change(arrays):
        arrays["joints"][10:12, 4] = np.nan
        arrays["joints"][200:, 8] = np.nan

    rewrite(write_trial(folder, "p6", 0), change)
    (folder / "more.csv").write_text("nothing")
    assert run(scene, "gaps", "--data.held_out", "null", "--data.paths", f"['{folder}']") == 0
    said = capsys.readouterr().out
    assert "note: 2 frames with missing joints are interpolated, in gaps of up to 0.2 s" in said
    assert "p6_0.npz: 40 of 240 frames are left out" in said
    assert (
        "note: not read, since the folder holds recordings as .npz" in said.partition("9 limbs")[0]
    )


def test_bad_input_is_refused_in_one_line(scene, capsys) -> None:
    folders = {}
    for name, change in (("holes", make_hole), ("timeless", lambda arrays: arrays.pop("fps"))):
        folders[name] = scene.home / name
        folders[name].mkdir(exist_ok=True)
        rewrite(write_trial(folders[name], "p6", 0), change)
    nobody = ["--data.init_args.held_out", "null", "--data.init_args.paths"]
    check_refusals(
        scene, capsys,
        (["--data.init_args.persons", "[p9]"], "'p9' is nobody's name"),
        (["--data.init_args.actions", "[hop]"], "no recording of hop; there are walk0, walk1"),
        (["--data.init_args.without", "[p9_9]"], "no file named p9_9"),
        (["--data.init_args.held_out", "[p0, p1, p2]"], "nobody is left to learn from"),
        (["--data.init_args.fps", "0"], "fps must be positive"),
        (["--model.init_args.least_std", "-1"], "least_std must be zero or more"),
        (["--data", "train.data.RecordingsDataModule"], "train.limbs.LimbData"),
        ([*nobody, f"['{folders['holes']}']"], "p6_0.npz: no half a second in which all joints are there"),
        ([*nobody, f"['{folders['timeless']}']"], "does not say its frame rate"),
    )  # fmt: skip
