"""Kalman gains of fixed tracks, computed once per history of masks and shared by all sequences.

With fixed tracks the covariances depend on which joints were measured, never on where they were. The
histories form a graph: a node is the covariances of all tracks, an edge is one time step under one
pattern of measured dimensions. Where a step leaves the covariances unchanged, or leads to a steady
state that is known already, its edge leads back there; so long sequences need few edges.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose._core.module_state import outside_inference
from torchpose.filters.scan import BlockModel, block_model
from torchpose.filters.transition import Transition
from torchpose.math.gaussian import kalman_gain, symmetrise

__all__ = ["Edge", "GainGraph"]

_SETTLED = 4e-13
MAX_EDGES = 1024


class Edge(NamedTuple):
    """One time step of all M tracks under one pattern of measured dimensions.

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


class GainGraph:
    """The gains that were needed so far, by history.

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
        """Whether no more edges should be added; the caller then goes without the graph."""
        return len(self.edges) >= MAX_EDGES

    def edge(self, node: int, pattern: int) -> Edge:
        """The step from `node` under `pattern`, whose bit k says whether dimension k is measured."""
        key = (node, pattern)
        if key not in self.edges:
            with outside_inference():
                self.edges[key] = self._make(node, pattern)
        return self.edges[key]

    def is_steady(self, node: int, pattern: int) -> bool:
        """Whether the step from `node` under `pattern` leads back to `node`."""
        return self._steady.get(pattern) == node

    def blocks(self, node: int, means: Tensor, length: int, dtype: torch.dtype) -> BlockModel:
        """The recursion over blocks of frames at a steady node."""
        key = (node, length, dtype)
        if key not in self._blocks:
            pattern = next(p for p, steady in self._steady.items() if steady == node)
            edge = self.edge(node, pattern)
            gains = (edge.inverse_factor, edge.white, self.transition.matrix)
            model = block_model(*gains, means, self.observed, length)
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
        if _same(updated, self.nodes[node]):
            self._steady[pattern] = node
            return node
        known = self._steady.get(pattern)
        if known is not None and _same(updated, self.nodes[known]):
            return known
        self.nodes.append(updated)
        return len(self.nodes) - 1


def _same(a: Tensor, b: Tensor) -> bool:
    deviation = b.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
    scale = deviation[..., :, None] * deviation[..., None, :]
    return bool(((a - b).abs() <= _SETTLED * scale).all())
