"""Run `python -m benchmarks.root_uncertainty`."""

from benchmarks._command import main

main("root_uncertainty")
