"""Video in and out: files, folders of images and cameras; H.264 files that a browser plays."""

from torchpose._core.facade import set_up_facade
from torchpose.video._base import VideoFrame, VideoSource
from torchpose.video._camera import CameraSource
from torchpose.video._file import FileSource
from torchpose.video._images import FolderSource
from torchpose.video._silhouettes import SilhouetteMeasurer, read_silhouettes
from torchpose.video._source import open_video
from torchpose.video._writer import VideoWriter

__all__ = [
    "CameraSource",
    "FileSource",
    "FolderSource",
    "SilhouetteMeasurer",
    "VideoFrame",
    "VideoSource",
    "VideoWriter",
    "open_video",
    "read_silhouettes",
]

set_up_facade(__name__)
