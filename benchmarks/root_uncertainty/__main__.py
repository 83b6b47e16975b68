"""Run `python -m benchmarks.root_uncertainty`."""

from benchmarks._command import main

main(
    "root_uncertainty",
    "whole bodies by many hypotheses of the root, over cameras, frame rates, displacements",
    "mocap",
    "benchmarks.root_uncertainty.protocol",
)
