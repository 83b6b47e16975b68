"""Run `python -m benchmarks.bend`."""

from benchmarks._command import main

main("bend")
