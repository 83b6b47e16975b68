"""Turn lifted bodies upright that are seen from above or below.

The network that lifts was fitted to cameras that look at people from about their own height. Somebody who is
seen from above or below it takes for somebody who leans: the body is turned about the horizontal axis across
the line of sight, while its shape is little worse. Where it is known which way is up, so is the elevation e
of the line of sight to the body, and with it the mean turn

    d(e) = c_0 + c_1 e + c_2 e^2 + c_3 e^3,

away from the camera where it is positive. It is taken back.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.math._rotations import rotvec_to_matrix

# Radians. Means over the recordings of `benchmarks.keypoint_bodies` for choosing, from -30 to 30 degrees.
_TURNS = (-0.035, -0.41, -0.37, -0.46)
_STEEPEST = math.radians(30.0)


def lean_of_network(elevation: Tensor) -> Tensor:
    """Return by how much lifted bodies are turned, with their heads away from the camera; radians.

    Args:
        elevation: of the line of sight, radians, positive where the camera looks up at the body.
    """
    e = elevation.clamp(-_STEEPEST, _STEEPEST)
    a, b, c, d = _TURNS
    return a + e * (b + e * (c + e * d))


def without_lean(
    joints: Float[Tensor, "*batch J 3"],
    ray: Float[Tensor, "*batch 2"],
    up: Float[Tensor, "*#batch 3"],
) -> Float[Tensor, "*batch J 3"]:
    """Return joints, relative to the pelvis, without the turn that the network gives them on average.

    Args:
        joints: camera axes. ray: (x, y) of K^-1 [u, v, 1] of the body. up: the direction that points up, of
            length one, in the same axes.
    """
    sight = torch.nn.functional.normalize(
        torch.cat([ray, torch.ones_like(ray[..., :1])], -1), dim=-1
    )
    up = up.expand_as(sight)
    turn = lean_of_network((sight * up).sum(-1).clamp(-1, 1).asin())
    axis = torch.nn.functional.normalize(torch.linalg.cross(sight, up), dim=-1)
    return joints @ rotvec_to_matrix(turn[..., None] * axis).mT
