"""The boundary of foreign files: one typed line for whatever is wrong, and nothing believed unseen."""

import io
import json
import os
import struct
import subprocess
import sys
import zipfile
import zlib

import numpy as np
import pytest
import torch

from torchpose._core.checks import check_rate
from torchpose._core.reading import check_span, npz_keys, read_json, read_npz, reading, require_file
from torchpose.camera import PinholeCamera, load_cameras
from torchpose.errors import (
    CameraError,
    FileFormatError,
    InputError,
    MissingDependencyError,
    OutputError,
    TorchposeError,
    printable,
)
from torchpose.io import read_keypoints, read_recording


def npy(text, data=b""):
    header = text.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


def archive(path, entries, method=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", method) as file:
        for key, data in entries.items():
            file.writestr(f"{key}.npy", data)
    return path


def whole(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


# --- messages -------------------------------------------------------------------------------------


def test_messages_are_one_printable_line_of_bounded_length():
    error = FileFormatError("a\x1b[31m\n  b\x00\u202e" + "y" * 50_000_000 + "end")
    text = str(error)
    assert text.isprintable() and len(text) <= 1200
    assert text.startswith("a\\x1b[31m b\\x00\\u202ey") and text.endswith("yend")
    assert "characters ..." in text
    for kind in (OutputError, MissingDependencyError, CameraError):
        assert str(kind("one\ntwo")) == "one two"
        assert kind("x").args == ("x",)
    assert printable("häuser – 姿勢") == "häuser – 姿勢"


def test_escapes_that_lengthen_a_text_do_not_break_the_bound():
    assert len(printable("\x00" * 5000)) <= 1200
    assert len(printable("\x00" * 60, 100)) <= 100


@pytest.mark.parametrize(
    "error",
    [
        ValueError("a\nb"), RecursionError(), zlib.error("x"), zipfile.BadZipFile("x"), KeyError("x"),
        UnicodeDecodeError("utf-8", b"\xff", 0, 1, "x"), OverflowError("x"), struct.error("x"),
        PermissionError(13, "Permission denied"), IsADirectoryError(21, "Is a directory"),
    ],
)  # fmt: skip
def test_whatever_a_parser_raises_names_the_file(error):
    with pytest.raises(TorchposeError, match=r"^a\.npz: ") as caught, reading("a.npz", "numbers"):
        raise error
    assert str(caught.value).isprintable()
    assert isinstance(caught.value, InputError if isinstance(error, OSError) else FileFormatError)
    assert caught.value.__cause__ is error


def test_errors_of_torchpose_stay_what_they_are():
    with pytest.raises(CameraError, match=r"^a\.toml: no camera$"), reading("a.toml", "a camera"):
        raise CameraError("no camera")
    with pytest.raises(CameraError, match=r"^a\.toml, line 3: x$"), reading("a.toml", "a camera"):
        raise CameraError("a.toml, line 3: x")
    for error in (MemoryError(), KeyboardInterrupt()):
        with pytest.raises(type(error)), reading("a", "x"):
            raise error


# --- paths ----------------------------------------------------------------------------------------


def test_names_that_are_no_files(tmp_path):
    (tmp_path / "dangling.npz").symlink_to(tmp_path / "nothing")
    (tmp_path / "loop.npz").symlink_to(tmp_path / "loop.npz")
    os.mkfifo(tmp_path / "pipe.npz")
    for name, words in {
        "a\0b.npz": "NUL", "n" * 300 + ".npz": "too long", "n" * 5000: "too long",
        "dangling.npz": "no such file", "loop.npz": "symbolic links", "pipe.npz": "pipe",
    }.items():  # fmt: skip
        for read in (require_file, read_npz, load_cameras):
            with pytest.raises(InputError, match=words) as caught:
                read(tmp_path / name)
            assert str(caught.value).isprintable()


@pytest.mark.parametrize("odd", ["folder", "dangling"])
def test_something_else_in_place_of_a_frame_of_openpose(tmp_path, odd):
    path = tmp_path / "a_0_keypoints.json"
    path.mkdir() if odd == "folder" else path.symlink_to(tmp_path / "nothing")
    with pytest.raises(InputError, match=r"a_0_keypoints\.json"):
        read_keypoints(tmp_path)


# --- archives -------------------------------------------------------------------------------------


def test_only_what_is_needed_is_read(tmp_path):
    path = archive(tmp_path / "a.npz", {"x": whole(np.arange(3)), "broken": b"nothing of NumPy's"})
    assert npz_keys(path) == ("x", "broken")
    assert read_npz(path, ["x"], [])["x"].tolist() == [0, 1, 2]
    with pytest.raises(FileFormatError, match=r"a\.npz"):
        read_npz(path)


@pytest.mark.parametrize(
    ("header", "data", "words"),
    [
        ("{'descr': '<f8', 'fortran_order': False, 'shape': (80000000000,), }", b"", "80000000000"),
        ("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }", b"", "does not fit"),
        ("{'descr': '<f8', 'fortran_order': False, 'shape': (2,), }", bytes(24), "does not fit"),
        ("{'descr': '|O', 'fortran_order': False, 'shape': (), }", b"cos\nsystem\n", "pickled"),
        (
            "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,), }",
            bytes(8),
            "structures",
        ),
        (
            "{'descr': '<U0', 'fortran_order': False, 'shape': (10000000000,), }",
            b"",
            "does not fit",
        ),
        ("{'descr': '<U1', 'fortran_order': False, 'shape': (1,), }", b"\xff" * 4, "Unicode"),
        ("(" * 150 + ")" * 150, b"", "damaged"),
        ("(" * 3, b"", "damaged"),
    ],
)
def test_headers_that_claim_what_is_not_there(tmp_path, header, data, words):
    path = archive(tmp_path / "a.npz", {"x": npy(header, data)})
    with pytest.raises(FileFormatError, match=rf"a\.npz: .*{words}"):
        read_npz(path, ["x"])


@pytest.mark.parametrize("method", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_packing_that_numpy_does_not_write(tmp_path, method):
    path = archive(tmp_path / "a.npz", {"x": whole(np.arange(3))}, method)
    with pytest.raises(FileFormatError, match="packed"):
        read_npz(path)


def test_a_bomb_is_refused_where_it_is_needed_and_passed_over_where_not(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, x=np.arange(3), bomb=np.zeros(40_000_000))  # 320 MB in 310 kB
    assert path.stat().st_size < 1_000_000
    assert read_npz(path, ["x"], [])["x"].tolist() == [0, 1, 2]
    with pytest.raises(FileFormatError, match="it claims 320000000"):
        read_npz(path, ["bomb"], [])


# --- sizes and rates ------------------------------------------------------------------------------


def test_few_rows_cannot_span_many_frames(tmp_path):
    check_span("a", 100_000, 1)
    with pytest.raises(FileFormatError, match="span 100201 frames, of which 2"):
        check_span("a", 100_201, 2)
    rows = [f"{100_000 * t},1,2" for t in range(300)]
    (tmp_path / "a.csv").write_text("\n".join(["frame,head_x,head_y", *rows]))
    for number in (0, 2_000_000):
        people = {"people": [{"pose_keypoints_2d": [1.0] * 75}]}
        (tmp_path / f"a_{number}_keypoints.json").write_text(json.dumps(people))
    code = f"""
from torchpose.io import read_keypoints
for path in ({str(tmp_path / "a.csv")!r}, {str(tmp_path)!r}):
    try:
        read_keypoints(path)
    except ValueError as error:
        print(error)
with open("/proc/self/status") as status:  # getrusage would count the parent's memory as well
    print(next(line.split()[1] for line in status if line.startswith("VmHWM")))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    first, second, peak = done.stdout.splitlines()
    assert "span 29900001 frames" in first and "span 2000001 frames" in second
    assert int(peak) < 1_000_000  # kB; the tables would have taken gigabytes


def test_many_bodies_cannot_span_many_frames_each(tmp_path):
    joints = np.random.default_rng(0).normal(size=(32, 3)).tolist()
    bodies = [{"body_id": i, "joint_positions": joints} for i in range(40)]
    there, empty = {"bodies": bodies}, {"bodies": []}
    (tmp_path / "a.json").write_text(json.dumps({"frames": [there, *[empty] * 20_000, there]}))
    with pytest.raises(FileFormatError, match="span 800080 frames, of which 80"):
        read_recording(tmp_path / "a.json")


@pytest.mark.parametrize("fps", [0, -1.0, 10_000, float("nan"), float("inf"), True, "30", 10**400])
def test_rates_that_no_camera_has(fps):
    with pytest.raises(InputError, match=r"fps must be positive and at most 1000"):
        check_rate("fps", fps)


def test_rates_that_cameras_have():
    assert [check_rate("fps", fps) for fps in (30, 29.97, 1000, np.float32(60))] == [
        30,
        29.97,
        1000,
        60,
    ]


# --- text -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 100_000, "1" * 5000, "[1, 2", "\x00"])
def test_json_that_python_cannot_read(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(FileFormatError, match=r"a\.json"):
        read_json(tmp_path / "a.json", "JSON")


@pytest.mark.parametrize("depth", [50_000, 500])
def test_brackets_in_opencv_files(tmp_path, depth):
    path = tmp_path / "a.yaml"
    path.write_text(
        "%YAML:1.0\n---\nx: !!opencv-matrix\n   rows: 1\n   cols: 24\n   dt: d\n   data: "
        + "[" * depth
    )
    with pytest.raises(FileFormatError, match=r"a\.yaml"):
        read_recording(path)


# --- cameras --------------------------------------------------------------------------------------

K = "matrix = [[525.0, 0.0, 319.5], [0.0, 525.0, 239.5], [0.0, 0.0, 1.0]]\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[a]\n" + K.replace("525.0", "true", 1), "must be 3 x 3 numbers"),
        ("[a]\n" + K.replace("525.0", "9" * 400, 1), "must be 3 x 3 numbers"),
        ("[a]\n" + K.replace("525.0", "9" * 5000, 1), "a.toml"),
        ("[a]\n" + K.replace("525.0", "1e300", 1), "at most 1e"),
        ("[a]\n" + K.replace("525.0", "1e-300", 1), "positive focal lengths"),
        ("[a]\n" + K + "rotation = [1e160, 0.0, 0.0]", "at most 1e"),
        ("[a]\n" + K + "rotation = [500.0, 0.0, 0.0]", "Rodrigues vector"),
        ("[a]\n" + K + "translation = [inf, 0.0, 0.0]", "finite"),
        ("[a]\n" + K + "translation = [true, 0.0, 0.0]", "must be numbers"),
        ("[a]\n" + K + "size = [1e300, 480]", "whole number of pixels"),
        ("[a]\n" + K + "size = [true, 480]", "whole number of pixels"),
        ("[a]\n" + K + "fisheye = 3", "true or false"),
        ("x = " + "[" * 50_000, "nested too deeply"),
        ("x = " + "{a = " * 50_000, "nested too deeply"),
    ],
)
def test_numbers_that_no_camera_has(tmp_path, text, words):
    path = tmp_path / "a.toml"
    path.write_text(text)
    with pytest.raises((CameraError, FileFormatError), match=words) as caught:
        load_cameras(path)
    assert str(caught.value).isprintable() and "a.toml" in str(caught.value)


def test_ordinary_cameras_are_taken():
    camera = PinholeCamera.from_matrix(torch.tensor([[525, 0, 319], [0, 525, 239], [0, 0, 1]]))
    assert camera.matrix.dtype == torch.float64
    exact = PinholeCamera(525.1, 525, 319.5, 239.5)
    assert float(exact.matrix[0, 0]) == 525.1
