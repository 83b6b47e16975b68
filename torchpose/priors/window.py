"""Priors over short windows: an arm's state together with where hands were seen around it.

A window state is the 21 numbers of the arm followed by pixels (u, v) of hands: of the arm's own hand
some frames earlier (or later), and of the other hand. A mixture over windows carries motion and the
other arm into the estimate, which a mixture over single poses cannot.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchpose.body_view import BodyPath
from torchpose.camera import ViewRange, sample_viewpoints
from torchpose.errors import InputError, PriorError
from torchpose.priors.arm_state import STATE_DIM, mirror_arm_state
from torchpose.priors.gmm import GaussianMixture
from torchpose.projection import project
from torchpose.rotations import euler_to_matrix
from torchpose.skeleton import LEFT_ARM, RIGHT_ARM

__all__ = ["WindowLayout", "WindowPrior", "augment_bodies", "window_measurements", "window_states"]

_HANDS = {"left": (0, 7), "right": (7, 0)}  # own hand, other hand
_ARMS = {"left": LEFT_ARM, "right": RIGHT_ARM}
_BONES = ((4, 3), (4, 2), (2, 1), (1, 0), (4, 5), (5, 6), (6, 7))  # parent first, from the neck
_SAME_BONE = (0, 1, 2, 3, 1, 2, 3)  # left and right limbs are of one length
_MIRROR = (7, 6, 5, 3, 4, 2, 1, 0)  # left and right change places, head and neck stay


class WindowLayout(NamedTuple):
    """Which hands a window holds.

    Attributes:
        own: lags of the arm's own hand, frames; positive is the past. other: lags of the other hand.
        fps: the frame rate that the lags count at.
    """

    own: tuple[int, ...]
    other: tuple[int, ...]
    fps: float = 30.0

    @property
    def dim(self) -> int:
        """Number of dimensions of a window state."""
        return STATE_DIM + 2 * (len(self.own) + len(self.other))

    @property
    def lags(self) -> tuple[int, ...]:
        """All lags, with 0, in order."""
        return tuple(sorted({0, *self.own, *self.other}))

    @property
    def ahead(self) -> int:
        """Number of later frames that a window needs."""
        return max(0, -min((*self.own, *self.other), default=0))

    def at_rate(self, fps: float) -> "WindowLayout":
        """The lags in frames at another frame rate."""
        ratio = fps / self.fps
        own = tuple(round(lag * ratio) for lag in self.own)
        return WindowLayout(own, tuple(round(lag * ratio) for lag in self.other), fps)


class WindowPrior(nn.Module):
    """Mixtures over window states of both arms, with the settings of the filter that uses them.

    Args:
        left, right: mixtures over `layout.dim` dimensions. layout: the hands in a window.
        settings: numbers by name: hand_std (pixels, of the window's hands), likelihood_power, and
            joint_ratio, pixel_ratio and placement_ratio (1/s^3, of `torchpose.read_out.MotionStage`).

    Raises:
        PriorError: mixtures of another size.
    """

    def __init__(
        self,
        left: GaussianMixture,
        right: GaussianMixture,
        layout: WindowLayout,
        settings: Mapping[str, float],
    ) -> None:
        super().__init__()
        for side, mixture in (("left", left), ("right", right)):
            if mixture.dim != layout.dim:
                raise PriorError(
                    f"the {side} window mixture must be over {layout.dim} dimensions for "
                    f"{layout}, got {mixture.dim}"
                )
        self.left, self.right = left, right
        self.layout = layout
        self.settings = dict(settings)

    def facts(self) -> dict[str, Any]:
        """What a prior file says about it, as JSON can hold it."""
        layout = {"own": list(self.layout.own), "other": list(self.layout.other)}
        return layout | {"fps": self.layout.fps, "settings": self.settings}

    @classmethod
    def from_facts(
        cls, left: GaussianMixture, right: GaussianMixture, facts: Mapping[str, Any]
    ) -> "WindowPrior":
        """From mixtures and `facts`."""
        own, other = tuple(facts["own"]), tuple(facts["other"])
        return cls(left, right, WindowLayout(own, other, facts["fps"]), facts["settings"])

    def mirrored(self, cx: float) -> "WindowPrior":
        """Windows of the mirrored person: each arm is the mirror image of the other one."""
        left, right = (_mirror(mixture, cx) for mixture in (self.right, self.left))
        return WindowPrior(left, right, self.layout, self.settings)


def _mirror(mixture: GaussianMixture, cx: float) -> GaussianMixture:
    extra = mixture.dim - STATE_DIM
    base = mirror_arm_state(mixture.means[:, :STATE_DIM], cx)
    flip = mixture.means.new_tensor([-1.0, 1.0]).repeat(extra // 2)
    shift = mixture.means.new_tensor([2 * cx, 0.0]).repeat(extra // 2)
    means = torch.cat([base, mixture.means[:, STATE_DIM:] * flip + shift], 1)
    sign = torch.cat([mirror_arm_state(torch.ones_like(base[0]), 0.0), flip])
    return GaussianMixture(mixture.weights, means, mixture.covariances * sign * sign[:, None])


def augment_bodies(
    joints: Float[Tensor, "N W 8 3"],
    generator: torch.Generator,
    size: float,
    bones: float,
) -> Float[Tensor, "N W 8 3"]:
    """Windows of bodies of other sizes: all bones times one factor, and each by one of its own.

    Args:
        joints: centred on the neck. size, bones: largest relative change, uniform; left and right
            limbs stay of one length, and all frames of a window keep their body.
    """
    n = len(joints)

    def draw(count: int, limit: float) -> Tensor:
        return 1 + limit * (2 * torch.rand(n, count, generator=generator, dtype=joints.dtype) - 1)

    factors = draw(4, bones)[:, list(_SAME_BONE)] * draw(1, size)
    out = joints.clone()
    for bone, (parent, child) in enumerate(_BONES):
        offset = joints[:, :, child] - joints[:, :, parent]
        out[:, :, child] = out[:, :, parent] + factors[:, bone, None, None] * offset
    return out


def window_states(
    sequences: Sequence[Float[Tensor, "T 8 3"]],
    rates: Sequence[float],
    layout: WindowLayout,
    matrix: Float[Tensor, "3 3"],
    views: ViewRange,
    rotation_order: str,
    generator: torch.Generator,
    *,
    n_samples: int,
    size: float = 0.0,
    bones: float = 0.0,
    mirror_share: float = 0.0,
) -> dict[str, Float[Tensor, "N W"]]:
    """Window states of both arms from recorded sequences, each from a viewpoint and body of its own.

    Beyond the ends of a sequence its first and last poses are held.

    Args:
        sequences: poses centred on the neck, metres, complete. rates: their frames per second.
        layout: the hands of a window. matrix: K, without skew. views, rotation_order: of the random
            viewpoints (BL section 3.1). n_samples: windows, spread evenly over all frames.
        size, bones: see `augment_bodies`. mirror_share: share of windows that are mirrored.

    Raises:
        InputError: no sequences, or joints missing.
    """
    if not sequences:
        raise InputError("window states need at least one sequence, got none")
    lags = layout.lags
    windows = torch.cat(
        [
            _windows(sequence, [round(lag * rate / layout.fps) for lag in lags])
            for sequence, rate in zip(sequences, rates, strict=True)
        ]
    ).double()
    if not bool(torch.isfinite(windows).all()):
        raise InputError("window states need complete poses; leave out frames with missing joints")
    rounds, rest = divmod(n_samples, len(windows))
    order = [torch.arange(len(windows))] * rounds
    order += [torch.randperm(len(windows), generator=generator)[:rest]]
    windows = augment_bodies(windows[torch.cat(order)], generator, size, bones)
    mirrored = torch.rand(len(windows), generator=generator) < mirror_share
    flip = windows.new_tensor([-1.0, 1.0, 1.0])
    windows = torch.where(
        mirrored[:, None, None, None], windows[:, :, list(_MIRROR)] * flip, windows
    )
    view = sample_viewpoints(len(windows), views, generator)
    rotation = euler_to_matrix(view.angles, rotation_order)  # type: ignore[arg-type]
    uvl = project(windows, matrix, rotation[:, None], view.translation[:, None])
    at = {lag: i for i, lag in enumerate(lags)}
    states = {}
    for side, arm in _ARMS.items():
        own, other = _HANDS[side]
        parts = [uvl[:, at[0], list(arm)].flatten(1), view.angles, view.translation]
        parts += [uvl[:, at[lag], own, :2] for lag in layout.own]
        parts += [uvl[:, at[lag], other, :2] for lag in layout.other]
        states[side] = torch.cat(parts, 1)
    return states


def _windows(sequence: Tensor, lags: Sequence[int]) -> Tensor:
    frames = torch.arange(len(sequence))
    taken = [sequence[(frames - lag).clamp(0, len(sequence) - 1)] for lag in lags]
    return torch.stack(taken, 1)


def window_measurements(
    uv: Float[Tensor, "B T 8 2"],
    mask: Bool[Tensor, "B T 8"],
    layout: WindowLayout,
    side: str,
    path: BodyPath,
    start: int = 0,
) -> tuple[Float[Tensor, "B S H 2"], Bool[Tensor, "B S H"]]:
    """Where the hands of each frame's window were measured, relative to where the body is now.

    Poses of the prior are centred on the neck and seen from one place, so a hand of another frame is
    carried along with the body (`BodyPath.carried`). A hand that was not measured, or that lies
    beyond the ends of the sequence, is missing.

    Args:
        uv, mask: the eight joints in the prior's pixels. layout: lags in frames of this sequence.
        side: "left" or "right". path: of the body, at the lags of the layout.
        start: first frame that is wanted, as in `body_path`.

    Returns:
        Pixels [B, S, H, 2] and mask [B, S, H] of S = T - start frames and H = own + other hands, in
        the order of the window state.
    """
    own, other = _HANDS[side]
    taken = [(own, lag) for lag in layout.own] + [(other, lag) for lag in layout.other]
    values, known = [], []
    for joint, lag in taken:
        then, seen = _shifted(uv[:, :, joint], mask[:, :, joint], lag)
        values.append(path.carried(then[:, start:], lag))
        known.append(seen[:, start:])
    if not values:
        shape = (uv.shape[0], uv.shape[1] - start, 0)
        return uv.new_zeros(*shape, 2), mask.new_zeros(shape)
    return torch.stack(values, 2), torch.stack(known, 2)


def _shifted(
    uv: Float[Tensor, "B T 2"], mask: Bool[Tensor, "B T"], lag: int
) -> tuple[Tensor, Tensor]:
    """Values `lag` frames ago, missing where that is outside the sequence."""
    n_frames = uv.shape[1]
    source = torch.arange(n_frames, device=uv.device) - lag
    inside = (source >= 0) & (source < n_frames)
    source = source.clamp(0, n_frames - 1)
    return uv[:, source], mask[:, source] & inside
