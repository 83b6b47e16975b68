"""Run `python -m benchmarks.silhouette`."""

from benchmarks._protocols import run_protocol

run_protocol("silhouette")
