"""Recorded poses as a keypoint detector would see them: noisy head, neck and hands."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.camera._projection import project
from torchpose.camera._viewpoints import ViewRange, sample_viewpoints
from torchpose.math._rotations import euler_to_matrix
from torchpose.priors._prior_file import PriorInfo
from torchpose.skeleton._joint_sets import UPPER_BODY

__all__ = ["seen_keypoints"]

_UNSEEN = [i for i, name in enumerate(UPPER_BODY) if name.startswith(("elbow", "shoulder"))]


def seen_keypoints(
    poses: Float[Tensor, "B T 8 3"],
    info: PriorInfo,
    generator: torch.Generator,
    *,
    view_share: float,
    noise_std: float,
) -> Float[Tensor, "B T 8 2"]:
    """Keypoints of sequences, each from a random viewpoint of its own (BL section 3.1).

    Args:
        poses: body axes, metres. info: of the prior whose camera and viewpoints are taken.
        generator: of viewpoints and noise. view_share: of the width of the training views.
        noise_std: of a keypoint, pixels.

    Returns:
        The prior's pixels; elbows and shoulders are NaN, as is whatever is NaN in the poses.
    """
    views = sample_viewpoints(len(poses), ViewRange(**info.views).scaled(view_share), generator)
    rotation = euler_to_matrix(views.angles, info.rotation_order)  # type: ignore[arg-type]
    pixels = project(poses, info.matrix, rotation[:, None], views.translation[:, None])[..., :2]
    noise = torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    keypoints = pixels + noise_std * noise
    keypoints[:, :, _UNSEEN] = torch.nan
    return keypoints
