"""The animated walk: angles of textbooks, feet on the floor, another body than the average; its videos."""

import math

import cv2
import numpy as np
import pytest
import torch

from torchpose.body import BODY_15, Body
from torchpose.demo._rendering.walk import (
    cameras_around,
    empty_scene,
    gait_angles,
    render_body_video,
    walk,
    walk_clip,
)
from torchpose.errors import InputError
from torchpose.video import open_video


def joint(one, name):
    return one.joints[:, BODY_15.joint(name)]


def angle_at(one, middle, a, b):
    """Angle of the bend at a joint, degrees, from three places."""
    p, q, r = (joint(one, name) for name in (a, middle, b))
    cosine = torch.nn.functional.cosine_similarity(p - q, r - q, dim=-1)
    return 180 - torch.rad2deg(torch.acos(cosine.clamp(-1, 1)))


def test_knees_bend_as_the_curves_say():
    one = walk(3.0, fps=60.0, cadence=1.0)
    for side in ("left", "right"):
        bend = angle_at(one, f"{side}_knee", f"{side}_hip", f"{side}_ankle")
        assert 64 < float(bend.max()) < 70 and 8 < float(bend.min()) < 13
        # the shank goes back: the ankle is behind the line of the thigh
        most = int(bend.argmax())
        assert float(joint(one, f"{side}_ankle")[most, 2] - joint(one, f"{side}_knee")[most, 2]) < 0
    phase = torch.linspace(0, 2, 400, dtype=torch.float64)
    angles = gait_angles(phase)
    for values in angles.values():
        torch.testing.assert_close(
            values[:200], gait_angles(phase[:200] + 1)[_name(angles, values)]
        )
        assert float(values.diff().abs().max()) < math.radians(4)  # no jump, not where cycles meet


def _name(angles, wanted):
    return next(name for name, values in angles.items() if values is wanted)


def test_the_foot_that_carries_stays_and_the_walker_gets_on():
    one = walk(3.0, fps=60.0)
    ankles = torch.stack([joint(one, f"{side}_ankle") for side in ("left", "right")], 1)
    lowest = ankles[..., 1].min(1).values
    assert float((lowest - 0.08).abs().max()) < 0.01
    speed = 60 * ankles.diff(dim=0).norm(dim=-1)
    assert float(speed.min(1).values.median()) < 0.25 < 2.0 < float(speed.max())
    way = joint(one, "pelvis")[-1] - joint(one, "pelvis")[0]
    assert 0.9 < float(way[2]) / 3.0 < 1.5 and abs(float(way[1])) < 0.1
    # arms swing against the legs
    swing = joint(one, "left_wrist")[:, 2] - joint(one, "pelvis")[:, 2]
    stride = joint(one, "left_ankle")[:, 2] - joint(one, "pelvis")[:, 2]
    both = torch.stack([swing - swing.mean(), stride - stride.mean()])
    assert float(torch.corrcoef(both)[0, 1]) < -0.7


def test_it_is_another_body_than_the_trackers():
    one, average = walk(1.0, height=1.8), Body.of_height(BODY_15, 1.8)
    ratio = (one.body.bone_lengths / average.bone_lengths)[1:]
    assert float(ratio.max()) > 1.03 and float(ratio.min()) < 0.97
    torch.testing.assert_close(one.body.joints(one.states), one.joints)
    again, other = walk(1.0, height=1.8), walk(1.0, height=1.8, seed=1)
    assert torch.equal(again.joints, one.joints) and not torch.equal(other.joints, one.joints)


def test_its_videos_show_it_where_it_is(tmp_path):
    one = walk(0.2, fps=30.0)
    cameras = cameras_around(walk_clip(one))[:2]
    videos, scenes = render_body_video(tmp_path, one, cameras, seed=1)
    for camera, video, scene in zip(cameras, videos, scenes, strict=True):
        empty = cv2.imread(str(scene))[..., ::-1].astype(float)
        with open_video(video) as source:
            frames = [frame.image for frame in source]
        assert len(frames) == len(one.joints) == 6
        changed = np.abs(frames[0].astype(float) - empty).max(-1) > 40
        seen = camera(one.joints[0])[:, :2].round().long().tolist()
        for name, (u, v) in zip(BODY_15.names, seen, strict=True):
            assert changed[v - 2 : v + 3, u - 2 : u + 3].any(), name
        rows, columns = np.nonzero(changed)
        pixels = camera(one.joints[0])[:, :2]
        assert rows.min() < float(pixels[:, 1].min()) and columns.mean() == pytest.approx(
            float(pixels[:, 0].mean()), abs=20
        )


def test_refusals():
    for bad in ({"seconds": 0.0}, {"fps": math.nan}, {"height": -1.0}, {"cadence": math.inf}):
        with pytest.raises(InputError, match=next(iter(bad))):
            walk(**bad)
    camera = cameras_around(walk_clip(walk(0.5)))[0]
    camera.width = camera.height = None
    with pytest.raises(InputError, match="size"):
        empty_scene(camera)
