"""Rendered performers: video with known truth, for the demo, the benchmarks and the tests."""

from torchpose.rendering.look import LOOKS, Look
from torchpose.rendering.performances import PERFORMANCES, crossing, performance
from torchpose.rendering.performer import render_performance
from torchpose.rendering.scene import Scene
from torchpose.rendering.truth import Truth, performance_truth, render_video

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
