"""Resident memory of this process, and its peak."""

import contextlib
import ctypes
import resource
import sys
from pathlib import Path

MB = 2**20


def resident() -> int:
    """Return the bytes of resident memory now."""
    return _status("VmRSS") or peak_resident()


def return_free_memory() -> None:
    """Hand what was freed back to the system, or results would be put where it counts as resident."""
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)


def forget_peak() -> None:
    """Start the system's count of the peak anew, where it can be done."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_resident() -> int:
    """Return the largest resident memory so far, bytes; getrusage also counts the process before `exec`."""
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return _status("VmHWM") or used * (1 if sys.platform == "darwin" else 1024)


def _status(key: str) -> int:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return 0
    found = [line.split()[1] for line in lines if line.startswith(f"{key}:")]
    return int(found[0]) * 1024 if found else 0
