"""Pull elbows that are not measured to where people have them when their hand is there.

A random walk of the directions of an arm forgets their prior. Of all arms that reach a hand, most have the
elbow far out, and there the elbow went. With the density c of the elbow given the hand, a walk t(x' | x) gets
the factor

    c(x')^1/2 / a(x),   a(x) = sum_x' t(x' | x) l(x') c(x')^1/2 / sum_x' t(x' | x) l(x'),

with the likelihood l. Under the root, walks that go on for long are spread as c is. The divisor a leaves what
the walk says of the keypoints as it is, and c where the hand is.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_SAME_PLACE = 0.15  # step of the depths of hands, in lengths of a bone
_LEAST = 1e-30  # density


class ElbowPull(NamedTuple):
    """Pull of elbows at the hypotheses of arms.

    Attributes:
        root: the root of c, up to a factor, [B, 2, N]; 1 of arms that are not guessed.
        weighed: the likelihood of each hypothesis times that, and by itself, [B, 2, 2, N].
    """

    root: Tensor
    weighed: Tensor


def pull_of_elbows(
    directions: Float[Tensor, "B 2 N 6"],
    prior: Float[Tensor, "B 2 N"],
    log_likelihood: Float[Tensor, "B 2 N"],
    hand_rays: Float[Tensor, "B 2 3"],
    guessed: Bool[Tensor, "B 2"],
) -> ElbowPull | None:
    """Return the pull of the elbows that are guessed from their hands; None if there are none.

    The density of the elbow given the hand is the prior's over its mean where the hand is as deep.

    Args:
        directions: of upper arm and forearm, hypotheses whose hands are on their rays. prior: its density.
        log_likelihood: of the hypotheses, up to a constant. hand_rays: of length one, in the same axes.
        guessed: the arms whose hand is measured and whose elbow is not.
    """
    if not bool(guessed.any()):
        return None
    likelihood = torch.softmax(log_likelihood, -1)
    depth = (directions @ hand_rays.repeat(1, 1, 2)[..., None])[..., 0]
    mean, whole = _sums_as_deep(torch.stack([likelihood * prior, likelihood], -1), depth).unbind(-1)
    alone = torch.ones_like(prior)
    root = torch.where(guessed[..., None], (prior * whole / mean.clamp_min(_LEAST)).sqrt(), alone)
    return ElbowPull(root, likelihood[:, :, None] * torch.stack([root, alone], 2))


def _sums_as_deep(
    values: Float[Tensor, "B 2 N K"], depth: Float[Tensor, "B 2 N"]
) -> Float[Tensor, "B 2 N K"]:
    """Return the sums of values over the hypotheses of an arm that are as deep, for each of them.

    They are summed at even depths, with linear weights to either side.

    Args:
        values: of each hypothesis. depth: of its hand from the shoulder, in lengths of a bone.
    """
    n_arms, n_nodes = depth.shape[:-1].numel(), depth.shape[-1]
    most = math.ceil(2 / _SAME_PLACE) + 1  # an arm has two bones
    place = depth.flatten() / _SAME_PLACE + most
    low = place.floor()
    farther = (place - low)[:, None]
    count, flat = 2 * most + 1, values.flatten(0, -2)
    first = torch.arange(0, count * n_arms, count, device=depth.device)
    rows = low.long() + first.repeat_interleave(n_nodes)
    sums = flat.new_zeros(count * n_arms, flat.shape[-1])
    sums = sums.index_add(0, rows, (1 - farther) * flat).index_add(0, rows + 1, farther * flat)
    return torch.lerp(sums[rows], sums[rows + 1], farther).view(values.shape)
