"""Render performers: video with ground truth, for the demo, the benchmarks and the tests."""

from torchpose.demo._rendering.look import LOOKS, Look
from torchpose.demo._rendering.performer import (
    Truth,
    performance_truth,
    render_performance,
    render_video,
)
from torchpose.demo._rendering.scene import Scene

__all__ = [
    "LOOKS",
    "Look",
    "Scene",
    "Truth",
    "performance_truth",
    "render_performance",
    "render_video",
]
