"""A video with the truth beside it."""

import numpy as np
import pytest

from benchmarks._performances import crossing
from tests.demo.rendering.frames import CAMERA
from torchpose.demo import performer
from torchpose.demo._rendering import (
    Scene,
    performance_truth,
    render_performance,
    render_video,
)
from torchpose.skeleton import UPPER_BODY
from torchpose.video import open_video


def test_video_and_truth_agree_with_what_was_asked_for(tmp_path):
    clip = performer(12)
    scene = Scene(noise=1.0)
    (truth,) = render_video(tmp_path / "clip.mp4", clip, CAMERA, scene=scene)
    with open_video(tmp_path / "clip.mp4") as source:
        frames = [frame.image for frame in source]
        assert source.fps == 30 and source.size == (640, 480)
    assert len(frames) == 12
    rendered = list(render_performance(clip, CAMERA, scene=scene))
    error = np.abs(np.stack(frames).astype(int) - np.stack(rendered))
    assert error.mean() < 4
    saved = np.load(tmp_path / "truth.npz")
    np.testing.assert_array_equal(saved["joints3d"], clip.joints.numpy())
    np.testing.assert_array_equal(saved["joints2d"], truth.joints2d.numpy())
    assert saved["occluded"].shape == (12, 8) and saved["occluded"].dtype == bool
    assert tuple(saved["names"]) == UPPER_BODY and tuple(saved["labels"]) == clip.labels
    assert saved["fps"] == 30 and saved["image_size"].tolist() == [640, 480]
    np.testing.assert_array_equal(saved["K"], CAMERA.matrix.numpy())


def test_every_performer_has_a_file(tmp_path):
    pair = crossing(2)
    target = tmp_path / "known.npz"
    render_video(tmp_path / "pair.mp4", pair, CAMERA, fps=25, truth=target)
    for clip, path, truth in zip(
        pair, [target, tmp_path / "known_p02.npz"], performance_truth(pair, CAMERA), strict=True
    ):
        saved = np.load(path)
        np.testing.assert_array_equal(saved["joints3d"], clip.joints.numpy())
        np.testing.assert_array_equal(saved["occluded"], truth.occluded.numpy())
        assert saved["fps"] == 25


def test_the_name_must_be_that_of_a_video(tmp_path):
    with pytest.raises(ValueError, match=r"\.mp4"):
        render_video(tmp_path / "clip.txt", performer(1), CAMERA)
    assert not list(tmp_path.iterdir())
