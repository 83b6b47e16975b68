"""Shape checks of every annotated function, and settings of the whole run.

TORCHPOSE_SHAPE_CHECKS=0 switches the shape checks off, for profiling or a debugger.
"""

import contextlib
import gc
import os
import signal

import pytest

from tests import shape_checks

if os.environ.get("TORCHPOSE_SHAPE_CHECKS", "1") != "0":
    shape_checks.install("torchpose")


def pytest_addoption(parser):
    parser.addoption(
        "--fuzz-seconds",
        type=float,
        default=3.0,
        help="processor time for damaged files and odd calls (tests/fuzz; default 3)",
    )


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Leave modules and tests, millions of objects that stay, out of all collections of garbage."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.enable()
        gc.set_threshold(20_000, 20, 10)  # the usual 700 objects are a frame or two


@pytest.fixture(scope="session", autouse=True)
def _one_thread():
    """Timings and sums that do not depend on the number of cores; xdist runs processes instead."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session", autouse=True)
def _interruptible():
    """Processes of tests hear Ctrl-C, which a shell ignores for commands in the background."""
    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    if ignored:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    if ignored:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@pytest.fixture(scope="session", autouse=True)
def _coarse_pictures():
    """Pictures have 50 dots per inch where a test asks for no other number: they are drawn faster."""
    from torchpose.viz._style import save_figure

    before, save_figure.__defaults__ = save_figure.__defaults__, (50,)
    yield
    save_figure.__defaults__ = before


@pytest.fixture(scope="session")
def small_windows_file(tmp_path_factory):
    """The file of a prior with windows, fitted once in a run; a module that uses it reads it."""
    from tests.shared_fits import fit_small_windows, fitted_once

    return fitted_once(tmp_path_factory, "small-windows", fit_small_windows)


@pytest.fixture(scope="module")
def prior(small_windows_file):
    """The prior with windows that is fitted once in a run."""
    from torchpose.priors import UpperBodyPrior

    return UpperBodyPrior.load(small_windows_file)


@pytest.fixture(scope="module")
def undoubted_cameras():
    """In a module of tests nobody looks for what is wrong with cameras that see a body's keypoints.

    That takes more than half of the time of a short track, and makes nothing but notes.
    """
    with _undoubted():
        yield


@pytest.fixture
def undoubted_here():
    """The same in one test."""
    with _undoubted():
        yield


@contextlib.contextmanager
def _undoubted():
    from torchpose.whole_body._keypoints.track_builder import TrackBuilder

    whole = TrackBuilder.track

    def track(*given, **options):
        return whole(*given, **options | {"cameras": False})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrackBuilder, "track", track)
        yield
