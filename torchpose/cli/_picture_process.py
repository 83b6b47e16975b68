"""Draw pictures in another process, while this one tracks and writes the other files.

That process imports Matplotlib during the tracking, and never PyTorch.
"""

import contextlib
import gc
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Mapping
from typing import Any

_PROGRAM = "import sys; sys.path[:] = {!r}; from {} import serve; serve()"


class PictureProcess:
    """Draws pictures in a process of its own, which starts in the background.

    It runs the interpreter of this one, with the same paths. There is none on one core, on Windows, where
    Matplotlib is imported here already, and where it cannot be started.

    Args:
        wanted: whether there may be something to draw.
    """

    def __init__(self, wanted: bool) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        if not wanted or not _is_sooner():
            return
        with contextlib.suppress(OSError):
            self._process = subprocess.Popen(
                [sys.executable, "-c", _PROGRAM.format(sys.path, __name__)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,  # without this one's Ctrl-C
            )

    def draw(self, pictures: Mapping[str, Callable[[], Any]]) -> dict[str, bytes] | None:
        """Return pictures as PNG files; None if the process cannot draw them, for whatever reason.

        Args:
            pictures: functions that return a figure, by name; they are pickled.
        """
        if self._process is None:
            return None
        drawn, _ = self._process.communicate(pickle.dumps(pictures))
        return None if self._process.returncode else pickle.loads(drawn)

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()


def _is_sooner() -> bool:
    """Return whether another process draws sooner than this one."""
    from torchpose.video._other_process import cores

    return cores() > 1 and sys.platform != "win32" and "matplotlib" not in sys.modules


def serve() -> None:
    """Draw the pictures that come through standard input; the program of the process."""
    gc.disable()  # what is made here stays until the end
    own = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # standard error, for what libraries print
    try:
        from torchpose.viz import _pose_drawing  # noqa: F401
        from torchpose.viz._style import new_figure, png_of

        png_of(new_figure(1.0, 1.0, "imports all of Matplotlib before anything comes"))
        pictures = pickle.load(sys.stdin.buffer)
        drawn = {name: png_of(draw()) for name, draw in pictures.items()}
        with own:
            own.write(pickle.dumps(drawn))
    except Exception:  # whatever it is, the process that started this one draws then, and says it
        sys.exit(1)
