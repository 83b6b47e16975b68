"""Runs and priors kept in a folder, each under a name that changes with everything that it depends on."""

import hashlib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from torchpose.errors import TorchposeError
from torchpose.evaluation._trials import keep, read_kept, settings_hash
from torchpose.priors import UpperBodyPrior

_CHECKOUT = Path(__file__).parents[2]


@cache
def source_hash(*names: str, root: Path = _CHECKOUT) -> str:
    """Return sixteen letters that change with the source of these modules and packages.

    A run that is kept under them is made anew once a constant, a default or a formula of what it was
    made with has changed. The files are read once in a process.

    Args:
        names: of files and folders in `root`, such as "torchpose/filters" and "benchmarks/ub_one.py".
    """
    digest = hashlib.sha256()
    for name in names:
        at = root / name
        for path in sorted(at.rglob("*.py")) if at.is_dir() else [at]:
            digest.update(path.relative_to(root).as_posix().encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def kept_runs(
    folder: Path,
    kind: Any,
    facts: Sequence[Any],
    seeds: Sequence[int],
    make: Callable[[Sequence[int]], Sequence[Any]],
) -> list[Any]:
    """Return one run for each seed; those that are not in the folder are made as one batch.

    A run that was made is read back from its file, so that an experiment that goes on where it was
    stopped works with the same bits.

    Args:
        folder: with a file for each run; damaged files are replaced.
        kind: of the runs, a NamedTuple of tensors.
        facts: everything beside the seed that a run depends on (`settings_hash`).
        seeds: of the runs. make: runs for the seeds that are missing.
    """

    def read(seed: int) -> Any:
        return read_kept(paths[seed], kind, kind._fields)

    paths = {s: folder / f"run-{settings_hash([kind.__name__, *facts, s])}.npz" for s in seeds}
    found = {seed: read(seed) for seed in seeds}
    missing = [seed for seed in seeds if found[seed] is None]
    if missing:
        for seed, run in zip(missing, make(missing), strict=True):
            keep(paths[seed], run)
            found[seed] = read(seed)
    return list(found.values())


def kept_prior(
    folder: Path, name: str, facts: Sequence[Any], make: Callable[[], UpperBodyPrior]
) -> UpperBodyPrior:
    """Return a prior from its file, which is made if it is not there.

    Args:
        folder: with a file for each prior; damaged files are replaced.
        name: of the kind of prior, with which the file's name begins.
        facts: everything that the prior depends on (`settings_hash`).
        make: fits it.
    """
    path = folder / f"{name}-{settings_hash(facts)}.safetensors"
    if path.is_file():
        try:
            return UpperBodyPrior.load(path)
        except TorchposeError:
            path.unlink()
    make().save(path)
    return UpperBodyPrior.load(path)
