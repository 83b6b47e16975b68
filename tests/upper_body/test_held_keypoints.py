"""Hidden arms are held where they were last seen: by a loop over frames, in blocks, and in poses."""

import numpy as np
import pytest
import torch

from tests.upper_body.test_articulated import ROW, body, pixels, tracker
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body._absence import Absence
from torchpose.upper_body._held_keypoints import hold_hidden
from torchpose.upper_body._measured_joints import MeasuredJoints

RATE = 30.0
NECK = UPPER_BODY.index("neck")
ARMS = [[UPPER_BODY.index(f"{joint}_{side}") for joint in ("shoulder", "elbow", "hand")]
        for side in ("left", "right")]  # fmt: skip
SPEEDS = (0.25, 0.55, 1.0)


def walks(n_frames=80, share=0.5, seed=0):
    """Return two noisy walks in which each joint is missing in long stretches."""
    generator = torch.Generator().manual_seed(seed)
    uv = torch.randn(2, n_frames, 8, 2, generator=generator, dtype=torch.float64).cumsum(1) + 300
    there = torch.rand(2, n_frames // 5, 8, generator=generator) < share
    mask = there.repeat_interleave(5, 1)
    cov = (4.0 + torch.rand(2, n_frames, 8, 1, 1, generator=generator)) * torch.eye(2).double()
    return MeasuredJoints(uv * mask[..., None], mask, cov.double())


def held_by_a_loop(uv, mask, cov):
    """Return the same of one sequence, frame by frame."""
    uv, mask, cov = uv.copy(), mask.copy(), cov.copy()
    seen, moved = mask.copy(), np.zeros((len(uv), 2, 2))
    known, last = mask.copy(), {}
    for t in range(len(uv)):
        for side, arm in enumerate(ARMS):
            chain = list(zip(arm, [NECK, *arm[:2]], SPEEDS, strict=True))
            hidden = not known[t, arm[1:]].any()
            here = {j: (uv[t, j].copy() if known[t, j] else None) for j in (NECK, *arm)}
            for joint, start, speed in chain:
                if known[t, joint]:
                    last[joint] = t, uv[t, joint].copy(), here[start], cov[t, joint].copy()
                    continue
                frame, place, before, noise = last.get(joint, (-1e9, None, None, None))
                time = (t - frame) / RATE
                if joint in arm[1:] and (hidden or joint == arm[2]):
                    s = speed * time / (1 + (time / 0.7) ** 2) * (1.0 if hidden else 0.5)
                    moved[t, side, arm.index(joint) - 1] = s**2
                if hidden and time <= 1:
                    now = uv[t, start] if mask[t, start] else None
                    shift = 0 if now is None or before is None else now - before
                    uv[t, joint], mask[t, joint], cov[t, joint] = place + shift, True, 9 * noise
                    seen[t, joint] = False
    return uv, mask, cov, seen, moved


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_arms_are_held_as_a_loop_holds_them(share):
    measured = walks(share=share)
    found = hold_hidden(measured, None, RATE)
    for b in range(2):
        expected = held_by_a_loop(*(x[b].numpy() for x in measured[:3]))
        held = found.measured
        ours = held.uv[b], held.mask[b], held.cov[b], held.seen[b], found.moved[b]
        there = expected[1]
        assert there.sum() > measured.mask[b].sum()  # some are held
        for own, wanted in zip(ours, expected, strict=True):
            same = there if own.shape[:2] == there.shape else np.ones(len(there), bool)
            np.testing.assert_allclose(own.numpy()[same], wanted[same], atol=1e-9)
        np.testing.assert_array_equal(ours[1], there)


@pytest.mark.parametrize("rate", [RATE, 20.0])  # 20 times 1 / 20 is more than a second, by rounding
@pytest.mark.parametrize("sizes", [(1,) * 80, (7, 1, 40, 32)])
def test_blocks_of_frames_are_held_as_the_whole(sizes, rate):
    measured, last, parts = walks(share=0.3), None, []
    whole = hold_hidden(measured, None, rate)
    for block in zip(*(x.split(sizes, 1) for x in measured[:3]), strict=True):
        held = hold_hidden(MeasuredJoints(*block), last, rate)
        last = held.last
        parts.append(held)
    for name in ("uv", "mask", "cov"):
        cov = [
            getattr(p.measured, name).expand(
                *p.measured.mask.shape, *getattr(measured, name).shape[3:]
            )
            for p in parts
        ]
        torch.testing.assert_close(torch.cat(cov, 1), getattr(whole.measured, name))
    moved = [torch.zeros(2, n, 2, 2) if p.moved is None else p.moved
             for p, n in zip(parts, sizes, strict=True)]  # fmt: skip
    torch.testing.assert_close(torch.cat([x.double() for x in moved], 1), whole.moved)


def test_what_is_measured_is_left_alone():
    measured = walks(share=1.1)
    found = hold_hidden(measured, None, RATE)
    assert found.measured is measured and found.moved is None
    elbows = measured._replace(mask=measured.mask.clone())
    elbows.mask[:, 3:, [arm[1] for arm in ARMS]] = False
    assert hold_hidden(elbows, None, RATE).measured is elbows  # hands tell of the arms


def test_a_hand_that_is_rather_outside_of_the_image_is_not_held():
    measured = walks(10, 1.1)
    mask = measured.mask.clone()
    mask[:, 5:, ARMS[0][1:] + ARMS[1][1:]] = False
    outside = torch.zeros(2, 10, 2).double()
    outside[0, :, 1] = -2.0
    missing = measured._replace(mask=mask, absence=Absence(outside, torch.zeros(4, 3).double()))
    held = hold_hidden(missing, None, RATE).measured.mask
    assert held[:, 5:, [arm[1] for arm in ARMS]].all()
    assert held[0, 5:, ARMS[0][2]].all() and not held[0, 5:, ARMS[1][2]].any() and held[1].all()


def test_a_hidden_arm_moves_with_its_shoulder_and_is_drawn_where_it_was_held():
    joints = body(1).expand(40, -1, -1).clone()
    joints[20:] = joints[20:] + joints.new_tensor([0.2, 0.0, 0.0])  # a step to the side
    seen = pixels(joints)
    keypoints = seen.clone()
    keypoints[20:, [ROW["elbow_left"], ROW["hand_left"]]] = torch.nan
    found = tracker()(keypoints[None])
    for name, most in (("elbow_left", 7.0), ("hand_left", 13.0)):
        away = (found.joints2d[0, 22:30, ROW[name]] - seen[22:30, ROW[name]]).norm(dim=-1)
        assert float(away.max()) < most, name
    assert not bool(found.observed[0, 20:, ROW["hand_left"]].any())
    std = found.covariance3d[0, :, ROW["hand_left"]].diagonal(dim1=-2, dim2=-1).mean(-1).sqrt()
    assert float(std[30]) > float(std[21]) > float(std[19])
