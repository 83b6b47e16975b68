"""See measurements in a virtual camera that follows the body (`torchpose.camera._virtual_camera`)."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose._core.module_state import derived
from torchpose.camera._virtual_camera import (
    ANCHORS,
    BodyView,
    PathModel,
    Regression,
    body_path,
    path_regression,
    to_view,
    view_body,
)
from torchpose.filters._lengths import inside_lengths
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.priors._window import WindowLayout, window_measurements
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._estimator import ARMS
from torchpose.upper_body._measured_joints import MeasuredJoints, pixels_per_metre

_HANDS = slice(0, len(UPPER_BODY), len(UPPER_BODY) - 1)  # the first and the last joint


class SeenInView(NamedTuple):
    """Measurements for a filter over windows, in the pixels of a virtual camera.

    Attributes:
        measured: the eight joints of each frame.
        hands: pixels [B, T, 2, H, 2] and mask [B, T, 2, H] of the hands of each frame's window, of both arms.
        view: the virtual camera of each frame.
        log_scale: the log of the area that a pixel of the camera has in the virtual one, [B, T, 8].
    """

    measured: MeasuredJoints
    hands: tuple[Tensor, Tensor]
    view: BodyView
    log_scale: Tensor


def suitable_window(
    prior: UpperBodyPrior, smoothing: int | str | None, fps: float
) -> tuple[str, WindowLayout] | None:
    """Return the name of the window that suits the smoothing, and its lags at this frame rate.

    It is None where the prior has none, or where it looks farther ahead than estimates may.

    Args:
        prior: the prior with its windows. smoothing: None, the number of later frames that an estimate
            may use, or "full". fps: frames per second.
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
    layout: WindowLayout,
    measurement_cov: Float[Tensor, "8 2 2"],
    lengths: Int[Tensor, " B"] | None,
    start: int,
) -> SeenInView:
    """Return the measurements of windows in a virtual camera that follows the body, from a frame on.

    Args:
        measured: the eight joints in the prior's pixels. prior: the prior, whose mean pose has the
            expected head and neck. layout: the lags of a window, at the frame rate of the measurements.
        measurement_cov: R of the eight joints, for where it does not change from frame to frame.
        lengths: the number of frames of each sequence, [B]. start: the first frame that is wanted; may be
            negative.
    """
    uv, mask, matrix = measured.uv, measured.mask, prior.info.matrix_like(measured.uv)
    if lengths is not None:
        mask = mask & inside_lengths(lengths.to(mask.device), mask.shape[1])[..., None]
    start = start % mask.shape[1]
    regression: Regression | None
    model, regression = _kept_path(prior, layout, measurement_cov, uv)
    noise = None
    if measured.cov.ndim > 3:
        noise = _of_anchors(measured.cov)
    elif measured.cov is not measurement_cov:
        model, regression = model._replace(variance=_of_anchors(measured.cov)), None
    path = body_path(
        uv, mask, layout.lags, layout.ahead, layout.fps, model, start, noise, regression
    )
    neck, height = path.at(0)
    carried, known = window_measurements(uv, mask, layout, tuple(ARMS), path, start)
    uv, mask = uv[:, start:], mask[:, start:]
    apart = torch.linalg.vector_norm(uv[:, :, _HANDS] - neck[:, :, None], dim=-1)
    reach = torch.where(mask[:, :, _HANDS], apart, 0.0).amax(-1)
    view = view_body(neck, height, model, matrix, reach)
    seen, log_scale = to_view(torch.cat([uv, carried], 2), view, matrix)
    now, hands = seen.split([uv.shape[2], carried.shape[2]], 2)
    windows = hands.unflatten(2, (len(ARMS), -1)), known.unflatten(2, (len(ARMS), -1))
    now = torch.where(mask[..., None], now, 0.0)
    cov = measured.cov if measured.cov.ndim == 3 else measured.cov[:, start:]
    return SeenInView(MeasuredJoints(now, mask, cov), windows, view, log_scale[..., : uv.shape[2]])


def _kept_path(
    prior: UpperBodyPrior, layout: WindowLayout, measurement_cov: Tensor, like: Tensor
) -> tuple[PathModel, Regression]:
    """Return the model of head and neck with its regression, the same ones as long as they hold."""
    sources = (*prior.left.parameters_tuple(), *prior.right.parameters_tuple(), measurement_cov)

    def make() -> tuple[PathModel, Regression]:
        model = _path_model(prior, measurement_cov, like)
        return model, path_regression(layout.lags, layout.ahead, layout.fps, model, like)

    name = ("body path", layout, prior.info.fx, prior.info.fy, like.dtype)
    return derived(prior, name, sources, make)


def _path_model(prior: UpperBodyPrior, measurement_cov: Tensor, like: Tensor) -> PathModel:
    """Return head and neck of the prior's mean pose, and their measurement noise."""
    both = (prior.left.moments()[0] + prior.right.moments()[0]) / 2
    head, neck = both[9:11].to(like), both[12:14].to(like)
    return PathModel(neck, head - neck, _of_anchors(measurement_cov), pixels_per_metre(prior))


def _of_anchors(cov: Float[Tensor, "*batch 8 2 2"]) -> Float[Tensor, "*batch 2"]:
    """Return the variance of a coordinate of head and neck, pixels squared."""
    return cov[..., ANCHORS, :, :].diagonal(dim1=-2, dim2=-1).mean(-1)
