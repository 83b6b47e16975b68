"""Run `python -m benchmarks.bend`."""

from benchmarks._command import main

main(
    "bend",
    "an action tracked from one camera, with and without the constraints of its action model",
    "mocap",
    "benchmarks.bend.protocol",
)
