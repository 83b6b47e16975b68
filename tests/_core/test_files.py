"""Writing whole files or none, and refusing what is no plain .npz."""

import gc
import os
import stat
import sys

import numpy as np
import pytest

from torchpose._core import files
from torchpose._core.files import atomic_path, check_output_folder, write_npz
from torchpose._core.reading import read_npz, require_file
from torchpose.errors import FileFormatError, InputError, OutputError


def test_a_file_appears_when_the_block_succeeds(tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text("old")
    with atomic_path(path) as temporary:
        assert (temporary.parent, temporary.suffix) == (path.parent, ".csv")
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~umask


def test_nothing_is_left_when_the_block_fails(tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text("old")
    with pytest.raises(KeyError), atomic_path(path) as temporary:
        temporary.write_text("half")
        raise KeyError("stopped")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def _interrupt_at(step):
    """A tracer that raises KeyboardInterrupt before instruction number `step` of the module of files."""
    left = [step]

    def trace(frame, event, argument):
        if frame.f_code.co_filename != files.__file__:
            return None
        frame.f_trace_opcodes = True
        if event == "opcode":
            left[0] -= 1
            if left[0] == 0:
                raise KeyboardInterrupt
        return trace

    return trace


def test_an_interruption_at_any_instruction_leaves_nothing(tmp_path):
    """A signal may come between making the file and writing it; what stood there is whole after it."""
    path = tmp_path / "poses.csv"
    path.write_text("old")
    before = sys.gettrace()
    interrupted = 0
    for step in range(1, 1000):
        sys.settrace(_interrupt_at(step))
        try:
            with atomic_path(path) as temporary:
                temporary.write_text("new")
        except KeyboardInterrupt:
            interrupted += 1
        finally:
            sys.settrace(before)
        gc.collect(0)
        assert [p.name for p in tmp_path.iterdir()] == ["poses.csv"], step
        assert path.read_text() in ("old", "new")
        if interrupted < step:
            break
    assert 100 < interrupted < 999


def test_what_cannot_be_written_to(tmp_path):
    with pytest.raises(OutputError, match="cannot write"), atomic_path(tmp_path / "no" / "x.npz"):
        pass
    with pytest.raises(OutputError, match="is a folder"), atomic_path(tmp_path):
        pass
    with pytest.raises(OutputError, match="disk"), atomic_path(tmp_path / "x"):
        raise OSError(28, "no space left on disk")
    assert not list(tmp_path.iterdir())


def test_output_folders(tmp_path):
    assert check_output_folder(tmp_path / "a" / "b").is_dir()
    assert not list((tmp_path / "a" / "b").iterdir())
    (tmp_path / "file").touch()
    for bad in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match="choose another"):
            check_output_folder(bad)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_folder(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError):
        check_output_folder(tmp_path)


def test_npz_round_trip(tmp_path):
    write_npz(tmp_path / "a.npz", {"x": np.arange(3), "names": np.array(["a", "b"])})
    back = read_npz(tmp_path / "a.npz", ["x"])
    assert set(back) == {"x", "names"}
    assert set(read_npz(tmp_path / "a.npz", ["x"], optional=[])) == {"x"}
    with pytest.raises(FileFormatError, match=r"joints.*found names, x"):
        read_npz(tmp_path / "a.npz", ["joints"])


def test_a_truncated_npz_at_any_length(tmp_path):
    path = tmp_path / "a.npz"
    write_npz(path, {"x": np.random.default_rng(0).normal(size=(50, 8, 3)), "fps": 30})
    whole = path.read_bytes()
    for length in [0, 1, 10, *range(100, len(whole), 997), len(whole) - 1]:
        path.write_bytes(whole[:length])
        with pytest.raises(FileFormatError, match=r"a.npz"):
            read_npz(path)
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 0xFF
    path.write_bytes(bytes(damaged))
    with pytest.raises(FileFormatError):
        read_npz(path)


def test_foreign_files(tmp_path):
    path = tmp_path / "a.npz"
    for content in (b"", b"hello", b"PK\x03\x04 no archive", b"\x80\x04\x95 pickle"):
        path.write_bytes(content)
        with pytest.raises(FileFormatError, match=r"a.npz"):
            read_npz(path)
    with path.open("wb") as stream:
        np.save(stream, np.zeros(3))
    with pytest.raises(FileFormatError, match="single array"):
        read_npz(path)


class _Trap:
    def __reduce__(self):
        return (pytest.fail, ("it was unpickled",))


def test_pickles_are_never_opened(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, x=np.array([_Trap()], dtype=object))
    with pytest.raises(FileFormatError, match="pickled"):
        read_npz(path)


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        require_file(tmp_path / "none")
    with pytest.raises(InputError, match="folder"):
        require_file(tmp_path)
