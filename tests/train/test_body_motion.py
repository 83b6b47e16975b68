"""The motion of bodies fitted with Lightning: the same fit as the library's."""

import pytest
import torch

pytest.importorskip("lightning", reason="lightning is not installed; training needs it")

from tests.train.scenes import run, scene_of
from tests.train.test_limbs import write_trial
from torchpose.learning._body_motion_fit import BodyMotionRecipe
from torchpose.learning._recipes import RecordedMotion, fit_motion
from torchpose.priors._body_motion import BodyMotion


def test_it_is_the_fit_of_the_library(tmp_path, capsys) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    for person in ("p0", "p1", "p2"):
        write_trial(folder, person, 0, fps=60.0)
    options = {
        "--data.init_args.paths": f"['{folder}']", "--data.init_args.held_out": "[p2]",
        "--model.init_args.n_components": 2, "--model.init_args.n_samples": 200,
    }  # fmt: skip
    scene = scene_of(tmp_path, "body.yaml", options)
    assert run(scene, "motion") == 0
    said = capsys.readouterr().out
    found = BodyMotion.load(tmp_path / "motion.safetensors")
    recorded = RecordedMotion.gather([str(folder)], held_out=["p2"])
    expected, spread = fit_motion(recorded, BodyMotionRecipe(n_components=2, n_samples=200))
    for name, value in expected.state_dict().items():
        torch.testing.assert_close(found.state_dict()[name], value, msg=name)
    assert f"persons held out accelerate {spread.acceleration:.2f} times as much" in said
    assert found.info.persons == ("set#p0", "set#p1") and "configs/body.yaml" in found.info.command
    log = (tmp_path / "runs" / "motion" / "version_0" / "metrics.csv").read_text().splitlines()
    assert "acceleration" in log[0] and "log_density" in log[0] and len(log) == 2
