"""Draw training states in blocks, each a function of its source and its number alone.

A source stands for many states that are not held in memory. Processes and workers that share its
blocks see the same states as one process that takes all of them, without padding or repetition.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.checks import check_seed, check_shape
from torchpose._core.rows import joined
from torchpose.camera._viewpoints import ViewRange, sample_viewpoints
from torchpose.errors import InputError
from torchpose.priors._arm_state import arm_state
from torchpose.priors._window import WindowLayout, augment_bodies, mirror_bodies, window_state

BLOCK = 4096
PRODUCT = 8 * BLOCK  # states per product: single blocks take a third more time
_CACHE_BYTES = 1 << 30
_GOLDEN = (math.sqrt(5) - 1) / 2


class Samples(NamedTuple):
    """Holds training states with a weight each.

    Attributes:
        states: float64. weight: in [0, 1]; a state of weight 0.5 counts half.
    """

    states: Float[Tensor, "N D"]
    weight: Float[Tensor, " N"]


@runtime_checkable
class SampleSource(Protocol):
    """Yields training states in blocks, each a function of the source, its number and the epoch."""

    @property
    def dim(self) -> int:
        """Return the dimensions D of a state."""
        ...

    @property
    def n_samples(self) -> int:
        """Return the number of states in all blocks together."""
        ...

    @property
    def n_blocks(self) -> int:
        """Return the number of blocks of `BLOCK` states; the last may be shorter."""
        ...

    def block(self, index: int, epoch: int = 0) -> Samples:
        """Return the states of a block; the epoch matters only where each draws fresh ones."""
        ...


def all_samples(source: SampleSource) -> Samples:
    """Return every state of a source."""
    return joined([source.block(index) for index in range(source.n_blocks)])


def derived_seed(seed: int, purpose: str) -> int:
    """Return a seed for one purpose, so that random numbers of different purposes are independent.

    Raises:
        InputError: a seed that is no whole number from 0 on, or too long.
    """
    check_seed("seed", seed)
    words = np.random.SeedSequence([seed, *purpose.encode()]).generate_state(1, np.uint64)
    return int(words[0]) >> 1


class _Blocks:
    """Counts blocks and their rows; base class of sources."""

    n_samples: int

    @property
    def n_blocks(self) -> int:
        """Return the number of blocks of `BLOCK` states; the last may be shorter."""
        return -(-self.n_samples // BLOCK)

    def _rows(self, index: int) -> tuple[int, int]:
        if not 0 <= index < self.n_blocks:
            raise InputError(f"block must lie in 0..{self.n_blocks - 1}, got {index}")
        start = index * BLOCK
        return start, min(self.n_samples, start + BLOCK)


class TensorSource(_Blocks):
    """Yields given states, in memory or in a memory-mapped file.

    Args:
        states: [N, D], tensor or array (`numpy.memmap` for more than memory holds).
        weight: [N], in [0, 1]; ones if None.
    """

    def __init__(self, states: Tensor | np.ndarray, weight: Tensor | None = None) -> None:
        if states.ndim != 2:
            raise InputError(f"states must have shape [N, D], got {list(states.shape)}")
        self._states = states
        self._weight = weight
        if weight is not None:
            check_shape("weight", weight, (len(states),))
        self.n_samples, self.dim = (int(n) for n in states.shape)

    def block(self, index: int, epoch: int = 0) -> Samples:
        """Return the states of a block."""
        start, stop = self._rows(index)
        rows = self._states[start:stop]
        states = torch.from_numpy(np.array(rows)) if isinstance(rows, np.ndarray) else rows
        if self._weight is None:
            return Samples(states.double(), torch.ones(stop - start, dtype=torch.float64))
        return Samples(states.double(), self._weight[start:stop].double())


class CachedSource(_Blocks):
    """Keeps the blocks of another source once they were drawn.

    Args:
        source: whose blocks do not change with the epoch.
    """

    def __init__(self, source: SampleSource) -> None:
        self.source = source
        self.n_samples, self.dim = source.n_samples, source.dim
        self.n_poses = getattr(source, "n_poses", source.n_samples)
        self._kept: dict[int, Samples] = {}

    def block(self, index: int, epoch: int = 0) -> Samples:
        """Return the states of a block, drawn once."""
        if index not in self._kept:
            self._kept[index] = self.source.block(index)
        return self._kept[index]

    def __getstate__(self) -> dict[str, Any]:
        """Return the source without its kept blocks: worker processes draw their own."""
        return self.__dict__ | {"_kept": {}}


def cached(source: SampleSource, limit: int = _CACHE_BYTES) -> SampleSource:
    """Return the source with its blocks kept in memory if all of them fit into `limit` bytes."""
    fresh = getattr(source, "fresh", False)
    fits = 8 * (source.dim + 1) * source.n_samples <= limit
    return CachedSource(source) if fits and not fresh else source


@dataclass(frozen=True, eq=False)
class _Drawn(_Blocks):
    """Draws states of recorded poses seen from random viewpoints (BL section 3.1).

    Attributes:
        matrix: K, pixels. views, rotation_order: of the viewpoints. n_samples: how many states.
        seed: the seed of everything random. fresh: whether every epoch draws its own viewpoints.
    """

    matrix: Tensor
    views: ViewRange
    rotation_order: str
    n_samples: int
    seed: int
    fresh: bool

    def _generator(self, index: int, epoch: int) -> torch.Generator:
        """Return the random generator of one block, the same in every process."""
        purpose = f"block {index} epoch {epoch if self.fresh else 0}"
        return torch.Generator().manual_seed(derived_seed(self.seed, purpose))

    def _poses(self, index: int, n_poses: int) -> Int[Tensor, " n"]:
        """Return the pose of each state of a block; poses have equal numbers of states, up to one.

        State i takes pose (a p + r) mod N of round r = i // N, p = i mod N, where a has no factor in
        common with N and is near the golden section of it: consecutive states come from all over the
        recordings, and no list of them is held.
        """
        states = torch.arange(*self._rows(index))
        return (_stride(n_poses) * (states % n_poses) + states // n_poses) % n_poses


def _stride(n: int) -> int:
    stride = max(1, round(_GOLDEN * n))
    while math.gcd(stride, n) != 1:
        stride += 1
    return stride


@dataclass(frozen=True, eq=False)
class ArmSource(_Drawn):
    """Draws states of one arm (`arm_state`) from random viewpoints (BL section 3.1).

    Args:
        arms: hand, elbow, shoulder, head, neck of each recorded pose, body axes, metres; complete.
        weight: of each pose, in [0, 1].
        matrix, views, rotation_order, n_samples, seed, fresh: see `_Drawn`.
    """

    arms: Float[Tensor, "N 5 3"]
    weight: Float[Tensor, " N"]
    dim: int = field(default=21, init=False)

    @property
    def n_poses(self) -> int:
        """Return the number of distinct poses."""
        return len(self.arms)

    def block(self, index: int, epoch: int = 0) -> Samples:
        """Return the states of a block."""
        chosen = self._poses(index, len(self.arms))
        views = sample_viewpoints(len(chosen), self.views, self._generator(index, epoch))
        states = arm_state(self.arms[chosen], views, self.matrix, self.rotation_order)
        return Samples(states, self.weight[chosen])


@dataclass(frozen=True, eq=False)
class PoseFrames:
    """Holds the frames of all recordings in one tensor, with the first and last frame of each recording.

    Attributes:
        joints: [F, 8, 3], centred, metres; NaN where missing. weight: [F, 8], in [0, 1].
        first, last: of the recording that a frame belongs to, [F]. fps: of that recording, [F].
    """

    joints: Float[Tensor, "F 8 3"]
    weight: Float[Tensor, "F 8"]
    first: Int[Tensor, " F"]
    last: Int[Tensor, " F"]
    fps: Float[Tensor, " F"]

    @classmethod
    def join(
        cls,
        sequences: Sequence[Float[Tensor, "T 8 3"]],
        rates: Sequence[float],
        weights: Sequence[Float[Tensor, "T 8"]] | None = None,
    ) -> "PoseFrames":
        """Join the frames of several recordings.

        Raises:
            InputError: no recordings.
        """
        if not sequences:
            raise InputError("training states need at least one recording, got none")
        lengths = torch.tensor([len(sequence) for sequence in sequences])
        last = lengths.cumsum(0) - 1
        first = last - lengths + 1
        joints = torch.cat(list(sequences)).double()
        weight = torch.ones(joints.shape[:2]).double() if weights is None else torch.cat([*weights])
        fps = torch.tensor(rates, dtype=torch.float64)
        each = (values.repeat_interleave(lengths) for values in (first, last, fps))
        return cls(joints, weight.double(), *each)

    def at_lags(self, frames: Int[Tensor, " N"], layout: WindowLayout) -> Int[Tensor, "N W"]:
        """Return the frames of each window, held at the ends of a recording."""
        wanted = self.wanted(frames, layout.lags, layout.fps)
        return torch.minimum(
            torch.maximum(wanted, self.first[frames, None]), self.last[frames, None]
        )

    def wanted(
        self, frames: Int[Tensor, " N"], lags: Sequence[int], fps: float
    ) -> Int[Tensor, "N L"]:
        """Return the indices of the frames at some lags, which may be beyond the ends of a recording.

        Args:
            frames: indices. lags: in frames at the rate `fps`; positive is the past.
        """
        ratio = (self.fps[frames] / fps)[:, None]
        return frames[:, None] - torch.round(torch.tensor(lags).double() * ratio).long()

    def complete(self, layout: WindowLayout) -> Int[Tensor, " N"]:
        """Return the frames whose whole window has all joints."""
        known: Bool[Tensor, " F"] = torch.isfinite(self.joints).flatten(1).all(1)
        frames = torch.arange(len(self.joints))
        return frames[known[self.at_lags(frames, layout)].all(1)]


@dataclass(frozen=True, eq=False)
class WindowSource(_Drawn):
    """Draws window states of one arm, each from a viewpoint and a body of its own.

    Args:
        frames: recorded poses, centred on the neck. centres: frames whose windows are complete.
        layout: the hands of a window. side: "left" or "right"; both sides have the same windows.
        body_size, bone_lengths: see `augment_bodies`. mirror_share: share of windows mirrored.
        matrix, views, rotation_order, n_samples, seed, fresh: see `_Drawn`.
    """

    frames: PoseFrames
    centres: Int[Tensor, " C"]
    layout: WindowLayout
    side: str
    body_size: float = 0.0
    bone_lengths: float = 0.0
    mirror_share: float = 0.0

    @property
    def dim(self) -> int:
        """Return the dimensions of a window state."""
        return self.layout.dim

    @property
    def n_poses(self) -> int:
        """Return the number of distinct poses."""
        return len(self.centres)

    def centres_of(self, index: int) -> Int[Tensor, " n"]:
        """Return the frames at the centres of a block's windows."""
        return self.centres[self._poses(index, len(self.centres))]

    def block(self, index: int, epoch: int = 0) -> Samples:
        """Return the states of a block."""
        generator = self._generator(index, epoch)
        centres = self.centres_of(index)
        taken = self.frames.at_lags(centres, self.layout)
        bodies = augment_bodies(
            self.frames.joints[taken], generator, self.body_size, self.bone_lengths
        )
        bodies = mirror_bodies(bodies, generator, self.mirror_share)
        views = sample_viewpoints(len(bodies), self.views, generator)
        states = window_state(
            bodies, views, self.layout, self.side, self.matrix, self.rotation_order
        )
        return Samples(states, self.frames.weight[taken].flatten(1).amin(1))
