"""`torchpose evaluate`: priors and trackers on recordings of one's own."""

from argparse import ArgumentError

from jsonargparse import ArgumentParser

from torchpose.cli.common import new_parser
from torchpose.cli.protocol import Protocol, build, execute

PROTOCOLS = {
    "score": Protocol(
        "torchpose.evaluation.score",
        "a prior and a tracker on recordings of persons whom the prior does not know",
        "recordings",
    ),
    "leave-one-person-out": Protocol(
        "torchpose.evaluation.leave_one_person_out",
        "each person of some recordings under a prior of the others",
        "recordings",
    ),
    "learning-curve": Protocol(
        "torchpose.evaluation.learning_curve",
        "error over the number of training persons",
        "recordings",
    ),
    "cross-dataset": Protocol(
        "torchpose.evaluation.cross_dataset",
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
    rest = list(arguments)
    rest.remove(name)
    return execute(PROTOCOLS[name], build(f"evaluate {name}", PROTOCOLS[name]).parse_args(rest))


def _overview() -> ArgumentParser:
    """Parser for the help on all protocols."""
    known = "; ".join(f"{name}: {protocol.text}" for name, protocol in PROTOCOLS.items())
    return new_parser(
        "evaluate PROTOCOL",
        "Run an evaluation protocol on recordings, print its tables, and write them with pictures "
        f"into a folder. Protocols are {known}.",
        "\n".join(f"torchpose evaluate {name} --help" for name in PROTOCOLS),
    )


def _protocol_name(arguments: list[str]) -> str | None:
    """The first argument if it is no option, else the first one that names a protocol."""
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
