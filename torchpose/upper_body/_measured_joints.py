"""Turn the keypoints of a caller into the measured joints that estimators take."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.checks import (
    CONFIDENCE_ADVICE,
    MOST_CONFIDENCE,
    STAYS_POSITIVE,
    check_covariance,
    check_finite,
    check_floating,
    check_pixels,
    check_shape,
    check_tensors,
    refuse_half,
)
from torchpose._core.module_state import derived, index_tensor
from torchpose._core.value_checks import seen_finite
from torchpose.camera._pinhole import PinholeCamera
from torchpose.camera._projection import PixelMap, map_pixel_covariance
from torchpose.camera._tilt import Turn
from torchpose.errors import InputError, SkeletonError
from torchpose.filters._lengths import inside_lengths
from torchpose.filters._measurements import check_lengths
from torchpose.io._keypoints import is_filled
from torchpose.math._gaussian import block_diagonal
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.skeleton._torso import KINECT_NECK, NeckFraction
from torchpose.skeleton._upper_body import ARM_JOINTS
from torchpose.upper_body._absence import Absence
from torchpose.upper_body._face_points import FacePoints, measure_face
from torchpose.upper_body._lifted_arms import BodyPoints, measure_body
from torchpose.upper_body._picked import Picked
from torchpose.upper_body._picked import pick_joints as pick_joints  # for `torchpose.measurements`

CAMERA_ANGLES = (15, 16)
"""Dimensions of an arm's state that are roll and pitch of the camera, in both orders of rotations."""

_DEFAULT_STD = 3.0  # pixels
_UPRIGHT_STD = math.radians(3.0)  # of cameras that a prior takes to be level
_LEAST_CONFIDENCE = 0.05
# Metres of the neck above the middle of the shoulders where there is no head, and their spread.
_NECK_HEIGHT, _NECK_SPREAD = 0.105, 0.035
_HEAD, _NECK = UPPER_BODY.index("head"), UPPER_BODY.index("neck")
_LEFT, _RIGHT = UPPER_BODY.index("shoulder_left"), UPPER_BODY.index("shoulder_right")


class MiddlePoint(NamedTuple):
    """Measured middle of the shoulders, which some detectors call the neck.

    Attributes:
        uv: [B, T, 2], zero where missing. mask: [B, T]. cov: R, [2, 2] or [B, T, 2, 2].
    """

    uv: Tensor
    mask: Tensor
    cov: Tensor


class MeasuredJoints(NamedTuple):
    """Measurements of the eight joints of `UPPER_BODY`.

    Attributes:
        uv: [B, T, 8, 2], zero where missing. mask: [B, T, 8], True where measured.
        cov: R of each joint, [8, 2, 2], or [B, T, 8, 2, 2] if it changes.
        face: pixels of nose, eyes and ears, None if none is among the keypoints.
        middle: the point by which the neck was put (`place_measured_neck`); None where the neck itself was
            measured.
        confidence: the confidence of the detector, [B, T, 8], 1 where missing; None where it gives none.
        absence: the evidence that missing hands are outside of the image; None without any.
        body: all keypoints of the whole body, None where shoulders or elbows are not among them.
        bridged: the variance, metres squared, by which joints may be off whose keypoints were put into gaps
            (`bridged_over_gaps`), [B, T, 8], 0 of those that are measured; None without any.
    """

    uv: Tensor
    mask: Tensor
    cov: Tensor
    face: FacePoints | None = None
    middle: MiddlePoint | None = None
    confidence: Tensor | None = None
    absence: Absence | None = None
    body: BodyPoints | None = None
    bridged: Tensor | None = None

    @property
    def seen(self) -> Bool[Tensor, "B T 8"]:
        """Return which joints are measured, those not that were put into gaps."""
        return self.mask if self.bridged is None else self.mask & (self.bridged == 0)

    @property
    def cov_of_frames(self) -> Float[Tensor, "B T 8 2 2"]:
        """Return R of each joint in each frame."""
        return self.cov.expand(*self.mask.shape, 2, 2)


def pixels_per_metre(prior: UpperBodyPrior) -> float:
    """Return the scale of the prior's camera at the neck of its mean pose; computed once for each prior."""
    info = prior.info

    def make() -> float:
        depth = (prior.left.moments()[0][14] + prior.right.moments()[0][14]).detach() / 2
        return math.sqrt(info.fx * info.fy) / float(depth)

    sources = (*prior.left.parameters_tuple(), *prior.right.parameters_tuple())
    return derived(prior, ("pixels per metre", info.fx, info.fy), sources, make)


def place_measured_neck(
    measured: MeasuredJoints, pixels_per_metre: float, neck: NeckFraction = KINECT_NECK
) -> MeasuredJoints:
    """Put the neck between the middle of the shoulders and the head.

    n = m + f (h - m),   R_n = (1 - f)^2 R_m + f^2 R_h + s^2 I

    The middle of two measured shoulders has R_m = (R_l + R_r) / 4. Where the head is missing, the neck is
    put upright above the middle, as high as Kinect's usually is; where the middle is missing, so is the
    neck. Its errors go with those of the head, which the filter does not know.

    Args:
        measured: the joints, whose neck is a keypoint in the middle of the shoulders; where that is
            missing, the middle of two measured shoulders does.
        pixels_per_metre: the scale at the body's usual distance. neck: f and s.
    """
    uv, mask, cov = (x.clone() for x in measured[:3])
    point = MiddlePoint(
        *(x.clone() for x in (uv[..., _NECK, :], mask[..., _NECK], cov[..., _NECK, :, :]))
    )
    both = mask[..., _LEFT] & mask[..., _RIGHT] & ~mask[..., _NECK]
    middle = torch.where(
        both[..., None], (uv[..., _LEFT, :] + uv[..., _RIGHT, :]) / 2, uv[..., _NECK, :]
    )
    known, head = mask[..., _NECK] | both, mask[..., _HEAD].clone()
    above = middle - uv.new_tensor([0.0, _NECK_HEIGHT * pixels_per_metre])
    between = middle + neck.fraction * (uv[..., _HEAD, :] - middle)
    place = torch.where(head[..., None], between, above)
    uv[..., _NECK, :] = torch.where(known[..., None], place, torch.zeros_like(place))
    mask[..., _NECK] = known
    spread = (neck.spread * pixels_per_metre) ** 2 * torch.eye(
        2, dtype=cov.dtype, device=cov.device
    )
    share = neck.fraction
    headless, by_shoulders = (known & ~head).any(), both.any()
    if bool(headless | (by_shoulders & (known & ~both).any())):
        cov = cov.expand(*uv.shape[:-2], *cov.shape[-3:]).clone()
    of_shoulders = (cov[..., _LEFT, :, :] + cov[..., _RIGHT, :, :]) / 4
    stands = both[..., None, None] if cov.ndim > 3 else by_shoulders
    of_middle = torch.where(stands, of_shoulders, cov[..., _NECK, :, :])
    of_neck = (1 - share) ** 2 * of_middle + share**2 * cov[..., _HEAD, :, :] + spread
    if bool(headless):
        alone = of_middle + spread * (_NECK_SPREAD / neck.spread) ** 2
        of_neck = torch.where(head[..., None, None], of_neck, alone)
    cov[..., _NECK, :, :] = of_neck
    return measured._replace(uv=uv, mask=mask, cov=cov, middle=point)


def known_covariances(
    covariance: Float[Tensor, "B T J 2 2"],
    measured: Bool[Tensor, "B T J"],
    indices: Sequence[int],
    like: Tensor,
) -> Float[Tensor, "B T J 2 2"]:
    """Return the covariances of the joints that are measured, and the identity for all other keypoints.

    Args:
        covariance: of every keypoint. measured: which of them are there. indices: the places of the eight
            joints among them, -1 if absent. like: a tensor of the dtype and on the device to work in.
    """
    check_shape("covariance", covariance, [*measured.shape, 2, 2])
    wanted = torch.tensor([i in indices for i in range(measured.shape[2])], device=like.device)
    used = (measured & wanted)[..., None, None]
    covariance = torch.where(used, covariance.to(like), torch.eye(2).to(like))
    check_covariance("covariance", covariance)
    return covariance


def measured_keypoints(
    keypoints: Float[Tensor, "B T J 2"], confidence: Tensor | None, mask: Tensor | None
) -> Bool[Tensor, "B T J"]:
    """Return which keypoints are measured.

    Args:
        keypoints: NaN where missing, or exactly (0, 0) or (-1, -1) as many detectors write. confidence:
            [B, T, J] in 0..1, or None: at 0 or NaN a keypoint is missing. mask: [B, T, J], False = ignore,
            or None.

    Raises:
        InputError: infinite values, or the confidence of a measured keypoint is below 0 or above 2.
        ShapeError: confidence or mask do not fit the keypoints.
    """
    measured = ~is_filled(keypoints)
    if not seen_finite(keypoints):
        check_finite("keypoints", keypoints, ~keypoints.isnan(), "missing keypoints are NaN")
        measured = measured & torch.isfinite(keypoints).all(-1)
    check_tensors(mask=mask)
    if mask is not None:
        check_shape("mask", mask, list(measured.shape))
        measured = measured & mask.to(measured.device, torch.bool)
    if confidence is not None:
        check_floating("confidence", confidence)
        check_shape("confidence", confidence, list(measured.shape))
        confidence = confidence.to(measured.device)
        _check_confidence(confidence, measured)
        measured = measured & (confidence > 0)
    return measured


def measure_joints(
    keypoints: Float[Tensor, "B T J 2"],
    measured: Bool[Tensor, "B T J"],
    confidence: Tensor | None,
    indices: Sequence[int],
    cov: Float[Tensor, "8 2 2"],
    own_cov: Float[Tensor, "B T J 2 2"] | None,
) -> MeasuredJoints:
    """Return the eight joints among the keypoints, in the pixels of the keypoints.

    Args:
        keypoints: [B, T, J, 2]. measured: which of them are there (`measured_keypoints`).
        confidence: [B, T, J], by which R is divided, or None.
        indices: the places of the eight joints among the keypoints, -1 if absent. cov: R at full
            confidence. own_cov: R of every single keypoint instead.
    """
    picked = index_tensor(tuple(max(i, 0) for i in indices), measured.device)
    present = index_tensor(tuple(i >= 0 for i in indices), measured.device).bool()
    measured = measured.index_select(2, picked) & present
    uv = torch.where(measured[..., None], keypoints.index_select(2, picked), 0.0)
    if own_cov is not None:
        cov = torch.where(measured[..., None, None], own_cov.to(cov)[:, :, picked], cov)
    if confidence is not None:
        weight = confidence.to(uv)[:, :, picked].nan_to_num(1.0).clamp(_LEAST_CONFIDENCE, 1.0)
        weight = weight.masked_fill(~measured, 1.0)
        if bool((weight < 1).any()):
            cov = cov / weight[..., None, None]
            return MeasuredJoints(uv, measured, cov, confidence=weight)
    return MeasuredJoints(uv, measured, cov)


def kept_pixel_maps(camera: PinholeCamera, prior: UpperBodyPrior) -> tuple[PixelMap, PixelMap]:
    """Return the maps from a camera's pixels to the prior's and back, the same ones as long as they hold."""
    info = prior.info

    def make() -> tuple[PixelMap, PixelMap]:
        own, wanted = camera.matrix, info.matrix.to(camera.matrix)
        return PixelMap.between(own, wanted), PixelMap.between(wanted, own)

    name = ("pixel maps", info.fx, info.fy, info.cx, info.cy)
    return derived(camera, name, (camera.matrix,), make)


def kept_turn(camera: PinholeCamera, prior: UpperBodyPrior) -> Turn | None:
    """Return the turn of the prior's pixels that makes a camera level; None where it is, or may be.

    Args:
        camera: the camera of the keypoints. prior: the prior, in whose pixels the turn is.
    """
    up, info = camera.up, prior.info
    if up is None:
        return None

    def make() -> Turn | None:
        turn = Turn.to_level(up, info.matrix.to(camera.matrix))
        level = torch.equal(turn.rotation, torch.eye(3).to(turn.rotation))
        return None if level else turn

    return derived(camera, ("level", info.fx, info.fy, info.cx, info.cy), (up, camera.matrix), make)


def in_level_pixels(
    measured: MeasuredJoints, turn: Turn | None, matrix: Float[Tensor, "3 3"]
) -> MeasuredJoints:
    """Return measurements as the level camera has them, with R of each joint in each frame.

    What is seen more than 84 degrees beside the level camera's axis is not measured.

    Args:
        measured: the measurements in the prior's pixels. turn: `kept_turn`; None changes nothing.
        matrix: K of these pixels.
    """
    if turn is None:
        return measured
    uv, mask = measured.uv, measured.mask & turn.visible(measured.uv, matrix)
    cov = measured.cov_of_frames
    cov = torch.where(mask[..., None, None], turn.covariances(cov, uv), cov)
    turned = torch.where(mask[..., None], turn.points(uv), torch.zeros_like(uv))
    face = measured.face
    if face is not None:
        sure = face.confidence * turn.visible(face.places, matrix)
        places = torch.where(sure[..., None] > 0, turn.points(face.places), 0.0)
        face = face._replace(places=places, confidence=sure)
    body = measured.body
    if body is not None:
        body = body.moved(turn.points(body.places), turn.visible(body.places, matrix))
    return measured._replace(uv=turned, mask=mask, cov=cov, face=face, body=body)


def in_prior_pixels(
    keypoints: Float[Tensor, "B T J 2"],
    confidence: Float[Tensor, "B T J"] | None,
    mask: Bool[Tensor, "B T J"] | None,
    covariance: Float[Tensor, "B T J 2 2"] | None,
    picked: Picked,
    prior: UpperBodyPrior,
    camera: PinholeCamera,
    measurement_cov: Float[Tensor, "8 2 2"],
) -> MeasuredJoints:
    """Return the eight joints among the keypoints, in the pixels of the prior's camera, which is level.

    Args:
        keypoints, confidence, mask, covariance: as in `UpperBodyTracker.forward`.
        picked: the places of the joints among them. prior, camera: the prior, in whose pixels the result
            is, and the camera of the keypoints.
        measurement_cov: R without `covariance`, in the prior's pixels.

    Raises:
        ShapeError, InputError: as `measured_keypoints`, or most keypoints are shares of the image.
        CovarianceError: a covariance that is none.
    """
    to_prior, _ = kept_pixel_maps(camera, prior)
    there = measured_keypoints(keypoints, confidence, mask)
    confidence = None if confidence is None else confidence.clamp(max=1.0)
    check_pixels("keypoints", keypoints, there)
    if covariance is not None:
        known = known_covariances(covariance, there, picked.indices, keypoints)
        covariance = to_prior.covariances(known)
    measured = measure_joints(
        keypoints, there, confidence, picked.indices, measurement_cov, covariance
    )
    measured = measured._replace(uv=to_prior.points(measured.uv))
    if max(picked.face) >= 0:
        face = measure_face(keypoints, confidence, mask, picked.face)
        face = face._replace(places=to_prior.points(face.places))
        measured = measured._replace(face=face)
    body = measure_body(keypoints, confidence, mask, picked.names)
    if body is not None:
        body = body._replace(places=to_prior.points(body.places))
        measured = measured._replace(body=body)
    measured = in_level_pixels(
        measured, kept_turn(camera, prior), prior.info.matrix_like(measured.uv)
    )
    if not picked.middle:
        return measured
    return place_measured_neck(measured, pixels_per_metre(prior))


def _check_confidence(confidence: Tensor, measured: Bool[Tensor, "B T J"]) -> None:
    """Refuse a confidence below 0 or of another scale of a keypoint that is there; NaN is missing."""
    outside = measured & ((confidence < 0) | (confidence > MOST_CONFIDENCE))
    if bool(outside.any()):
        b, t, j = outside.nonzero()[0].tolist()
        raise InputError(
            f"confidence must lie in [0, 1] (0 or NaN is missing), got {float(confidence[b, t, j]):g} "
            f"of keypoint {j} in frame {t} of sequence {b}; {CONFIDENCE_ADVICE}"
        )


def check_sequences(keypoints: Tensor) -> Float[Tensor, "B T J 2"]:
    """Return keypoints of whole sequences after checks of type and shape.

    Raises:
        InputError: integers, half precision, no sequence or no frame. ShapeError: another shape.
    """
    check_floating("keypoints", keypoints)
    refuse_half("keypoints", keypoints)
    check_shape("keypoints", keypoints, ["B", "T", "J", 2])
    if keypoints.shape[0] == 0 or keypoints.shape[1] == 0:
        raise InputError(
            f"keypoints must hold at least one sequence of one frame, got {list(keypoints.shape)}"
        )
    return keypoints


def as_lengths(lengths: Tensor | Sequence[int], batch: int, n_frames: int) -> Int[Tensor, " B"]:
    """Return the numbers of frames of sequences as a tensor, on its own device.

    Raises:
        ShapeError: not [B]. InputError: not whole numbers from 1 to T.
    """
    try:
        found = torch.as_tensor(lengths)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(
            f"lengths must hold the number of frames of each sequence, got {lengths!r}; pass a tensor or a "
            "list of whole numbers"
        ) from error
    check_tensors(lengths=found)
    return check_lengths(found, batch, n_frames, found.device)


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
    inside = torch.ones_like(measured[..., 0])
    if lengths is not None:
        inside = inside_lengths(lengths.to(measured.device), n_frames)
    seen = measured.any(-1) & inside
    empty = torch.nonzero(~seen.any(1)).flatten().tolist()
    several = batch > 1
    if empty:
        which = f" of sequence {empty[0]} ({len(empty)} such sequences)" if several else ""
        raise InputError(
            f"no joint is measured in any frame{which}; expected keypoints of some of "
            f"{', '.join(UPPER_BODY)}"
        )
    if max_gap is None:
        return
    frames = torch.arange(n_frames, device=measured.device).expand(batch, -1)
    last_seen = frames.where(seen, -1).cummax(1).values
    gap = (frames - last_seen).where(inside, 0)
    if bool((gap > max_gap * fps).any()):
        b, t = (int(i) for i in torch.nonzero(gap == gap.max())[0])
        raise InputError(
            f"nothing is measured for {int(gap[b, t])} frames, from frame {int(last_seen[b, t]) + 1}"
            f"{f' of sequence {b}' if several else ''} on, longer than max_gap = {max_gap} s; cut the "
            "recording there, or raise max_gap (--max-gap) to have the prior fill it"
        )


def joint_covariances(
    prior: UpperBodyPrior,
    std: float | Sequence[float] | Tensor | None,
    matrix: Float[Tensor, "3 3"],
) -> Float[Tensor, "8 2 2"]:
    """Return R of each of the eight joints in the prior's pixels.

    Args:
        prior: the prior, in whose pixels the result is, and whose noise is taken where none is stated.
        std: the standard deviation of a keypoint, pixels of the camera: None, one number, or one for each
            of `ARM_JOINTS`. matrix: K of that camera.

    Raises:
        ShapeError, InputError: another number of deviations, or some that are not positive.
    """
    learnt = prior.noise.get("measurement_std") if std is None else None
    if learnt is None:
        given = torch.as_tensor(_DEFAULT_STD if std is None else std, dtype=torch.float64)
    else:
        given = learnt.double()
    by_joint = given.expand(5) if given.ndim == 0 else given
    check_shape("measurement_std", by_joint, [5])
    check_finite("measurement_std", by_joint)
    if bool((by_joint <= 0).any()):
        advice = STAYS_POSITIVE if by_joint.requires_grad else "leave it out where it is not known"
        raise InputError(
            f"measurement_std must be positive, got {given.tolist()}; it is how far keypoints are off, in "
            f"pixels, mostly 1 to 10: {advice}"
        )
    cov = torch.diag_embed(by_joint.square()[:, None].expand(5, 2))
    if learnt is None:
        cov = map_pixel_covariance(cov, matrix, prior.info.matrix)
    return cov[[ARM_JOINTS.index(joint.split("_")[0]) for joint in UPPER_BODY]]


def upright_cov() -> Float[Tensor, "2 2"]:
    """Return R of roll and pitch of a camera whose orientation against gravity is known, radians squared."""
    return _UPRIGHT_STD**2 * torch.eye(2, dtype=torch.float64)


def pixel_indices(joints: Sequence[str]) -> list[int]:
    """Return the state dimensions of u and v of some joints of an arm.

    Args:
        joints: names among `torchpose.skeleton.ARM_JOINTS`.

    Returns:
        Two indices for each joint.

    Raises:
        SkeletonError: a name that is not among them.
    """
    unknown = [joint for joint in joints if joint not in ARM_JOINTS]
    if unknown:
        raise SkeletonError(f"joints must be among {', '.join(ARM_JOINTS)}, got {unknown[0]!r}")
    return [3 * ARM_JOINTS.index(joint) + axis for joint in joints for axis in (0, 1)]


def arm_measurements(
    arm: tuple[int, ...], joints: tuple[str, ...], measured: MeasuredJoints
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the measurements of an arm's joints, as filters take them.

    Args:
        arm: indices of its five joints, `torchpose.skeleton.LEFT_ARM` or its counterpart.
        joints: names among `torchpose.skeleton.ARM_JOINTS`, J of them; Z = 2 J.
        measured: joints of both arms, pixels.

    Returns:
        z [B, T, Z] in pixels, mask [B, T, Z], and R [Z, Z], or [B, T, Z, Z] if it changes.
    """
    rows = [arm[ARM_JOINTS.index(joint)] for joint in joints]
    z = measured.uv[:, :, rows].flatten(-2)
    mask = measured.mask[:, :, rows].repeat_interleave(2, -1)
    return z, mask, block_diagonal(measured.cov[..., rows, :, :])
