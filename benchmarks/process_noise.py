"""Process noise of each method: errors over its factor, on training persons held out.

A prior of s1 to s4 of UTD-MHAD tracks every n-th sequence of s5 and s6 in the test camera, with Q = k S
for the walks and Q = k diag(S) for the others; the shipped factors are
`torchpose.upper_body.METHODS`.

    python -m benchmarks.process_noise --data DIR
    python -m benchmarks.process_noise --data DIR --every 5 --methods mkf-fixed mkf-sampled mkf-split
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import torch

from benchmarks._command import OneOf, run_command
from benchmarks._upper_body import plain_prior, score, trials_of
from benchmarks.ub_people import people
from torchpose.evaluation._trials import CAMERA, Trials, track
from torchpose.learning import UpperBodyRecipe
from torchpose.priors import UpperBodyPrior
from torchpose.upper_body import METHODS, PoseFilter, method_options

FACTORS = {
    name: method.noise.factor for name, method in METHODS.items() if isinstance(method, PoseFilter)
}
SEEN, TRIED = ("s1", "s2", "s3", "s4"), ("s5", "s6")


def main(
    *,
    data: Path,
    every: int = 24,
    methods: Annotated[Sequence[str], OneOf(FACTORS)] = tuple(FACTORS),
    factors: Sequence[float] = (0.3, 1.0, 10.0, 100.0),
    particles: int = 3000,
) -> None:
    """Print a line for each method and factor.

    Args:
        data: folder of the recordings.
        every: take every n-th sequence.
        methods: which trackers.
        factors: multiples of the recorded steps' second moment.
        particles: of each particle filter.
    """
    train, _ = people(data)
    recipe = UpperBodyRecipe(window_components=0, calibration_folds=0)
    prior = recipe.fit([r for r in train if r.person in SEEN])
    tried = [r for r in train if r.person in TRIED][::every]
    test = trials_of(tried)
    print(f"{len(test.lengths)} sequences, {int(test.lengths.sum())} frames")
    for method in methods:
        drawn = "n_particles" in method_options(method)
        options = {"n_particles": particles} if drawn else {}
        print(f"{method} released: {error(plain_prior(prior), method, options, test):.2f} cm")
        for factor in factors:
            ratio = factor / FACTORS[method]
            noise = {name: value for name, value in prior.noise.items() if "increment" in name}
            own = UpperBodyPrior(
                prior.left, prior.right, prior.info, {n: ratio * v for n, v in noise.items()}
            )
            shape = "S" if METHODS[method].noise.walks else "diag(S)"
            print(
                f"{method} {factor:g} {shape}: {error(own, method, options, test):.2f} cm",
                flush=True,
            )


def error(prior: UpperBodyPrior, method: str, options: dict[str, Any], test: Trials) -> float:
    """Return the mean 3D error after Procrustes, cm."""
    generator = torch.Generator().manual_seed(0)
    found = score(track(prior, CAMERA, test, method=method, generator=generator, **options), test)
    return found.mean_error


if __name__ == "__main__":
    run_command(main)
