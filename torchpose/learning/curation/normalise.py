"""Turning bodies towards the camera, rigidly."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from torchpose.errors import InputError, check_shape
from torchpose.io.recordings import Recording
from torchpose.skeleton.joint_sets import canonical_names

__all__ = ["face_camera", "torso_rotation"]

_NECK, _LEFT, _RIGHT = 4, 2, 5  # in UPPER_BODY


def torso_rotation(
    across: Float[Tensor, "... 3"], up: Float[Tensor, "... 3"] | None = None
) -> Float[Tensor, "... 3 3"]:
    """The rotation after which a torso faces the camera: R with rows x, y, z.

        x = a / |a|,  y = -(u - (u . x) x) / |...|,  z = x × y

    so that a, from the right to the left shoulder, is along x and u points up (-y). Without u the
    body is turned about the vertical alone.

    Args:
        across: a, camera axes, of any length. up: u, from the hips to the neck.

    >>> torso_rotation(torch.tensor([0.0, 0.0, 2.0])).mv(torch.tensor([0.0, 0.0, 2.0])).round()
    tensor([2., 0., 0.])
    """
    check_shape("across", across, ["...", 3])
    vertical = across.new_tensor([0.0, -1.0, 0.0]).expand_as(across)
    if up is None:
        up = vertical
        across = across * across.new_tensor([1.0, 0.0, 1.0])
    x = normalize(across, dim=-1)
    y = -normalize(up - (up * x).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], -2)


def face_camera(recording: Recording, of: Literal["recording", "pose"] = "recording") -> Recording:
    """Turn a recording about its neck so that the torso faces the camera upright.

    With hips among the joints the line from them to the neck becomes vertical, too; without, the
    body is only turned about the vertical. The neck stays where it is.

    This changes what a prior learns. Its poses are relative to a body (BL section 3.1): after ``pose``
    they say nothing of how people turn and lean, which is then left to the random viewpoints; after
    ``recording`` what is kept is how they do so about their own mean.

    Args:
        recording: camera axes.
        of: one rotation for the recording, from its mean torso, or one for each pose. Poses without
            both shoulders take the mean's.

    Raises:
        InputError: no frame with neck and both shoulders, or another `of`.
    """
    if of not in ("recording", "pose"):
        raise InputError(f"of must be recording or pose, got {of!r}")
    joints = recording.upper_body().joints
    neck = joints[:, _NECK]
    across, up = joints[:, _LEFT] - joints[:, _RIGHT], _up(recording, neck)
    whole = torch.isfinite(across).all(-1) & torch.isfinite(neck).all(-1)
    if up is not None:
        whole &= torch.isfinite(up).all(-1)
    if not bool(whole.any()):
        raise InputError(
            f"{recording.path}, person {recording.person_id}: no frame has neck, both shoulders and, "
            "where the joint set has them, hips; it cannot be turned towards the camera"
        )
    mean = torso_rotation(across[whole].mean(0), None if up is None else up[whole].mean(0))
    turn = mean.expand(len(recording), 3, 3)
    if of == "pose":
        turn = torch.where(whole[:, None, None], torso_rotation(across, up), turn)
    centre = torch.where(torch.isfinite(neck), neck, neck[whole].mean(0))[:, None]
    turned = (recording.joints - centre) @ turn.mT + centre
    note = f"turned towards the camera, each {of}"
    return replace(recording, joints=turned, notes=(*recording.notes, note))


def _up(recording: Recording, neck: Tensor) -> Tensor | None:
    hips = _columns(recording.names, ("hip_left", "hip_right")) or _columns(
        recording.names, ("hip_center",)
    )
    return neck - recording.joints[:, hips].mean(1) if hips else None


def _columns(names: Sequence[str], wanted: Sequence[str]) -> list[int]:
    """Columns of joints, empty unless all are there."""
    canonical = canonical_names(names)
    found = [canonical.index(name) for name in wanted if name in canonical]
    return found if len(found) == len(wanted) else []
