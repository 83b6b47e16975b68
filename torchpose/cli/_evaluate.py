"""`torchpose evaluate`: priors and trackers on recordings of one's own; what runs any protocol."""

import json
from argparse import ArgumentError
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, NamedTuple

from jsonargparse import ArgumentParser, Namespace

from torchpose._core.terminal import show_progress
from torchpose.cli._command import add_options, new_parser, with_lists
from torchpose.cli._options import REQUIRED, Option, documented, options_of
from torchpose.errors import InputError

Data = Literal["folder", "recordings", "mocap"]
_COMMON = ("data", "out", "seed", "progress", "prior")
_MOVED = "earlier-*/*"
_METAVARS = {
    "added": "[DIR,...]", "compare": "[NAME=MODULE.FUNCTION,...]", "fits": "DIR", "more": "[DIR,...]",
    "out": "DIR", "part": "cross|added|both", "prior": "NAME|FILE", "tested": "[PERSON,...]",
}  # fmt: skip
_EXAMPLES: dict[Data, str] = {
    "folder": "--data data/",
    "recordings": "mine/ more/",
    "mocap": "--mocap data/mocap_cmu_walk/",
}


class Protocol(NamedTuple):
    """Describes an evaluation as a command.

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
        """Return the function, imported when it is asked for."""
        function: Callable[..., Any] = import_module(self.module).run
        return function

    @property
    def options(self) -> tuple[Option, ...]:
        """Return its options beside the common ones, by the signature of the function."""
        spaced = getattr(import_module(self.run.__module__), "SPACED", ())
        shared = PROTOCOLS["leave-one-person-out"].run
        return options_of(self.run, _COMMON, spaced=spaced, refers_to=shared)


PROTOCOLS = {
    "score": Protocol(
        "torchpose.evaluation._score",
        "a prior and a tracker on recordings of persons whom the prior does not know",
        "recordings",
    ),
    "leave-one-person-out": Protocol(
        "torchpose.evaluation._leave_one_person_out",
        "each person of some recordings under a prior of the others",
        "recordings",
    ),
    "learning-curve": Protocol(
        "torchpose.evaluation._learning_curve",
        "error over the number of training persons",
        "recordings",
    ),
    "cross-dataset": Protocol(
        "torchpose.evaluation._cross_dataset",
        "a prior of one data set on another one's persons, and what motion capture adds",
        "recordings",
    ),
}
BENCHMARKS = (
    "ub-people",
    "ub-one",
    "signer",
    "uncommon-poses",
    "silhouette",
    "root-uncertainty",
    "body-models",
    "bend",
)
"""Reproductions of the papers, which are run from a checkout."""


def main(arguments: list[str]) -> int:
    """Run the protocol that the arguments name, and return the exit code."""
    name = _protocol_name(arguments)
    if name is None:
        if {"-h", "--help"} & {*arguments}:
            _overview().parse_args(arguments)  # prints the help and ends
        raise ArgumentError(None, f"the protocol is missing; known are {', '.join(PROTOCOLS)}")
    rest, protocol = list(arguments), PROTOCOLS[name]
    rest.remove(name)
    words = with_lists(rest, protocol.options, by_place=1, alone=True)
    return execute(protocol, build(f"evaluate {name}", protocol).parse_args(words))


def _overview() -> ArgumentParser:
    """Return the parser for the help on all protocols."""
    known = "; ".join(f"{name}: {protocol.text}" for name, protocol in PROTOCOLS.items())
    return new_parser(
        "evaluate PROTOCOL",
        "Run an evaluation protocol on recordings, print its tables, and write them with pictures "
        f"into a folder. Protocols are {known}.",
        "\n".join(f"torchpose evaluate {name} --help" for name in PROTOCOLS),
    )


def _protocol_name(arguments: list[str]) -> str | None:
    """Return the first argument if it is no option, else the first one that names a protocol."""
    if arguments and not arguments[0].startswith("-"):
        name = arguments[0]
        if name in BENCHMARKS:
            raise ArgumentError(
                None,
                f"{name} reproduces a paper and is run from a checkout: "
                f"python -m benchmarks.{name.replace('-', '_')}",
            )
        if name not in PROTOCOLS:
            raise ArgumentError(
                None, f"unknown protocol {name!r}; known are {', '.join(PROTOCOLS)}"
            )
        return name
    return next((a for a in arguments if a in PROTOCOLS), None)


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
    common = [
        Option("out", "out", str, REQUIRED, "folder of the results"),
        Option("seed", "seed", int, 0, "seed of noise, viewpoints and fits"),
    ]
    texts = documented(protocol.run)
    if "prior" in texts or "prior" in protocol.run.__annotations__:
        text = texts.get("prior") or (
            "score this prior, fitted on other persons, instead of fitting one"
        )
        common.append(Option("prior", "prior", str, None, text))
    add_options(parser, [*common[:2], *protocol.options, *common[2:]], metavars=_METAVARS)
    return parser


def _add_data(parser: ArgumentParser, data: Data) -> None:
    """Add where the recordings are: by hand, since a protocol takes it as checked paths."""
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


def execute(protocol: Protocol, args: Namespace) -> int:
    """Run a protocol after checking its folders, print its summary, and return the exit code."""
    from torchpose._core.files import check_output_folder

    data = checked_data(protocol.data, args)
    given = {option.name: getattr(args, option.key) for option in protocol.options}
    own = {name: tuple(v) if isinstance(v, list) else v for name, v in given.items()}
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
    """Refuse to write the report over a file that is no earlier report."""
    from torchpose.evaluation._report import RESULTS
    from torchpose.io._results import refuse_stranger

    earlier = _is_report(out / "report.json")
    for name in ("report.json", "report.md"):
        refuse_stranger(out / name, RESULTS, earlier)


def _is_report(path: Path) -> bool:
    """Return whether a file is the report of an evaluation, of which earlier versions kept no list."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(found, dict) and {"settings", "tables", "findings"} <= found.keys()
