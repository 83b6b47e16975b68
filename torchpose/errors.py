"""Define the typed errors.

Every message says what was expected, what came, and what to do about it. Messages are one line of
printable characters, whatever the file or the name that they quote.
"""

from typing import Any

__all__ = [
    "CameraError",
    "CovarianceError",
    "DegenerateFilterWarning",
    "FileFormatError",
    "InputError",
    "MissingDependencyError",
    "NobodySeenError",
    "OutputError",
    "OverlapError",
    "PriorError",
    "ShapeError",
    "SkeletonError",
    "TorchposeError",
]


_LONGEST, _TAIL = 1200, 300  # characters of a message, and how many of those are of its end


def printable(text: str, longest: int = _LONGEST) -> str:
    r"""Return text as one line: controls escaped, white space joined, cut in its middle if too long.

    What a file or a name holds may be printed on a terminal, where controls would act.

    >>> printable("red \x1b[31m\n  text")
    'red \\x1b[31m text'
    """
    if len(text) > longest:
        tail = min(_TAIL, longest // 4)
        cut = f" [... {len(text) - longest} characters ...] "
        text = text[: longest - tail - len(cut)] + cut + text[len(text) - tail :]
    if text.isprintable():
        return text
    line = " ".join(text.split()) if "\n" in text else text
    escaped = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
    return escaped if len(escaped) <= longest else printable(escaped, longest)


class TorchposeError(Exception):
    """Serves as the base class of the errors that torchpose raises on purpose; messages are `printable`."""

    def __init__(self, *args: Any, **facts: Any) -> None:
        super().__init__(*(printable(a) if isinstance(a, str) else a for a in args), **facts)


class ShapeError(TorchposeError, ValueError):
    """Signals that a tensor has the wrong number of dimensions or a wrong size."""


class InputError(TorchposeError, ValueError):
    """Signals a value outside what is allowed: NaN, infinity, a negative weight, an empty sequence."""


class CovarianceError(InputError):
    """Signals that a covariance is not symmetric or not positive definite."""


class CameraError(InputError):
    """Signals that a camera lacks a focal length, or that no camera can be determined for the input."""


class SkeletonError(InputError):
    """Signals that joint names are unknown, or that the joints do not form the expected skeleton."""


class PriorError(InputError):
    """Signals that a prior does not fit the task: other skeleton, rotation order, neck, or state size."""


class NobodySeenError(InputError):
    """Signals that no frame shows a person: not in the silhouettes of all cameras, or not in keypoints."""


class OverlapError(InputError):
    """Signals that a model would be scored on persons on whom it was fitted."""


class FileFormatError(TorchposeError, ValueError):
    """Signals that a file is truncated, of another kind, or holds other keys than expected."""


class OutputError(TorchposeError, OSError):
    """Signals that output cannot be written to the given place."""


class MissingDependencyError(TorchposeError, ImportError):
    """Signals that an optional package is needed for this call and is not installed."""


class DegenerateFilterWarning(UserWarning):
    """Warns that some elements of a batch degenerated while the others finished."""


def __dir__() -> list[str]:
    return sorted({*__all__, "__all__", "__doc__", "__file__", "__name__"})
