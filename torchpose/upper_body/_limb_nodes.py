"""Place a limb's far end on or near the ray of its pixel, at every angle to that ray that it may have."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose._core.module_state import outside_inference

_STEEPEST = 80.0  # degrees out of the image plane; beyond, a limb is a point in the image


@dataclass(frozen=True)
class LimbNodes:
    """Hypotheses about one limb.

    Attributes:
        start: the near end of the limb, [..., 3]. length: its length, [...].
        axes, turns: e and t of the unit vectors from there to the far end, sum_a t_a e_a, [..., A, 3] and
            [G, A].
        log_weight: the log of the likelihood of the pixel times the node's share of the sphere of
            directions, [..., G]. A sum over nodes, times a density over directions, is its integral.
    """

    start: Tensor
    length: Tensor
    axes: Tensor
    turns: Tensor
    log_weight: Tensor

    @cached_property
    def directions(self) -> Float[Tensor, "*batch G 3"]:
        """Return the unit vectors from the near end to the far end."""
        return _turned(self.axes, self.turns)

    @cached_property
    def ends(self) -> Float[Tensor, "*batch G 3"]:
        """Return the far ends of the limb."""
        return self.start[..., None, :] + self.length[..., None, None] * self.directions

    def chosen(
        self, near: Float[Tensor, "*batch G0 3"], rows: Int[Tensor, "*rows"]
    ) -> Float[Tensor, "*rows 6"]:
        """Return the directions of some pairs of the limb before, which has G0, and of this one.

        Args:
            near: the directions of the limb before, from whose far ends this one starts.
            rows: the pairs, as rows of all pairs of the batch, G0 G of each element (`flat_rows`).
        """
        count = len(self.turns)
        axes = self.axes.expand(*near.shape[:-1], -1, 3).flatten(-2)
        bones = torch.cat([near, axes], -1).flatten(0, -2).unflatten(-1, (-1, 1, 3))
        first, *along = bones.index_select(0, (rows // count).flatten()).unbind(1)
        turns = self.turns.index_select(0, (rows % count).flatten())[..., None, None].unbind(1)
        return torch.cat([first, _sum_of(turns, along)], -1).view(*rows.shape, 6)


def nodes_on_ray(
    start: Float[Tensor, "*#batch 3"],
    ray: Float[Tensor, "*#batch 3"],
    length: Float[Tensor, "*#batch"],
    std: Float[Tensor, "*#batch"],
    n_nodes: int,
) -> LimbNodes:
    """Return nodes at even angles phi between the limb and the plane square to its end's ray.

    With the distance rho of the start from the ray, noise of sigma across it and a limb of length L in
    direction d(phi, alpha), the integral of a density p over directions and of the pixel's likelihood
    over the azimuth alpha leaves

        int p(d(phi)) N(rho; L cos phi, sigma^2) / L  d phi,

    since the area cos phi d phi d alpha of the sphere and the length L cos phi d alpha along the image
    cancel; d(phi) points from the start to where the ray is seen. Lengths of limbs hold exactly, and
    pixels up to their noise.

    Args:
        start: the near end of the limb, metres. ray: the ray of the far end's pixel, of length one.
        length: L. std: sigma, metres. n_nodes: G.
    """
    across = (start * ray).sum(-1, keepdim=True) * ray - start
    rho = torch.linalg.vector_norm(across, dim=-1, keepdim=True)
    turns = _even_angles(n_nodes, start.dtype, start.device)
    off = (rho - length[..., None] * turns[:, 1]) / std[..., None]
    step = math.log(math.radians(2 * _STEEPEST / (n_nodes - 1)))
    constant = step - 0.5 * math.log(2 * math.pi) - (std * length).log()
    log_weight = constant[..., None].sub(off.square(), alpha=0.5)
    axes = torch.stack([ray.expand_as(across), across / rho.clamp_min(1e-6)], -2)
    return LimbNodes(start, length, axes, turns, log_weight)


def nodes_anywhere(
    start: Float[Tensor, "*batch 3"],
    length: Float[Tensor, "*#batch"],
    axes: Float[Tensor, "*#batch 3 3"],
    n_nodes: int,
) -> LimbNodes:
    """Return nodes over the sphere of directions, for a limb whose end is not measured.

    Args:
        start: the near end of the limb, metres. length: L. axes: three at right angles, of length one, in
            which the points of the sphere are. n_nodes: G.
    """
    weight = start.new_full((), math.log(4 * math.pi / n_nodes))
    weight = weight.expand(*start.shape[:-1], n_nodes)
    points = _kept_sphere(n_nodes, start.dtype, start.device)
    return LimbNodes(start, length, axes, points, weight)


def take_rows(
    values: Float[Tensor, "*batch N D"], rows: Int[Tensor, "*batch K"]
) -> Float[Tensor, "*batch K D"]:
    """Return some rows of each batch element; whole rows are taken faster than by `gather`."""
    n, size = values.shape[-2:]
    flat = values.reshape(-1, size).index_select(0, flat_rows(rows, n).flatten())
    return flat.view(*rows.shape, size)


def flat_rows(rows: Int[Tensor, "*batch K"], n: int) -> Int[Tensor, "*batch K"]:
    """Return rows of each batch element, which has n, as rows of all of them."""
    before = torch.arange(0, n * rows.shape[:-1].numel(), n, device=rows.device)
    return rows + before.view(*rows.shape[:-1], 1)


def _turned(
    axes: Float[Tensor, "*batch A 3"], turns: Float[Tensor, "G A"]
) -> Float[Tensor, "*batch G 3"]:
    """Return sum_a t_a e_a of each t."""
    return _sum_of(turns[..., None].unbind(1), axes[..., None, :].unbind(-3))


def _sum_of(turns: Sequence[Tensor], axes: Sequence[Tensor]) -> Tensor:
    """Return sum_a t_a e_a."""
    total = turns[0] * axes[0]
    for turn, axis in zip(turns[1:], axes[1:], strict=True):
        total = torch.addcmul(total, axis, turn)
    return total


@cache
def _even_angles(n_nodes: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "G 2"]:
    """Return sine and cosine of the angles phi of nodes on a ray."""
    with outside_inference():
        angles = torch.linspace(-_STEEPEST, _STEEPEST, n_nodes, dtype=dtype, device=device)
        phi = torch.deg2rad(angles)
        return torch.stack([phi.sin(), phi.cos()], -1)


@cache
def _kept_sphere(n_nodes: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "G 3"]:
    """Return `sphere_points` on a device."""
    with outside_inference():
        return sphere_points(n_nodes).to(device, dtype)


def sphere_points(n_points: int) -> Float[Tensor, "G 3"]:
    """Return points spread evenly over the unit sphere, on a Fibonacci spiral."""
    row = torch.arange(n_points, dtype=torch.float64) + 0.5
    height = 1 - 2 * row / n_points
    turn = row * math.pi * (3 - math.sqrt(5))
    radius = (1 - height.square()).sqrt()
    return torch.stack([radius * turn.cos(), radius * turn.sin(), height], -1)
