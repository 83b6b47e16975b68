"""Messages on trees against the dense joint Gaussian, and over rotations against weighted draws."""

import math

import numpy as np
import pytest
import torch

from tests.math.scipy_rotations import local, scipy
from torchpose.errors import ShapeError, SkeletonError
from torchpose.math import compose
from torchpose.math._tree_messages import message_tree, propagate
from torchpose.priors._limb_conditionals import LimbConditionals, LimbInfo


def normal(g, *sizes):
    return torch.randn(*sizes, generator=g, dtype=torch.float64)


def covariances(g, *batch, dim=3, std=1.0):
    a = normal(g, *batch, dim, dim)
    return std**2 * (a @ a.mT / dim + 0.05 * torch.eye(dim).double())


class LinearModel:
    """x_j = A x_i + b + N(0, Q) along every edge."""

    def __init__(self, g, edges, n_nodes, batch, dim=3):
        self.edges, self.n_nodes, self.dim = edges, n_nodes, dim
        n = len(edges)
        u, _, v = torch.linalg.svd(normal(g, *batch, n, dim, dim))
        stretch = 0.3 + 1.7 * torch.rand(*batch, n, dim, generator=g).double()
        self.matrix = u * stretch[..., None, :] @ v
        self.offset, self.noise = normal(g, *batch, n, dim), covariances(g, *batch, n, dim=dim)

    def transport(self, mean, covariance, edges, upward):
        a, b, q = (t.index_select(self_dim, edges) for t, self_dim in self._parts())
        if upward:
            a_inverse = torch.linalg.inv(a)
            new = (a_inverse @ (mean - b)[..., None]).squeeze(-1)
            return new, a_inverse @ (covariance + q) @ a_inverse.mT
        return (a @ mean[..., None]).squeeze(-1) + b, a @ covariance @ a.mT + q

    def _parts(self):
        return (self.matrix, -3), (self.offset, -2), (self.noise, -3)

    def dense(self, mean, cov, index):
        """Marginals of one element of the batch by the inverse of the joint precision."""
        d = self.dim
        precision = np.zeros((self.n_nodes * d,) * 2)
        shift = np.zeros(self.n_nodes * d)
        for node in range(self.n_nodes):
            rows = slice(node * d, node * d + d)
            own = np.linalg.inv(cov[index][node].numpy())
            precision[rows, rows] += own
            shift[rows] += own @ mean[index][node].numpy()
        for edge, (i, j) in enumerate(self.edges.tolist()):
            select = np.zeros((d, self.n_nodes * d))
            select[:, j * d : j * d + d] = np.eye(d)
            select[:, i * d : i * d + d] = -self.matrix[index][edge].numpy()
            own = select.T @ np.linalg.inv(self.noise[index][edge].numpy())
            precision += own @ select
            shift += own @ self.offset[index][edge].numpy()
        joint = np.linalg.inv(precision)
        blocks = joint.reshape(self.n_nodes, d, self.n_nodes, d)
        return (joint @ shift).reshape(-1, d), np.einsum("idie->ide", blocks)


def random_tree(g, n_nodes, n_trees=1):
    """Nodes in a random order, each below one of those before; the first ones are the tops."""
    order = torch.randperm(n_nodes, generator=g).tolist()
    pairs = [
        (order[int(torch.randint(0, k, (), generator=g))], order[k])
        for k in range(n_trees, n_nodes)
    ]
    shuffled = torch.randperm(len(pairs), generator=g).tolist()
    return torch.tensor([pairs[i] for i in shuffled])


@pytest.mark.parametrize("seed", range(8))
def test_linear_trees_have_the_marginals_of_the_dense_joint(seed):
    g = torch.Generator().manual_seed(seed)
    n_nodes = 5 + seed
    edges = random_tree(g, n_nodes, n_trees=1 + seed % 3)
    model = LinearModel(g, edges, n_nodes, (2, 3), dim=2 if seed == 4 else 3)
    mean = normal(g, 2, 3, n_nodes, model.dim)
    cov = covariances(g, 2, 3, n_nodes, dim=model.dim)
    ours = propagate(mean, cov, message_tree(edges, n_nodes), model.transport)
    for index in np.ndindex(2, 3):
        dense_mean, dense_cov = model.dense(mean, cov, index)
        np.testing.assert_allclose(ours[0][index], dense_mean, atol=1e-8, rtol=0)
        np.testing.assert_allclose(ours[1][index], dense_cov, atol=1e-8, rtol=0)
    assert torch.equal(ours[1], ours[1].mT)


def test_an_isolated_node_keeps_its_observation():
    g = torch.Generator().manual_seed(0)
    mean, cov = normal(g, 4, 3), covariances(g, 4)
    tree = message_tree(torch.zeros(0, 2, dtype=torch.long), 4)
    ours = propagate(mean, cov, tree, lambda *_: pytest.fail("no edge carries a message"))
    torch.testing.assert_close(ours, (mean, cov), atol=1e-9, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_observations_of_rank_one_and_zero(dtype):
    """A certain node stays where it is, and a flat one is certain across its own line only."""
    g = torch.Generator().manual_seed(1)
    edges = torch.tensor([[0, 1], [1, 2]])
    model = LinearModel(g, edges, 3, ())
    model.matrix, model.offset, model.noise = (
        t.to(dtype) for t in (model.matrix, model.offset, model.noise)
    )
    mean, cov = normal(g, 3, 3).to(dtype), covariances(g, 3).to(dtype)
    axis = torch.tensor([1.0, 2.0, -2.0], dtype=dtype) / 3
    cov[0], cov[1] = 0, axis[:, None] * axis
    new_mean, new_cov = propagate(mean, cov, message_tree(edges, 3), model.transport)
    torch.testing.assert_close(new_mean[0], mean[0])
    assert float(new_cov[0].abs().max()) < 1e-12
    loose = 5e-3 if dtype == torch.float32 else 2e-5
    moved = new_mean[1] - mean[1]
    torch.testing.assert_close(moved, axis * (axis @ moved), atol=loose, rtol=0)
    torch.testing.assert_close(
        new_cov[1], (axis @ new_cov[1] @ axis) * axis[:, None] * axis, atol=loose, rtol=0
    )
    assert new_mean.isfinite().all() and new_cov.isfinite().all()


def test_a_lost_element_stays_alone():
    g = torch.Generator().manual_seed(2)
    edges = torch.tensor([[0, 1], [0, 2]])
    model = LinearModel(g, edges, 3, ())
    mean, cov = normal(g, 4, 3, 3), covariances(g, 4, 3)
    whole = propagate(mean, cov, message_tree(edges, 3), model.transport)
    cov[1, 2, 0, 0], mean[2, 0, 0], cov[2, 1, 2, 2] = math.nan, math.nan, -1.0
    broken = propagate(mean, cov, message_tree(edges, 3), model.transport)
    for kept, lost in zip(whole, broken, strict=True):
        assert torch.equal(kept[[0, 3]], lost[[0, 3]])
        assert lost[1:3].flatten(1).isnan().any(1).all()


# --- rotations ------------------------------------------------------------------------------------


def limbs(g, edges, n_nodes, std):
    """Conditionals about random rotations; part 0 is the root, node n is part n + 1."""
    info = LimbInfo(parts=tuple(f"p{i}" for i in range(n_nodes + 1)))
    n = len(edges)
    turns, centres = 0.4 * normal(g, n, 3), 0.3 * normal(g, n_nodes + 1, 3)
    for edge, (above, below) in enumerate((edges + 1).tolist()):  # a safe space for every node
        centres[below] = compose(compose(centres[above], turns[edge]), 0.05 * normal(g, 3))
    still = torch.zeros(n_nodes + 1, 3, 3).double()
    return LimbConditionals(
        info, edges + 1, 0.05 * normal(g, n, 3), covariances(g, n, std=std), turns, centres, still
    )


def weighted_draws(model, mean, cov, count=100_000):
    """Exact posterior moments by draws from the top observation and the conditionals downwards."""
    rng = np.random.default_rng(0)
    below = {j: (e, i) for e, (i, j) in enumerate((model.edges - 1).tolist())}
    turns, log_weights = {}, np.zeros(count)
    for node in range(len(mean)):  # every node comes after the one above it
        centre = model.centres[node + 1].numpy()
        if node not in below:
            x = rng.multivariate_normal(mean[node].numpy(), cov[node].numpy(), count)
            turns[node] = scipy(centre) * scipy(x)
            continue
        edge, above = below[node]
        x = rng.multivariate_normal(model.mean[edge].numpy(), model.covariance[edge].numpy(), count)
        turns[node] = turns[above] * scipy(model.edge_centres[edge].numpy()) * scipy(x)
        off = local(turns[node], centre) - mean[node].numpy()
        log_weights -= 0.5 * np.einsum("ni,ij,nj->n", off, np.linalg.inv(cov[node].numpy()), off)
    weights = np.exp(log_weights - log_weights.max())
    points = [local(turns[node], model.centres[node + 1].numpy()) for node in range(len(mean))]
    means = np.stack([np.average(p, axis=0, weights=weights) for p in points])
    covs = np.stack([np.cov(p.T, aweights=weights) for p in points])
    return means, covs


TREES = {"pair": [[0, 1]], "chain": [[0, 1], [1, 2]], "fork": [[0, 1], [0, 2]]}


@pytest.mark.parametrize("name", TREES)
def test_rotations_are_within_monte_carlo_error(name):
    """Deviations of 3 to 6 degrees; the draws' own error is a hundredth of them."""
    g = torch.Generator().manual_seed(len(name))
    edges = torch.tensor(TREES[name])
    n_nodes = len(edges) + 1
    model = limbs(g, edges, n_nodes, 0.05)
    # observations near to where the tree puts the nodes, as in tracking
    at, cov = 0.05 * normal(g, n_nodes, 3), covariances(g, n_nodes, std=0.05)
    for level in model.tree.levels:
        predicted, _ = model.transport(at[level.above], cov[level.above], level.edges, False)
        at[level.below] = predicted + 0.03 * normal(g, len(level.below), 3)
    ours = propagate(at, cov, model.tree, model.transport)
    means, covs = weighted_draws(model, at, cov)
    np.testing.assert_allclose(ours[0], means, atol=2e-3)
    np.testing.assert_allclose(ours[1], covs, atol=1.5e-4)


def test_hypotheses_do_not_touch_each_other():
    g = torch.Generator().manual_seed(3)
    edges = torch.tensor([[0, 1], [0, 2], [2, 3]])
    model = limbs(g, edges, 4, 0.1)
    mean, cov = 0.1 * normal(g, 2, 5, 4, 3), covariances(g, 2, 5, 4, std=0.1)
    both = propagate(mean, cov, model.tree, model.transport)
    one = propagate(mean[1, 3], cov[1, 3], model.tree, model.transport)
    torch.testing.assert_close((both[0][1, 3], both[1][1, 3]), one)


# --- bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("edges", "message"),
    [
        ([[0, 1], [1, 2], [2, 0]], "cycle"),
        ([[0, 1], [2, 2]], "cycle"),
        ([[0, 1], [2, 1]], "node 1 hangs on both 0 and 2"),
        ([[0, 1], [0, 1]], "node 1 hangs on both 0 and 0"),
        ([[0, 3]], "needs nodes from 0 to 2, got 3"),
        ([[-1, 2]], "needs nodes from 0 to 2, got -1"),
    ],
)
def test_what_is_no_tree(edges, message):
    with pytest.raises(SkeletonError, match=message):
        message_tree(torch.tensor(edges), 3)


def test_sizes():
    with pytest.raises(ShapeError, match="edges must have shape"):
        message_tree(torch.zeros(2, 3, dtype=torch.long), 3)
    tree = message_tree(torch.tensor([[0, 1]]), 2)
    for sizes in ((3, 3), (2, 4)):
        with pytest.raises(ShapeError, match="must have shape"):
            propagate(torch.zeros(sizes), torch.zeros(2, 3, 3), tree, None)
    with pytest.raises(ShapeError, match="the same leading sizes"):
        propagate(torch.zeros(5, 2, 3), torch.zeros(2, 3, 3), tree, None)
