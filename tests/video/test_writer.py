"""Files that are written: what they hold, when they appear, and what happens when they cannot."""

import errno
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from tests.full_disk import files_up_to
from tests.video.make import number_of, numbered
from torchpose.errors import InputError, MissingDependencyError, OutputError, ShapeError
from torchpose.video import VideoWriter, open_video
from torchpose.video import _writer as module


def write(path, n=20, size=(64, 48), fps=25, **options):
    with VideoWriter(path, fps, size, **options) as writer:
        for i in range(n):
            writer.write(numbered(i, size))
    return writer


def numbers(path):
    with open_video(path) as source:
        assert source.notes == []
        return [number_of(frame.image) for frame in source]


def boxes(path):
    """Names of the outermost boxes of an MP4."""
    data, names, place = path.read_bytes(), [], 0
    while place < len(data):
        names.append(data[place + 4 : place + 8])
        place += int.from_bytes(data[place : place + 4], "big")
    return names


@pytest.mark.parametrize("fps", [25, 29.97, 30000 / 1001, 12.5, 120, 9.673])
def test_frames_and_rate_come_back(tmp_path, fps):
    writer = write(tmp_path / "a.mp4", fps=fps)
    assert writer.frames == 20
    assert writer.notes == []
    assert numbers(tmp_path / "a.mp4") == list(range(20))
    with open_video(tmp_path / "a.mp4") as source:
        assert source.fps == pytest.approx(fps, rel=1e-4)


def test_a_browser_plays_it(tmp_path):
    write(tmp_path / "a.mp4")
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert stream.average_rate == Fraction(25)
        assert (stream.color_range, stream.colorspace) == (1, 1)
    order = boxes(tmp_path / "a.mp4")
    assert order.index(b"moov") < order.index(b"mdat")


def test_another_reader_agrees(tmp_path):
    """OpenCV's own FFmpeg, which knows nothing of this library."""
    write(tmp_path / "a.mp4")
    capture, seen = cv2.VideoCapture(str(tmp_path / "a.mp4")), []
    while (frame := capture.read()[1]) is not None:
        seen.append(number_of(frame))
    assert seen == list(range(20))


@pytest.mark.parametrize("rgb", [(255, 0, 0), (0, 255, 0), (0, 0, 255), (198, 134, 110), (0, 0, 0)])
def test_colours_come_back(tmp_path, rgb):
    with VideoWriter(tmp_path / "a.mp4", 25, (64, 48), crf=5) as writer:
        for _ in range(3):
            writer.write(np.full((48, 64, 3), rgb, np.uint8))
    with open_video(tmp_path / "a.mp4") as source:
        for frame in source:
            np.testing.assert_allclose(frame.image.reshape(-1, 3).mean(0), rgb, atol=3)


@pytest.mark.parametrize(
    ("size", "stored"),
    [((65, 48), (66, 48)), ((64, 49), (64, 50)), ((67, 51), (68, 52)), ((1, 1), (2, 2))],
)
def test_odd_sizes_are_padded_and_it_is_said(tmp_path, size, stored):
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 255, (size[1], size[0], 3), np.uint8), (0, 0), 4)
    image = image.reshape(size[1], size[0], 3)
    with VideoWriter(tmp_path / "a.mp4", 25, size, crf=1) as writer:
        writer.write(image)
    assert writer.notes == [
        f"H.264 needs even sizes: {size[0]}x{size[1]} is padded to {stored[0]}x{stored[1]}"
    ]
    with open_video(tmp_path / "a.mp4") as source:
        assert source.size == stored
        shown = next(source).image[: size[1], : size[0]]
    assert np.abs(shown.astype(int) - image).mean() < 5


def test_views_of_arrays_are_fine(tmp_path):
    big = np.zeros((96, 128, 3), np.uint8)
    big[::2, ::2] = numbered(77)[..., ::-1]
    with VideoWriter(tmp_path / "a.mp4", 25, (64, 48)) as writer:
        writer.write(big[::2, ::2, ::-1])
    assert numbers(tmp_path / "a.mp4") == [77]


def test_quality(tmp_path):
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (48, 64, 3), np.uint8)
    sizes = []
    for crf in (10, 40):
        with VideoWriter(tmp_path / "a.mp4", 25, (64, 48), crf=crf) as writer:
            for _ in range(5):
                writer.write(image)
        sizes.append((tmp_path / "a.mp4").stat().st_size)
    assert sizes[0] > 2 * sizes[1]


# whole or not at all


def test_appears_when_it_is_closed(tmp_path):
    writer = VideoWriter(tmp_path / "a.mp4", 25, (64, 48))
    for i in range(20):
        writer.write(numbered(i))
    assert not (tmp_path / "a.mp4").exists()
    writer.close()
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]
    writer.close()
    assert numbers(tmp_path / "a.mp4") == list(range(20))
    with pytest.raises(InputError, match="is closed"):
        writer.write(numbered(0))


def test_an_exception_leaves_what_was_there(tmp_path):
    write(tmp_path / "a.mp4", 3)
    before = (tmp_path / "a.mp4").read_bytes()
    with pytest.raises(RuntimeError), VideoWriter(tmp_path / "a.mp4", 25, (64, 48)) as writer:
        writer.write(numbered(1))
        raise RuntimeError
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]
    assert (tmp_path / "a.mp4").read_bytes() == before


def test_ctrl_c_keeps_what_was_written(tmp_path):
    with pytest.raises(KeyboardInterrupt), VideoWriter(tmp_path / "a.mp4", 25, (64, 48)) as writer:
        for i in range(7):
            writer.write(numbered(i))
        raise KeyboardInterrupt
    assert numbers(tmp_path / "a.mp4") == list(range(7))


def test_ctrl_c_between_encoder_and_file(tmp_path, monkeypatch):
    """What the encoder has given and the file has not yet got is not lost."""
    with pytest.raises(KeyboardInterrupt), VideoWriter(tmp_path / "a.mp4", 25, (64, 48)) as writer:
        for i in range(60):
            writer.write(numbered(i))
        real = writer._stream

        class Interrupted:
            def encode(self, frame):
                packets = real.encode(frame)
                monkeypatch.setattr(writer, "_stream", real)
                writer._waiting += packets
                raise KeyboardInterrupt

        writer._stream = Interrupted()
        writer.write(numbered(60))
    assert numbers(tmp_path / "a.mp4") == list(range(61))


@pytest.mark.parametrize("interrupt", [False, True])
def test_without_a_frame_there_is_no_file(tmp_path, interrupt):
    if interrupt:
        with pytest.raises(KeyboardInterrupt), VideoWriter(tmp_path / "a.mp4", 25, (64, 48)):
            raise KeyboardInterrupt
    else:
        write(tmp_path / "a.mp4", 0)
    assert list(tmp_path.iterdir()) == []


# what cannot be written


@pytest.mark.parametrize("shape", [(48, 64), (48, 64, 4), (64, 48, 3), (48, 65, 3), (3, 48, 64)])
def test_frames_of_another_shape(tmp_path, shape):
    with VideoWriter(tmp_path / "a.mp4", 25, (64, 48)) as writer:
        writer.write(numbered(5))
        with pytest.raises(ShapeError, match=r"\[48, 64, 3\] \(H, W, RGB\), got"):
            writer.write(np.zeros(shape, np.uint8))
    assert numbers(tmp_path / "a.mp4") == [5]


@pytest.mark.parametrize("kind", [np.float32, np.int64, np.uint16])
def test_frames_of_another_type(tmp_path, kind):
    with VideoWriter(tmp_path / "a.mp4", 25, (64, 48)) as writer:
        with pytest.raises(InputError, match=f"must be uint8 from 0 to 255, got {kind.__name__}"):
            writer.write(np.zeros((48, 64, 3), kind))
        with pytest.raises(ShapeError, match="got no array"):
            writer.write(None)
    assert list(tmp_path.iterdir()) == []


def test_a_slow_series(tmp_path):
    write(tmp_path / "a.mp4", 5, fps=0.05)
    with open_video(tmp_path / "a.mp4") as source:
        assert source.fps == pytest.approx(0.05)
        assert source.n_frames == 5
        assert [number_of(frame.image) for frame in source] == list(range(5))


@pytest.mark.parametrize(
    ("fps", "size", "name", "crf", "message"),
    [
        (0, (64, 48), "a.mp4", 20, "fps must be from 0.01"),
        (float("nan"), (64, 48), "a.mp4", 20, "fps must be from 0.01"),
        (1e9, (64, 48), "a.mp4", 20, "fps must be from 0.01"),
        (25, (0, 48), "a.mp4", 20, "size must be"),
        (25, (64, 99999), "a.mp4", 20, "size must be"),
        (25, (64, 48), "a.avi", 20, "must end in .mp4"),
        (25, (64, 48), "a", 20, "must end in .mp4"),
        (25, (64, 48), "a.mp4", 99, "crf must be from 0 to 51"),
    ],
)
def test_impossible_settings(tmp_path, fps, size, name, crf, message):
    with pytest.raises(InputError, match=message):
        VideoWriter(tmp_path / name, fps, size, crf=crf)
    with pytest.raises(InputError, match=r"preset must be one of ultrafast, .*'instant'"):
        VideoWriter(tmp_path / "a.mp4", 25, (64, 48), preset="instant")
    assert list(tmp_path.iterdir()) == []


def test_impossible_places(tmp_path):
    with pytest.raises(OutputError, match="cannot write here"):
        VideoWriter(tmp_path / "missing" / "a.mp4", 25, (64, 48))
    (tmp_path / "a.mp4").mkdir()
    with pytest.raises(OutputError, match="is a folder"):
        VideoWriter(tmp_path / "a.mp4", 25, (64, 48))


def test_an_encoder_that_does_not_start(tmp_path, monkeypatch):
    def refuse(*args, **kwargs):
        raise av.error.OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(av, "open", refuse)
    with pytest.raises(OutputError, match="No space left on device"):
        VideoWriter(tmp_path / "a.mp4", 25, (64, 48))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("at", ["write", "close"])
def test_disk_full(tmp_path, at):
    """As FFmpeg reports it: an OSError of its own."""
    writer = VideoWriter(tmp_path / "a.mp4", 25, (64, 48))
    container = writer._container

    class Full:
        def mux(self, packet):
            raise av.error.OSError(errno.ENOSPC, "No space left on device", "a.mp4")

        def close(self):
            container.close()

    writer._container = Full()
    with pytest.raises(OutputError, match=r"cannot be written \(No space left on device\)"):
        if at == "write":
            for i in range(100):
                writer.write(numbered(i))
        else:
            writer.write(numbered(0))
            writer.close()
    assert list(tmp_path.iterdir()) == []
    writer.close()
    with pytest.raises(InputError, match="is closed"):
        writer.write(numbered(0))


@pytest.mark.parametrize("part", ["while frames come", "when it is finished"])
def test_a_file_that_may_not_grow(tmp_path, part):
    images = np.random.default_rng(0).integers(0, 255, (30, 120, 160, 3), np.uint8)

    def write_all():
        with VideoWriter(tmp_path / "a.mp4", 25, (160, 120), preset="ultrafast") as writer:
            for image in images:
                writer.write(image)

    write_all()
    full = (tmp_path / "a.mp4").stat().st_size
    (tmp_path / "a.mp4").unlink()
    limit = full // 10 if part == "while frames come" else full - 50
    with files_up_to(limit), pytest.raises(OutputError, match="File too large"):
        write_all()
    assert list(tmp_path.iterdir()) == []


def test_without_the_usual_encoder(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_ENCODERS", ("libnothing", "libx264"))
    write(tmp_path / "a.mp4", 5)
    assert numbers(tmp_path / "a.mp4") == list(range(5))
    monkeypatch.setattr(module, "_ENCODERS", ("libnothing", "libneither"))
    with pytest.raises(MissingDependencyError, match=r"libnothing or libneither.*pip install"):
        VideoWriter(tmp_path / "b.mp4", 25, (64, 48))
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]
