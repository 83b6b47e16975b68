"""Choose the sharpness exponent of a likelihood on validation sequences."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from torchpose._core.checks import check_shape
from torchpose.errors import InputError
from torchpose.whole_body._filters.silhouette_filter import SilhouetteParticleFilter


class ValidationSequence(NamedTuple):
    """Silhouettes of a known motion.

    Attributes:
        silhouettes: [T, C, H, W]. cameras: the C cameras.
        states: the true states [T, D], or None where only `joints` are known.
        initial_state: [D], the pose before the first frame; the first of `states` if None.
        joints: true positions [T, J, 3], metres, NaN where unknown; from `states` if None.
    """

    silhouettes: Tensor
    cameras: Any
    states: Tensor | None = None
    initial_state: Tensor | None = None
    joints: Tensor | None = None


class SharpnessFit(NamedTuple):
    """Holds the exponent with the smallest error, and all that were tried.

    Attributes:
        sharpness: the best of `tried`. tried: [K]. errors: metres [K], mean over sequences and runs.
    """

    sharpness: float
    tried: tuple[float, ...]
    errors: tuple[float, ...]


def log_grid(low: float, high: float, count: int) -> tuple[float, ...]:
    """Return numbers from low to high with equal ratios.

    >>> log_grid(1, 100, 3)
    (1.0, 10.0, 100.0)
    """
    if not 0 < low <= high < math.inf or count < 1:
        raise InputError(f"expected 0 < low <= high and a count, got {low}, {high}, {count}")
    if count == 1:
        return (math.sqrt(low * high),)
    ratio = (high / low) ** (1 / (count - 1))
    return tuple(round(low * ratio**i, 10) for i in range(count))


def mean_joint_error(
    body: Any, estimate: Float[Tensor, "*batch T D"], joints: Float[Tensor, "T J 3"]
) -> Float[Tensor, "*batch"]:
    """Return the mean distance of joints, metres (MR 31); joints that are NaN do not count.

    Args:
        estimate: states [..., T, D]. joints: true positions [T, J, 3], metres.
    """
    return (body.joints(estimate) - joints).norm(dim=-1).nanmean((-2, -1))


def fit_sharpness(
    make_filter: Callable[[float], SilhouetteParticleFilter],
    sequences: Iterable[ValidationSequence],
    *,
    values: Sequence[float] | None = None,
    n_values: int = 9,
    seeds: int = 2,
    progress: bool = False,
) -> SharpnessFit:
    """Choose the sharpness exponent by the error against true poses, on sequences that are not the test's.

    Every filter gets the same budget: the same exponents, sequences and seeds, a grid on a
    logarithmic scale. Every exponent sees the same random numbers, so that differences between them
    are not those of chance alone. The error is the mean distance of the joints (MR 31).

    Args:
        make_filter: sharpness -> filter. An annealed filter with solved exponents does not depend
            on its sharpness; let this set its survival rate instead, and give `values`.
        sequences: the validation sequences.
        values: exponents to try; by default 1 (the published form) to 1000 in equal ratios.
        n_values: number of exponents where `values` is None.
        seeds: runs per sequence, filtered as one batch.
        progress: whether to show a progress bar.

    Returns:
        `SharpnessFit`. An exponent whose error is not finite is never chosen.

    Raises:
        InputError: no sequences, no values, a sequence without truth, or no value of a finite error.
            ShapeError: joints of another number of frames.

    Reference: MR, equation (31), and section 6.1: parameters are set by an optimisation.
    """
    sequences = list(sequences)
    tried = tuple(log_grid(1.0, 1000.0, n_values) if values is None else map(float, values))
    if not sequences or not tried or seeds < 1:
        raise InputError(
            f"at least one sequence, one value and one seed are needed, got {len(sequences)}, "
            f"{len(tried)} and {seeds}"
        )
    errors = []
    for value in tqdm(tried, disable=not progress, unit="value"):
        tracker = make_filter(value)
        found = [_error(tracker, one, seeds) for one in sequences]
        errors.append(sum(found) / len(found))
    finite = [e if math.isfinite(e) else math.inf for e in errors]
    if min(finite) == math.inf:
        raise InputError(
            f"no value has a finite error, got {errors}; check the true joints of the sequences"
        )
    return SharpnessFit(tried[finite.index(min(finite))], tried, tuple(errors))


def _error(tracker: SilhouetteParticleFilter, one: ValidationSequence, seeds: int) -> float:
    start = one.initial_state
    if start is None and one.states is not None:
        start = one.states[0]
    joints = one.joints
    if joints is None and one.states is not None:
        joints = tracker.body.joints(one.states)  # type: ignore[attr-defined]
    if start is None or joints is None:
        raise InputError(
            "a validation sequence needs its true states, or its joints and an initial state"
        )
    check_shape("joints of a validation sequence", joints, [len(one.silhouettes), None, 3])
    # a stream of numbers for each run, the same ones for every value
    generators = [
        torch.Generator(tracker.step_std.device).manual_seed(seed) for seed in range(seeds)
    ]
    silhouettes = one.silhouettes.expand(seeds, *one.silhouettes.shape)
    track = tracker(silhouettes, one.cameras, start.expand(seeds, -1), generator=generators)
    return float(mean_joint_error(tracker.body, track.mean, joints.to(track.mean)).mean())
