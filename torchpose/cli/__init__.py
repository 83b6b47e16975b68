"""The command `torchpose`: fit, track, evaluate, demo, info.

Each command is a module with `run`, a function whose parameters are the options (`Command`), and `main`,
which reads the command line and calls it. The module is imported when the command is called for, so that
help comes up at once. Exit codes: 0 done; 1 done, but the result is not good; 2 refused (input, options,
output), with one line on stderr; 130 interrupted.
"""

import atexit
import gc
import os
import sys
from argparse import ArgumentError
from collections.abc import Callable, Sequence
from importlib import import_module
from types import ModuleType

__all__ = ["main"]

COMMANDS = {
    "track": "video or 2D keypoints to poses of the upper body",
    "track-body": "keypoints or videos of calibrated cameras to poses of the whole body",
    "fit": "fit a prior to recorded 3D poses",
    "evaluate": "score priors on recordings: score, leave-one-person-out, ...",
    "demo": "track an animated performer; needs no data",
    "info": "version, shipped models, contents of a file",
}
_EXAMPLES = """\
examples:
  torchpose demo --out demo-output
  torchpose track clip.mp4 --out result
  torchpose track keypoints.npz --out result
  torchpose track keypoints.csv --out result --camera 525,525,319.5,239.5 --smoothing full
  torchpose fit recordings/ --out prior.safetensors --components 30 --seed 0
  torchpose evaluate score recordings/ --prior kinect-upper-body --out result
  torchpose info kinect-upper-body"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    Args:
        argv: what stands after `torchpose` on the command line; `sys.argv[1:]` if None.
    """
    return guarded(_dispatch, list(sys.argv[1:] if argv is None else argv))


def guarded(command: Callable[[list[str]], int], arguments: list[str]) -> int:
    """Return the exit code of a command; what it refuses is one line on stderr.

    Args:
        command: takes arguments, and returns an exit code.
        arguments: what stands after the program; `--debug` among them shows tracebacks.
    """
    debug = "--debug" in arguments or os.environ.get("TORCHPOSE_DEBUG", "0") not in ("", "0")
    arguments = [a for a in arguments if a != "--debug"]
    try:
        return command(arguments)
    except SystemExit as stop:  # --help and --print_config
        return stop.code if isinstance(stop.code, int) else 0
    except KeyboardInterrupt:
        print(
            "torchpose: interrupted; files that were not finished were not written", file=sys.stderr
        )
        return 130
    except BrokenPipeError:  # the reader of a pipe has gone, as in `torchpose info | head -1`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        if debug or not _is_refusal(error):
            raise
        from torchpose._core.terminal import one_line

        print(f"torchpose: error: {one_line(error)}", file=sys.stderr)
        return 2


def _is_refusal(error: Exception) -> bool:
    """Return whether an error is about what the user gave; anything else is a bug."""
    if isinstance(error, ArgumentError):
        return True
    from torchpose.errors import TorchposeError  # here, because it imports torch

    return isinstance(error, TorchposeError)


def _dispatch(arguments: list[str]) -> int:
    first = arguments[0] if arguments else ""
    if first in ("", "-h", "--help"):
        print(_help(), file=sys.stdout if first else sys.stderr)
        return 0 if first else 2
    if first == "--version":
        import torchpose

        print(f"torchpose {torchpose.__version__}")
        return 0
    if first not in COMMANDS:
        raise ArgumentError(None, f"unknown command {first!r}; known are {', '.join(COMMANDS)}")
    return _module(f"torchpose.cli._{first.replace('-', '_')}").main(arguments[1:])


def _module(name: str) -> ModuleType:
    """Return a module, imported without collections of garbage, then or later, among what it brings.

    PyTorch brings 200 000 objects that stay. To visit them over and over takes a quarter of the import's
    time, as much again when Python ends, and a tenth of a second whenever it happens in between.
    """
    if name in sys.modules or not gc.isenabled():
        return import_module(name)
    gc.disable()
    try:
        return import_module(name)
    finally:
        gc.freeze()
        gc.enable()
        atexit.register(gc.freeze)  # of the rest too: what ends needs no collection


def _help() -> str:
    commands = "\n".join(f"  {name:<11} {text}" for name, text in COMMANDS.items())
    return (
        "usage: torchpose COMMAND ...\n\n"
        "Bayesian human-pose tracking: from video or 2D keypoints to 3D poses with covariances.\n\n"
        f"commands:\n{commands}\n\n"
        "options:\n"
        "  -h, --help  this text; `torchpose COMMAND --help` for the options of a command\n"
        "  --version   print the version\n"
        "  --debug     with any command: show the traceback of an error (as TORCHPOSE_DEBUG=1 does)\n\n"
        "Every command takes --config FILE with its options as YAML; --print_config prints them.\n\n"
        f"{_EXAMPLES}"
    )
