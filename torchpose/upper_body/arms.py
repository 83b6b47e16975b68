"""What both arms' filters need beside themselves."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchpose.filters.base import Generators
from torchpose.filters.outputs import FilterOutput, StepOutput
from torchpose.skeleton.upper_body import ARM_JOINTS, LEFT_ARM, RIGHT_ARM

__all__ = [
    "ARMS",
    "arm_joints",
    "first_failure",
    "generators_of_arms",
    "in_double",
    "joints_of_arm",
    "mending_notes",
    "require_cov",
]

ARMS = {"left": LEFT_ARM, "right": RIGHT_ARM}
"""Indices into `UPPER_BODY` of each arm, in the order of `ARM_JOINTS`."""

_USUAL = ("hand", "head", "neck")


def joints_of_arm(side: str, there: Sequence[bool]) -> tuple[str, ...]:
    """Return hand, head and neck of an arm, and those of its other joints that are there.

    Args:
        side: "left" or "right". there: whether each of `UPPER_BODY` is.

    >>> joints_of_arm("left", [True, True, False, True, False, False, False, True])
    ('hand', 'elbow', 'head', 'neck')
    """
    rows = zip(ARM_JOINTS, ARMS[side], strict=True)
    return tuple(joint for joint, row in rows if joint in _USUAL or there[row])


def arm_joints(there: Sequence[bool]) -> dict[str, tuple[str, ...]]:
    """Return `joints_of_arm` of both arms.

    Args:
        there: whether each of `UPPER_BODY` is.
    """
    return {side: joints_of_arm(side, there) for side in ARMS}


def generators_of_arms(generator: Generators) -> dict[str, Generators]:
    """Return a generator for each arm, so that neither's numbers depend on how many the other drew."""
    return dict(zip(ARMS, _pair(generator), strict=True))


def _pair(generator: Generators) -> tuple[Generators, Generators]:
    if generator is None:
        return None, None
    if isinstance(generator, torch.Generator):
        left, right = torch.randint(2**62, (2,), generator=generator, device=generator.device)
        device = generator.device
        return (
            torch.Generator(device).manual_seed(int(left)),
            torch.Generator(device).manual_seed(int(right)),
        )
    pairs = [_pair(g) for g in generator]
    lefts = [left for left, _ in pairs if isinstance(left, torch.Generator)]
    return lefts, [right for _, right in pairs if isinstance(right, torch.Generator)]


def first_failure(left: FilterOutput, right: FilterOutput) -> Tensor:
    """Return the first frame at which either arm degenerated, -1 where none did, [B]."""
    n_frames = left.mean.shape[1]
    failures = torch.stack([left.failed_at, right.failed_at])
    first = failures.where(failures >= 0, n_frames).amin(0)
    return torch.where((failures >= 0).any(0), first, -1)


def in_double(out: FilterOutput) -> FilterOutput:
    """Return the estimates in float64, in which poses are read out of them."""
    wide = [v.double() if v is not None and v.is_floating_point() else v for v in out]
    return FilterOutput(*wide)  # type: ignore[arg-type]


def mending_notes(left: FilterOutput, right: FilterOutput) -> tuple[str, ...]:
    """Return a note about covariances that were mended; nothing where none was."""
    outputs = [out for out in (left, right) if out.mended is not None and out.jitter is not None]
    count = sum(int(out.mended.sum()) for out in outputs if out.mended is not None)
    if not count:
        return ()
    most = max(float(out.jitter.max()) for out in outputs if out.jitter is not None)
    return (
        f"{count} covariances were not positive definite in rounding and were mended: their "
        f"variances grew by at most {most:.0e} of themselves",
    )


def require_cov(out: FilterOutput | StepOutput) -> Tensor:
    """Return the covariances, which the filter was asked for."""
    if out.cov is None:
        raise RuntimeError("the filter was run without return_cov=True")
    return out.cov
