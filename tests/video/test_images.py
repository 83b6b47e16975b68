"""Folders of images."""

import cv2
import numpy as np
import pytest

from tests.video.make import number_of, numbered
from torchpose.errors import FileFormatError, InputError
from torchpose.video import open_video
from torchpose.video._images import FolderSource, find_images, natural_key


def save(path, image, *options):
    """Write an RGB(A) or grey image."""
    code = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}.get(image.shape[-1])
    assert cv2.imwrite(str(path), image if code is None else cv2.cvtColor(image, code), [*options])
    return path


def make_folder(folder, names):
    folder.mkdir(exist_ok=True)
    for i, name in enumerate(names):
        save(folder / name, numbered(i))
    return folder


def numbers(source):
    return [number_of(frame.image) for frame in source]


@pytest.mark.parametrize("suffix", ["png", "jpg", "jpeg", "bmp", "tif", "tiff", "webp", "PNG"])
def test_every_kind_of_image(tmp_path, suffix):
    folder = make_folder(tmp_path / "f", [f"{i}.{suffix}" for i in range(12)])
    with open_video(folder, fps=25) as source:
        assert (source.fps, source.size, source.n_frames, source.notes) == (25, (64, 48), 12, [])
        frames = list(source)
    assert [number_of(frame.image) for frame in frames] == list(range(12))
    assert [frame.time for frame in frames] == [i / 25 for i in range(12)]
    assert [frame.index for frame in frames] == list(range(12))
    assert all(frame.image.flags.c_contiguous for frame in frames)


def test_colours_are_rgb(tmp_path):
    save(tmp_path / "1.png", np.full((4, 6, 3), (200, 100, 50), np.uint8))
    with open_video(tmp_path) as source:
        assert next(source).image[2, 3].tolist() == [200, 100, 50]


def test_natural_order():
    ordered = sorted(["f10", "f9", "f1", "f100", "f2"], key=natural_key)
    assert ordered == ["f1", "f2", "f9", "f10", "f100"]
    assert sorted(["a2b10", "a2b9", "a10b1"], key=natural_key) == ["a2b9", "a2b10", "a10b1"]
    assert sorted(["x", "10", "9"], key=natural_key) == ["9", "10", "x"]


def test_other_files_are_left_alone(tmp_path):
    make_folder(tmp_path, ["f1.png", "f2.png"])
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / "._f1.png").write_bytes(b"left by another system")
    (tmp_path / "more.png").mkdir()
    assert [path.name for path in find_images(tmp_path)] == ["f1.png", "f2.png"]


def test_the_rate_is_assumed_and_said(tmp_path):
    with open_video(make_folder(tmp_path / "f", ["1.png", "2.png"])) as source:
        assert source.fps == 30
        assert "30 frames per second are assumed" in source.notes[0]


def test_gaps_in_the_numbers_are_said(tmp_path):
    folder = make_folder(tmp_path / "f", [f"{i:03d}.png" for i in (1, 2, 5, 6)])
    with open_video(folder, fps=30) as source:
        assert numbers(source) == [0, 1, 2, 3]
        assert "have gaps" in source.notes[0]


def test_reopen(tmp_path):
    first = open_video(make_folder(tmp_path / "f", ["1.png", "2.png"]), fps=10)
    assert first.reopenable
    assert numbers(first) == [0, 1]
    with first.reopen() as second:
        assert second.fps == 10
        assert numbers(second) == [0, 1]
    first.close()
    with pytest.raises(InputError, match="closed"):
        next(first)


def test_grey_16_bit_and_transparent(tmp_path):
    save(tmp_path / "1.png", np.full((8, 9), 77, np.uint8))
    save(tmp_path / "2.png", np.full((8, 9, 3), (40 * 256, 99, 65535), np.uint16))
    transparent = np.full((8, 9, 4), (200, 100, 50, 255), np.uint8)
    transparent[4:, :, 3] = 0
    save(tmp_path / "3.png", transparent)
    with open_video(tmp_path) as source:
        images = [frame.image for frame in source]
    assert [image.shape for image in images] == [(8, 9, 3)] * 3
    assert (images[0] == 77).all()
    assert (images[1] == (40, 0, 255)).all()
    assert (images[2] == (200, 100, 50)).all()


@pytest.mark.parametrize(
    ("image", "note"),
    [
        (np.full((8, 9), 60_000, np.uint16), "16-bit images: the upper 8 bits are used"),
        (np.full((8, 9), 4000, np.uint16), "they use the lower 12 only"),
        (np.full((8, 9, 4), 200, np.uint8), "transparency of the images is ignored"),
    ],
)
def test_unusual_images_are_said(tmp_path, image, note):
    save(tmp_path / "1.png", image)
    with open_video(tmp_path, fps=30) as source:
        assert note in source.notes[0]


def test_float_images_are_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "1.tif"), np.full((8, 9, 3), 0.5, np.float32))
    with pytest.raises(FileFormatError, match=r"1\.tif.*not an image of 8 or 16 bits"):
        open_video(tmp_path)


def exif_orientation(data, value):
    """A JPEG with the orientation that a phone would write."""
    tiff = (
        b"MM\0*\0\0\0\x08\0\x01" + b"\x01\x12\0\x03\0\0\0\x01" + bytes([0, value, 0, 0]) + bytes(4)
    )
    body = b"Exif\0\0" + tiff
    return data[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + data[2:]


def test_orientation_of_photographs(tmp_path):
    image = np.zeros((48, 64, 3), np.uint8)
    image[:24, :32] = 200
    path = save(tmp_path / "1.jpg", image)
    path.write_bytes(exif_orientation(path.read_bytes(), 6))  # to be turned clockwise
    upright = save(tmp_path / "2.jpg", np.rot90(image, -1).copy())
    with open_video(tmp_path) as source:
        assert source.size == (48, 64)
        first, second = (frame.image.astype(int) for frame in source)
    assert upright.exists()
    assert np.abs(first - second).mean() < 2
    assert np.abs(first - np.rot90(image, -1)).mean() < 2


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp"])
def test_the_odd_size_is_named_at_once(tmp_path, suffix):
    make_folder(tmp_path, [f"{i}.{suffix}" for i in range(5)])
    save(tmp_path / f"3.{suffix}", numbered(3, (66, 48)))
    with pytest.raises(FileFormatError, match=rf"3\.{suffix}: expected 64x48 .*got 66x48"):
        open_video(tmp_path)


def test_the_odd_size_is_named_when_it_comes(tmp_path):
    make_folder(tmp_path, [f"{i}.webp" for i in range(5)])
    save(tmp_path / "3.webp", numbered(3, (66, 48)))
    with open_video(tmp_path) as source:
        assert [next(source).index for _ in range(3)] == [0, 1, 2]
        with pytest.raises(FileFormatError, match=r"3\.webp: expected 64x48 .*got 66x48"):
            next(source)


@pytest.mark.parametrize("data", [b"", b"no image", b"\x89PNG\r\n\x1a\n"])
def test_a_first_image_that_cannot_be_read(tmp_path, data):
    make_folder(tmp_path, ["1.png", "2.png"])
    (tmp_path / "1.png").write_bytes(data)
    with pytest.raises(FileFormatError, match=r"1\.png: the first image cannot be read"):
        open_video(tmp_path)


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp", "tif", "webp"])
def test_a_damaged_image_repeats_the_one_before(tmp_path, suffix):
    make_folder(tmp_path, [f"{i}.{suffix}" for i in range(6)])
    data = (tmp_path / f"3.{suffix}").read_bytes()
    (tmp_path / f"3.{suffix}").write_bytes(data[: len(data) // 2])
    (tmp_path / f"4.{suffix}").write_bytes(b"")
    with open_video(tmp_path, fps=30) as source:
        frames = []
        for frame in source:
            frames.append(number_of(frame.image))
            frame.image[:] = 0
    assert frames == [0, 1, 2, 2, 2, 5]
    assert f"2 of 6 images cannot be read (3.{suffix}, 4.{suffix})" in source.notes[0]


def test_an_image_that_vanishes_is_missing(tmp_path):
    make_folder(tmp_path, [f"{i}.png" for i in range(4)])
    with open_video(tmp_path, fps=30) as source:
        (tmp_path / "2.png").unlink()
        assert numbers(source) == [0, 1, 1, 3]
    assert "1 of 4 images cannot be read (2.png)" in source.notes[0]


def test_folders_without_images(tmp_path):
    (tmp_path / "clip.mp4").write_bytes(b"x")
    with pytest.raises(InputError, match="found none among its 1 files"):
        open_video(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        FolderSource(tmp_path / "missing")
    with pytest.raises(InputError, match="is no folder"):
        FolderSource(tmp_path / "clip.mp4")
    with pytest.raises(InputError, match="fps must be positive"):
        FolderSource(tmp_path, fps=0)
