"""Hold frames as rays, in axes that are rolled with the torso."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize, pad

from torchpose._core.module_state import index_tensor
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._face_points import FacePoints
from torchpose.upper_body._lifted_arms import N_BONES, LiftedBones
from torchpose.upper_body._measured_joints import MeasuredJoints
from torchpose.upper_body._torso_likelihood import NOT_RAISED, REACH, STIFF_SHOULDER, Torso

_NECK = UPPER_BODY.index("neck")
LIMBS = tuple(UPPER_BODY.index(f"{j}_{s}") for s in ("left", "right") for j in ("elbow", "hand"))
"""Rows of elbow and hand of the left arm, then of the right one, among the eight joints."""


def _pair(joint: str) -> slice:
    """Return the rows of a left joint and a right one; views take a fifth of the time of copies."""
    left, right = (UPPER_BODY.index(f"{joint}_{side}") for side in ("left", "right"))
    return slice(left, right + 1, right - left)


SHOULDERS, ELBOWS, HANDS = (_pair(joint) for joint in ("shoulder", "elbow", "hand"))
_BOTH = [UPPER_BODY.index(f"shoulder_{side}") for side in ("left", "right")]
# Of the rays of a frame: all joints, then those of the torso, then elbow and hand of each arm, of length one.
_ROWS = (*range(len(UPPER_BODY)), *_BOTH, _NECK, UPPER_BODY.index("head"), *LIMBS)
_TORSO, _LIMBS, _LIFTS = slice(8, 12), slice(12, 16), slice(16, 18)
_ENDS = ((False, False), (False, True), (True, False), (True, True))  # measured: elbow, hand


class Optics(NamedTuple):
    """Camera that frames are seen by: K, its inverse, and the logarithm of the focal length in pixels."""

    matrix: Tensor
    inverse: Tensor
    log_focal: Tensor

    @classmethod
    def of(cls, matrix: Float[Tensor, "3 3"]) -> Self:
        """Return the optics of a camera matrix; the focal length is the mean of both axes' logarithms."""
        return cls(matrix, torch.linalg.inv(matrix), matrix.diagonal()[:2].log().mean())


class RayFrame(NamedTuple):
    """Measurements of one frame as rays, or of T frames [B, T, ...] until they are split.

    Attributes:
        rays: K^-1 [u, v, 1] of the joints in `_ROWS`, of length one for the last four; then, for both arms,
            the way from the end that is measured to the shoulder over its reach, [.., 0]; then the
            directions of lifted bones, if there are any; then nose, eyes and ears, [.., 0], if there are
            any. [B, 18 to 28, 3].
        known: whether each of the eight joints is measured, [B, 8].
        std: the standard deviation of a pixel over the focal length, [B, 8].
        exact: whether every keypoint has full confidence, [B].
        torso, torso_std: known and std of the torso's joints, [B, 4]. lifted: whether the elevation of
            each arm is seen, [B, 2].
        limbs: whether elbow and hand of both arms are measured, [B, 2, 2]. own, stiff: the variance along
            the rays of elbow and hand, which is own + stiff / depth^2 (`_noise_along`), [B, 2, 2] each.
        extrapolates: whether the evidence of hypotheses about the root is extrapolated to the depths
            beyond them, [B]. It is where hands are the only limbs, since elbows are sharper than a trend. A
            torso of one joint has no size in the image, and arms alone are a poor witness of how far it is.
        face: the confidence of nose, eyes and ears, [B, 5]; None if there are none.
        seen: as limbs, but those that were put into gaps not, [B, 2, 2].
        log_inside: see `Absence`, 0 where a hand is measured, [B, 2]; None without any evidence.
        told: k of lifted bones (`LiftedBones`), [B, 5]; None without any.
        moved: the variance of how far elbow and hand of both arms have moved since they were seen
            (`hold_hidden`), metres squared, [B, 2, 2]; None without any.
    """

    rays: Tensor
    known: Tensor
    std: Tensor
    exact: Tensor
    torso: Tensor
    torso_std: Tensor
    lifted: Tensor
    limbs: Tensor
    own: Tensor
    stiff: Tensor
    extrapolates: Tensor
    face: Tensor | None
    seen: Tensor
    log_inside: Tensor | None = None
    told: Tensor | None = None
    moved: Tensor | None = None


class Facts(NamedTuple):
    """What holds for some frames, known without a look at their values.

    Attributes:
        patterns: the pairs of whether elbow and hand are measured that there are among all arms.
        sided: whether any shoulder is measured. leaning: whether both of anybody are. whole: whether
            elbow and hand of any arm are. placed: whether of everybody some joint of the torso is.
        expected: which of nose, eyes and ears are among the keypoints at all, [5]; None without any.
        borders: the planes of the image's borders, K^T (a, b) of `Absence`, [P, 3]; None without any.
    """

    patterns: list[tuple[bool, bool]]
    sided: bool
    leaning: bool
    whole: bool
    placed: bool
    expected: Tensor | None
    borders: Tensor | None = None

    def alike(self, other: Facts) -> bool:
        """Return whether the same holds for other frames of the same sequences."""
        return self[:5] == other[:5]


class UprightFrame(NamedTuple):
    """One frame in axes in which the torso is upright, of a camera that is rolled by its lean.

    Attributes:
        rays: of the eight joints, [B, 8, 3]. limbs: of elbow and hand of both arms, of length one,
            [B, 2, 2, 3].
        torso: the rays of the torso. face: nose, eyes and ears, or None.
        given: the measurements. facts: what holds for them.
        borders: the planes of the image's borders, then the optical axis, [B, P + 1, 3]; None without any.
        bones: the lifted bones; None without any.
    """

    rays: Tensor
    limbs: Tensor
    torso: Torso
    face: FacePoints | None
    given: RayFrame
    facts: Facts
    borders: Tensor | None = None
    bones: LiftedBones | None = None


def upright(frame: RayFrame, facts: Facts, tilt: Float[Tensor, "B 3 3"]) -> UprightFrame:
    """Return a frame in tilted axes, of a camera that is rolled by the lean of the torso (`roll`)."""
    rows = frame.rays @ tilt  # from the right: turned back
    first, bones = _LIFTS.stop, None
    if frame.told is not None:
        bones, first = LiftedBones(rows[:, first : first + N_BONES], frame.told), first + N_BONES
    rise = torch.where(frame.lifted, rows[:, _LIFTS, 1], NOT_RAISED)
    torso = Torso(rows[:, _TORSO], frame.torso, frame.torso_std, rise, facts.sided)
    face = None
    if frame.face is not None and facts.expected is not None:
        face = FacePoints(rows[:, first:, :2], frame.face, facts.expected)
    limbs = rows[:, _LIMBS].unflatten(1, (2, 2))
    borders = None if facts.borders is None else facts.borders @ tilt
    return UprightFrame(rows[:, :8], limbs, torso, face, frame, facts, borders, bones)


def as_rays(
    measured: MeasuredJoints,
    optics: Optics,
    bones: LiftedBones | None = None,
    moved: Float[Tensor, "B T 2 2"] | None = None,
) -> RayFrame:
    """Return the measurements of T frames as rays, [B, T, ...].

    Args:
        measured: the measurements, [B, T, ...]. optics: those of the prior's camera.
        bones: what a network tells of them, or None. moved: as in `RayFrame`.
    """
    known, rows = measured.mask, index_tensor(_ROWS, measured.mask.device)
    rays = pad(measured.uv, (0, 1), value=1.0) @ optics.inverse.mT
    variance = measured.cov.diagonal(dim1=-2, dim2=-1).mean(-1)
    std = (variance.sqrt() / optics.log_focal.exp()).expand(known.shape)
    sure = measured.confidence
    exact = known.any(-1) if sure is None else (sure >= 1).all(-1)
    lifts, lifted = _lifts(rays, known)
    of_joints, of_limbs = rays.index_select(-2, rows).tensor_split([_LIMBS.start], -2)
    parts = [of_joints, normalize(of_limbs, dim=-1), lifts]
    if bones is not None:
        parts.append(bones.directions)
    face, matrix = measured.face, optics.matrix
    if face is not None:
        places = (face.places - matrix[:2, 2]) / matrix.diagonal()[:2]
        parts.append(pad(places, (0, 1)))
    there = known.index_select(-1, rows)
    torso, limbs = there[..., _TORSO], there[..., _LIMBS].unflatten(-1, (2, 2))
    seen = measured.seen.index_select(-1, rows[_LIMBS]).unflatten(-1, (2, 2))
    return RayFrame(
        torch.cat(parts, -2), known, std, exact, torso, std.index_select(-1, rows[_TORSO]), lifted,
        limbs, *_noise_along(std, known), (torso.sum(-1) > 1) & ~limbs[..., 0].any(-1),
        None if face is None else face.confidence, seen, _log_inside(measured),
        None if bones is None else bones.precision, moved,
    )  # fmt: skip


def facts_of(rays: RayFrame, measured: MeasuredJoints, matrix: Float[Tensor, "3 3"]) -> list[Facts]:
    """Return what holds for each of T frames; values are looked at once for all of them.

    Args:
        rays, measured: the measurements, [B, T, ...]. matrix: K of the prior's camera.
    """
    elbow, hand = rays.limbs.unbind(-1)
    ends = torch.stack([~(elbow | hand), hand & ~elbow, elbow & ~hand, elbow & hand], -1)
    left, right = rays.torso[..., :2].unbind(-1)
    sides = torch.stack([left | right, left & right, ~rays.torso.any(-1)], -1)
    there = torch.cat([ends.any(2), sides], -1).any(0)
    expected = None if measured.face is None else measured.face.expected
    borders = _borders(measured, matrix)
    facts = []
    for *here, some, both, lost in there.tolist():
        patterns = [pattern for pattern, found in zip(_ENDS, here, strict=True) if found]
        facts.append(Facts(patterns, some, both, here[-1], not lost, expected, borders))
    return facts


def _log_inside(measured: MeasuredJoints) -> Float[Tensor, "B T 2"] | None:
    """Return the evidence of hands that are not measured, 0 for the others."""
    if measured.absence is None:
        return None
    return measured.absence.log_inside.masked_fill(measured.mask[..., HANDS], 0.0)


def _borders(measured: MeasuredJoints, matrix: Float[Tensor, "3 3"]) -> Tensor | None:
    """Return the planes through the camera and the borders of the image, and the optical axis."""
    log_inside = _log_inside(measured)
    if measured.absence is None or log_inside is None or not bool((log_inside < 0).any()):
        return None
    axis = matrix.new_tensor([[0.0, 0.0, 1.0]])
    return torch.cat([measured.absence.planes @ matrix, axis])


def split(frames: RayFrame) -> list[RayFrame]:
    """Return each of T frames by itself."""
    n_frames = frames.known.shape[1]
    parts = ([None] * n_frames if part is None else part.unbind(1) for part in frames)
    return [RayFrame(*row) for row in zip(*parts, strict=True)]


def together(frames: Sequence[Any]) -> Any:
    """Return values of T frames [B, ...] as those of B T frames; of facts what holds for any of them."""
    first = frames[0]
    if len(frames) == 1:
        return first
    if isinstance(first, Tensor):
        return torch.stack([*frames], 1).flatten(0, 1)
    if isinstance(first, Facts):
        return first._replace(
            patterns=[ends for ends in _ENDS if any(ends in facts.patterns for facts in frames)],
            sided=any(facts.sided for facts in frames),
            whole=any(facts.whole for facts in frames),
        )
    if not isinstance(first, tuple):
        return first
    parts = [together(values) for values in zip(*frames, strict=True)]
    return type(first)(*parts) if hasattr(first, "_fields") else tuple(parts)


def apart(values: Any, n_frames: int) -> list[Any]:
    """Return values of B T frames as those of each of T frames [B, ...]; the inverse of `together`."""
    if n_frames == 1:
        return [values]
    if isinstance(values, Tensor):
        return [*values.unflatten(0, (-1, n_frames)).unbind(1)]
    if values is None:
        return [None] * n_frames
    rows = zip(*(apart(value, n_frames) for value in values), strict=True)
    return [type(values)(*row) if hasattr(values, "_fields") else row for row in rows]


def _lifts(
    rays: Float[Tensor, "B T 8 3"], known: Bool[Tensor, "B T 8"]
) -> tuple[Float[Tensor, "B T 2 3"], Bool[Tensor, "B T 2"]]:
    """Return the way from elbow, or else hand, to the shoulder over its reach, and whether it is seen."""
    elbow = known[..., ELBOWS]
    to_elbow, to_hand = (
        (rays[..., SHOULDERS, :] - rays[..., rows, :]) / reach
        for rows, reach in zip((ELBOWS, HANDS), REACH, strict=True)
    )
    lifts = torch.where(elbow[..., None], to_elbow, to_hand)
    return lifts, known[..., SHOULDERS] & (elbow | known[..., HANDS])


def _noise_along(
    std: Float[Tensor, "B T 8"], known: Bool[Tensor, "B T 8"]
) -> tuple[Float[Tensor, "B T 2 2"], Float[Tensor, "B T 2 2"]]:
    """Return the variance of elbow and hand over the focal length squared, with their near ends'.

    A shoulder that is not measured is as uncertain as its place in a stiff torso at its depth, and an
    elbow that is not measured as uncertain as its shoulder. What depends on the depth is the second.
    """
    shoulder, elbow, hand = (std[..., rows].square() for rows in (SHOULDERS, ELBOWS, HANDS))
    known_shoulder, known_elbow = known[..., SHOULDERS], known[..., ELBOWS]
    near = torch.where(known_shoulder, shoulder, 0.0)
    stiff = STIFF_SHOULDER**2 * (~known_shoulder).to(std)
    own = torch.stack([near + elbow, torch.where(known_elbow, elbow, near) + hand], -1)
    return own, torch.stack([stiff, stiff.masked_fill(known_elbow, 0.0)], -1)


def with_middle(measured: MeasuredJoints) -> MeasuredJoints:
    """Return the joints with the middle of the shoulders, as it was measured, in place of the neck."""
    middle = measured.middle
    if middle is None:
        return measured
    uv, mask, cov = (x.clone() for x in measured[:3])
    uv[..., _NECK, :], mask[..., _NECK] = middle.uv, middle.mask & mask[..., _NECK]
    cov[..., _NECK, :, :] = middle.cov
    return measured._replace(uv=uv, mask=mask, cov=cov)
