"""Call a function in a process of its own, so that a peak of memory is that of one call."""

import json
import subprocess
import sys
from importlib import import_module
from typing import Any

from benchmarks.speed._timing import limit_threads


def call_in_new_process(threads: int, module: str, function: str, *arguments: Any) -> Any:
    """Call a function in a new process, and return its result.

    Args:
        threads: of the process. module: full name of the function's module. function: its name.
        arguments: of the function; they, and what it returns, are written as JSON.
    """
    command = [sys.executable, "-m", __spec__.name, str(threads), module, function]
    done = subprocess.run(
        [*command, json.dumps(arguments)], check=True, stdout=subprocess.PIPE, text=True
    )
    return json.loads(done.stdout.splitlines()[-1])


def _main() -> None:
    """Call the function that the command line names, and print what it returns."""
    threads, module, function, arguments = sys.argv[1:]
    limit_threads(int(threads))
    print(json.dumps(getattr(import_module(module), function)(*json.loads(arguments))))


if __name__ == "__main__":
    _main()
