"""Place a limb's far end on or near the ray of its pixel, at every angle to that ray that it may have."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

__all__ = ["LimbNodes", "nodes_anywhere", "nodes_on_ray", "sphere_points"]

_STEEPEST = 80.0  # degrees out of the image plane; beyond, a limb is a point in the image


class LimbNodes(NamedTuple):
    """Hypotheses about one limb.

    Attributes:
        ends: the far ends of the limb, camera axes, [..., G, 3]. directions: unit vectors from its near
            end to them.
        log_weight: the log of the likelihood of the pixel times the node's share of the sphere of
            directions, [..., G]. A sum over nodes, times a density over directions, is its integral.
    """

    ends: Tensor
    directions: Tensor
    log_weight: Tensor


def nodes_on_ray(
    start: Float[Tensor, "*batch 3"],
    ray: Float[Tensor, "*batch 3"],
    length: Float[Tensor, "*batch"],
    std: Float[Tensor, "*batch"],
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
    rho = torch.linalg.vector_norm(across, dim=-1)
    angles = torch.linspace(-_STEEPEST, _STEEPEST, n_nodes, dtype=start.dtype, device=start.device)
    phi = torch.deg2rad(angles)
    inward = across / rho.clamp_min(1e-6)[..., None]
    directions = (
        inward[..., None, :] * phi.cos()[:, None] + along[..., None, :] * phi.sin()[:, None]
    )
    off = (rho[..., None] - length[..., None] * phi.cos()) / std[..., None]
    step = math.log(math.radians(2 * _STEEPEST / (n_nodes - 1)))
    constant = step - 0.5 * math.log(2 * math.pi) - std.log() - length.log()
    ends = start[..., None, :] + length[..., None, None] * directions
    return LimbNodes(ends, directions, constant[..., None] - 0.5 * off.square())


def nodes_anywhere(
    start: Float[Tensor, "*batch 3"], length: Float[Tensor, "*batch"], n_nodes: int
) -> LimbNodes:
    """Return nodes evenly over the sphere of directions, for a limb whose end is not measured.

    Args:
        start: the near end of the limb, metres. length: L. n_nodes: G.
    """
    points = sphere_points(n_nodes).to(start)
    directions = points.expand(*start.shape[:-1], -1, -1)
    ends = start[..., None, :] + length[..., None, None] * directions
    weight = start.new_full(directions.shape[:-1], math.log(4 * math.pi / n_nodes))
    return LimbNodes(ends, directions, weight)


def sphere_points(n_points: int) -> Float[Tensor, "G 3"]:
    """Return points spread evenly over the unit sphere, on a Fibonacci spiral."""
    row = torch.arange(n_points, dtype=torch.float64) + 0.5
    height = 1 - 2 * row / n_points
    turn = row * math.pi * (3 - math.sqrt(5))
    radius = (1 - height.square()).sqrt()
    return torch.stack([radius * turn.cos(), radius * turn.sin(), height], -1)
