"""The filter over windows of motion of an arm: what it is given, and what is taken from it.

Mixtures over windows see the body through a virtual camera that follows it
(`torchpose.camera.virtual_camera`).
"""

from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.camera.virtual_camera import (
    BodyView,
    PathModel,
    body_path,
    to_view,
    view_body,
    view_jacobian,
)
from torchpose.filters.mkf import MixtureKalmanFilter
from torchpose.filters.outputs import FilterOutput
from torchpose.priors.arm_state import STATE_DIM
from torchpose.priors.upper_body import UpperBodyPrior
from torchpose.priors.window import WindowLayout, WindowPrior, window_measurements
from torchpose.skeleton.joint_sets import UPPER_BODY
from torchpose.skeleton.upper_body import ARM_JOINTS
from torchpose.upper_body.arms import ARMS, require_cov
from torchpose.upper_body.measurements import (
    MeasuredJoints,
    append_blocks,
    arm_measurements,
    pixel_indices,
    pixels_per_metre,
)

__all__ = [
    "WINDOW_OPTIONS",
    "SeenInView",
    "pose_of_window",
    "see_in_view",
    "suitable_window",
    "window_filter",
    "window_inputs",
]

WINDOW_OPTIONS = ("likelihood_power", "dtype")
"""Options of `MixtureKalmanFilter` that count where every frame is conditioned on by itself."""

_BIMODAL = 2  # hand and elbow, which may be before or behind the body
_HEAD, _NECK = UPPER_BODY.index("head"), UPPER_BODY.index("neck")
_HANDS = [UPPER_BODY.index("hand_left"), UPPER_BODY.index("hand_right")]


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


def suitable_window(
    prior: UpperBodyPrior, smoothing: int | str | None, fps: float
) -> tuple[str, WindowLayout] | None:
    """The prior's window that suits the smoothing: its name, and its lags at this frame rate.

    None where the prior has none, or where it looks farther ahead than estimates may.

    Args:
        prior: with its windows. smoothing: None, the number of later frames that an estimate may
            use, or "full". fps: frame rate.
    """
    name = "causal" if smoothing is None else "full"
    if name not in prior.windows:
        return None
    layout = prior.windows[name].layout.at_rate(fps)
    too_far = isinstance(smoothing, int) and smoothing < layout.ahead
    return None if too_far else (name, layout)


def see_in_view(
    measured: MeasuredJoints,
    prior: UpperBodyPrior,
    window: str,
    layout: WindowLayout,
    measurement_cov: Float[Tensor, "8 2 2"],
    lengths: Int[Tensor, " B"] | None = None,
    start: int = 0,
) -> SeenInView:
    """The measurements of windows in a virtual camera that follows the body, from a frame on.

    Args:
        measured: the eight joints in the prior's pixels. prior: what is expected. window: which of
            its windows. layout: of that window, at the frame rate of the measurements.
        measurement_cov: R of the eight joints where it is not told frame by frame.
        lengths: frames of each sequence, [B]. start: first frame that is wanted; may be negative.
    """
    uv, mask, matrix = measured.uv, measured.mask, prior.info.matrix.to(measured.uv)
    if lengths is not None:
        frames = torch.arange(mask.shape[1], device=mask.device)
        mask = mask & (frames < lengths.to(mask.device)[:, None])[..., None]
    start = start % mask.shape[1]
    model = _path_model(prior, measurement_cov, uv)
    noise = None
    if measured.cov.ndim > 3:
        noise = _of_anchors(measured.cov)
    else:
        model = model._replace(variance=_of_anchors(measured.cov))
    path = body_path(uv, mask, layout.lags, layout.ahead, layout.fps, model, start, noise)
    neck, height = path.at(0)
    apart = (uv[:, start:, _HANDS] - neck[:, :, None]).norm(dim=-1)
    reach = torch.where(mask[:, start:, _HANDS], apart, torch.zeros_like(apart)).amax(-1)
    view = view_body(neck, height, model, matrix, reach)
    hands = {}
    for side in ARMS:
        values, known = window_measurements(uv, mask, layout, side, path, start)
        hands[side] = to_view(values, view, matrix).flatten(-2), known.repeat_interleave(2, -1)
    now = to_view(uv[:, start:], view, matrix)
    now = torch.where(mask[:, start:, :, None], now, torch.zeros_like(now))
    cov = measured.cov if measured.cov.ndim == 3 else measured.cov[:, start:]
    log_scale = -view_jacobian(now, view, matrix).det().abs().log()
    return SeenInView(window, MeasuredJoints(now, mask[:, start:], cov), hands, view, log_scale)


def _path_model(prior: UpperBodyPrior, measurement_cov: Tensor, like: Tensor) -> PathModel:
    """Head and neck of the prior's mean pose, and their measurement noise."""
    both = (prior.left.moments()[0] + prior.right.moments()[0]) / 2
    head, neck = both[9:11].to(like), both[12:14].to(like)
    return PathModel(neck, head - neck, _of_anchors(measurement_cov), pixels_per_metre(prior))


def _of_anchors(cov: Float[Tensor, "*batch 8 2 2"]) -> Float[Tensor, "*batch 2"]:
    """Variance of a coordinate of head and neck, pixels squared."""
    return cov[..., [_HEAD, _NECK], :, :].diagonal(dim1=-2, dim2=-1).mean(-1)


def window_filter(
    window: WindowPrior,
    side: str,
    joints: tuple[str, ...],
    measurement_cov: Float[Tensor, "8 2 2"],
    options: dict[str, Any],
) -> MixtureKalmanFilter:
    """Fixed tracks over window states that measure these joints and all hands of the window.

    Args:
        window: whose mixture is taken. side: "left" or "right". joints: of `ARM_JOINTS`.
        measurement_cov: R of the eight joints, the prior's pixels. options: among `WINDOW_OPTIONS`.
    """
    arm, layout = ARMS[side], window.layout
    blocks = [measurement_cov[arm[ARM_JOINTS.index(joint)]] for joint in joints]
    blocks += [_hand_cov(window, side, measurement_cov)] * layout.n_hands
    settings = {"likelihood_power": window.settings["likelihood_power"]}
    # Poses of consecutive frames are tied by the window itself: no memory beyond it.
    return MixtureKalmanFilter(
        getattr(window, side),
        torch.ones(layout.dim, dtype=torch.float64),
        torch.block_diag(*blocks),
        pixel_indices(joints) + list(layout.hands),
        transition="ou",
        gamma=0.0,
        weighting="frame",
        medians=layout.in_torso[: 3 * _BIMODAL : 3] if joints else (),
        **(settings | options),
    )


def _hand_cov(window: WindowPrior, side: str, measurement_cov: Tensor) -> Tensor:
    """Noise of a hand of the window: that of a hand now, and what moving it here adds."""
    own = measurement_cov[ARMS[side][0]]
    return own + window.settings["hand_std"] ** 2 * torch.eye(2, dtype=own.dtype, device=own.device)


def window_inputs(
    seen: SeenInView,
    window: WindowPrior,
    side: str,
    joints: tuple[str, ...],
    measurement_cov: Float[Tensor, "8 2 2"],
) -> tuple[
    tuple[Float[Tensor, "B T Z"], Bool[Tensor, "B T Z"]],
    Tensor,
    tuple[Float[Tensor, "B T H"], Bool[Tensor, "B T H"]],
]:
    """Values and mask of joints and hands, their R, and values and mask of the hands alone.

    Args:
        seen: from `see_in_view`. window, side, joints, measurement_cov: as in `window_filter`.
    """
    z, mask, cov = arm_measurements(ARMS[side], joints, seen.measured)
    hands, known = seen.hands[side]
    noise = append_blocks(cov, _hand_cov(window, side, measurement_cov), hands.shape[-1] // 2)
    return (torch.cat([z, hands], -1), torch.cat([mask, known], -1)), noise, (hands, known)


def pose_of_window(
    out: FilterOutput,
    context: FilterOutput,
    seen: SeenInView,
    arm: tuple[int, ...],
    layout: WindowLayout,
) -> FilterOutput:
    """The arm's part of a window's estimate, and its evidence beyond that of the window's hands.

    The arm's joints in the axes of the torso follow, where the window has them.

    The evidence is a density over pixels of the prior's camera, not of the virtual one.
    """
    measured = seen.measured.mask[:, :, list(arm)]
    evidence = out.log_evidence - context.log_evidence
    evidence = evidence + (seen.log_scale[:, :, list(arm)] * measured).sum(-1)
    evidence = torch.where(measured.any(-1), evidence, torch.zeros_like(evidence))
    kept = torch.tensor([*range(STATE_DIM), *layout.in_torso], device=out.mean.device)
    cov = require_cov(out)[..., kept[:, None], kept]
    return out._replace(mean=out.mean[..., kept], cov=cov, log_evidence=evidence)
