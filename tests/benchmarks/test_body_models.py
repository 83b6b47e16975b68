"""Protocol Body models: who is refused, what stands still, and that the errors are those of the tracks."""

import json

import numpy as np
import pytest
import torch

from benchmarks import body_models
from benchmarks.bodies.views import Conditions, subjects_of
from tests.benchmarks.walkers import walker, write_walkers
from torchpose.errors import InputError, OverlapError, PriorError
from torchpose.io import read_mocap
from torchpose.learning import ManifoldRecipe, fit_limbs
from torchpose.learning._recipes import LimbStates, ManifoldFitting, ManifoldPoses


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Walks of three persons, a manifold of the first with noise of the second, limbs of both."""
    home = tmp_path_factory.mktemp("body-models")
    walks = write_walkers(home / "walks", ("p1", "p2", "p3"), n_trials=2)
    poses = ManifoldPoses.gather([str(walks)], persons=["p1"], held_out=["p2"], frames=60)
    fitting = ManifoldFitting(poses, ManifoldRecipe(steps=2))
    while not fitting.finished:
        fitting.step()
    fitting.manifold(name="m").save(home / "m.safetensors")
    states = LimbStates.gather([str(walks)], held_out=["p3"])
    fit_limbs(states, name="l")[0].save(home / "l.safetensors")
    return home


@pytest.mark.slow
def test_everybody_unknown_is_tracked(scene, tmp_path):
    body_models.run(
        scene / "walks", tmp_path, quick=True, progress=False, size="80x60",
        manifold=str(scene / "m.safetensors"), conditionals=str(scene / "l.safetensors"),
    )  # fmt: skip
    said = (tmp_path / "report.md").read_text()
    assert "standing still" in said and "p3 p3_0" in said and "p1" not in said and "p2" not in said
    table = json.loads((tmp_path / "report.json").read_text())["tables"]["errors"]["rows"]
    assert list(table) == [body_models.STILL, body_models.MEAN_POSE, "sir", "apf", "mrpf", "root"]
    clip = read_mocap(scene / "walks" / "p3_0.npz", 60.0)[0].cut(0, 6)
    moved = (clip.joints - clip.joints[:1]).norm(dim=-1).mean()
    assert table[body_models.STILL]["whole body"] == pytest.approx(1000 * float(moved), abs=5.0)
    rows = (tmp_path / "runs.csv").read_text().splitlines()
    assert len(rows) > 6


def test_persons_whom_a_model_knows_are_refused(scene, tmp_path):
    walks, manifold = scene / "walks", str(scene / "m.safetensors")
    for person in ("p1", "p2"):  # fitted to, and held out for its noise
        with pytest.raises(OverlapError, match=f"'m' was fitted on example/walkers#{person}"):
            body_models.run(walks, tmp_path, manifold=manifold, persons=(person,), progress=False)
    known = write_walkers(tmp_path / "known", ("p1", "p2"), n_trials=2)
    with pytest.raises(InputError, match="known to the models: p1, p2"):
        body_models.run(known, tmp_path, manifold=manifold, progress=False)


def test_refusals(scene, tmp_path):
    walks, limbs = scene / "walks", str(scene / "l.safetensors")
    for options, error, said in (
        ({}, InputError, "name a model"),
        ({"manifold": "nobody"}, PriorError, "nobody: no such file"),
        (
            {"conditionals": limbs, "clips": 2},
            InputError,
            "expected more than 2 recordings of walk",
        ),
        ({"conditionals": limbs, "cameras_used": 4}, InputError, "cameras_used from 1 to 3"),
    ):
        with pytest.raises(error, match=said):
            body_models.run(walks, tmp_path, progress=False, **options)


def test_the_mean_pose_is_put_where_the_person_is(scene):
    """Of somebody who always has the same pose it is without error."""
    folder = scene / "statues"
    folder.mkdir(exist_ok=True)
    still = np.repeat(walker(1), 20, 0)
    still[:, :, 2] += np.linspace(0, 1, 20)[:, None]
    from tests.benchmarks.walkers import NAMES

    for trial in range(2):
        np.savez(folder / f"s_{trial}.npz", joints=still, names=np.array(NAMES), fps=60.0,
                 subject="s", action="slide", axes="y-up", source="example/slides")  # fmt: skip
    clips = read_mocap(folder, 60.0)
    one = body_models._prepare(clips, 1, 20, Conditions((60, 80), 0.0, 1, None, 0))
    stays, mean = body_models._blind(subjects_of([one]), 0).runs
    assert float(mean.errors.nanmean()) < 5
    expected = torch.linspace(0, 1000, 20)
    torch.testing.assert_close(stays.errors.nanmean(1), expected, atol=8.0, rtol=0)
