"""Video files of every kind, made here: frames, times, colours, and what is said about them."""

from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from tests.video.make import add_sound, make_video, number_of, numbered
from torchpose.errors import FileFormatError, InputError
from torchpose.video import _timing as probe
from torchpose.video import open_video
from torchpose.video._file import FileSource


def read(path, **options):
    """Numbers of the frames, and the source after it was read."""
    with open_video(path, **options) as source:
        frames = []
        for frame in source:
            assert frame.image.dtype == np.uint8
            assert frame.image.shape == (source.size[1], source.size[0], 3)
            assert frame.image.flags.c_contiguous
            assert frame.image.flags.writeable
            assert frame.index == len(frames)
            assert frame.time == frame.index / source.fps
            frames.append(number_of(frame.image))
    return frames, source


def random_images(n, size=(160, 120)):
    """Images that do not compress, so that a cut file is cut in the middle of the frames."""
    rng = np.random.default_rng(0)
    images = [rng.integers(100, 156, (size[1], size[0], 3), dtype=np.uint8) for _ in range(n)]
    for i, image in enumerate(images):
        image[:8, :64] = numbered(i)[:8, :64]
    return images


def cut(path, part):
    data = path.read_bytes()
    path.write_bytes(data[: int(part * len(data))])
    return path


@pytest.mark.parametrize(
    ("name", "codec", "pix_fmt"),
    [
        ("a.mp4", "libx264", "yuv420p"),
        ("a.mkv", "libx264", "yuv420p"),
        ("a.mov", "libx265", "yuv420p"),
        ("a.webm", "libvpx-vp9", "yuv420p"),
        ("a.avi", "mpeg4", "yuv420p"),
        ("a.avi", "mjpeg", "yuvj420p"),
        ("a.ts", "libx264", "yuv420p"),
        ("a.h264", "libx264", "yuv420p"),
        ("hevc10.mp4", "libx265", "yuv420p10le"),
        ("h264_10.mkv", "libx264", "yuv420p10le"),
        ("grey.mkv", "ffv1", "gray"),
        ("grey16.mkv", "ffv1", "gray16le"),
        ("grey.mp4", "libx265", "gray"),
        ("alpha.webm", "libvpx-vp9", "yuva420p"),
        ("full.mkv", "ffv1", "yuv444p16le"),
    ],
)
def test_every_frame_once_and_in_order(tmp_path, name, codec, pix_fmt):
    path = make_video(tmp_path / name, 40, codec=codec, pix_fmt=pix_fmt, fps=25)
    frames, source = read(path)
    assert frames == list(range(40))
    assert source.fps == 25
    assert source.size == (64, 48)
    assert source.n_frames == 40
    assumed = name.endswith(".h264")
    assert source.notes == ["the file has no times; 25 frames per second are assumed"] * assumed


def test_rate_of_broadcasts_is_exact(tmp_path):
    _, source = read(make_video(tmp_path / "a.mp4", fps=Fraction(30000, 1001)))
    assert source.fps == 30000 / 1001


@pytest.mark.parametrize("n", [1, 2])
def test_very_short(tmp_path, n):
    frames, source = read(make_video(tmp_path / "a.mp4", n))
    assert frames == list(range(n))
    assert (source.fps, source.n_frames, source.notes) == (30, n, [])


def test_reopen_is_a_second_pass(tmp_path):
    first = open_video(make_video(tmp_path / "a.mp4"), fps=15)
    assert first.reopenable
    for _ in range(3):
        next(first)
    second = first.reopen()
    assert second.fps == 15
    assert number_of(next(second).image) == 0
    assert number_of(next(first).image) == 6
    first.close()
    first.close()
    assert number_of(next(second).image) == 2
    second.close()
    with pytest.raises(InputError, match="closed; open it again"):
        next(first)


def test_after_the_last_frame_there_is_none(tmp_path):
    with open_video(make_video(tmp_path / "a.mp4", 5)) as source:
        assert len(list(source)) == 5
        assert next(source, None) is None
        with pytest.raises(InputError, match=r"have been read; open it again, or reopen\(\) it"):
            list(source)


# what is no video


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("text.mp4", b"not a video\n" * 200, "expected a video file, got something else"),
        ("text.txt", b"not a video\n" * 200, "expected a video, got text"),
        ("empty.mp4", b"", "empty file"),
        ("noise.mp4", np.random.default_rng(0).bytes(50_000), "expected a video"),
        ("list.mp4", b"#EXTM3U\n#EXTINF:1,\nhttp://localhost/1.ts\n#EXT-X-ENDLIST\n", "video"),
        ("list.mp4", b"ffconcat version 1.0\nfile other.mp4\n", "video"),
    ],
)
def test_not_a_video(tmp_path, name, data, message):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(FileFormatError, match=message) as raised:
        open_video(tmp_path / name)
    assert name in str(raised.value)


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp", "tif", "webp"])
def test_a_picture_with_the_name_of_a_video(tmp_path, suffix):
    cv2.imwrite(str(tmp_path / f"a.{suffix}"), numbered(1))
    for name in (f"a.{suffix}", "a.mp4"):
        (tmp_path / name).write_bytes((tmp_path / f"a.{suffix}").read_bytes())
        with pytest.raises(FileFormatError, match=r"single picture .*give the folder"):
            open_video(tmp_path / name)


def test_a_photograph_is_a_single_picture(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "a.jpg"), noise)
    with pytest.raises(FileFormatError, match=r"single picture \(jpg\); .*give the folder"):
        open_video(tmp_path / "a.jpg")


def test_nothing_there_and_a_folder(tmp_path):
    with pytest.raises(InputError, match="no such file or folder"):
        open_video(tmp_path / "missing.mp4")
    for address in ("https://example.org/a.mp4", "rtsp://camera/1"):
        with pytest.raises(InputError, match="addresses are not read: copy the video"):
            open_video(address)
    with pytest.raises(InputError, match="is a folder"):
        FileSource(tmp_path)
    with pytest.raises(InputError, match="none among its 0 files"):
        open_video(tmp_path)


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.avi"])
def test_zero_frames(tmp_path, name):
    path = make_video(tmp_path / name, 0, codec="mpeg4")
    with pytest.raises(FileFormatError, match="zero frames"):
        open_video(path)


def test_sound_only(tmp_path):
    with av.open(str(tmp_path / "a.m4a"), "w") as out:
        add_sound(out, out.add_stream("aac", rate=44100, layout="mono"), 0.5)
    with pytest.raises(FileFormatError, match="sound only"):
        open_video(tmp_path / "a.m4a")


def test_sound_with_a_picture_of_the_cover(tmp_path):
    cover = tmp_path / "cover.png"
    cv2.imwrite(str(cover), numbered(1))
    with av.open(str(tmp_path / "a.mka"), "w", format="matroska") as out:
        sound = out.add_stream("aac", rate=44100, layout="mono")
        out.add_attachment("cover.png", "image/png", cover.read_bytes())
        add_sound(out, sound, 0.5)
    with pytest.raises(FileFormatError, match="sound only"):
        open_video(tmp_path / "a.mka")


def test_video_with_sound(tmp_path):
    frames, source = read(make_video(tmp_path / "a.mp4", sound=True))
    assert frames == list(range(30))
    assert source.notes == []


# damage


@pytest.mark.parametrize("part", [0.6, 0.97])
@pytest.mark.parametrize(
    ("name", "codec", "pix_fmt"),
    [
        ("a.mp4", "libx264", "yuv420p"),
        ("a.mkv", "libx264", "yuv420p"),
        ("a.avi", "mjpeg", "yuvj420p"),
    ],
)
def test_truncated_keeps_what_is_there(tmp_path, name, codec, pix_fmt, part):
    kind = {"codec": codec, "pix_fmt": pix_fmt, "faststart": name.endswith("mp4")}
    # frames of one size, however many cores the encoder uses
    quality = {"options": {"qmin": "5", "qmax": "5"}} if codec == "mjpeg" else {}
    path = make_video(tmp_path / name, 90, (160, 120), images=random_images(90), **kind, **quality)
    frames, source = read(cut(path, part))
    assert 0.8 * 90 * part < len(frames) < 90
    assert frames == list(range(len(frames)))
    assert 0 <= source.n_frames - len(frames) <= 1
    assert "truncated" in source.notes[0]
    assert f"{source.n_frames}" in source.notes[0]


def test_truncated_is_said_before_reading(tmp_path):
    path = make_video(tmp_path / "a.mkv", 90, (160, 120), images=random_images(90))
    with open_video(cut(path, 0.5)) as source:
        assert any("truncated" in note for note in source.notes)


def test_mp4_without_its_index(tmp_path):
    path = make_video(tmp_path / "a.mp4", 60, (160, 120), images=random_images(60))
    with pytest.raises(FileFormatError, match=r"no index \(moov\)"):
        open_video(cut(path, 0.7))


def test_damage_in_the_middle_costs_only_time_without_news(tmp_path):
    path = make_video(tmp_path / "a.mp4", 90, (160, 120), images=random_images(90), faststart=True)
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 3000] = bytes(3000)
    path.write_bytes(data)
    frames, source = read(path)
    assert len(frames) == 90
    assert frames[:30] == list(range(30))
    assert frames[-10:] == list(range(80, 90))
    assert source.notes


def test_nothing_of_it_can_be_decoded(tmp_path):
    path = make_video(tmp_path / "a.mp4", 30, faststart=True)
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat") + 4
    data[start:] = bytes(len(data) - start)
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match="none of its 30 frames can be decoded"):
        open_video(path)


# time


def test_variable_rate_shows_the_nearest_frame(tmp_path):
    rng = np.random.default_rng(0)
    pts = np.cumsum(rng.choice([20, 40, 90, 200], 60))
    tick = Fraction(1, 1000)
    frames, source = read(make_video(tmp_path / "a.mkv", 60, pts=pts.tolist(), time_base=tick))
    seconds = (pts - pts[0]) / 1000
    assert source.fps == pytest.approx(59 / seconds[-1])
    nearest = np.abs(seconds[None] - np.arange(len(frames))[:, None] / source.fps).argmin(1)
    assert frames == nearest.tolist()
    assert "variable frame rate" in source.notes[0]
    assert "repeated" in source.notes[1]
    assert source.n_frames == len(frames)


@pytest.mark.parametrize("fps", [7.0, 15.0, 24.0, 60.0])
def test_another_rate_on_request(tmp_path, fps):
    frames, source = read(make_video(tmp_path / "a.mp4"), fps=fps)
    times = np.arange(30) / 30
    distance = np.abs(times[None] - np.arange(len(frames))[:, None] / fps)
    np.testing.assert_allclose(distance[np.arange(len(frames)), frames], distance.min(1), atol=1e-9)
    assert source.fps == fps
    assert source.n_frames == len(frames) == pytest.approx(fps, abs=1)
    assert "as asked" in source.notes[0]


def test_jitter_is_no_variable_rate(tmp_path):
    rng = np.random.default_rng(0)
    pts = (np.arange(60) * 100 / 3 + rng.integers(-3, 4, 60) + 10).astype(int).tolist()
    path = make_video(tmp_path / "a.mp4", 60, pts=pts, time_base=Fraction(1, 1000))
    frames, source = read(path)
    assert frames == list(range(60))
    assert source.fps == pytest.approx(30, rel=0.005)
    assert source.notes == []


def test_lost_frames_are_filled(tmp_path):
    places = [i for i in range(60) if i not in (10, 30, 31)]
    frames, source = read(make_video(tmp_path / "a.mkv", 57, pts=places))
    assert len(frames) == source.n_frames == 60
    moved = [abs(places[frame] - i) for i, frame in enumerate(frames)]
    assert max(moved) == 1
    assert source.notes == ["3 frames repeated to keep 30 frames per second"]


@pytest.mark.parametrize("name", ["a.mkv", "a.mp4", "a.ts"])
def test_start_that_is_not_zero(tmp_path, name):
    path = make_video(tmp_path / name, pts=[300 + i for i in range(30)])
    frames, source = read(path)
    assert frames == list(range(30))
    assert (source.fps, source.n_frames) == (30, 30)
    if name != "a.mp4":  # where an edit list takes it out
        assert len(source.notes) == 1
        assert "starts at 10.00 s" in source.notes[0]


def test_times_that_cannot_be(tmp_path):
    """A frame every ten microseconds."""
    path = make_video(tmp_path / "a.mp4", time_base=Fraction(1, 100_000))
    frames, source = read(path, fps=50)
    assert frames == list(range(30))
    assert (source.fps, source.n_frames) == (50, 30)
    assert source.notes == ["the file has no times; 50 frames per second are assumed"]


def test_times_that_go_back(tmp_path):
    """Packets of an intra-only codec, times of which are swapped by hand."""
    path = make_video(tmp_path / "a.avi", 40, codec="mjpeg", pix_fmt="yuvj420p")
    order = list(range(40))
    order[20:24] = [21, 20, 20, 23]
    with av.open(str(path)) as old, av.open(str(tmp_path / "b.mkv"), "w") as new:
        stream = new.add_stream_from_template(old.streams.video[0])
        for i, packet in enumerate(p for p in old.demux() if p.size):
            packet.stream, packet.time_base = stream, Fraction(1, 30)
            packet.pts, packet.dts = order[i] + 3, i
            new.mux(packet)
    frames, source = read(tmp_path / "b.mkv")
    assert len(frames) == 40
    assert frames == sorted(frames)
    assert max(abs(frame - i) for i, frame in enumerate(frames)) <= 1
    assert any("not after the one before" in note for note in source.notes)


def test_two_recordings_in_one_file(tmp_path):
    first = make_video(tmp_path / "a.ts", 40)
    second = make_video(tmp_path / "b.ts", 40)
    first.write_bytes(first.read_bytes() + second.read_bytes())
    frames, source = read(first)
    assert frames == [*range(40), *range(40)]
    assert source.fps == 30
    assert any("clock jumped 1 time" in note for note in source.notes)


def test_a_jump_of_the_clock_is_not_filled(tmp_path):
    path = make_video(tmp_path / "a.mkv", pts=[*range(15), *range(3000, 3015)])
    frames, source = read(path)
    assert frames == list(range(30))
    assert source.n_frames <= 30


# geometry and colour


@pytest.mark.parametrize("rotation", [0, 90, 180, 270, -90])
def test_rotated_phone_video_is_upright(tmp_path, rotation):
    """The angle is how far, counterclockwise, the stored picture is turned for display."""
    stored = np.zeros((48, 64, 3), np.uint8)
    stored[:24, :32] = (200, 0, 0)
    stored[24:, 32:] = (0, 0, 200)
    path = make_video(tmp_path / "a.mp4", 3, images=[stored] * 3, rotation=rotation)
    expected = np.rot90(stored, rotation // 90)
    with open_video(path) as source:
        assert source.size == (expected.shape[1], expected.shape[0])
        assert bool(source.notes) == (rotation != 0)
        for frame in source:
            assert frame.image.flags.c_contiguous
            assert np.median(np.abs(frame.image.astype(int) - expected)) <= 4


@pytest.mark.parametrize("flip", ["x", "y"])
def test_mirrored_video(tmp_path, flip):
    stored = np.zeros((48, 64, 3), np.uint8)
    stored[:24, :32] = 200
    one = 1 << 16
    matrix = [-one if flip == "x" else one, 0, 0, 0, -one if flip == "y" else one, 0, 0, 0, 1 << 30]
    with av.open(str(tmp_path / "a.mp4"), "w") as out:
        stream = out.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.set_display_matrix(matrix)
        out.mux(stream.encode(av.VideoFrame.from_ndarray(stored, "rgb24")))
        out.mux(stream.encode(None))
    with open_video(tmp_path / "a.mp4") as source:
        image = next(source).image
    expected = stored[:, ::-1] if flip == "x" else stored[::-1]
    assert np.median(np.abs(image.astype(int) - expected)) <= 4


def test_skewed_display_is_ignored_and_said(tmp_path):
    frames, source = read(make_video(tmp_path / "a.mp4", 3, rotation=30))
    assert frames == [0, 1, 2]
    assert "no multiple of 90" in source.notes[0]


@pytest.mark.parametrize("size", [(67, 49), (65, 48), (64, 51)])
def test_odd_sizes(tmp_path, size):
    frames, source = read(make_video(tmp_path / "a.mkv", 5, size, codec="ffv1"))
    assert frames == list(range(5))
    assert source.size == size


def test_4k(tmp_path):
    path = make_video(tmp_path / "a.mp4", 3, (3840, 2160), options={"preset": "ultrafast"})
    frames, source = read(path)
    assert frames == [0, 1, 2]
    assert source.size == (3840, 2160)


def test_a_size_that_changes_is_scaled(tmp_path):
    first = make_video(tmp_path / "a.ts", 20, (64, 48))
    second = make_video(tmp_path / "b.ts", 20, (128, 96))
    first.write_bytes(first.read_bytes() + second.read_bytes())
    with open_video(first) as source:
        images = [frame.image for frame in source]
    assert {image.shape for image in images} == {(48, 64, 3)}
    assert len(images) == 40
    assert "20 frames of another size, scaled to 64x48" in source.notes


MATRICES = {1: (0.2126, 0.0722), 6: (0.299, 0.114), 9: (0.2627, 0.0593)}  # Kr, Kb by H.273 number


def planes(rgb, matrix, full, bits, pix_fmt, size):
    """A frame of one colour, made by the formulas of the standards."""
    kr, kb = MATRICES[matrix]
    r, g, b = (np.array(rgb) / 255).tolist()
    y = kr * r + (1 - kr - kb) * g + kb * b
    cb, cr = (b - y) / (2 - 2 * kb), (r - y) / (2 - 2 * kr)
    top = 2**bits
    if full:
        values = y * (top - 1), cb * (top - 1) + top / 2, cr * (top - 1) + top / 2
    else:
        values = ((16 + 219 * y) * top / 256, (128 + 224 * cb) * top / 256,
                  (128 + 224 * cr) * top / 256)  # fmt: skip
    frame = av.VideoFrame(*size, pix_fmt)
    for plane, value in zip(frame.planes, values, strict=True):
        kind = np.uint8 if bits == 8 else np.uint16
        plane.update(
            np.full(plane.buffer_size // kind().nbytes, min(round(value), top - 1), kind).tobytes()
        )
    return frame


@pytest.mark.parametrize(
    "rgb", [(255, 0, 0), (0, 255, 0), (0, 0, 255), (198, 134, 110), (255,) * 3]
)
@pytest.mark.parametrize(
    ("matrix", "full", "bits", "declared", "size"),
    [
        (6, False, 8, True, (64, 48)),
        (1, False, 8, True, (64, 48)),
        (9, False, 10, True, (64, 48)),
        (1, True, 8, True, (64, 48)),
        (6, True, 8, True, (64, 48)),
        (1, False, 10, True, (64, 48)),
        (6, False, 8, False, (64, 48)),  # nothing is declared: as players do, by the size
        (1, False, 8, False, (64, 720)),
    ],
)
def test_colours(tmp_path, rgb, matrix, full, bits, declared, size):
    pix_fmt = "yuv420p" if bits == 8 else "yuv420p10le"
    images = [planes(rgb, matrix, full, bits, pix_fmt, size) for _ in range(2)]
    tags = {"colorspace": matrix, "color_range": 2 if full else 1} if declared else {}
    path = make_video(
        tmp_path / "a.mkv", 2, size, images=images, pix_fmt=pix_fmt, tags=tags, options={"crf": "1"}
    )
    with open_video(path) as source:
        for frame in source:
            np.testing.assert_allclose(frame.image.reshape(-1, 3).mean(0), rgb, atol=3)


@pytest.mark.parametrize(
    ("name", "codec", "pix_fmt"),
    [("a.mp4", "libx264", "yuv420p"), ("a.mov", "png", "rgb24"), ("a.mp4", "libx264rgb", "rgb24")],
)
def test_frames_do_not_share_memory(tmp_path, name, codec, pix_fmt):
    path = make_video(tmp_path / name, 10, codec=codec, pix_fmt=pix_fmt)
    with open_video(path, fps=60) as source:
        for frame in source:
            assert number_of(frame.image) == (frame.index + 1) // 2
            frame.image[:] = 0  # a repeated frame must not show this


def test_the_rate_must_be_positive(tmp_path):
    path = make_video(tmp_path / "a.mp4", 3)
    for fps in (0.0, -5.0, float("inf"), float("nan")):
        with pytest.raises(InputError, match="fps must be positive"):
            open_video(path, fps=fps)


def test_pixels_that_are_not_square(tmp_path):
    path = make_video(tmp_path / "a.mp4", 3, tags={"sample_aspect_ratio": Fraction(16, 11)})
    _, source = read(path)
    assert source.notes == ["pixels are not square (16/11); treated as square"]


def test_interlaced(tmp_path):
    path = make_video(tmp_path / "a.mp4", 3, options={"x264-params": "interlaced=1"})
    frames, source = read(path)
    assert frames == [0, 1, 2]
    assert source.notes[0].startswith("interlaced")


def test_several_video_streams(tmp_path):
    with av.open(str(tmp_path / "a.mkv"), "w") as out:
        streams = [out.add_stream("libx264", rate=25) for _ in range(2)]
        for stream in streams:
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for number, stream in zip((3, 4), streams, strict=True):
            out.mux(stream.encode(av.VideoFrame.from_ndarray(numbered(number), "rgb24")))
            out.mux(stream.encode(None))
    frames, source = read(tmp_path / "a.mkv")
    assert frames == [3]
    assert source.notes == ["2 video streams; the first is read"]


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
@pytest.mark.parametrize("part", [1.0, 0.7])
def test_too_long_to_be_looked_through(tmp_path, monkeypatch, name, part):
    monkeypatch.setattr(probe, "_SCAN_PACKETS", 10)
    path = make_video(
        tmp_path / name,
        120,
        (160, 120),
        images=random_images(120),
        sound=True,
        faststart=True,
        options={"preset": "ultrafast"},
    )
    with open_video(cut(path, part)) as source:
        assert source.fps == 30
        assert source.n_frames == pytest.approx(120, abs=2)
        assert source.notes == []
        count = sum(1 for _ in source)
        assert count < 100 if part < 1 else count == 120
        assert any(f"holds {count}" in note for note in source.notes) == (part < 1)


def test_a_disk_that_fails_while_reading(tmp_path):
    with open_video(make_video(tmp_path / "a.mp4")) as source:
        packets = source._container.demux(source._stream)

        class Failing:
            def demux(self, stream):
                for _ in range(12):
                    yield next(packets)
                raise av.error.OSError(5, "Input/output error")

            def close(self):
                container.close()

        container, source._container = source._container, Failing()
        source._decoded = source._decode()
        count = sum(1 for _ in source)
    assert 10 <= count < 30
    assert "reading ended early (Input/output error)" in source.notes


def test_high_dynamic_range_is_said(tmp_path):
    tags = {"color_trc": 18, "colorspace": 9, "color_primaries": 9, "color_range": 1}
    path = make_video(tmp_path / "a.mkv", 3, codec="libx265", pix_fmt="yuv420p10le", tags=tags)
    _, source = read(path)
    assert "high dynamic range (HLG)" in source.notes[0]


def test_a_title_in_another_encoding(tmp_path):
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as out:
        out.metadata["title"] = "CafXX"
        stream = out.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for i in range(3):
            frame = av.VideoFrame.from_ndarray(numbered(i), "rgb24").reformat(format="yuv420p")
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    data = path.read_bytes()
    assert data.count(b"CafXX") == 1
    path.write_bytes(data.replace(b"CafXX", b"Caf\xe9!"))
    with FileSource(path) as source:
        assert [number_of(frame.image) for frame in source] == [0, 1, 2]


@pytest.mark.parametrize("fps", [0.0, -1.0, 10_000.0, float("nan")])
def test_rates_that_no_video_has(tmp_path, fps):
    make_video(tmp_path / "a.mp4", 3)
    with pytest.raises(InputError, match="at most 1000 frames per second"):
        FileSource(tmp_path / "a.mp4", fps)
