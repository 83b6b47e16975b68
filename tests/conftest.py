"""Shape checks of every annotated function, and settings of the whole run.

TORCHPOSE_SHAPE_CHECKS=0 switches the shape checks off, for profiling or a debugger.
"""

import os
import sys

import pytest
from jaxtyping import install_import_hook

import tests.shape_checks  # the hook finds it by this name  # noqa: F401

if os.environ.get("TORCHPOSE_SHAPE_CHECKS", "1") != "0":
    if any(name.startswith("torchpose.") for name in sys.modules):
        raise RuntimeError("torchpose was imported before the shape checks were set up")
    install_import_hook("torchpose", "tests.shape_checks.check_after_call")


def pytest_addoption(parser):
    parser.addoption(
        "--fuzz-seconds",
        type=float,
        default=30.0,
        help="processor time for damaged files and odd calls (tests/fuzz; default 30)",
    )


@pytest.fixture(scope="session", autouse=True)
def _one_thread():
    """Timings and sums that do not depend on the number of cores; xdist runs processes instead."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
