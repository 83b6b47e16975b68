"""A disk that is full, for tests of what is written."""

import contextlib

import pytest


@contextlib.contextmanager
def files_up_to(size):
    """A limit of the system to the size of files, met as a full disk is met."""
    resource = pytest.importorskip("resource", reason="limits of the system")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
