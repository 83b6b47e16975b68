"""The module by itself: devices it refuses, states that are bad, data that are none of its own."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("lightning", reason="training needs the extra `train`")

from tests.priors.poses import lowered_neck, poses
from torchpose.errors import FileFormatError, InputError, OverlapError
from torchpose.io import Recording
from torchpose.learning._recipes import MixtureTask, UpperBodyRecipe
from torchpose.learning._recipes.choosing import expand_path, fingerprint
from torchpose.learning._samplers import BLOCK, TensorSource
from torchpose.learning._streamed_em import StreamedEM, fit_streamed
from torchpose.math._mixture_em import SufficientStatistics
from torchpose.skeleton import UPPER_BODY
from train.blocks import Key, SweepLoader
from train.checkpoints import check_identity
from train.data import RecordingsDataModule, split
from train.mixture_em import MixtureEM
from train.processes import first_failure


def module(sources, n_components=2, max_iter=3):
    """Fits of some sources, as far as training_step needs a trainer."""
    data = RecordingsDataModule(["nowhere"])
    data.tasks = {
        key.name: MixtureTask(source, n_components, max_iter, 0.0, 0)
        for key, source in sources.items()
        if not key.held_out
    }
    data.sources = dict(sources)
    em = MixtureEM()
    em._trainer = SimpleNamespace(
        datamodule=data, should_stop=False, global_rank=0, world_size=1, precision="32-true",
        strategy=SimpleNamespace(root_device=torch.device("cpu")), training=True,
    )  # fmt: skip
    em.log_dict = lambda values, on_step: None
    em.setup("fit")
    em.on_fit_start()
    return em


def states(n, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(n, 3, generator=generator, dtype=torch.float64)


def test_steps_are_those_of_the_library():
    sources = {
        Key("pose"): TensorSource(states(BLOCK + 100)),
        Key("a.b"): TensorSource(states(900, 1)),
    }
    sources[Key("pose", held_out=True)] = TensorSource(states(50, 2))
    em = module(sources)
    loader = SweepLoader(sources, epochs=em.epoch_of)
    for step in range(4):
        assert not em.finished
        em.training_step(next(iter(loader)), step)
    assert em.finished and em.trainer.should_stop
    for key in (Key("pose"), Key("a.b")):
        wanted = fit_streamed(sources[key], 2, 0, max_iter=3, tol=0.0)
        found = em.em(key.name).mixture()
        torch.testing.assert_close(found.means, wanted.means, rtol=0, atol=1e-10)
        assert found.fit_report.log_likelihood == pytest.approx(
            wanted.fit_report.log_likelihood, abs=1e-10
        )
    held_out = sources[Key("pose", held_out=True)].block(0).states
    assert len(em.held_out_history["pose"]) == 4
    assert em.held_out_history["pose"][-1] == pytest.approx(
        float(em.em("pose").mixture().log_prob(held_out).mean()), abs=1e-9
    )


def test_bad_states_end_the_fit_and_name_the_block():
    bad = states(BLOCK + 100)
    sources = {Key("pose"): TensorSource(bad)}
    em = module(sources)
    bad[-1, 0] = torch.nan
    with pytest.raises(InputError, match=r"mixture 'pose', block 1 of 2: states must be finite"):
        em.training_step(next(iter(SweepLoader(sources, epochs=em.epoch_of))), 0)


def test_more_components_than_states():
    with pytest.raises(InputError, match="mixture 'pose': "):
        module({Key("pose"): TensorSource(states(5))}, n_components=9)


@pytest.mark.parametrize(("device", "precision"), [("mps", "32-true"), ("cpu", "bf16-mixed")])
def test_single_precision_is_refused(device, precision):
    em = MixtureEM()
    em._trainer = SimpleNamespace(
        strategy=SimpleNamespace(root_device=torch.device(device)), precision=precision
    )
    with pytest.raises(InputError, match="double precision"):
        em.setup("fit")


def test_other_data_are_refused():
    em = MixtureEM()
    em._trainer = SimpleNamespace(
        strategy=SimpleNamespace(root_device=torch.device("cpu")), precision="32-true",
        datamodule=None,
    )  # fmt: skip
    with pytest.raises(InputError, match=r"set data\.class_path to train\.data\."):
        em.setup("fit")


def test_statistics_are_packed_as_the_library_does():
    em = StreamedEM.start(TensorSource(states(100)), 2)
    sums = em.accumulate(TensorSource(states(100)))
    again = SufficientStatistics.unpack(sums.pack(), 2)
    assert all(torch.equal(a, b) for a, b in zip(again, sums, strict=True))


def people(*names):
    return [
        Recording(torch.rand(40, 8, 3).double(), UPPER_BODY, 30.0, name, source="x")
        for name in names
    ]


def test_split_by_person():
    recordings = people("a", "b", "a", "c")
    train, watched = split(recordings, None, ["c"])
    assert [r.person for r in train] == ["a", "b", "a"] and [r.person for r in watched] == ["c"]
    train, watched = split(recordings, ["x#b"], ["c"])
    assert [r.person for r in train] == ["b"]
    twin = people("d")[0]
    twin.joints = recordings[1].joints.clone()
    with pytest.raises(OverlapError):
        split([*recordings, twin], None, ["d"])


def test_other_people_in_the_file_of_a_held_out_person_are_on_neither_side():
    alice, friend, bob, other = people("a", "a", "b", "b")
    for recording, file in ((alice, "a"), (friend, "a"), (bob, "b"), (other, "b")):
        recording.path = Path(f"{file}.csv")
    friend.companion = other.companion = 1
    train, watched = split([alice, friend, bob, other], None, ["a"])
    assert [r.person_id for r in train] == ["x#b", "x#b+1"]
    assert [r.person_id for r in watched] == ["x#a"]


def test_held_out_persons_have_the_neck_of_the_training(tmp_path):
    low = lowered_neck(poses(60, seed=2))
    for name, joints in {"a": poses(60, seed=1), "b": low}.items():
        np.savez(
            tmp_path / f"{name}.npz", joints=joints.numpy(), names=np.array(UPPER_BODY), fps=30.0,
            subject=name, source="x", axes="camera",
        )  # fmt: skip
    recipe = UpperBodyRecipe(n_components=2, n_samples=300, window_components=0)
    data = RecordingsDataModule([str(tmp_path)], recipe, None, held_out=["b"])
    data.setup("fit")
    assert Key("pose", held_out=True) in data.sources
    assert len(data.sources_by_person()) == 1
    assert data._watched_recipe().poses(data.watched, data.train).facts["neck"] == "neck"


def test_fingerprints_tell_recordings_apart():
    recordings = people("a", "b")
    first = fingerprint(recordings)
    assert first["count"] == 2 and first["frames"] == 80 and first["persons"] == ["x#a", "x#b"]
    recordings[0].joints = recordings[0].joints.clone()
    assert fingerprint(recordings) == first
    recordings[0].joints[3, 2, 1] += 1e-6
    assert fingerprint(recordings)["sha256"] != first["sha256"]


def test_identity_of_a_checkpoint():
    wanted = {"model": "MixtureEM", "recipe": {"seed": 1}}
    kept = {"identity": wanted, "held_out": {}, "stopped": False}
    assert check_identity(kept, wanted, "x.ckpt") == kept
    with pytest.raises(FileFormatError, match=r"x\.ckpt: expected a checkpoint of MixtureEM"):
        check_identity(None, wanted, "x.ckpt")
    other = {"model": "FineTuning", "recipe": {"seed": 2}}
    with pytest.raises(
        InputError, match="model was MixtureEM, is FineTuning; recipe seed was 1, is 2"
    ):
        check_identity(kept, other, "x.ckpt")


def test_failure_of_one_process_is_that_of_all():
    assert first_failure([(1, ""), (2, "")]) == [1, 2]
    with pytest.raises(InputError, match="second"):
        first_failure([(1, ""), (2, "second")])


def test_variables_in_paths(monkeypatch):
    monkeypatch.setenv("PLACE", "/data")
    assert expand_path("$PLACE/x") == expand_path("${PLACE}/x") == "/data/x"
    monkeypatch.delenv("PLACE")
    with pytest.raises(InputError, match="PLACE is not set"):
        expand_path("$PLACE/x")
