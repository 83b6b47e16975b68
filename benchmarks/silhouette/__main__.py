"""Run `python -m benchmarks.silhouette`."""

from benchmarks._command import main

main("silhouette")
