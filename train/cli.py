"""Run a command of `python -m train`, and turn its errors into messages and exit codes."""

import os
import signal
import sys
from collections.abc import Sequence
from typing import NoReturn

__all__ = ["end_process", "main"]

_HELP = """\
usage: python -m train COMMAND ...

commands:
  fit      fit a prior with Lightning: resumable, in one process or many
  select   choose its number of components by the likelihood of held-out persons
  predict  track many recordings, in one process or many

`python -m train COMMAND --help` lists the options of a command, --print_config writes them as YAML,
--config FILE reads them, --debug shows the traceback of an error.

examples:
  python -m train fit --config configs/kinect-upper-body.yaml
  python -m train fit --data.paths '[recordings/]' --prior.out prior.safetensors --ckpt_path auto
  torchrun --nproc-per-node 2 -m train fit --config configs/many-machines.yaml
"""
_NEEDED = ("lightning", "tensorboard")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    0 done, 1 done but not all is good, 2 refused, 130 interrupted (Ctrl-C), 143 terminated (SIGTERM).

    Args:
        argv: what stands after `python -m train`; `sys.argv[1:]` if None.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    command = arguments[0] if arguments else ""
    if command in ("", "-h", "--help"):
        print(_HELP, end="", file=sys.stdout if command else sys.stderr)
        return 0 if command else 2
    if command == "predict":
        return _predict(arguments[1:])
    if command in ("fit", "select"):
        return _fit(arguments)
    return _refuse(f"unknown command {command!r}; known are fit, select and predict")


def end_process(status: int) -> NoReturn:
    """End this process with an exit code, without Python's own clearing up if it is one of several.

    Threads of gloo may still hold tensors of the last exchange. To free them they need Python's lock:
    Python waits for these threads while it holds the lock, or aborts them (SIGABRT) once it is half gone.

    Args:
        status: the exit code.
    """
    distributed = sys.modules.get("torch.distributed")
    if distributed is not None and distributed.is_available() and distributed.is_initialized():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)


def _predict(arguments: list[str]) -> int:
    from train.stopping import raise_if_signalled, signal_of, stopped_by_signals

    try:
        with stopped_by_signals():
            from train.predict import main as predict  # takes seconds

            raise_if_signalled()
            code = predict(arguments)
            raise_if_signalled()  # `main` returns the code of any exit, as that of --help
            return code
    except (KeyboardInterrupt, SystemExit) as error:
        stopped = signal_of(error)
        if stopped is None:
            raise
        return _stop(stopped, "run the same command again to go on")


def _fit(arguments: list[str]) -> int:
    from train.stopping import raise_if_signalled, signal_of, stopped_by_signals

    debug = "--debug" in arguments or os.environ.get("TORCHPOSE_DEBUG", "0") not in ("", "0")
    arguments = [a for a in arguments if a != "--debug"]
    try:
        with stopped_by_signals():
            from train.command import run  # takes seconds

            raise_if_signalled()
            run(arguments)
    except BaseException as error:
        stopped = signal_of(error)
        if stopped is not None:
            return _stop(stopped, _how_to_go_on())
        if isinstance(error, SystemExit):  # --help and --print_config
            return error.code if isinstance(error.code, int) else 0
        text = None if debug else _reason(error, arguments)
        if text is None:
            raise
        return _refuse(text)
    return 0


def _reason(error: BaseException, arguments: list[str]) -> str | None:
    """Return what was wrong, in one sentence, or None if it was nothing that the user gave."""
    if isinstance(error, ModuleNotFoundError):
        missing = error.name if (error.name or "").partition(".")[0] in _NEEDED else None
        return missing and (
            f"training needs {missing}; run `python -m pip install -e '.[train]'` in the checkout"
        )
    from train.refusals import is_full, reason

    text = reason(error, arguments)
    return f"{text}; once there is room, {_how_to_go_on()}" if text and is_full(error) else text


def _stop(stopped: signal.Signals, how: str) -> int:
    """Say how to resume, and return the exit code that shells give to a process ended by a signal."""
    if _rank() == "0":
        what = "interrupted" if stopped == signal.SIGINT else "terminated"
        print(f"train: {what}; {how}", file=sys.stderr)
    return 128 + stopped


def _how_to_go_on() -> str:
    command = sys.modules.get("train.command")  # not yet there if it was stopped while loading
    return "run the same command again" if command is None else str(command.how_to_go_on())


def _rank() -> str:
    return os.environ.get("RANK", os.environ.get("LOCAL_RANK", "0"))


def _refuse(text: str) -> int:
    rank = _rank()
    of = "" if rank == "0" else f" (process {rank})"
    print(f"train: error{of}: {text}", file=sys.stderr)
    return 2
