"""Video in and out: files, folders of images and cameras; H.264 files that a browser plays."""

from torchpose._core.facade import set_up_facade
from torchpose.video.base import Image, VideoFrame, VideoSource
from torchpose.video.camera import CameraSource
from torchpose.video.file import FileSource
from torchpose.video.images import FolderSource
from torchpose.video.prefetch import prefetch
from torchpose.video.silhouettes import SilhouetteMeasurer, fit_view, read_silhouettes
from torchpose.video.source import open_video
from torchpose.video.writer import VideoWriter

__all__ = [
    "CameraSource",
    "FileSource",
    "FolderSource",
    "Image",
    "SilhouetteMeasurer",
    "VideoFrame",
    "VideoSource",
    "VideoWriter",
    "fit_view",
    "open_video",
    "prefetch",
    "read_silhouettes",
]

set_up_facade(__name__)
