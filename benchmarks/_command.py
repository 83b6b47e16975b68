"""`python -m benchmarks.NAME` for the reproductions of the papers."""

import sys

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


def main(name: str) -> None:
    """Run a protocol with the options of the command line, and exit."""
    sys.exit(run(name, sys.argv[1:]))


def run(name: str, arguments: list[str]) -> int:
    """Run a protocol, and return the exit code: 2 if it refuses what it was given."""

    def command(arguments: list[str]) -> int:
        parser = build(f"benchmarks.{name}", PROTOCOLS[name], "python -m")
        return execute(PROTOCOLS[name], parser.parse_args(arguments))

    return guarded(command, arguments)
