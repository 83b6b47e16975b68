"""Follow how large a torso is seen: who comes nearer grows in the image, who goes away shrinks."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.upper_body._torso_likelihood import Torso

_MEMORY = 0.3  # seconds
# Of height and width: how much noise, raised shoulders and small turns change their logs, and the weight
# of what is beyond that, since shoulders are seen closer together when they turn too.
_UNSURE, _WEIGHTS = (0.1, 0.2), (1.0, 0.4)
_MOST_CHANGE = 0.5  # of the log of a size in a second: nobody walks faster, but turns are
_LEAST_LENGTH = 1e-3  # least length between rays: shoulders may be seen one behind the other


class SeenSize(NamedTuple):
    """Logs of the height of the head above the shoulders and of their width, as they are seen.

    Attributes:
        mean: means over the last frames, [B, 2]; NaN before the first.
        held: the same, but for small changes, [B, 2].
    """

    mean: Tensor
    held: Tensor

    @classmethod
    def unknown(cls, batch_size: int, like: Tensor) -> SeenSize:
        """Return the sizes before the first frame."""
        none = like.new_full((batch_size, 2), torch.nan)
        return cls(none, none)


def follow_size(
    size: SeenSize, torso: Torso, seconds: float
) -> tuple[SeenSize, Float[Tensor, " B"]]:
    """Return the sizes after a frame, and the log of the factor on the depth that explains their change.

        m <- (1 - a) m + a log l,   h' = clamp(h, m - c, m + c),   log z'/z = -w (h' - h)

    The height of the head tells it, c = 0.1 and w = 1, as turns do not change it; without a head the width,
    c = 0.2 and w = 0.4. What is faster than half of the depth in a second is left out.

    Args:
        size: the sizes after the frame before. torso: the measured joints, upright. seconds: between both.
    """
    left, right, _, head = torso.rays[..., :2].unbind(1)
    lengths = torch.stack([(left + right)[:, 1] / 2.0 - head[:, 1], (left - right)[:, 0].abs()], 1)
    both = torso.known[:, :2].all(1)
    known = torch.stack([both & torso.known[:, 3], both], 1)
    logs = lengths.clamp_min(_LEAST_LENGTH).log()
    first = size.mean.isnan()
    mean = size.mean + (1 - math.exp(-seconds / _MEMORY)) * (logs - size.mean)
    mean = torch.where(known, torch.where(first, logs, mean), size.mean)
    unsure = mean.new_tensor(_UNSURE)
    held = torch.where(first, mean, size.held.clamp(mean - unsure, mean + unsure))
    change = (
        (held - size.held).nan_to_num(0.0).clamp(-_MOST_CHANGE * seconds, _MOST_CHANGE * seconds)
    )
    of_height, of_width = (change * change.new_tensor(_WEIGHTS)).unbind(1)
    return SeenSize(mean, held), -torch.where(known[:, 0], of_height, of_width)
