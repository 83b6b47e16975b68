"""Compute Kalman gains of fixed tracks once per history of masks, shared by all sequences.

With fixed tracks the covariances depend on which joints were measured, never on where they were. The
histories form a graph: a node is the covariances of all tracks, an edge is one time step under one
pattern of measured dimensions. Where a step leaves the covariances unchanged, or leads to a steady
state that is known already, its edge leads back there; so long sequences need few edges.
"""

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.module_state import derived, outside_inference
from torchpose.filters._lengths import inside_lengths
from torchpose.filters._measurements import Measurements
from torchpose.filters._mkf import MixtureKalmanFilter
from torchpose.filters._outputs import Mending
from torchpose.filters._transition import Transition
from torchpose.math._gaussian import kalman_gain, symmetrise

_SETTLED = 4e-13
_MOST_EDGES = 1024
_SETTLING = 32  # frames until gains are constant, as a rule
_COST_OF_STEP = 4  # of making a step of the graph, in frames of one sequence without it


class Edge(NamedTuple):
    """Describes one time step of all M tracks under one pattern of measured dimensions.

    Attributes:
        target: the node that the step leads to. inverse_factor: L^-1 [M, Z, Z] of the innovation
            covariance. white: W = L^-1 H P [M, Z, D]. log_norm: [M], constant of the likelihood.
        predicted_cov: covariance before the update [M, D, D].
        mended: number of innovation covariances that were mended. jitter: the largest they took.
    """

    target: int
    inverse_factor: Tensor
    white: Tensor
    log_norm: Tensor
    predicted_cov: Tensor
    mended: int
    jitter: float


class BlockModel(NamedTuple):
    """Holds the recursion of M tracks over blocks of n frames, for row vectors.

    Attributes:
        length: n. outputs: [M, D + n Z + 1, n (D + Z)] takes a row (start, measurements, 1) to the
            n deviations and the n whitened innovations of a block; the 1 carries the means.
        carry: start to end [M, D, D]. inputs_to_end: (measurements, 1) to end [M, n Z + 1, D].
    """

    length: int
    outputs: Tensor
    carry: Tensor
    inputs_to_end: Tensor


class GainGraph:
    """Holds the gains that were needed so far, by history.

    Args:
        transition: of the M tracks. observed: measured state dimensions [Z].
        measurement_cov: R [Z, Z]. initial_cov: [M, D, D].
    """

    def __init__(
        self, transition: Transition, observed: Tensor, measurement_cov: Tensor, initial_cov: Tensor
    ) -> None:
        self.transition = transition
        self.observed = observed
        self.measurement_cov = measurement_cov
        self.nodes = [initial_cov]
        self.edges: dict[tuple[int, int], Edge] = {}
        self._steady: dict[int, int] = {}
        self._blocks: dict[tuple[int, int, torch.dtype], BlockModel] = {}

    def full(self) -> bool:
        """Return whether the graph has its largest size; the caller then filters without it."""
        return len(self.edges) >= _MOST_EDGES

    def edge(self, node: int, pattern: int) -> Edge:
        """Return the step from `node` under `pattern`, whose bit k is set if dimension k is measured."""
        key = (node, pattern)
        if key not in self.edges:
            with outside_inference():
                self.edges[key] = self._make(node, pattern)
        return self.edges[key]

    def is_steady(self, node: int, pattern: int) -> bool:
        """Return whether the step from `node` under `pattern` leads back to `node`."""
        return self._steady.get(pattern) == node

    def blocks(self, node: int, means: Tensor, length: int, dtype: torch.dtype) -> BlockModel:
        """Return the recursion over blocks of `length` frames at a steady node."""
        key = (node, length, dtype)
        if key not in self._blocks:
            pattern = next(p for p, steady in self._steady.items() if steady == node)
            edge = self.edge(node, pattern)
            gains = (edge.inverse_factor, edge.white, self.transition.matrix)
            model = _block_model(*gains, means, self.observed, length)
            self._blocks[key] = BlockModel(length, *(part.to(dtype) for part in model[1:]))
        return self._blocks[key]

    def _make(self, node: int, pattern: int) -> Edge:
        matrix, _, noise = self.transition
        cov = self.nodes[node]
        predicted = symmetrise(matrix @ cov @ matrix.mT + noise)
        measured = [bool(pattern >> k & 1) for k in range(self.observed.numel())]
        mask = None if all(measured) else torch.tensor(measured, device=cov.device)
        gain, updated = kalman_gain(predicted, self.measurement_cov, self.observed, mask)
        eye = torch.eye(len(measured), dtype=cov.dtype, device=cov.device).expand_as(gain.factor)
        inverse = torch.linalg.solve_triangular(gain.factor, eye, upper=False)
        if mask is not None:
            inverse = inverse * mask
        target = self._target(node, pattern, updated)
        mended, jitter = 0, 0.0
        if gain.jitter is not None:
            mended, jitter = int((gain.jitter > 0).sum()), float(gain.jitter.max())
        return Edge(target, inverse, gain.white, gain.log_norm, predicted, mended, jitter)

    def _target(self, node: int, pattern: int, updated: Tensor) -> int:
        if _is_settled(updated, self.nodes[node]):
            self._steady[pattern] = node
            return node
        known = self._steady.get(pattern)
        if known is not None and _is_settled(updated, self.nodes[known]):
            return known
        self.nodes.append(updated)
        return len(self.nodes) - 1


def _is_settled(a: Tensor, b: Tensor) -> bool:
    deviation = b.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
    scale = deviation[..., :, None] * deviation[..., None, :]
    return bool(((a - b).abs() <= _SETTLED * scale).all())


def _block_model(
    inverse_factor: Float[Tensor, "M Z Z"],
    white: Float[Tensor, "M Z D"],
    matrix: Float[Tensor, "M D D"],
    means: Float[Tensor, "M D"],
    observed: Tensor,
    length: int,
) -> BlockModel:
    """Return the recursion unrolled over `length` frames.

    Args:
        inverse_factor: L^-1. white: W = L^-1 H P, so that the gain is K = W^T L^-1. matrix: F.
        means: mu. observed: measured state dimensions [Z].
    """
    n_tracks, dim = means.shape
    n_obs = observed.numel()
    gain = white.mT @ inverse_factor
    whiten = inverse_factor @ matrix[:, observed, :]
    closed = matrix - gain @ matrix[:, observed, :]
    offset = means[:, observed, None]
    width = dim + length * n_obs + 1
    state = torch.zeros(n_tracks, dim, width, dtype=means.dtype, device=means.device)
    state[:, :, :dim] = torch.eye(dim, dtype=means.dtype, device=means.device)
    states, innovations = [], []
    for i in range(length):
        at = slice(dim + i * n_obs, dim + (i + 1) * n_obs)
        innovation = -whiten @ state
        innovation[:, :, at] += inverse_factor
        innovation[:, :, -1:] -= inverse_factor @ offset
        state = closed @ state
        state[:, :, at] += gain
        state[:, :, -1:] -= gain @ offset
        states.append(state)
        innovations.append(innovation)
    return BlockModel(
        length,
        torch.cat(states + innovations, 1).mT.contiguous(),
        state[:, :, :dim].mT.contiguous(),
        state[:, :, dim:].mT.contiguous(),
    )


class History(NamedTuple):
    """Describes a walk through the gain graph for H distinct histories of masks.

    Attributes:
        graph: the graph. edges: per frame, one edge for each history, or a single one for all.
        steady: per frame, the steady node that all elements stay at, or -1.
        group: the history of each element, [B].
    """

    graph: GainGraph
    edges: list[list[Edge]]
    steady: list[int]
    group: Tensor


def shares_gains(frames: Measurements) -> bool:
    """Return whether the graph is likely to need few steps for these masks, beside all that are filtered.

    After a change of the measured dimensions it takes some frames until the gains are constant again.
    """
    patterns = torch.unique(_patterns(frames), dim=0)
    changes = int((patterns[:, 1:] != patterns[:, :-1]).sum())
    made = min(patterns.numel(), _SETTLING * changes)
    return _COST_OF_STEP * made <= frames.mask[..., 0].numel()


def find_history(model: MixtureKalmanFilter, frames: Measurements) -> History | None:
    """Return the walk through the gain graph; None if there are too many histories to share them.

    Args:
        model: with fixed tracks. frames: whose masks have histories; R is constant.
    """
    graph = _gain_graph(model, frames.cov)
    patterns = _patterns(frames)
    distinct, group = torch.unique(patterns, dim=0, return_inverse=True)
    if len(distinct) == 1:
        return _one_history(graph, distinct[0].tolist(), group)
    nodes = [0] * distinct.shape[0]
    edges, steady = [], []
    for row in distinct.T.tolist():
        keys = set(zip(nodes, row, strict=True))
        found = {key: graph.edge(*key) for key in keys}
        if len(graph.edges) > _MOST_EDGES:
            return None
        first = (nodes[0], row[0])
        same = len(keys) == 1
        steady.append(nodes[0] if same and graph.is_steady(*first) else -1)
        taken = [found[key] for key in zip(nodes, row, strict=True)]
        edges.append(taken[:1] if same else taken)
        nodes = [edge.target for edge in taken]
    return History(graph, edges, steady, group)


def _one_history(graph: GainGraph, row: list[int], group: Tensor) -> History | None:
    """Return the walk of a single history; a steady stretch is walked through in one stride."""
    node, edges, steady = 0, [], []
    for pattern, run in groupby(row):
        left = sum(1 for _ in run)
        while left:
            edge = graph.edge(node, pattern)
            if len(graph.edges) > _MOST_EDGES:
                return None
            stays = graph.is_steady(node, pattern)
            count = left if stays else 1
            edges += [[edge]] * count
            steady += [node if stays else -1] * count
            node, left = edge.target, left - count
    return History(graph, edges, steady, group)


def _gain_graph(model: MixtureKalmanFilter, measurement_cov: Tensor) -> GainGraph:
    """Return the graph of gains for constant R, kept while model and R stay as they are."""
    kept: dict[str, GainGraph] = derived(model, f"gains {model.dtype}", model.sources, dict)
    graph = kept.get("graph")
    if graph is None or graph.full() or not torch.equal(graph.measurement_cov, measurement_cov):
        steady = model.transition(model.burn_in)
        with outside_inference():
            graph = GainGraph(steady, model.observed, measurement_cov.clone(), model.start_cov)
        kept["graph"] = graph
    return graph


def _patterns(frames: Measurements) -> Tensor:
    """Return the measured dimensions as bits [B, T]; finished sequences have those of the longest."""
    n_frames, n_obs = frames.z.shape[1:]
    bits = 2 ** torch.arange(n_obs, device=frames.z.device)
    patterns = (frames.mask * bits).sum(-1)
    inside = inside_lengths(frames.lengths, n_frames)
    return torch.where(inside, patterns, patterns[frames.lengths.argmax()])


def mending_of_edges(edges: Sequence[list[Edge]], group: Tensor) -> Mending:
    """Sum up the mended covariances of sequences that share their gains, [B, T].

    Args:
        edges: per frame, one for each history of masks, or a single one for all.
        group: history of each element [B].
    """
    mended = torch.zeros(len(group), len(edges), dtype=torch.long, device=group.device)
    jitter = mended.double()
    for t, taken in enumerate(edges):
        if any(edge.mended for edge in taken):
            own = group if len(taken) > 1 else torch.zeros_like(group)
            mended[:, t] = mended.new_tensor([edge.mended for edge in taken])[own]
            jitter[:, t] = jitter.new_tensor([edge.jitter for edge in taken])[own]
    return Mending(mended, jitter)
