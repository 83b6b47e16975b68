"""The reproductions of the papers as commands: `python -m benchmarks.NAME`."""

import sys
from collections.abc import Sequence
from typing import NoReturn

from benchmarks._command import spell_out_switches
from torchpose.cli import guarded
from torchpose.cli._evaluate import Protocol, build, execute

PROTOCOLS = {
    "ub_people": Protocol(
        "benchmarks.ub_people", "persons whom the prior never saw (kinect_utd_mhad)", "folder"
    ),
    "ub_one": Protocol(
        "benchmarks.ub_one",
        "the paper's trackers on the authors' own recording (burke_kinect)",
        "folder",
    ),
    "signer": Protocol(
        "benchmarks.signer", "the authors' released sign-language tracker", "folder"
    ),
    "uncommon_poses": Protocol(
        "benchmarks.uncommon_poses",
        "training recordings of raised arms left out (kinect_utd_mhad)",
        "folder",
    ),
    "silhouette": Protocol(
        "benchmarks.silhouette.protocol",
        "whole bodies tracked from silhouettes of several cameras by three particle filters",
        "mocap",
    ),
    "root_uncertainty": Protocol(
        "benchmarks.root_uncertainty.protocol",
        "whole bodies by many hypotheses of the root, over cameras, frame rates, displacements",
        "mocap",
    ),
    "body_models": Protocol(
        "benchmarks.body_models",
        "whole bodies of persons whom a manifold, limb conditionals or actions do not know",
        "mocap",
    ),
    "bend": Protocol(
        "benchmarks.bend.protocol",
        "an action tracked from one camera, with and without the constraints of its action model",
        "mocap",
    ),
}


def run_protocol(name: str) -> NoReturn:
    """Run a protocol with the options of the command line, and exit."""
    sys.exit(execute_protocol(name, sys.argv[1:]))


def execute_protocol(name: str, arguments: Sequence[str]) -> int:
    """Run a protocol with the options of a command line, and return the exit code.

    Args:
        name: one of `PROTOCOLS`. arguments: what stands after the program; if they are refused, the
            exit code is 2.
    """

    def command(arguments: list[str]) -> int:
        protocol = PROTOCOLS[name]
        parser = build(f"benchmarks.{name}", protocol, "python -m")
        given = spell_out_switches(arguments, protocol.options)
        return execute(protocol, parser.parse_args(given))

    return guarded(command, list(arguments))
