"""`torchpose evaluate`: the protocols that published figures come from."""

import inspect
import json
import re
import typing
from argparse import ArgumentError
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from jsonargparse import ArgumentParser, Namespace

from torchpose.cli.common import add_seed, new_parser, show_progress
from torchpose.errors import InputError

PROTOCOLS = {
    "ub-people": ("ub_people", "persons whom the prior never saw (kinect_utd_mhad)"),
    "ub-one": ("ub_one", "the paper's trackers on the authors' own recording (burke_kinect)"),
    "signer": ("signer", "the authors' released sign-language tracker"),
    "leave-one-person-out": (
        "leave_one_person_out",
        "each person of some recordings under a prior of the others",
    ),
    "learning-curve": (
        "learning_curve",
        "error over the number of training persons (kinect_utd_mhad and more)",
    ),
    "cross-dataset": (
        "cross_dataset",
        "a prior of one data set on another one's persons, and what motion capture adds",
    ),
    "uncommon-poses": (
        "uncommon_poses",
        "training recordings of raised arms left out (kinect_utd_mhad)",
    ),
    "silhouette": (
        "silhouette",
        "whole bodies tracked from silhouettes of several cameras by three particle filters",
    ),
    "root-uncertainty": (
        "root_uncertainty",
        "whole bodies by many hypotheses of the root, over cameras, frame rates, displacements",
    ),
    "body-models": (
        "body_models",
        "whole bodies of persons whom a manifold, limb conditionals or actions do not know",
    ),
    "bend": (
        "bend",
        "an action tracked from one camera, with and without the constraints of its action model",
    ),
}
_SEVERAL = ("leave-one-person-out",)
"""Protocols on recordings from any folders; the others know theirs by name."""
_MOCAP = ("silhouette", "root-uncertainty", "body-models", "bend")
"""Protocols on any one folder of motion capture."""
_COMMON = ("data", "out", "seed", "progress")
_MOVED = "earlier-*/*"
_PLAIN = (int, float, bool, str, type(None))


def main(arguments: list[str]) -> int:
    """Run the protocol that the arguments name, and return the exit code."""
    name = _protocol_name(arguments)
    if name is None:
        if {"-h", "--help"} & {*arguments}:
            build(None).parse_args(arguments)  # prints the help and ends
        raise ArgumentError(None, f"the protocol is missing; known are {', '.join(PROTOCOLS)}")
    rest = list(arguments)
    rest.remove(name)
    return run(name, build(name).parse_args(rest))


def build(name: str | None) -> ArgumentParser:
    """Parser of one protocol with the options that are its own; of none, for the help."""
    known = "; ".join(f"{protocol}: {text}" for protocol, (_, text) in PROTOCOLS.items())
    parser = new_parser(
        f"evaluate {name or 'PROTOCOL'}",
        "Run an evaluation protocol on recordings, print its tables, and write them with pictures "
        f"into a folder. Protocols are {known}.",
        "\n".join(f"torchpose evaluate {p} {_example(p)} --out result" for p in PROTOCOLS),
    )
    add = parser.add_argument
    if name in _SEVERAL:
        add("recordings", nargs="*", type=str, metavar="DIR", help="folders or files of recordings")
        add("--data", type=str, metavar="DIR", help="one folder, instead of or beside these")
    elif name in _MOCAP:
        text = (
            "folder or file of recordings of whole bodies, such as .npz of 3D joints; or HumanEva-I"
        )
        add("--data", "--mocap", type=str, required=True, metavar="DIR", help=text)
    else:
        add("--data", type=str, required=True, metavar="DIR", help="folder with the recordings")
    add("--out", type=str, required=True, metavar="DIR", help="folder of the results")
    add_seed(parser, "noise, viewpoints and fits")
    if name is not None:
        _add_own_options(parser, _runner(name))
    return parser


def run(name: str, args: Namespace) -> int:
    """Run a protocol after checking its folders, and print its summary."""
    from torchpose._core.files import check_output_folder

    data: Any = _folders(args) if name in _SEVERAL else Path(args.data)
    if name in _MOCAP and not data.exists():
        raise InputError(f"--mocap {data}: no such folder or file of motion capture")
    if isinstance(data, Path) and name not in _MOCAP and not data.is_dir():
        raise InputError(f"--data {data}: no such folder; expected the one with the recordings")
    function = _runner(name)
    given = {key: getattr(args, key) for key in _own_options(function)}
    own = {key: tuple(v) if isinstance(v, list) else v for key, v in given.items()}
    if getattr(args, "prior", None) is not None:
        from torchpose.priors.upper_body import load_prior

        own["prior"] = load_prior(args.prior)
    out = check_output_folder(args.out)
    _refuse_other_reports(out)
    moved = {*out.glob(_MOVED)}
    report = function(data, out, seed=args.seed, progress=show_progress(), **own)
    print(report.summary())
    for path in sorted({*out.glob(_MOVED)} - moved):
        print(f"note: what was in the place of {path.name} was moved to {path}")
    return 0


def _refuse_other_reports(out: Path) -> None:
    """See that the report will be written over none but an earlier one."""
    from torchpose.evaluation.report import RESULTS
    from torchpose.io.results import refuse_stranger

    earlier = _is_report(out / "report.json")
    for name in ("report.json", "report.md"):
        refuse_stranger(out / name, RESULTS, earlier)


def _is_report(path: Path) -> bool:
    """Whether it is a report of this command, which earlier versions kept no list of."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(found, dict) and {"settings", "tables", "findings"} <= found.keys()


def _folders(args: Namespace) -> list[Path]:
    """Where the recordings are, given one by one or by --data."""
    given = [*(args.recordings or ()), *([args.data] if args.data else ())]
    if not given:
        raise InputError("expected folders or files of recordings, got none; see --help")
    return [Path(path) for path in given]


def _example(name: str) -> str:
    if name in _SEVERAL:
        return "mine/ more/"
    return "--mocap data/mocap_cmu_walk/" if name in _MOCAP else "--data data/"


def _protocol_name(arguments: list[str]) -> str | None:
    """The first argument if it is no option, else the first one that names a protocol."""
    if arguments and not arguments[0].startswith("-"):
        if arguments[0] not in PROTOCOLS:
            raise ArgumentError(
                None, f"unknown protocol {arguments[0]!r}; known are {', '.join(PROTOCOLS)}"
            )
        return arguments[0]
    return next((a for a in arguments if a in PROTOCOLS), None)


def _runner(name: str) -> Callable[..., Any]:
    module = import_module(f"torchpose.evaluation.{PROTOCOLS[name][0]}")
    return module.run


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
            help="score this prior, fitted on other persons, instead of fitting one",
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
