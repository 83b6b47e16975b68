"""Filter and smooth numbers that move at nearly constant velocity, by a Kalman filter."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Integer
from torch import Tensor, nn

from torchpose._core.checks import check_positive, check_shape
from torchpose._core.former_arguments import takes_former_arguments
from torchpose._core.module_state import derived
from torchpose.filters._lengths import held_past_lengths, inside_lengths
from torchpose.filters._measurements import check_lengths
from torchpose.filters._recursive_filter import check_lag
from torchpose.math._gaussian import kalman_gain, safe_cholesky, symmetrise

_SETTLED = 1e-13
_MOST_STEPS = 10_000
_VELOCITY_VARIANCE = 100.0  # at the start, in units of r per s^2


class ConstantVelocityState(NamedTuple):
    """Holds the position and velocity of every number.

    Attributes:
        mean: [B, 2, N], in the units of the numbers and per second. time: frames seen.
    """

    mean: Tensor
    time: int


class _Gains(NamedTuple):
    """Holds the motion matrix [2, 2], and gains frame by frame: filter [S, 2, 1], smoother [S, 2, 2]."""

    matrix: Tensor
    filter: Tensor
    smoother: Tensor


class ConstantVelocityFilter(nn.Module):
    """Filters numbers that move at nearly constant velocity and are measured in every frame (Kalman filter).

    Each number by itself, at all times with the same gains:
        (x, v)_t = [1 dt; 0 1] (x, v)_{t-1} + N(0, q [dt^3/3 dt^2/2; dt^2/2 dt]),   z_t = x_t + N(0, r).
    Only the ratio q/r matters for the estimates. Large ratios follow the measurements, small ones are
    smooth and late.

    Args:
        ratio: q/r, 1/s^3. fps: frames per second.

    Raises:
        InputError: either is not positive and finite.

    Reference:
        Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
        Navigation" (2001), section 6.2.2; H. Rauch, F. Tung, C. Striebel (1965) for the smoother.

    Example:
        >>> import torch
        >>> f = ConstantVelocityFilter(ratio=1e3, fps=30.0)
        >>> z = torch.linspace(0, 1, 100, dtype=torch.float64)[None, :, None]
        >>> bool((f(z)[0, -1] - 1).abs() < 1e-3)
        True
    """

    def __init__(self, ratio: float, fps: float) -> None:
        super().__init__()
        for name, value in (("ratio", ratio), ("fps", fps)):
            check_positive(name, value)
        for name, value in (("ratio", ratio), ("fps", fps)):
            self.register_buffer(name, torch.tensor(float(value), dtype=torch.float64))

    ratio: Tensor
    fps: Tensor

    def _gains(self) -> "_Gains":
        return derived(self, "gains", (self.ratio, self.fps), self._make_gains)

    def _make_gains(self) -> "_Gains":
        dt = 1.0 / float(self.fps)
        matrix = torch.tensor([[1.0, dt], [0.0, 1.0]], dtype=torch.float64)
        noise = torch.tensor([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], dtype=torch.float64)
        gains = _riccati(matrix, float(self.ratio) * noise)
        return _Gains(*(part.to(self.ratio.device) for part in (matrix, *gains)))

    def init(self, z: Float[Tensor, "B N"]) -> ConstantVelocityState:
        """Return the state before the first frame, whose values are `z`."""
        return ConstantVelocityState(torch.stack([z, torch.zeros_like(z)], 1), 0)

    def step(
        self, state: ConstantVelocityState, z: Float[Tensor, "B N"]
    ) -> tuple[ConstantVelocityState, Float[Tensor, "B N"]]:
        """Filter one frame: the same numbers as the same frame of `forward`."""
        state, _ = _next(self._gains(), state, z)
        return state, state.mean[:, 0]

    def advance(
        self, state: ConstantVelocityState, z: Float[Tensor, "B T N"]
    ) -> tuple[ConstantVelocityState, Float[Tensor, "B T N"]]:
        """Filter some more frames: the same numbers as `step` for one after the other."""
        known, found = self._gains(), []
        for frame in z.unbind(1):
            state, _ = _next(known, state, frame)
            found.append(state.mean[:, 0])
        return state, torch.stack(found, 1)

    def forward(
        self, z: Float[Tensor, "B T N"], *, lengths: Integer[Tensor, " B"] | None = None
    ) -> Float[Tensor, "B T N"]:
        """Return filtered numbers: each uses its own frame and those before.

        Args:
            z: [B, T, N]. lengths: frames of each sequence [B]; past them its last number is repeated.

        Raises:
            ShapeError, InputError: wrong shapes, or lengths outside 1..T.
        """
        check_shape("z", z, ["B", "T", "N"])
        found = self.advance(self.init(z[:, 0]), z)[1]
        if lengths is None:
            return found
        return held_past_lengths(found, check_lengths(lengths, len(z), z.shape[1], z.device))

    def _run(
        self, state: ConstantVelocityState, z: Tensor
    ) -> tuple[ConstantVelocityState, Tensor, Tensor]:
        """Return the state after all frames, filtered means, and these minus predicted, [B, T, 2, N]."""
        means, corrections = [], []
        for frame in z.unbind(1):
            state, correction = _next(self._gains(), state, frame)
            means.append(state.mean)
            corrections.append(correction)
        return state, torch.stack(means, 1), torch.stack(corrections, 1)

    @takes_former_arguments
    def smooth(
        self,
        z: Float[Tensor, "B T N"],
        *,
        lengths: Integer[Tensor, " B"] | None = None,
        lag: int | None = None,
    ) -> Float[Tensor, "B T N"]:
        """Return numbers that use later frames too.

        Args:
            z: [B, T, N]. lengths: frames of each sequence [B]; those after are not used, and its last
                number is repeated.
            lag: number of later frames that each may use; None is all.

        Raises:
            ShapeError, InputError: wrong shapes, lengths outside 1..T, or a negative lag.
        """
        check_shape("z", z, ["B", "T", "N"])
        check_lag(lag)
        inside = check_lengths(lengths, len(z), z.shape[1], z.device)
        found = self.smooth_frames(z, inside, lag)
        return found if lengths is None else held_past_lengths(found, inside)

    def smooth_frames(
        self, z: Float[Tensor, "B T N"], lengths: Int[Tensor, " B"] | None, lag: int | None
    ) -> Float[Tensor, "B T N"]:
        """Return smoothed numbers, given checked arguments; past its length a sequence is filtered alone."""
        _, means, corrections = self._run(self.init(z[:, 0]), z)
        n_frames = z.shape[1]
        frames = torch.arange(n_frames, device=z.device)
        if lengths is None:
            lengths = torch.full((len(z),), n_frames, device=z.device)
        later = inside_lengths(lengths - 1, n_frames)[..., None, None]
        known = self._gains().smoother
        gains = known[frames.clamp(max=len(known) - 1)].to(z)
        if lag is None or lag >= n_frames - 1:
            changes = [torch.zeros_like(means[:, 0])]
            for t in range(n_frames - 2, -1, -1):
                pulled = gains[t] @ (corrections[:, t + 1] + changes[-1])
                changes.append(torch.where(later[:, t], pulled, torch.zeros_like(pulled)))
            return (means + torch.stack(changes[::-1], 1))[:, :, 0]
        change = torch.zeros_like(means)
        for _ in range(lag):
            pulled = gains[:-1] @ (corrections[:, 1:] + change[:, 1:])
            pulled = torch.where(later[:, :-1], pulled, torch.zeros_like(pulled))
            change = torch.cat([pulled, change[:, -1:]], 1)
        return (means + change)[:, :, 0]

    def extra_repr(self) -> str:
        """Return the settings, for printing."""
        return f"ratio={float(self.ratio):g}, fps={float(self.fps):g}"


class VelocityFiltersState(NamedTuple):
    """State of `VelocityFilters`.

    Attributes:
        mean: [B, 2, N], as in `ConstantVelocityState`. time: frames since each sequence began, [B].
    """

    mean: Tensor
    time: Tensor


class VelocityFilters:
    """Filters of constant velocity, each over some of the numbers, which are advanced all at once.

    Sequences begin when they are told to. Before, their numbers stay as they are.

    Args:
        filters: of one frame rate. counts: how many of the numbers each filters, one after the other.
    """

    def __init__(self, filters: Sequence[ConstantVelocityFilter], counts: Sequence[int]) -> None:
        known = [own._gains() for own in filters]
        n_frames = max(len(gains.filter) for gains in known)
        columns = [
            torch.cat(
                [gains.filter, gains.filter[-1:].expand(n_frames - len(gains.filter), -1, -1)]
            )
            for gains in known
        ]
        counted = zip(columns, counts, strict=True)
        gains = torch.cat([gains.expand(-1, -1, count) for gains, count in counted], -1)
        at_rest = torch.zeros_like(gains[:1])
        at_rest[:, 0] = 1.0
        # by the number of frames of a sequence so far, of which the first one begins as it is, at rest
        self._gains = torch.cat([at_rest, at_rest, gains[1:]])
        self._matrix = known[0].matrix

    def init(self, z: Float[Tensor, "B T N"]) -> VelocityFiltersState:
        """Return the state before the first frame."""
        times = torch.zeros(len(z), dtype=torch.long, device=z.device)
        return VelocityFiltersState(z.new_zeros(len(z), 2, z.shape[-1]), times)

    def advance(
        self, state: VelocityFiltersState, z: Float[Tensor, "B T N"], seen: Bool[Tensor, "B T"]
    ) -> tuple[VelocityFiltersState, Float[Tensor, "B T N"]]:
        """Filter some more frames.

        Args:
            state: before them. z: the numbers. seen: the first frame in which it holds is the first one of a
                sequence.
        """
        before = state.time[:, None]
        times = before + (before + seen.cumsum(1) > 0).cumsum(1)
        gains = self._gains.to(z)[times.clamp(max=len(self._gains) - 1)]
        matrix, mean, found = self._matrix.to(z), state.mean, []
        for frame, gain in zip(z.unbind(1), gains.unbind(1), strict=True):
            predicted = matrix @ mean
            mean = predicted + _correction(predicted, frame, gain)
            found.append(mean[:, 0])
        return VelocityFiltersState(mean, times[:, -1]), torch.stack(found, 1)


def _next(
    known: _Gains, state: ConstantVelocityState, z: Float[Tensor, "B N"]
) -> tuple[ConstantVelocityState, Float[Tensor, "B 2 N"]]:
    """Return the next state, and by how much it differs from its prediction."""
    predicted = state.mean if state.time == 0 else known.matrix.to(state.mean) @ state.mean
    gain = known.filter[min(state.time, len(known.filter) - 1)].to(z)
    correction = _correction(predicted, z, gain)
    return ConstantVelocityState(predicted + correction, state.time + 1), correction


def _correction(
    predicted: Float[Tensor, "B 2 N"], z: Float[Tensor, "B N"], gain: Float[Tensor, "*shape"]
) -> Float[Tensor, "B 2 N"]:
    """Return what numbers z change of predicted positions and velocities."""
    return gain * (z[:, None] - predicted[:, :1])


def _riccati(matrix: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Return Kalman gains [S, 2, 1] and smoother gains [S, 2, 2], until they settle; r = 1."""
    observed, unit = torch.tensor([0]), torch.ones(1, 1, dtype=matrix.dtype)
    predicted = torch.diag(torch.tensor([1.0, _VELOCITY_VARIANCE], dtype=matrix.dtype))
    gains, smoothers = [], []
    for _ in range(_MOST_STEPS):
        gain, cov = kalman_gain(predicted, unit, observed)
        gains.append(gain.white[0] / gain.factor[0, 0])
        following = symmetrise(matrix @ cov @ matrix.mT + noise)
        smoothers.append(torch.cholesky_solve(matrix @ cov, safe_cholesky(following)).mT)
        settled = bool(((following - predicted).abs() <= _SETTLED * following.abs()).all())
        predicted = following
        if settled:
            break
    return torch.stack(gains)[..., None], torch.stack(smoothers)
