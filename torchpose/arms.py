"""What the two arms' filters need beside themselves: generators, views, and their parts of windows."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.body_view import BodyView
from torchpose.filters.base import FilterOutput, Generators, StepOutput
from torchpose.measurements import MeasuredJoints
from torchpose.priors.arm_state import STATE_DIM

__all__ = ["SeenInView", "generators_of_arms", "pose_of_window", "require_cov"]


class SeenInView(NamedTuple):
    """Measurements for a filter over windows, in the pixels of a virtual camera.

    Attributes:
        window: which of the prior's windows. measured: the eight joints of each frame.
        hands: values and mask [B, T, 2 H] of the hands of each frame's window, for both arms.
        view: the virtual camera of each frame.
        log_scale: log of the area that a pixel of the camera has in the virtual one, [B, T, 8].
    """

    window: str
    measured: MeasuredJoints
    hands: dict[str, tuple[Tensor, Tensor]]
    view: BodyView
    log_scale: Tensor


def generators_of_arms(generator: Generators) -> tuple[Generators, Generators]:
    """A generator for each arm, so that one arm's numbers do not depend on how many the other drew."""
    if generator is None:
        return None, None
    if isinstance(generator, torch.Generator):
        left, right = torch.randint(2**62, (2,), generator=generator, device=generator.device)
        device = generator.device
        return (
            torch.Generator(device).manual_seed(int(left)),
            torch.Generator(device).manual_seed(int(right)),
        )
    pairs = [generators_of_arms(g) for g in generator]
    lefts = [left for left, _ in pairs if isinstance(left, torch.Generator)]
    return lefts, [right for _, right in pairs if isinstance(right, torch.Generator)]


def pose_of_window(
    out: FilterOutput, context: FilterOutput, seen: SeenInView, arm: tuple[int, ...]
) -> FilterOutput:
    """The arm's part of a window's estimate, and its evidence beyond that of the window's hands.

    The evidence is a density over pixels of the prior's camera, not of the virtual one.
    """
    measured = seen.measured.mask[:, :, list(arm)]
    evidence = out.log_evidence - context.log_evidence
    evidence = evidence + (seen.log_scale[:, :, list(arm)] * measured).sum(-1)
    evidence = torch.where(measured.any(-1), evidence, torch.zeros_like(evidence))
    cov = require_cov(out)[..., :STATE_DIM, :STATE_DIM]
    return out._replace(mean=out.mean[..., :STATE_DIM], cov=cov, log_evidence=evidence)


def require_cov(out: FilterOutput | StepOutput) -> Tensor:
    if out.cov is None:
        raise RuntimeError("the filter was run without return_cov=True")
    return out.cov
