"""Rendered performers: video with known truth, for the demo, the benchmarks and the tests."""

from torchpose._core.facade import set_up_facade
from torchpose.demo.rendering.look import LOOKS, Look
from torchpose.demo.rendering.performances import PERFORMANCES, crossing, performance
from torchpose.demo.rendering.performer import render_performance
from torchpose.demo.rendering.scene import Scene
from torchpose.demo.rendering.truth import Truth, performance_truth, render_video

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

set_up_facade(__name__)
