"""Place a limb's far end on or near the ray of its pixel, at every angle to that ray that it may have."""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from torchpose._core.module_state import outside_inference

_STEEPEST = 80.0  # degrees out of the image plane; beyond, a limb is a point in the image


class LimbNodes(NamedTuple):
    """Hypotheses about one limb.

    Attributes:
        start: the near end of the limb, [..., 3]. length: its length, [...].
        directions: unit vectors from there to the far end, sum_a t_a e_a, [..., G, 3].
        axes, turns: e and t, [..., A, 3] and [G, A].
        log_weight: the log of the likelihood of the pixel times the node's share of the sphere of
            directions, [..., G]. A sum over nodes, times a density over directions, is its integral.
    """

    start: Tensor
    length: Tensor
    directions: Tensor
    axes: Tensor
    turns: Tensor
    log_weight: Tensor

    @property
    def ends(self) -> Float[Tensor, "*batch G 3"]:
        """Return the far ends of the limb."""
        return self.start[..., None, :] + self.length[..., None, None] * self.directions


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
        start: the near end of the limb, metres. ray: the ray of the far end's pixel, of any length.
        length: L. std: sigma, metres. n_nodes: G.
    """
    along = normalize(ray, dim=-1)
    across = (start * along).sum(-1, keepdim=True) * along - start
    rho = torch.linalg.vector_norm(across, dim=-1, keepdim=True)
    turns = _even_angles(n_nodes, start.dtype, start.device)
    off = (rho - length[..., None] * turns[:, 1]) / std[..., None]
    step = math.log(math.radians(2 * _STEEPEST / (n_nodes - 1)))
    constant = step - 0.5 * math.log(2 * math.pi) - (std * length).log()
    log_weight = constant[..., None].sub(off.square(), alpha=0.5)
    axes = torch.stack([along.expand_as(across), across / rho.clamp_min(1e-6)], -2)
    return LimbNodes(start, length, _turned(axes, turns), axes, turns, log_weight)


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
    return LimbNodes(start, length, _turned(axes, points), axes, points, weight)


def _turned(
    axes: Float[Tensor, "*batch A 3"], turns: Float[Tensor, "G A"]
) -> Float[Tensor, "*batch G 3"]:
    """Return sum_a t_a e_a."""
    first, *others = axes[..., None, :].unbind(-3)
    turn, *more = turns[..., None].unbind(1)
    total = turn * first
    for axis, turn in zip(others, more, strict=True):
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
