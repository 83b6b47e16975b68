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
    """Base class of every error that torchpose raises on purpose; its message is `printable`."""

    def __init__(self, *args: Any, **facts: Any) -> None:
        super().__init__(*(printable(a) if isinstance(a, str) else a for a in args), **facts)


class ShapeError(TorchposeError, ValueError):
    """A tensor has the wrong number of dimensions or a wrong size."""


class InputError(TorchposeError, ValueError):
    """A value is outside what is allowed: NaN, infinity, a negative weight, an empty sequence."""


class CovarianceError(InputError):
    """A covariance is not symmetric or not positive definite."""


class CameraError(InputError):
    """A camera lacks a focal length, or no camera can be told for the input."""


class SkeletonError(InputError):
    """Joint names are unknown, or the joints do not form the expected skeleton."""


class PriorError(InputError):
    """A prior does not fit the task: other skeleton, rotation order, neck, or state size."""


class NobodySeenError(InputError):
    """Nobody is seen by all cameras in any frame of some silhouettes."""


class OverlapError(InputError):
    """A model would be scored on persons whom it was fitted on."""


class FileFormatError(TorchposeError, ValueError):
    """A file is truncated, of another kind, or holds other keys than expected."""


class OutputError(TorchposeError, OSError):
    """Output cannot be written where it was asked for."""


class MissingDependencyError(TorchposeError, ImportError):
    """An optional package is needed for this call and is not installed."""


class DegenerateFilterWarning(UserWarning):
    """Some elements of a batch degenerated; the others finished."""


def __dir__() -> list[str]:
    return sorted({*__all__, "__all__", "__doc__", "__file__", "__name__"})
