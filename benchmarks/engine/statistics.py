"""Statistics over subjects and seeds, and the cells of tables that they make."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.engine.experiment import Measure, Results

Statistic = Callable[[Tensor], Tensor]
"""Numbers of subjects and seeds [..., Q, S] -> [...]."""

Cell = Callable[[Results], float | int | str | None]
"""What a table says about some runs."""

Number = Callable[[Results], float]

_DRAWS = 2000


def mean_of(values: Float[Tensor, "*batch Q S"]) -> Float[Tensor, "*batch"]:
    """Return the mean over subjects and seeds."""
    return values.mean((-1, -2))


def worst_of(values: Float[Tensor, "*batch Q S"]) -> Float[Tensor, "*batch"]:
    """Return the largest value of all subjects and seeds."""
    return values.amax((-1, -2))


def pooled_std(values: Float[Tensor, "*batch Q S"]) -> Float[Tensor, "*batch"]:
    """Return the standard deviation over seeds, pooled over subjects: the root of the mean variance."""
    return values.var(-1, correction=1).mean(-1).sqrt()


def bootstrap(
    statistic: Statistic,
    one: Float[Tensor, "Q S"],
    other: Float[Tensor, "Q S"] | None = None,
    seed: int = 0,
    draws: int = _DRAWS,
) -> tuple[float, float, float]:
    """Return a statistic, or its difference one - other, with the 95 % interval of a bootstrap.

    Subjects are drawn with replacement, the same for both; then seeds within each, apart.

    Args:
        statistic: [..., Q, S] -> [...]. one, other: by subject and seed. seed: of the draws.
        draws: how many.
    """
    generator = torch.Generator().manual_seed(seed)
    n, s = one.shape
    rows = torch.randint(n, (draws, n, 1), generator=generator)

    def drawn(values: Tensor) -> Tensor:
        columns = torch.randint(s, (draws, n, s), generator=generator)
        return statistic(values[rows, columns])

    value, interval = statistic(one), drawn(one)
    if other is not None:
        value, interval = value - statistic(other), interval - drawn(other)
    low, high = torch.quantile(
        interval, torch.tensor([0.025, 0.975], dtype=interval.dtype)
    ).tolist()
    return float(value), low, high


# --- cells ----------------------------------------------------------------------------------------


def mean(measure: Measure, scale: float = 1.0) -> Number:
    """Return the cell with the mean of a measure over all runs, times `scale`."""
    return lambda results: scale * float(mean_of(results.values(measure)))


def worst(measure: Measure) -> Number:
    """Return the cell with the largest value of a measure in any run."""
    return lambda results: float(worst_of(results.values(measure)))


def spread(measure: Measure) -> Number:
    """Return the cell with the standard deviation over seeds, pooled; NaN with one seed."""

    def cell(results: Results) -> float:
        values = results.values(measure)
        return float(pooled_std(values)) if values.shape[1] > 1 else float("nan")

    return cell
