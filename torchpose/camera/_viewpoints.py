"""Draw random viewpoints: the camera poses that training poses are seen from."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose._core.checks import check_generator
from torchpose.errors import InputError


class Viewpoints(NamedTuple):
    """Holds camera poses: angles (roll, pitch, yaw) [N, 3] in radians, translation [N, 3] in metres."""

    angles: Tensor
    translation: Tensor


@dataclass(frozen=True)
class ViewRange:
    """Limits of random viewpoints; the defaults are the paper's, at a nominal distance of 2 m.

    Args:
        roll, pitch, yaw: largest absolute angle, radians.
        tx, ty, tz: (low, high) of the translation, metres, in camera axes.
    """

    roll: float = math.radians(30)
    pitch: float = math.radians(30)
    yaw: float = math.radians(30)
    tx: tuple[float, float] = (-0.5, 0.5)
    ty: tuple[float, float] = (-0.5, 0.5)
    tz: tuple[float, float] = (1.5, 2.5)

    def __post_init__(self) -> None:
        for name in ("roll", "pitch", "yaw"):
            angle = getattr(self, name)
            if not 0 <= angle <= math.pi:
                raise InputError(f"ViewRange.{name} must be in [0, pi] radians, got {angle}")
        for name in ("tx", "ty", "tz"):
            low, high = getattr(self, name)
            if not -math.inf < low <= high < math.inf:
                raise InputError(
                    f"ViewRange.{name} must be (low, high) in metres with low <= high, "
                    f"got ({low}, {high})"
                )

    def scaled(self, factor: float) -> "ViewRange":
        """Return limits of another width about the same middle.

        Args:
            factor: the factor by which the width is multiplied, 0 or more; 1 changes nothing.

        Returns:
            `ViewRange`, radians and metres.
        """

        def about_middle(limits: tuple[float, float]) -> tuple[float, float]:
            low, high = limits
            middle, half = (low + high) / 2, factor * (high - low) / 2
            return middle - half, middle + half

        return ViewRange(
            factor * self.roll,
            factor * self.pitch,
            factor * self.yaw,
            about_middle(self.tx),
            about_middle(self.ty),
            about_middle(self.tz),
        )


PAPER_VIEWS = ViewRange()


def sample_viewpoints(
    n: int,
    view_range: ViewRange = PAPER_VIEWS,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> Viewpoints:
    """Draw camera poses, every angle and translation uniform within its limits.

    Args:
        n: number of viewpoints.
        view_range: the limits.
        generator: source of random numbers; its device is that of the result.
        dtype: the floating-point type of the result.

    Returns:
        `Viewpoints` with angles [n, 3] and translation [n, 3].

    Raises:
        InputError: n is negative, or no generator.

    Reference: Burke & Lasenby, section 3.1 (angles up to 30 degrees, translations up to 0.5 m).
    """
    if n < 0:
        raise InputError(f"n must not be negative, got {n}")
    check_generator(generator)
    r = view_range
    limits = [(-r.roll, r.roll), (-r.pitch, r.pitch), (-r.yaw, r.yaw), r.tx, r.ty, r.tz]
    device = generator.device if generator is not None else None
    low, high = torch.tensor(limits, dtype=dtype, device=device).unbind(-1)
    unit = torch.rand((n, 6), generator=generator, dtype=dtype, device=device)
    drawn = low + (high - low) * unit
    return Viewpoints(drawn[:, :3], drawn[:, 3:])
