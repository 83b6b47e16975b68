"""Limbs of a body in the room: tapered cylinders with round ends."""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from torchpose.errors import InputError, ShapeError, check_shape

__all__ = ["Limbs", "check_limbs"]


class Limbs(NamedTuple):
    """Tapered cylinders with round ends, L for each body.

    Attributes:
        start, end: [..., L, 3], the middles of both ends, metres, world axes.
        radii: [L, 2] or [..., L, 2], radius at the start and at the end, metres, not negative.
            A limb whose start is its end is a ball.
    """

    start: Float[Tensor, "*batch L 3"]
    end: Float[Tensor, "*batch L 3"]
    radii: Float[Tensor, "*radii L 2"]

    def select(self, index: Tensor) -> "Limbs":
        """Return the limbs at `index` (indices [l], or bool [L])."""
        return Limbs(self.start[..., index, :], self.end[..., index, :], self.radii[..., index, :])


def check_limbs(limbs: Limbs) -> None:
    """Raise unless both ends have one shape and radii fit them.

    Raises:
        ShapeError: shapes differ. InputError: a radius is negative or NaN.
    """
    check_shape("start of the limbs", limbs.start, ["...", "L", 3])
    shape = tuple(limbs.start.shape)
    if tuple(limbs.end.shape) != shape:
        raise ShapeError(f"both ends of the limbs must have shape {shape}, got {limbs.end.shape}")
    radii = tuple(limbs.radii.shape)
    wanted = (*shape[:-1], 2)
    if len(radii) < 2 or len(radii) > len(wanted) or not _broadcasts(radii, wanted):
        raise ShapeError(
            f"radii of the limbs must have shape [{shape[-2]}, 2] or {list(wanted)}, "
            f"got {list(radii)}"
        )
    if not bool((limbs.radii >= 0).all()):
        raise InputError(
            f"radii of the limbs must be 0 m or more, got {float(limbs.radii.min()):g}"
        )


def _broadcasts(shape: tuple[int, ...], target: tuple[int, ...]) -> bool:
    tail = target[len(target) - len(shape) :]
    if shape[-2:] != tail[-2:]:
        return False
    return all(s in (1, t) for s, t in zip(shape[:-2], tail[:-2], strict=True))
