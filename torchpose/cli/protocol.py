"""Command line of an evaluation protocol: its options from the signature of its `run`."""

import inspect
import json
import re
import typing
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, NamedTuple

from jsonargparse import ArgumentParser, Namespace

from torchpose._core.terminal import show_progress
from torchpose.cli.common import add_seed, new_parser
from torchpose.errors import InputError

__all__ = ["Protocol", "build", "checked_data", "execute"]

Data = Literal["folder", "recordings", "mocap"]
_COMMON = ("data", "out", "seed", "progress")
_MOVED = "earlier-*/*"
_PLAIN = (int, float, bool, str, type(None))
_EXAMPLES: dict[Data, str] = {
    "folder": "--data data/",
    "recordings": "mine/ more/",
    "mocap": "--mocap data/mocap_cmu_walk/",
}


class Protocol(NamedTuple):
    """An evaluation as a command.

    Attributes:
        module: full name of the module whose `run(data, out, *, seed, progress, ...)` it is.
        text: what it evaluates, for the help.
        data: what it runs on: "folder" is one with data sets of known names, "recordings" any
            folders or files of them, "mocap" one folder or file of whole bodies.
    """

    module: str
    text: str
    data: Data

    @property
    def run(self) -> Callable[..., Any]:
        """The function, imported when it is asked for."""
        function: Callable[..., Any] = import_module(self.module).run
        return function


def build(command: str, protocol: Protocol, program: str = "torchpose") -> ArgumentParser:
    """Return the parser of a protocol.

    Args:
        command: what is typed after the program to run it. protocol: which one it is.
        program: what is typed first.
    """
    parser = new_parser(
        command,
        f"Evaluate {protocol.text}; print the tables, and write them with pictures into a folder.",
        f"{program} {command} {_EXAMPLES[protocol.data]} --out result",
        program,
    )
    _add_data(parser, protocol.data)
    parser.add_argument(
        "--out", type=str, required=True, metavar="DIR", help="folder of the results"
    )
    add_seed(parser, "noise, viewpoints and fits")
    _add_own_options(parser, protocol.run)
    return parser


def execute(protocol: Protocol, args: Namespace) -> int:
    """Run a protocol after checking its folders, print its summary, and return the exit code."""
    from torchpose._core.files import check_output_folder

    data = checked_data(protocol.data, args)
    given = {key: getattr(args, key) for key in _own_options(protocol.run)}
    own = {key: tuple(v) if isinstance(v, list) else v for key, v in given.items()}
    if getattr(args, "prior", None) is not None:
        from torchpose.priors import load_prior

        own["prior"] = load_prior(args.prior)
    out = check_output_folder(args.out)
    _refuse_other_reports(out)
    moved = {*out.glob(_MOVED)}
    report = protocol.run(data, out, seed=args.seed, progress=show_progress(), **own)
    print(report.summary())
    for path in sorted({*out.glob(_MOVED)} - moved):
        print(f"note: what was in the place of {path.name} was moved to {path}")
    return 0


def _add_data(parser: ArgumentParser, data: Data) -> None:
    add = parser.add_argument
    if data == "recordings":
        add("recordings", nargs="*", type=str, metavar="DIR", help="folders or files of recordings")
        add("--data", type=str, metavar="DIR", help="one folder, instead of or beside these")
    elif data == "mocap":
        text = (
            "folder or file of recordings of whole bodies, such as .npz of 3D joints; or HumanEva-I"
        )
        add("--data", "--mocap", type=str, required=True, metavar="DIR", help=text)
    else:
        add("--data", type=str, required=True, metavar="DIR", help="folder with the recordings")


def checked_data(data: Data, args: Namespace) -> Any:
    """Return the folder or folders of the recordings, which have to be there."""
    if data == "recordings":
        given = [*(args.recordings or ()), *([args.data] if args.data else ())]
        if not given:
            raise InputError("expected folders or files of recordings, got none; see --help")
        paths = [Path(path) for path in given]
        missing = [path for path in paths if not path.exists()]
        if missing:
            raise InputError(f"{missing[0]}: no such folder or file of recordings")
        return paths
    path = Path(args.data)
    if data == "mocap" and not path.exists():
        raise InputError(f"--mocap {path}: no such folder or file of motion capture")
    if data == "folder" and not path.is_dir():
        raise InputError(f"--data {path}: no such folder; expected the one with the recordings")
    return path


def _refuse_other_reports(out: Path) -> None:
    """See that the report will be written over none but an earlier one."""
    from torchpose.evaluation.report import RESULTS
    from torchpose.io._results import refuse_stranger

    earlier = _is_report(out / "report.json")
    for name in ("report.json", "report.md"):
        refuse_stranger(out / name, RESULTS, earlier)


def _is_report(path: Path) -> bool:
    """Whether it is a report of an evaluation, which earlier versions kept no list of."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(found, dict) and {"settings", "tables", "findings"} <= found.keys()


def _add_own_options(parser: ArgumentParser, function: Callable[..., Any]) -> None:
    """Add the options of a protocol, with their help from its docstring."""
    own, parameters = _own_options(function), inspect.signature(function).parameters
    texts = _documented(function)
    hints = typing.get_type_hints(function)
    spaced = getattr(import_module(function.__module__), "SPACED", ())
    for key in own:
        if key in spaced:  # words with blanks between them, for those who type
            parser.add_argument(
                f"--{key.replace('_', '-')}", type=typing.get_args(hints[key])[0], nargs="+",
                metavar="N" if int in typing.get_args(hints[key]) else key.upper(),
                default=list(parameters[key].default), help=texts.get(key),
            )  # fmt: skip
            continue
        numbers = {int, float} & {hints[key], *typing.get_args(hints[key])}
        kind = "true|false" if hints[key] is bool else "N" if numbers else key.upper()
        parser.add_argument(
            f"--{key.replace('_', '-')}",
            type=hints[key],
            default=parameters[key].default,
            metavar=kind,
            help=texts.get(key),
        )
    if "prior" in parameters:
        parser.add_argument(
            "--prior",
            type=str,
            metavar="NAME|FILE",
            help=texts.get(
                "prior", "score this prior, fitted on other persons, instead of fitting one"
            ),
        )


def _documented(function: Callable[..., Any]) -> dict[str, str]:
    """Text of each parameter in the Args section; one line may hold several."""
    section = re.search(r"\n\s*Args:\n(.*?)(\n\s*\n|$)", function.__doc__ or "", re.DOTALL)
    text = " ".join(section[1].split()) if section else ""
    parts = re.split(rf"\b({'|'.join(inspect.signature(function).parameters)}): ", text)
    return {
        name: words.strip().rstrip(".")
        for name, words in zip(parts[1::2], parts[2::2], strict=True)
    }


def _own_options(function: Callable[..., Any]) -> list[str]:
    """Parameters beside the common ones that a command line can give: numbers, words, lists."""
    hints = typing.get_type_hints(function)
    return [
        key
        for key in inspect.signature(function).parameters
        if key not in _COMMON and _is_plain(hints.get(key))
    ]


def _is_plain(hint: Any) -> bool:
    parts = [part for part in typing.get_args(hint) if part is not Ellipsis]
    if typing.get_origin(hint) is typing.Literal:
        return True
    return hint in _PLAIN or (bool(parts) and all(_is_plain(part) for part in parts))
