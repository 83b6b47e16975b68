"""Describe errors in what the user gave in one sentence that names the key and the file."""

import errno
import traceback
from argparse import ArgumentError
from collections.abc import Sequence

import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException

from torchpose._core.terminal import one_line
from torchpose.errors import TorchposeError
from train.argument_errors import configuration_files, describe_argument_error

__all__ = ["is_full", "reason"]

_SETTINGS = "accelerator_connector"  # where Lightning looks at devices and strategies
_SEED = "seed.py"  # where it looks at seeds
_FULL = (errno.EDQUOT, errno.EFBIG, errno.ENOSPC)
_REFUSED = (*_FULL, errno.EACCES, errno.EIO, errno.EPERM, errno.EROFS)  # by the system


def reason(error: BaseException, arguments: Sequence[str]) -> str | None:
    """Return what was wrong, in one sentence, or None if it was nothing that the user gave.

    Args:
        error: that was raised. arguments: of the command.
    """
    if isinstance(error, TorchposeError | MisconfigurationException):
        return one_line(error)
    if isinstance(error, ArgumentError) or "Does not validate against" in str(error):
        return describe_argument_error(str(error), arguments, "fit")
    frames = traceback.extract_tb(error.__traceback__)
    if isinstance(error, ValueError) and frames and _SETTINGS in frames[-1].filename:
        return one_line(error)
    if isinstance(error, ValueError) and frames and frames[-1].filename.endswith(_SEED):
        return f"seed_everything: {one_line(error)}"
    files = ", ".join(map(str, configuration_files(arguments)))
    if isinstance(error, UnicodeDecodeError) and files:
        return f"{files}: expected UTF-8, got bytes that are none"
    if isinstance(error, OSError) and error.errno in _REFUSED:
        return f"{error.filename or 'logs'}: cannot be read or written ({error.strerror})"
    if isinstance(error, torch.distributed.DistError) or "gloo" in str(error):
        return "another process has gone, see its messages; go on with --ckpt_path last"
    return None


def is_full(error: BaseException) -> bool:
    """Return whether an error comes from a disk that is full."""
    cause = error if type(error) is OSError else error.__cause__
    return isinstance(cause, OSError) and cause.errno in _FULL
