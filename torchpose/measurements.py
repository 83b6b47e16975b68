"""From the keypoints that a caller has to the measurements that the arms' filters take."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.errors import InputError, check_finite, check_shape
from torchpose.skeleton import ARM_JOINTS, UPPER_BODY, upper_body_indices

__all__ = [
    "MeasuredJoints",
    "append_blocks",
    "arm_measurements",
    "check_gaps",
    "measure_joints",
    "pick_joints",
    "pixel_indices",
]

_LEAST_CONFIDENCE = 0.05


class MeasuredJoints(NamedTuple):
    """Measurements of the eight joints of `UPPER_BODY`.

    Attributes:
        uv: [B, T, 8, 2], zero where missing. mask: [B, T, 8], True where measured.
        cov: R of each joint, [8, 2, 2], or [B, T, 8, 2, 2] if it changes.
    """

    uv: Tensor
    mask: Tensor
    cov: Tensor


def pick_joints(
    n_joints: int,
    names: Sequence[str] | None,
    neck: str | None,
    wanted_neck: str | None,
    wanted_hand: str | None,
) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """For each of the eight joints its index among the keypoints, -1 if absent; and notes.

    Args:
        n_joints: number of keypoints. names: of them, None if they are the eight in order.
        neck: kind of neck of the keypoints where the names do not tell; one of another kind than
            `wanted_neck` is left out. wanted_neck, wanted_hand: the prior's kinds.

    Raises:
        InputError: names missing, or not as many as keypoints. SkeletonError: unknown names.
    """
    if names is None:
        if n_joints != len(UPPER_BODY):
            raise InputError(
                f"names may be left out only for the {len(UPPER_BODY)} joints "
                f"{', '.join(UPPER_BODY)}; got {n_joints} keypoints without names"
            )
        names = UPPER_BODY
    if len(names) != n_joints:
        raise InputError(
            f"names must name each of the {n_joints} keypoints, got {len(names)} names"
        )
    found = upper_body_indices(names)
    indices, notes = list(found.indices), []
    neck = neck or found.neck
    at = UPPER_BODY.index("neck")
    if indices[at] >= 0 and neck is not None and wanted_neck is not None and neck != wanted_neck:
        indices[at] = -1
        notes.append(
            f"the keypoints' neck ({neck}) is not the prior's ({wanted_neck}): not measured"
        )
    if found.hand is not None and wanted_hand is not None and found.hand != wanted_hand:
        notes.append(f"the keypoints' {found.hand}s stand for the prior's {wanted_hand}s")
    return tuple(indices), tuple(notes)


def measure_joints(
    keypoints: Float[Tensor, "B T J 2"],
    confidence: Tensor | None,
    mask: Tensor | None,
    indices: Sequence[int],
    cov: Float[Tensor, "8 2 2"],
) -> MeasuredJoints:
    """The eight joints among the keypoints, in the pixels of the keypoints.

    Args:
        keypoints: NaN where missing. confidence: [B, T, J] in 0..1, or None: at 0 or NaN a keypoint is
            missing, and between, R is divided by it. mask: [B, T, J], False = ignore, or None.
        indices: of the eight joints among the keypoints, -1 if absent. cov: R at full confidence.

    Raises:
        InputError: infinite values. ShapeError: confidence or mask do not fit the keypoints.
    """
    check_finite("keypoints", keypoints, ~keypoints.isnan(), "missing keypoints are NaN")
    measured = torch.isfinite(keypoints).all(-1)
    if mask is not None:
        check_shape("mask", mask, list(measured.shape))
        measured = measured & mask.to(measured.device, torch.bool)
    if confidence is not None:
        check_shape("confidence", confidence, list(measured.shape))
        measured = measured & (confidence.to(measured.device) > 0)
    picked = [max(i, 0) for i in indices]
    present = torch.tensor([i >= 0 for i in indices], device=measured.device)
    measured = measured[:, :, picked] & present
    uv = torch.where(measured[..., None], keypoints[:, :, picked], keypoints.new_zeros(()))
    if confidence is not None:
        weight = confidence.to(uv)[:, :, picked].nan_to_num(1.0).clamp(_LEAST_CONFIDENCE, 1.0)
        weight = torch.where(measured, weight, torch.ones_like(weight))
        if bool((weight < 1).any()):
            cov = cov / weight[..., None, None]
    return MeasuredJoints(uv, measured, cov)


def check_gaps(
    measured: Bool[Tensor, "B T 8"],
    lengths: Int[Tensor, " B"] | None,
    max_gap: float | None,
    fps: float,
) -> None:
    """Refuse sequences in which nothing at all is measured, wholly or for too long.

    Args:
        measured: True where a joint is measured. lengths: frames of each sequence, or None.
        max_gap: seconds over which nothing may be measured, None for no bound. fps: frame rate.

    Raises:
        InputError: the sequence and the frames are named.
    """
    batch, n_frames, _ = measured.shape
    frames = torch.arange(n_frames, device=measured.device).expand(batch, -1)
    inside = torch.ones_like(frames, dtype=torch.bool)
    if lengths is not None:
        check_shape("lengths", lengths, [batch])
        inside = frames < lengths.to(measured.device)[:, None]
    seen = measured.any(-1) & inside
    empty = torch.nonzero(~seen.any(1)).flatten().tolist()
    if empty:
        raise InputError(
            f"no joint is measured in any frame of sequence {empty[0]} "
            f"({len(empty)} such sequences); expected keypoints of some of {', '.join(UPPER_BODY)}"
        )
    if max_gap is None:
        return
    last_seen = torch.where(seen, frames, torch.full_like(frames, -1)).cummax(1).values
    gap = torch.where(inside, frames - last_seen, torch.zeros_like(frames))
    if bool((gap > max_gap * fps).any()):
        b, t = (int(i) for i in torch.nonzero(gap == gap.max())[0])
        raise InputError(
            f"nothing is measured for {int(gap[b, t])} frames, from frame "
            f"{int(last_seen[b, t]) + 1} of sequence {b} on, longer than max_gap = {max_gap} s; "
            "cut the recording there, or raise max_gap to have the prior fill it"
        )


def pixel_indices(joints: Sequence[str]) -> list[int]:
    """State dimensions of u and v of these joints of an arm."""
    return [3 * ARM_JOINTS.index(joint) + axis for joint in joints for axis in (0, 1)]


def arm_measurements(
    arm: tuple[int, ...], joints: tuple[str, ...], measured: MeasuredJoints
) -> tuple[Tensor, Tensor, Tensor | None]:
    """z, mask and R of an arm's joints; R is None where it is the filter's own."""
    rows = [arm[ARM_JOINTS.index(joint)] for joint in joints]
    z = measured.uv[:, :, rows].flatten(-2)
    mask = measured.mask[:, :, rows].repeat_interleave(2, -1)
    if measured.cov.ndim == 3:
        return z, mask, None
    return z, mask, _block_diagonal(measured.cov[:, :, rows])


def _block_diagonal(blocks: Float[Tensor, "B T N 2 2"]) -> Float[Tensor, "B T Z Z"]:
    n = blocks.shape[2]
    eye = torch.eye(n, dtype=blocks.dtype, device=blocks.device)
    return torch.einsum("btnij,nm->btnimj", blocks, eye).flatten(-2).flatten(-3, -2)


def append_blocks(cov: Float[Tensor, "B T Z Z"], block: Tensor, count: int) -> Tensor:
    """R with `count` more diagonal blocks."""
    blocks = torch.block_diag(*[block] * count).expand(*cov.shape[:2], -1, -1)
    n, extra = cov.shape[-1], blocks.shape[-1]
    whole = cov.new_zeros(*cov.shape[:2], n + extra, n + extra)
    whole[..., :n, :n], whole[..., n:, n:] = cov, blocks
    return whole
