"""Choose the number of components under which held-out states are most likely."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_choice
from torchpose.errors import InputError
from torchpose.learning._blocks import ALONE, Share, usable_samples
from torchpose.learning._samplers import SampleSource
from torchpose.learning._streamed_em import StartOptions, StreamedEM, run_streamed
from torchpose.priors._gaussian_mixture import GaussianMixture

RULES = ("best", "one-standard-error")


class Candidate(NamedTuple):
    """Holds one row of the table.

    Attributes:
        n_components: K. train, held_out: mean log-likelihoods, in units of the states.
        standard_error: of `held_out`, over the persons or blocks.
        behind: how far `held_out` is below that of the best candidate.
        behind_error: standard error of `behind`, over the differences of each person or block.
        steps: of EM. converged: whether they sufficed.
    """

    n_components: int
    train: float
    held_out: float
    standard_error: float
    behind: float
    behind_error: float
    steps: int
    converged: bool


class Selection(NamedTuple):
    """Holds the table of candidates, the chosen number of components, and the criterion.

    Attributes:
        rows: one for each candidate. n_components: the choice. best: most likely on held-out states.
        rule: that led from one to the other. groups: "persons" or "blocks", of the standard errors.
        n_groups: how many. mixture: of the chosen number, fitted to the training states.
    """

    rows: tuple[Candidate, ...]
    n_components: int
    best: int
    rule: str
    groups: str
    n_groups: int
    mixture: GaussianMixture

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Return header and rows to show; the choice is marked."""
        header = ["components", "training", "held out", "± (1 s.e.)", "behind best", "±", "steps"]
        rows = [
            [
                f"{row.n_components}{' *' if row.n_components == self.n_components else ''}",
                *(f"{value:.4f}" for value in row[1:6]),
                f"{row.steps}{'' if row.converged else ' (not converged)'}",
            ]
            for row in self.rows
        ]
        return header, rows


def select_n_components(
    train: SampleSource,
    held_out: SampleSource | Sequence[SampleSource],
    candidates: Sequence[int],
    seed: int = 0,
    *,
    rule: str = "best",
    max_iter: int = 100,
    tol: float = 1e-3,
    share: Share = ALONE,
    progress: bool = False,
    **options: Unpack[StartOptions],
) -> Selection:
    """Fit a mixture for each number of components and compare them on held-out states.

    Frames of one person resemble each other, so states of the same person in both sources make more
    components look better than they are for anyone else: build the sources from different persons.
    With one held-out source for each person, the standard errors are over persons, which is what
    counts for a new one; with a single source they are over its blocks, and much too small for that.

    Args:
        train: states to fit to.
        held_out: states of other persons, or one source for each of them; a person counts as much
            as their states weigh.
        candidates: numbers of components K.
        seed: the seed of every fit.
        rule: "best", or "one-standard-error" for the smallest K that is behind the best by no more
            than one standard error of that difference (persons differ in their level much more than
            in their differences, so errors of the level would let nearly any K pass).
        max_iter, tol: of every fit, see `fit_streamed`.
        share: of this process; all processes get the same result.
        progress: show a bar for every fit.
        options: the options of `StreamedEM.start`.

    Returns:
        The table, the choice and its mixture.

    Raises:
        InputError: no candidates, no held-out states, an unknown rule, a candidate with more
            components than the training states carry, and as `fit_streamed`.
    """
    groups = [held_out] if isinstance(held_out, SampleSource) else list(held_out)
    numbers = sorted(set(candidates))
    _check_request(numbers, groups, rule)
    fits: dict[int, StreamedEM] = {}
    scores: dict[int, Tensor] = {}
    for n_components in reversed(numbers):  # too many for the data fail before any work
        em = StreamedEM.start(train, n_components, seed, **options)
        run_streamed(em, train, max_iter=max_iter, tol=tol, share=share, progress=progress)
        fits[n_components], scores[n_components] = em, held_out_scores(em, groups, share)
    rows = _rows(numbers, fits, scores)
    best = min(rows, key=lambda row: row.behind).n_components
    chosen = best
    if rule == "one-standard-error":
        chosen = next(row.n_components for row in rows if row.behind <= row.behind_error)
    kind, n_groups = "blocks" if len(groups) == 1 else "persons", len(scores[best])
    return Selection(rows, chosen, best, rule, kind, n_groups, fits[chosen].mixture())


def _rows(
    numbers: list[int], fits: dict[int, StreamedEM], scores: dict[int, Tensor]
) -> tuple[Candidate, ...]:
    weights = scores[numbers[0]][:, 1]
    totals = {n: scores[n][:, 0] for n in numbers}
    best = totals[max(numbers, key=lambda n: float(totals[n].sum()))]
    return tuple(
        Candidate(
            n_components=n,
            train=float(fits[n].history[-1]),
            held_out=float(totals[n].sum() / weights.sum()),
            standard_error=_standard_error(totals[n], weights),
            behind=float((best - totals[n]).sum() / weights.sum()),
            behind_error=_standard_error(best - totals[n], weights),
            steps=int(fits[n].steps),
            converged=bool(fits[n].converged),
        )
        for n in numbers
    )


def held_out_scores(
    em: StreamedEM, sources: Sequence[SampleSource], share: Share = ALONE
) -> Float[Tensor, "G 2"]:
    """Sum log-likelihoods and weights over each source, or over each block of a single one.

    Args:
        em: the mixture. sources: states. share: of this process.

    Raises:
        InputError: states that are not finite, or without any weight.
    """
    places = [(s, b) for s, source in enumerate(sources) for b in range(source.n_blocks)]
    sums = torch.zeros(len(places), 2, dtype=torch.float64)
    with share.failing_together(sums.to(em.means)):
        for place in share.blocks(len(places)):
            source, block = places[place]
            name = f"held-out source {source}, block {block}"
            samples = usable_samples(sources[source].block(block), name)
            if len(samples.states):
                statistics = em.expect(samples)
                mean = em.mean_log_likelihood(statistics)
                sums[place] = torch.stack([mean * statistics.weight, statistics.weight]).cpu()
    sums = share.total(sums.to(em.means)).cpu()
    if bool(sums.isnan().any()):
        raise InputError(
            "held-out states cannot be scored: another process failed, see its message"
        )
    if len(sources) > 1:
        owner = torch.tensor([source for source, _ in places])
        sums = torch.zeros(len(sources), 2, dtype=sums.dtype).index_add_(0, owner, sums)
    sums = sums[sums[:, 1] > 0]
    if not len(sums):
        raise InputError("held-out states must have positive weight, got none that do")
    return sums


def _standard_error(totals: Tensor, weights: Tensor) -> float:
    """Return the standard error of sum_g t_g / sum_g w_g, a ratio estimate; NaN for a single group."""
    n = len(weights)
    if n < 2:
        return math.nan
    residuals = totals - totals.sum() / weights.sum() * weights
    return float((residuals.square().sum() * n / (n - 1)).sqrt() / weights.sum())


def _check_request(numbers: list[int], groups: list[SampleSource], rule: str) -> None:
    if not numbers:
        raise InputError("candidates must hold at least one number of components, got none")
    if not groups:
        raise InputError("held_out must hold at least one source, got none")
    check_choice("rule", rule, RULES)
    if rule != "best" and sum(source.n_blocks for source in groups) < 2:
        raise InputError(
            f"the rule {rule} needs held-out states of at least two persons or blocks, got one; "
            "hold out more, or use the rule best"
        )
