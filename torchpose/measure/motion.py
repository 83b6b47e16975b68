"""What moves in the windows about persons: frame differences, a running median, optical flow."""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from torchpose.measure.body_window import CELLS, EVIDENCE, move_maps

__all__ = ["Motion", "MotionState", "dense_flow"]

_DIFFERENCE, _UNUSUAL = (2.0, 20.0), (4.0, 30.0)  # below: noise; range above it; steps of Lab


class MotionState(NamedTuple):
    """The last frame of N persons.

    Attributes:
        last, median: Lab in bytes [N, 3, 160, 192], smoothed. grey: [N, 160, 192].
        flow: from the last frame back to the one before, pixels of `grey` [N, 160, 192, 2].
        frames: seen so far [N].
    """

    last: Float[Tensor, "N 3 h w"]
    median: Float[Tensor, "N 3 h w"]
    grey: UInt8[Tensor, "N H W"]
    flow: Float[Tensor, "N H W 2"]
    frames: Int[Tensor, " N"]


class Motion(nn.Module):
    """Difference from the last frame, difference from the median of all, and optical flow.

        moving = clip((|x_t - x_{t-1}|_w - 2) / 20, 0, 1),   m_t = m_{t-1} + clip(x_t - m_{t-1}, +-s)

    The second stands for a background model: a hand at rest for a second is still unusual.

    Args:
        step: s, in steps of Lab in bytes per frame at 30 frames per second.
        rate: frames at 30 per second that pass in one step. flow: whether to compute it.
    """

    def __init__(self, step: float = 0.7, rate: float = 1.0, flow: bool = True) -> None:
        super().__init__()
        self.limit, self.with_flow = step * rate, flow
        self.register_buffer("channel_weights", torch.tensor([0.6, 1.0, 1.0]))

    channel_weights: Tensor

    def init(self, persons: int) -> MotionState:
        """Return the state before the first frame."""
        rows, columns = CELLS
        small = torch.zeros(persons, 3, rows * EVIDENCE, columns * EVIDENCE)
        grey = torch.zeros(persons, rows * EVIDENCE, columns * EVIDENCE, dtype=torch.uint8)
        flow = torch.zeros(*grey.shape, 2)
        return MotionState(small, small, grey, flow, torch.zeros(persons, dtype=torch.long))

    def move(
        self,
        state: MotionState,
        old: Float[Tensor, "N 3"],
        new: Float[Tensor, "N 3"],
        moved: Bool[Tensor, " N"],
    ) -> MotionState:
        """The same for windows that have moved; only those are computed anew."""
        if not bool(moved.any()):
            return state
        old, new = old[moved], new[moved]
        small = torch.cat([state.last[moved], state.median[moved]], 1)
        small = move_maps(small, old, new, replicate=True)
        grey = move_maps(state.grey[moved][:, None].float(), old, new, replicate=True)
        scale = (old[:, 2] / new[:, 2]).to(state.flow)[:, None, None, None]
        flow = move_maps(state.flow[moved].permute(0, 3, 1, 2), old, new) * scale
        last, median, greys, flows = (
            x.clone() for x in (state.last, state.median, state.grey, state.flow)
        )
        last[moved], median[moved] = small[:, :3], small[:, 3:]
        greys[moved] = grey[:, 0].round().to(torch.uint8)
        flows[moved] = flow.permute(0, 2, 3, 1)
        return state._replace(last=last, median=median, grey=greys, flow=flows)

    def step(
        self,
        state: MotionState,
        small: Float[Tensor, "N 3 h w"],
        grey: UInt8[Tensor, "N H W"],
    ) -> tuple[
        MotionState, Float[Tensor, "N h w"], Float[Tensor, "N h w"], Float[Tensor, "N r c 2"]
    ]:
        """Compare with the frames before.

        Args:
            state: from `init` or the step before. small: windows in Lab, smoothed [N, 3, 160, 192].
            grey: windows [N, 160, 192], lightness in bytes.

        Returns:
            The next state; moving and unusual [N, 160, 192], 0 to 1; flow from this frame back to
            the last one, in cells [N, 72, 96, 2].
        """
        new = (state.frames == 0)[:, None, None, None]
        last = torch.where(new, small, state.last)
        median = torch.where(new, small, state.median)
        median = median + (small - median).clamp(-self.limit, self.limit)
        moving = self._difference(small, last, *_DIFFERENCE)
        unusual = self._difference(small, median, *_UNUSUAL)
        flow, cells = state.flow, small.new_zeros(len(small), *CELLS, 2)
        if self.with_flow and len(small):
            flow, cells = dense_flow(grey, state.grey, state.flow, state.frames > 0)
        return MotionState(small, median, grey, flow, state.frames + 1), moving, unusual, cells

    def _difference(self, small: Tensor, other: Tensor, noise: float, most: float) -> Tensor:
        weighted = (small - other).abs_().mul_(self.channel_weights[:, None, None]).sum(1)
        return weighted.sub_(noise).div_(most).clamp_(0, 1)


def dense_flow(
    grey: UInt8[Tensor, "N H W"],
    before: UInt8[Tensor, "N H W"],
    start: Float[Tensor, "N H W 2"],
    known: Bool[Tensor, " N"],
) -> tuple[Float[Tensor, "N H W 2"], Float[Tensor, "N r c 2"]]:
    """Compute the flow from `grey` back to `before` by DIS, in pixels, and its means over cells, in cells.

    OpenCV's algorithm takes one pair of images at a time, hence the loop; persons without a frame
    before (`known`) get zeros.

    Reference:
        T. Kroeger, R. Timofte, D. Dai, L. Van Gool, Fast optical flow using dense inverse search,
        2016, https://doi.org/10.1007/978-3-319-46493-0_29
    """
    import cv2

    method = _method()
    flow = torch.zeros_like(start)
    cells = start.new_zeros(len(grey), *CELLS, 2)
    for n in torch.nonzero(known)[:, 0].tolist():
        found = method.calc(grey[n].numpy(), before[n].numpy(), start[n].numpy().copy())
        flow[n] = torch.from_numpy(np.ascontiguousarray(found))
        small = cv2.resize(found, CELLS[::-1], interpolation=cv2.INTER_AREA)
        cells[n] = torch.from_numpy(small) / EVIDENCE
    return flow, cells


@cache
def _method() -> Any:
    """Making one takes longer than a frame; it keeps buffers only. Down to half the resolution."""
    import cv2

    method = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)  # type: ignore[attr-defined]
    method.setFinestScale(1)
    return method
