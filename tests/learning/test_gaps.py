"""Gaps of recordings: short ones are filled, recordings are cut at long ones, and notes say so."""

import pytest
import torch

from torchpose.body import BODY_15
from torchpose.errors import InputError
from torchpose.io import Recording
from torchpose.learning._recipes.choosing import recorded_joints
from torchpose.learning._recipes.gaps import fill_short_gaps, notes_on_gaps, whole_pieces

FPS = 30.0
N = 90
ELBOW = BODY_15.joint("left_elbow")


def swinging() -> torch.Tensor:
    """Joints [N, 15, 3] on circles of 0.3 m, one round in 2 seconds."""
    angle = torch.pi * torch.arange(N, dtype=torch.float64)[:, None] / FPS + torch.arange(15)
    return torch.stack([angle.cos(), angle.sin(), 0 * angle], -1) * 0.3


def recording(joints) -> Recording:
    return Recording(joints, BODY_15.names, FPS, "carl", source="set")


def test_short_gaps_are_filled_on_smooth_paths():
    joints = swinging()
    given = joints.clone()
    given[20:25, ELBOW] = torch.nan
    given[23:25, ELBOW + 1] = torch.nan
    given[50] = torch.nan
    filled = fill_short_gaps(given, FPS)
    missing = given.isnan()
    torch.testing.assert_close(filled[~missing], joints[~missing], atol=0, rtol=0)
    assert float((filled - joints).norm(dim=-1).max()) < 0.002
    straight = (joints[19] + joints[25])[ELBOW] / 2
    assert float((straight - joints[22, ELBOW]).norm()) > 0.01
    torch.testing.assert_close(recorded_joints(recording(given), FPS), filled)
    assert notes_on_gaps([recording(joints), recording(given)]) == (
        "6 frames with missing joints are interpolated, in gaps of up to 0.2 s: set#carl",
    )
    assert notes_on_gaps([recording(joints)]) == ()


def test_long_gaps_and_ends_are_not_filled():
    given = swinging()
    given[30:36, ELBOW] = torch.nan
    given[:2, ELBOW] = torch.nan
    torch.testing.assert_close(fill_short_gaps(given, FPS), given, equal_nan=True)
    with pytest.raises(InputError, match="left_elbow is missing in frame 0"):
        recorded_joints(recording(given), FPS)


def test_recordings_are_cut_at_long_gaps():
    given = swinging()
    given[:2, ELBOW] = torch.nan
    given[10, ELBOW] = torch.nan
    given[30:40] = torch.nan
    given[45:60, ELBOW] = torch.nan
    given[:, BODY_15.joint("head")] = torch.nan  # which the set lacks
    (first, last), notes = whole_pieces([recording(given)])
    assert (first.first_frame, len(first)) == (2, 28) and (last.first_frame, len(last)) == (60, 30)
    joints = recorded_joints(first, FPS)
    known = torch.arange(15) != BODY_15.joint("head")
    assert bool(joints[:, known].isfinite().all())
    assert notes == (
        "set#carl: 32 of 90 frames are left out, in or beside gaps of more than 0.2 s",
    )
    whole = recording(swinging())
    assert whole_pieces([whole]) == ([whole], ())
    given[:, ELBOW] = torch.where(torch.arange(N)[:, None] % 15 < 8, torch.nan, given[:, ELBOW])
    with pytest.raises(InputError, match="no half a second"):
        whole_pieces([recording(given)])
