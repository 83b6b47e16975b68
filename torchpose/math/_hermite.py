"""Interpolate by pieces of cubic polynomials."""

from torch import Tensor


def hermite(
    s: Tensor, ends: tuple[Tensor, Tensor], slopes: tuple[Tensor, Tensor], step: Tensor | float = 1
) -> Tensor:
    """Return points of pieces that have given ends, and slopes there.

        p(s) = h00 p_0 + h10 d m_0 + h01 p_1 + h11 d m_1
        h00 = 2 s^3 - 3 s^2 + 1,  h10 = s^3 - 2 s^2 + s,  h01 = 3 s^2 - 2 s^3,  h11 = s^3 - s^2

    Args:
        s: place within the piece, 0 to 1. ends: p_0 and p_1. slopes: m_0 and m_1, of a unit of `step`.
        step: d, length of the piece. All have shapes that broadcast.
    """
    return (
        (2 * s**3 - 3 * s**2 + 1) * ends[0]
        + (s**3 - 2 * s**2 + s) * step * slopes[0]
        + (3 * s**2 - 2 * s**3) * ends[1]
        + (s**3 - s**2) * step * slopes[1]
    )
