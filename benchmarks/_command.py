"""`python -m benchmarks.NAME` for the reproductions of the papers."""

import sys
from typing import Any

from torchpose.cli import guarded
from torchpose.cli.protocol import Data, Protocol, build, execute

__all__ = ["main"]


def main(name: str, text: str, data: Data, module: str | None = None) -> None:
    """Run a protocol with the options of the command line, and exit.

    Args:
        name: of the module or package in benchmarks. text: what it evaluates, for the help.
        data: what it runs on, as `Protocol` has it.
        module: full name of the module that has `run`; `benchmarks.NAME` if None.
    """
    protocol = Protocol(module or f"benchmarks.{name}", text, data)

    def command(arguments: list[str]) -> int:
        parser = build(f"benchmarks.{name}", protocol, "python -m")
        args: Any = parser.parse_args(arguments)
        return execute(protocol, args)

    sys.exit(guarded(command, sys.argv[1:]))
