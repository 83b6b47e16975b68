"""Tell faces from patterns that resemble one, by the other faces that are known."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# Where a far smaller face is a pattern on somebody's head or clothes, in sizes of that person's face.
_SMALLER_BY, _BESIDE, _ABOVE, _BELOW = 0.7, 0.8, 0.8, 3.0
_MINUTE = 0.3  # share of the size of a known face


def on_somebody(faces: Float[Tensor, "N 3"], known: Bool[Tensor, " N"]) -> Bool[Tensor, " N"]:
    """Return which faces are far smaller than a known one on whose head or chest they are."""
    if len(faces) < 2:  # none is smaller than itself
        return torch.zeros_like(known)
    size = faces[known, 2]
    x, y = ((faces[:, None, :2] - faces[known, :2]) / size[:, None]).unbind(-1)
    near = (x.abs() < _BESIDE) & (y > -_ABOVE) & (y < _BELOW)
    return (near & (faces[:, 2, None] < _SMALLER_BY * size)).any(1)


def far_smaller(
    size: Float[Tensor, " N"], small: Bool[Tensor, " N"], used: Bool[Tensor, " N"]
) -> Bool[Tensor, " N"]:
    """Return which small faces are far smaller than a used one: most of these are no faces.

    Small faces are searched for where no larger one is known, and found in patterns as well.

    Args:
        size: of the faces, pixels. small: whether they have always been so. used: which of them are used.
    """
    if len(size) < 2:
        return torch.zeros_like(small)
    return small & (size < _MINUTE * size.where(used, 0.0).amax())
