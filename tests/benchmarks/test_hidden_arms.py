"""Gaps are what they are called, the simplest ways fill them, and a quick run prints the table."""

import pytest
import torch

from benchmarks import bones
from benchmarks.hidden_arms import KINDS, filled, hidden
from tests.data import data_with

NAMES = ("wrist_left", "elbow_left", "neck", "wrist_right", "elbow_right")


def view(n_frames):
    nothing = torch.zeros(n_frames, len(NAMES), 2)
    return bones.View(nothing, nothing[..., 0], NAMES, None, "neck", None, 30.0)


def test_gaps_have_their_lengths_and_hide_their_joints():
    limbs = {None: (0, 1, 2, 3, 4), "arm": (0, 1, 3, 4), "hand": (0, 3), "elbow": (1, 4)}
    for kind, (limb, frames, period) in KINDS.items():
        gone = hidden(view(600), kind, number=3)
        assert not bool(gone[:10].any())
        assert [j for j in range(5) if bool(gone[:, j].any())] == [*limbs[limb]], kind
        for joint in limbs[limb]:
            begins = gone[1:, joint] & ~gone[:-1, joint]
            assert int(gone[:, joint].sum()) == pytest.approx(frames / period * 590, rel=0.12)
            starts = begins.nonzero()[:, 0]
            assert set(starts[1:].diff().tolist()) == {period}  # the first gap may be cut short


def test_the_simplest_ways_stay_or_go_straight_on():
    values = torch.arange(6.0)[:, None, None].expand(-1, 2, 1).clone()
    values[2:4] = torch.tensor([[[50.0], [60.0]], [[70.0], [80.0]]])
    gone = torch.tensor([False, False, True, True, False, True])[:, None].expand(-1, 2)
    stay = filled(values, gone, later=False)[..., 0]
    straight = filled(values, gone, later=True)[..., 0]
    assert stay[:, 0].tolist() == [0, 1, 1, 1, 4, 4]
    assert straight[:, 1].tolist() == [0, 1, 2, 3, 4, 4]  # nothing comes after the last one


@pytest.mark.slow
def test_a_quick_run_prints_a_row_for_each_kind_of_gap(run_here, tmp_path):
    data = data_with("mocap_berkeley_mhad")
    printed = run_here("hidden_arms", "--quick", "--data", str(data), "--out", str(tmp_path))
    for kind in KINDS:
        assert f"| s9 to s12 of Berkeley MHAD: {kind} |" in printed
    assert (tmp_path / "hidden_arms.md").read_text().split() == printed.split()
