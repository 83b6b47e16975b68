"""Propagate beliefs over a tree of Gaussians: every node's posterior from all observations.

Messages go from the leaves to the top and back. Nodes of one depth are taken at once, for all
elements of a batch; products of Gaussians are sums in information form (DX 7), P = Sigma^-1 and
h = Sigma^-1 mu, by Cholesky solves.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose.errors import ShapeError, SkeletonError
from torchpose.math._gaussian import safe_cholesky

Transport = Callable[[Tensor, Tensor, Tensor, bool], tuple[Tensor, Tensor]]


class TreeLevel(NamedTuple):
    """Holds the edges whose lower nodes are of one depth.

    Attributes:
        edges: [E_l], which ones. above, below: [E_l], their nodes.
        siblings: [E_l, E_l], 1 where two different edges hang on the same node, else 0.
    """

    edges: Tensor
    above: Tensor
    below: Tensor
    siblings: Tensor


class MessageTree(NamedTuple):
    """Describes a forest for `propagate`, from `message_tree`: V nodes, and its edges from the top down."""

    n_nodes: int
    levels: tuple[TreeLevel, ...]


def message_tree(edges: Int[Tensor, "E 2"], n_nodes: int) -> MessageTree:
    """Return the order in which messages pass along the edges of a tree, or of several (a forest).

    Args:
        edges: [E, 2], indices of the node above and the node below. n_nodes: V.

    Raises:
        SkeletonError: an unknown node, a node with two above it, or edges that form a cycle.
        ShapeError: edges that are not [E, 2].

    >>> tree = message_tree(torch.tensor([[0, 1], [1, 2], [1, 3]]), 5)  # node 4 stands alone
    >>> [level.below.tolist() for level in tree.levels]
    [[1], [2, 3]]
    """
    check_shape("edges", edges, [None, 2])
    pairs: list[list[int]] = edges.tolist()
    parents = [-1] * n_nodes
    for above, below in pairs:
        unknown = [node for node in (above, below) if not 0 <= node < n_nodes]
        if unknown:
            raise SkeletonError(
                f"the edge {above} - {below} needs nodes from 0 to {n_nodes - 1}, got {unknown[0]}"
            )
        if parents[below] >= 0:
            raise SkeletonError(
                f"node {below} hangs on both {parents[below]} and {above}; in a tree it hangs on one"
            )
        parents[below] = above
    depths = tree_levels(parents, [str(node) for node in range(n_nodes)])
    edge_of = {below: edge for edge, (_, below) in enumerate(pairs)}
    levels = []
    for nodes in depths[1:]:
        own = torch.tensor([edge_of[node] for node in nodes], device=edges.device)
        tops, hanging = edges[own].long().unbind(-1)
        alike = tops[:, None] == tops
        siblings = alike & ~torch.eye(len(nodes), dtype=torch.bool, device=edges.device)
        levels.append(TreeLevel(own, tops, hanging, siblings))
    return MessageTree(n_nodes, tuple(levels))


def propagate(
    mean: Float[Tensor, "*batch V D"],
    covariance: Float[Tensor, "*batch V D D"],
    tree: MessageTree,
    transport: Transport,
) -> tuple[Float[Tensor, "*batch V D"], Float[Tensor, "*batch V D D"]]:
    """Return the posterior of every node of a tree, given a Gaussian observation of each (DX 5-8).

    N(x_i; mu_i^ij, S_i^ij) = N(x_i; mu_i^obs, S_i^obs) prod_{k != j} N(x_i; mu_i^ki, S_i^ki)   (DX 8)
    p(x_j | O) = N(x_j; mu_j^obs, S_j^obs) prod_i N(x_j; mu_j^ij, S_j^ij)                       (DX 6)

    It is the exact posterior where the transport is that of a linear Gaussian model. A message
    leaves out what came from where it goes by adding up the others, not by subtraction.

    An observation may be singular: a covariance with next to no variance in some direction, less than
    a share of its mean variance of (machine epsilon)^(2/3) (4e-11 in double precision, 2e-5 in
    single), gets that on its diagonal, so that its precision stays finite. A node whose covariance is
    zero stays where it is.

    Args:
        mean: mu^obs [..., V, D]. covariance: S^obs [..., V, D, D].
        tree: the tree from `message_tree`.
        transport: takes mean [..., E_l, D], covariance [..., E_l, D, D], the numbers of the edges
            [E_l] and whether the messages go up; returns the messages (DX 9-11) as mean and
            covariance. Down, the Gaussians given are of the nodes above and the messages are about
            those below; up, the other way round. `LimbConditionals.transport` is one.

    Returns:
        Mean [..., V, D] and covariance [..., V, D, D]. An element of the batch that is not finite, or
        whose matrices are not covariances, is NaN; the others are as they would be without it.

    Raises:
        ShapeError: another number of nodes than the tree has.

    Reference: Daubney & Xie, equations (5) to (8).
    """
    n_dim = mean.shape[-1]
    check_shape("mean", mean, ["...", tree.n_nodes, None])
    check_shape("covariance", covariance, ["...", tree.n_nodes, n_dim, n_dim])
    if mean.shape[:-1] != covariance.shape[:-2]:
        raise ShapeError(
            f"mean and covariance must have the same leading sizes, got {list(mean.shape)} and "
            f"{list(covariance.shape)}"
        )
    belief = _information(mean, covariance)  # observation, and messages that have arrived
    levels = [TreeLevel(*(index.to(mean.device) for index in level)) for level in tree.levels]
    from_below: list[Tensor] = []
    without = belief  # of messages from below
    for level in reversed(levels):
        own = _moments(belief.index_select(-3, level.below))
        message = _information(*transport(*own, level.edges, True))
        belief = belief.index_add(-3, level.above, message)
        from_below.append(message)
    for level, upward in zip(levels, reversed(from_below), strict=True):
        # what is known of the node above from itself, from above, and from its other children
        others = torch.einsum("cs,...sij->...cij", level.siblings.to(mean.dtype), upward)
        own = _moments(without.index_select(-3, level.above) + others)
        message = _information(*transport(*own, level.edges, False))
        without = without.index_add(-3, level.below, message)
        belief = belief.index_add(-3, level.below, message)
    return _moments(belief)


def _information(mean: Tensor, covariance: Tensor) -> Tensor:
    """Return the precision and shift side by side, [P | P mu] of shape [..., D, D + 1]."""
    least = torch.finfo(mean.dtype).eps ** (2 / 3)
    scale = covariance.diagonal(dim1=-2, dim2=-1).mean(-1)
    factor, info = torch.linalg.cholesky_ex(covariance)
    pivots = factor.diagonal(dim1=-2, dim2=-1).square()
    flat = (pivots < least * scale[..., None]).any(-1) | (info != 0)
    if bool(flat.any()):
        floor = torch.where(flat, least * scale, torch.zeros_like(scale))
        factor = safe_cholesky(covariance + torch.diag_embed(floor[..., None].expand_as(mean)))
    return _solved(factor, mean)


def _moments(information: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean and covariance of [P | h]: P^-1 h and P^-1."""
    solved = _solved(safe_cholesky(information[..., :-1]), information[..., -1])
    return solved[..., -1], solved[..., :-1]


def _solved(factor: Tensor, vector: Tensor) -> Tensor:
    """Return [A^-1 | A^-1 b], symmetric on the left: W^T [W | W b] with W = L^-1, A = L L^T."""
    eye = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
    sides = torch.cat([eye.expand_as(factor), vector[..., None]], -1)
    white = torch.linalg.solve_triangular(factor, sides, upper=False)
    return white[..., :-1].mT @ white


def tree_levels(parents: Sequence[int], names: Sequence[str]) -> tuple[tuple[int, ...], ...]:
    """Return the nodes of a forest by their depth, the roots (parent -1) first.

    Args:
        parents: index of every node's parent, -1 for a root.
        names: the names of the nodes, for the message.

    Raises:
        SkeletonError: a parent outside the tree, or parents that form a cycle.

    >>> tree_levels((-1, 0, 0, 2), "abcd")
    ((0,), (1, 2), (3,))
    """
    wrong = [names[i] for i, p in enumerate(parents) if not -1 <= p < len(parents)]
    if wrong:
        raise SkeletonError(f"parents must be -1 or an index, not so for {', '.join(wrong)}")
    levels: list[tuple[int, ...]] = []
    left, above = set(range(len(parents))), {-1}
    while left:
        level = tuple(i for i in sorted(left) if parents[i] in above)
        if not level:
            cycle = ", ".join(names[i] for i in sorted(left))
            raise SkeletonError(f"parents must form a tree; these form a cycle or hang on: {cycle}")
        levels.append(level)
        above, left = set(level), left - set(level)
    return tuple(levels)
