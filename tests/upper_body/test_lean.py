"""Torsos that lean to a side: seen as a camera sees them that leans as they do."""

import math

import pytest
import torch

from tests.upper_body.test_articulated import ROW, body, pixels, tracker
from torchpose.upper_body._lean import lean_angle, roll, seen_lean

KNOWN = torch.ones(1, 8, dtype=torch.bool)
DEPTH = torch.tensor([2.0], dtype=torch.float64)


def settled(joints, known=KNOWN, frames=60):
    rays = (joints / joints[..., 2:])[None]
    moments = torch.zeros(1, 2, dtype=torch.float64)
    for _ in range(frames):
        moments = seen_lean(moments, rays, known, DEPTH, 30.0)
    return math.degrees(float(lean_angle(moments)))


def turned_about_the_axis(joints, degrees):
    """Return joints [T, 8, 3] turned about an axis along the view through the first neck."""
    neck = joints[:1, [ROW["neck"]]]
    angle = torch.full((len(joints),), math.radians(degrees), dtype=torch.float64)
    return (joints - neck) @ roll(angle).mT + neck


@pytest.mark.parametrize("turn", [0.0, 0.5, math.pi])
def test_lines_between_shoulders_tell_the_lean_before_and_behind(turn):
    joints = body(1, turn=turn, depth=2.0)
    assert abs(settled(joints[0])) < 2
    for degrees in (-45, 45):
        found = settled(turned_about_the_axis(joints, degrees)[0])
        assert found * degrees > 0 and 30 < abs(found) < 46


def test_raised_shoulders_and_side_views_are_no_lean():
    raised = body(1, depth=2.0)[0]
    raised[ROW["shoulder_left"], 1] -= 0.05
    assert abs(settled(raised)) < 3
    side = body(1, turn=math.pi / 2, depth=2.0)[0]
    side[ROW["shoulder_left"], 1] -= 0.05
    assert abs(settled(side)) < 3


def test_without_both_shoulders_the_lean_stays():
    known = KNOWN.clone()
    known[0, ROW["shoulder_left"]] = False
    assert settled(turned_about_the_axis(body(1, depth=2.0), 45)[0], known) == 0.0


def test_a_leaning_body_is_followed():
    """Arms of a body that leans by 45 degrees err about as much as those of an upright one."""
    upright = body(45)
    errors = []
    for joints in (upright, turned_about_the_axis(upright, 45)):
        track = tracker()(pixels(joints, 2.0)[None])
        off = []
        for side in ("left", "right"):
            ends = [ROW[f"shoulder_{side}"], ROW[f"hand_{side}"]]
            arm = (x[:, ends].diff(dim=1)[:, 0] for x in (track.joints3d[0], joints))
            found, true = arm
            off.append(torch.linalg.vector_norm(found - true, dim=-1)[15:].mean())
        errors.append(float(torch.stack(off).mean()))
        variances = torch.linalg.eigvalsh(track.covariance3d)
        assert bool((variances > 0).all())
    assert errors[1] < errors[0] + 0.04
