"""The fit of the network that lifts arms: what it draws, and whom it leaves out."""

import torch

from benchmarks import arm_lifter
from benchmarks.arm_lifter import LEFT_OUT, LEFT_OUT_PERSONS, main
from tests.data import data_with
from tests.upper_body.test_articulated import body
from torchpose.priors._arm_lifter import INPUTS, JOINTS, ArmLifter
from torchpose.priors._arms import shipped_arm_prior


def test_examples_have_arms_of_persons_and_hide_joints():
    draw = arm_lifter._Examples([(1.0, [body(60), body(50, depth=3.0)])], shipped_arm_prior())
    seen, ends = draw()
    lengths = ends[..., 0, :].norm(dim=-1), ends.diff(dim=-2).norm(dim=-1)
    for length in lengths:
        assert float(length.min()) > 0.15 and float(length.max()) < 0.5
    given = seen[..., -1 - len(JOINTS) : -1]
    assert seen.shape[-1] == INPUTS and 0.5 < float(given.mean()) < 0.9
    assert not torch.equal(seen[0, 0], seen[1, 0])
    assert seen[..., -1].unique().tolist() == [1.0]
    assert draw()[0][..., -1].unique().tolist() == [0.0]  # wrists and hands in turns


def test_a_quick_fit_writes_a_network_that_says_whom_it_left_out(tmp_path):
    data = data_with("burke_kinect")
    main(data=data, fit=tmp_path / "arms.safetensors", threads=1, quick=True)
    info = ArmLifter.load(tmp_path / "arms.safetensors").info
    assert info.recordings == ("burke_kinect",) and info.left_out == ()
    assert LEFT_OUT == "mocap_berkeley_mhad"
    assert LEFT_OUT_PERSONS == {"kinect_utd_mhad": ("s7", "s8")}


def test_persons_are_left_out(monkeypatch):
    asked = []
    monkeypatch.setattr(arm_lifter, "ArmExamples", lambda sets, *_: asked.append(sets))
    monkeypatch.setattr(arm_lifter, "train_lifter", lambda *_: None)
    data = data_with("burke_kinect")
    for persons in ({}, {"burke_kinect/kinect_joints.npz": ("burke01",)}):
        arm_lifter.fit_without(data, None, shipped_arm_prior(), True, persons)
    whole, nobody = asked[0], asked[2]
    assert len(whole[0][1]) == 1 and not nobody[0][1]
