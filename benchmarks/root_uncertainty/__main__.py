"""Run `python -m benchmarks.root_uncertainty`."""

from benchmarks._protocols import run_protocol

run_protocol("root_uncertainty")
