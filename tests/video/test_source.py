"""What `open_video` takes its argument for."""

import cv2
import numpy as np
import pytest

from tests.video.make import make_video
from torchpose.errors import InputError
from torchpose.video import _source as module
from torchpose.video import open_video
from torchpose.video._camera import CameraSource
from torchpose.video._file import FileSource
from torchpose.video._images import FolderSource


@pytest.fixture
def in_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    opened = []

    class Camera(module.VideoSource):
        def __init__(self, index, fps):
            super().__init__("camera")
            opened.append((index, fps))

        def _read(self):
            return iter(())

        def _release(self):
            pass

    monkeypatch.setattr(module, "CameraSource", Camera)
    return tmp_path, opened


def test_a_number_is_a_camera(in_folder):
    folder, opened = in_folder
    (folder / "3").mkdir()
    open_video(3, fps=60)
    assert opened == [(3, 60)]
    for wrong in (-1, True, None, b"clip.mp4"):
        with pytest.raises(InputError, match="number"):
            open_video(wrong)


def test_digits_are_a_camera_only_without_such_a_path(in_folder):
    folder, opened = in_folder
    open_video("0")
    open_video("2", fps=60)
    assert opened == [(0, None), (2, 60)]
    (folder / "0").mkdir()
    make_video(folder / "2", 3, format="mp4")
    cv2.imwrite(str(folder / "0" / "1.png"), np.zeros((4, 4, 3), np.uint8))
    with open_video("0") as images, open_video("2") as video:
        assert isinstance(images, FolderSource)
        assert isinstance(video, FileSource)
    assert len(opened) == 2
    open_video("0", kind="camera")
    assert opened[-1] == (0, None)


def test_digits_of_other_scripts_are_no_camera(in_folder):
    _, opened = in_folder
    for text in ("²", "٣", "-1", "1.5", ""):
        with pytest.raises(InputError):
            open_video(text)
    assert opened == []


def test_kind_is_obeyed(tmp_path):
    path = make_video(tmp_path / "a.mp4", 3)
    with open_video(path, kind="file") as source:
        assert isinstance(source, FileSource)
    with pytest.raises(InputError, match="is no folder"):
        open_video(path, kind="folder")
    with pytest.raises(InputError, match="is a folder"):
        open_video(tmp_path, kind="file")
    with pytest.raises(InputError, match="given by its number"):
        open_video(path, kind="camera")
    with pytest.raises(InputError, match="kind must be one of file, folder, camera"):
        open_video(path, kind="vidoe")


def test_devices_and_pipes():
    with pytest.raises(InputError, match="is a device or a pipe"):
        open_video("/dev/null")


def test_cameras_are_sources():
    assert issubclass(CameraSource, module.VideoSource)
