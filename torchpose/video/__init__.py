"""Read video from files, folders of images and cameras; write H.264 files that a browser plays."""

from torchpose._core.facade import set_up_facade
from torchpose.video._overlay import draw_overlay
from torchpose.video._silhouettes import SilhouetteMeasurer, read_silhouettes
from torchpose.video._source import open_video
from torchpose.video._source_interface import VideoFrame, VideoSource
from torchpose.video._writer import VideoWriter

__all__ = [
    "SilhouetteMeasurer",
    "VideoFrame",
    "VideoSource",
    "VideoWriter",
    "draw_overlay",
    "open_video",
    "read_silhouettes",
]

set_up_facade(__name__)
