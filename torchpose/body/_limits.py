"""Limit joints as recorded states do: a box per part with soft edges."""

import math
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchpose._core.checks import check_finite, check_shape
from torchpose._core.module_state import register_given
from torchpose.errors import InputError, ShapeError
from torchpose.math._rotations import within_unit_ball

_ROOT_COLUMNS = 6  # position and orientation of the root have no limits
_LEAST_MARGIN = 0.03  # sine of half the angle: about 3.5 degrees


class JointLimits(nn.Module):
    """Limits of every entry of the parts' quaternion vectors, l <= q <= u.

    As a density, an entry is uniform within its limits and falls off as a Gaussian of deviation s
    beyond them:

        log p(q) = -1/2 (e / s)^2 - log(u - l + s sqrt(2 pi)),   e = max(l - q, q - u, 0).

    States of a body with other centres or frame need limits of their own.

    Args:
        lower, upper: l and u, [Q], of a state's relative columns, Q = 3 (P - 1).
        softness: s, [Q], positive.

    Buffers: lower, upper, softness [Q].

    Raises:
        InputError: an upper limit below the lower one, a softness that is not positive.

    >>> states = torch.zeros(50, 12).double()
    >>> limits = JointLimits.fit(states)
    >>> limits.inside(states[0]), limits.upper[0]
    (tensor([True, True]), tensor(0.0300, dtype=torch.float64))
    """

    lower: Tensor
    upper: Tensor
    softness: Tensor

    def __init__(
        self, lower: Float[Tensor, " Q"], upper: Float[Tensor, " Q"], softness: Float[Tensor, " Q"]
    ) -> None:
        super().__init__()
        check_shape("lower", lower, [None])
        columns = lower.shape[0]
        if columns % 3 or not columns:
            raise ShapeError(f"limits come in threes, one vector per part, got {columns} of them")
        for name, value in (("lower", lower), ("upper", upper), ("softness", softness)):
            check_shape(name, value, [columns])
            check_finite(name, value)
            register_given(self, name, value)
        if bool((upper < lower).any()):
            column = int(torch.nonzero(upper < lower)[0])
            raise InputError(f"upper limits must not be below lower ones, see column {column}")
        if bool((softness <= 0).any()):
            raise InputError(f"softness must be positive, got {float(softness.min()):g}")

    @classmethod
    def fit(
        cls,
        states: Float[Tensor, "*batch D"],
        quantile: float = 0.005,
        margin: float = 0.1,
    ) -> "JointLimits":
        """Fit limits to recorded states, entry by entry.

        l = Q(a) - m and u = Q(1 - a) + m with quantiles Q at a = 0.5 %, which drops single wrong
        frames, and a margin m of a tenth of the range between them, at least 0.03 (3.5 degrees),
        which is also the softness. Limits beyond -1 and 1 are cut.

        Args:
            states: [..., D], of one body or of several with the same centres and frame.
            quantile: a. margin: m as a share of the range.

        Returns:
            `JointLimits` over the D - 6 relative columns.

        Raises:
            InputError: no states, not finite, or quantile and margin out of range. ShapeError: columns other
                than 6 + 3 (P - 1).
        """
        columns = states.shape[-1] - _ROOT_COLUMNS
        if columns < 3 or columns % 3:
            raise ShapeError(f"states must have 6 + 3 (P - 1) columns, got {states.shape[-1]}")
        if not (0 <= quantile < 0.5 and margin >= 0):
            raise InputError(
                f"quantile must be in [0, 0.5) and margin 0 or more, got {quantile} and {margin}"
            )
        relative = states.reshape(-1, states.shape[-1])[:, _ROOT_COLUMNS:]
        if relative.shape[0] == 0:
            raise InputError("limits need at least one recorded state, got none")
        check_finite("states", relative)
        ranked = relative.sort(0).values  # torch.quantile takes no more than 2^24 numbers
        lowest = int(quantile * (len(ranked) - 1))
        low, high = ranked[lowest], ranked[len(ranked) - 1 - lowest]
        width = (margin * (high - low)).clamp_min(_LEAST_MARGIN)
        return cls((low - width).clamp_min(-1), (high + width).clamp_max(1), width)

    def inside(self, state: Float[Tensor, "*batch D"]) -> Bool[Tensor, "*batch parts"]:
        """Return whether each part but the root is within its limits.

        Args:
            state: [..., D], metres and quaternion vectors.

        Returns:
            Bool [..., P - 1].

        Raises:
            ShapeError: another number of columns than the limits are for.
        """
        relative = self._relative(state)
        within = (relative >= self.lower) & (relative <= self.upper)
        return within.unflatten(-1, (-1, 3)).all(-1)

    def clamp(self, state: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch D"]:
        """Return the nearest state within the limits, entry by entry, and within the unit ball.

        Args:
            state: [..., D], metres and quaternion vectors.

        Returns:
            [..., D], with the root as it was.

        Raises:
            ShapeError: another number of columns than the limits are for.
        """
        relative = self._relative(state).clamp(self.lower, self.upper)
        relative = within_unit_ball(relative.unflatten(-1, (-1, 3))).flatten(-2)
        return torch.cat([state[..., :_ROOT_COLUMNS], relative], -1)

    def log_prob(self, state: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch"]:
        """Return the log density of the relative columns, their entries taken as independent.

        Args:
            state: [..., D], metres and quaternion vectors.

        Returns:
            [...], natural logarithm.

        Raises:
            ShapeError: another number of columns than the limits are for.
        """
        relative = self._relative(state)
        excess = torch.maximum(self.lower - relative, relative - self.upper).clamp_min(0)
        size = (self.upper - self.lower + math.sqrt(2 * math.pi) * self.softness).log()
        return (-0.5 * (excess / self.softness).square() - size).sum(-1)

    def forward(self, state: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch"]:
        """Return the log density of the relative columns, as `log_prob` does.

        Args:
            state: [..., D], metres and quaternion vectors.

        Returns:
            [...], natural logarithm.
        """
        return self.log_prob(state)

    if TYPE_CHECKING:  # nn.Module has Any
        __call__ = forward

    def _relative(self, state: Tensor) -> Tensor:
        wanted = _ROOT_COLUMNS + self.lower.shape[0]
        if state.ndim < 1 or state.shape[-1] != wanted:
            raise ShapeError(
                f"states must have {wanted} columns for these limits, got {list(state.shape)}"
            )
        return state[..., _ROOT_COLUMNS:]
