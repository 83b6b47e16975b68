"""Pictures that another process draws."""

import sys
from contextlib import closing
from functools import partial

import pytest

from tests.test_import import loaded_after
from torchpose import demo
from torchpose.cli import _picture_process
from torchpose.cli._picture_process import PictureProcess
from torchpose.viz._skeletons import prepare_pose_strip
from torchpose.viz._style import png_of

pytest.importorskip("matplotlib")
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="none is started there")


@pytest.fixture(autouse=True)
def _matplotlib_is_not_here(monkeypatch):
    monkeypatch.setattr(_picture_process, "_is_sooner", lambda: True)


def test_it_draws_the_same():
    pictures = {"strip.png": prepare_pose_strip(demo.performer(9).joints, n_frames=2)}
    with closing(PictureProcess(True)) as other:
        assert other.draw(pictures) == {"strip.png": png_of(pictures["strip.png"]())}


def test_it_imports_no_torch():
    code = "import torchpose.cli._picture_process, torchpose.viz._pose_drawing"
    assert "torch" not in loaded_after(code)


def test_what_it_cannot_draw_is_left_to_this_process(capfd):
    with closing(PictureProcess(True)) as other:
        assert other.draw({"a.png": partial(int, "no figure")}) is None
    assert capfd.readouterr().err == ""


def test_one_that_was_killed_or_never_began_draws_nothing(monkeypatch):
    with closing(PictureProcess(True)) as other:
        other._process.kill()
        assert other.draw({}) is None
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with closing(PictureProcess(True)) as other:
        assert other.draw({}) is None


def test_it_ends_with_its_user():
    other = PictureProcess(True)
    with pytest.raises(KeyboardInterrupt), closing(other):
        raise KeyboardInterrupt
    assert other._process.poll() is not None


def test_none_is_started_where_it_does_not_pay(monkeypatch):
    assert PictureProcess(False)._process is None
    monkeypatch.undo()
    monkeypatch.setattr("torchpose.video._other_process.cores", lambda: 2)
    assert PictureProcess(True)._process is None  # Matplotlib is here
    monkeypatch.delitem(sys.modules, "matplotlib")
    monkeypatch.setattr("torchpose.video._other_process.cores", lambda: 1)
    assert PictureProcess(True)._process is None
