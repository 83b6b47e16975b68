"""Run `python -m benchmarks.bend`."""

from benchmarks._protocols import run_protocol

run_protocol("bend")
