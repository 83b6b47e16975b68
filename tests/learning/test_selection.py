"""The number of components on states whose mixture is known, and the table behind it."""

import functools
import math

import numpy as np
import pytest
import torch

from torchpose.errors import InputError
from torchpose.learning._blocks import Share
from torchpose.learning._samplers import BLOCK, TensorSource
from torchpose.learning._selection import held_out_scores, select_n_components
from torchpose.learning._streamed_em import StreamedEM
from torchpose.priors import GaussianMixture


@functools.cache
def truth():
    """Three Gaussians that nobody takes for two or four."""
    means = torch.tensor([[0.0, 0.0], [8.0, 0.0], [0.0, 8.0]], dtype=torch.float64)
    covariances = torch.eye(2, dtype=torch.float64).expand(3, -1, -1).clone()
    return GaussianMixture(torch.full((3,), 1 / 3, dtype=torch.float64), means, covariances)


def draw(n, seed):
    return truth().sample((n,), torch.Generator().manual_seed(seed))


def persons(n=5, each=900):
    """Persons whose level differs much, as their states are spread differently."""
    return [TensorSource(draw(each, 10 + i) * (1 + 0.03 * i)) for i in range(n)]


def test_the_number_that_made_the_states_is_found():
    held_out = TensorSource(draw(3 * BLOCK + 100, 1))
    found = select_n_components(TensorSource(draw(3000, 0)), held_out, [6, 2, 3, 1, 3], tol=1e-5)
    assert [row.n_components for row in found.rows] == [1, 2, 3, 6]
    assert found.best == found.n_components == found.mixture.n_components == 3
    assert found.rule == "best" and found.groups == "blocks" and found.n_groups == 4
    train = [row.train for row in found.rows]
    assert train == sorted(train)  # more components always look better where they were fitted
    assert found.rows[3].held_out < found.rows[2].held_out
    assert found.rows[2].behind == 0 and found.rows[2].behind_error == 0
    header, rows = found.table()
    assert len(header) == len(rows[0]) and rows[2][0] == "3 *" and rows[0][0] == "1"


def test_rows_are_what_they_say():
    held_out = persons()
    found = select_n_components(TensorSource(draw(3000, 0)), held_out, [3, 5], tol=1e-5)
    per_person = np.array(
        [float(found.mixture.log_prob(s.block(0).states).mean()) for s in held_out]
    )
    row = next(row for row in found.rows if row.n_components == found.n_components)
    assert row.held_out == pytest.approx(per_person.mean())
    assert row.standard_error == pytest.approx(per_person.std(ddof=1) / math.sqrt(5))
    assert found.groups == "persons" and found.n_groups == 5
    assert row.converged and row.steps > 0


def test_one_standard_error_prefers_fewer():
    """States that are uniform on a square have no best number, so many are nearly as good."""
    g = torch.Generator().manual_seed(2)
    train, *held_out = (
        TensorSource(torch.rand(n, 2, generator=g, dtype=torch.float64)) for n in (400, *[100] * 6)
    )
    numbers = [1, 4, 6, 9, 12, 16, 20]
    best = select_n_components(train, held_out, numbers)
    few = select_n_components(train, held_out, numbers, rule="one-standard-error")
    assert few.rows == best.rows and few.best == best.best == best.n_components
    near = [row.n_components for row in best.rows if row.behind <= row.behind_error]
    assert few.n_components == few.mixture.n_components == near[0] < best.n_components
    assert few.n_components > 1


def test_errors_of_unequal_persons_are_those_of_a_ratio():
    """Against the jackknife, which knows nothing of ratios."""
    held_out = [TensorSource(draw(n, n) * s) for n, s in ((900, 1), (1000, 1.3), (1100, 0.9))]
    found = select_n_components(TensorSource(draw(2000, 0)), held_out, [3])
    sums = [(float(found.mixture.log_prob(s.block(0).states).sum()), s.n_samples) for s in held_out]
    left_out = [
        sum(t for j, (t, _) in enumerate(sums) if j != i)
        / sum(n for j, (_, n) in enumerate(sums) if j != i)
        for i in range(3)
    ]
    jackknife = math.sqrt(2 / 3 * sum((v - np.mean(left_out)) ** 2 for v in left_out))
    assert found.rows[0].standard_error == pytest.approx(jackknife, rel=0.15)


def test_weights_and_shares_count():
    weight = torch.rand(BLOCK + 500, generator=torch.Generator().manual_seed(0)).double()
    weight[:100] = 0
    x = draw(BLOCK + 500, 2)
    em = StreamedEM.start(TensorSource(draw(2000, 0)), 3)
    whole = held_out_scores(em, [TensorSource(x, weight)])
    expected = weight * em.mixture().log_prob(x)
    parts = torch.stack([part.sum() for part in expected.split(BLOCK)])
    torch.testing.assert_close(whole[:, 0], parts)
    torch.testing.assert_close(whole[:, 1], torch.stack([w.sum() for w in weight.split(BLOCK)]))
    mine = held_out_scores(em, [TensorSource(x, weight)], Share(0, 2))
    assert torch.equal(mine, whole[:1])


def test_bad_requests_are_refused():
    train, held_out = TensorSource(draw(50, 0)), TensorSource(draw(50, 1))
    for arguments, named in (
        ((train, held_out, []), "at least one number of components"),
        ((train, [], [2]), "at least one source"),
        ((train, held_out, [2, 51]), "50 distinct poses for 51 components"),
        ((train, TensorSource(draw(9, 1), torch.zeros(9)), [2]), "positive weight"),
        ((train, TensorSource(draw(9, 1) * torch.nan), [2]), "held-out source 0, block 0"),
    ):
        with pytest.raises(InputError, match=named):
            select_n_components(*arguments)
    with pytest.raises(InputError, match="rule"):
        select_n_components(train, held_out, [2], rule="two")
    with pytest.raises(InputError, match="at least two persons or blocks"):
        select_n_components(train, held_out, [2], rule="one-standard-error")
