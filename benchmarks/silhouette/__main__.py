"""Run `python -m benchmarks.silhouette`."""

from benchmarks._command import main

main(
    "silhouette",
    "whole bodies tracked from silhouettes of several cameras by three particle filters",
    "mocap",
    "benchmarks.silhouette.protocol",
)
