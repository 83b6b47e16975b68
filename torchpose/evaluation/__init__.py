"""Evaluation protocols on real recordings, each one function: ``run(data, out)`` gives a `Report`.

- `ub_people`: persons whom the prior never saw (UTD-MHAD).
- `ub_one`: the paper's comparison of trackers on the authors' own recording.
- `signer`: the released sign-language tracker, and how well hand positions are predicted.
- `leave_one_person_out`: each person of any recordings under a prior of the others.
- `learning_curve`: error over the number of training persons; one person's prior against many.
- `cross_dataset`: a prior of one data set on another one's persons, and what motion capture adds.
- `uncommon_poses`: training recordings of raised arms left out.
- `silhouette`: whole bodies in silhouettes of several cameras, by three particle filters.
- `root_uncertainty`: the same with many hypotheses of the root, over cameras and frame rates.
- `bend`: an action in one camera, with and without the constraints of its action model.
"""

from torchpose.evaluation.report import Report, Table

__all__ = ["PROTOCOLS", "Report", "Table", "run_protocol"]

PROTOCOLS = (
    "ub-people",
    "ub-one",
    "signer",
    "leave-one-person-out",
    "learning-curve",
    "cross-dataset",
    "uncommon-poses",
    "silhouette",
    "root-uncertainty",
    "body-models",
    "bend",
)


def run_protocol(name: str, data: str, out: str, **options: object) -> Report:
    """Run a protocol by its name; options as its own `run` has them.

    Raises:
        InputError: an unknown name.
    """
    from importlib import import_module

    from torchpose.errors import InputError

    if name not in PROTOCOLS:
        raise InputError(f"protocol must be one of {', '.join(PROTOCOLS)}, got {name!r}")
    module = import_module(f"torchpose.evaluation.{name.replace('-', '_')}")
    report: Report = module.run(data, out, **options)
    return report
