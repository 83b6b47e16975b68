"""Render performers: video with ground truth, for the demo, the benchmarks and the tests."""

from torchpose.demo._rendering.look import LOOKS, Look
from torchpose.demo._rendering.performances import PERFORMANCES, crossing, performance
from torchpose.demo._rendering.performer import (
    Truth,
    performance_truth,
    render_performance,
    render_video,
)
from torchpose.demo._rendering.scene import Scene

__all__ = [
    "LOOKS",
    "PERFORMANCES",
    "Look",
    "Scene",
    "Truth",
    "crossing",
    "performance",
    "performance_truth",
    "render_performance",
    "render_video",
]
