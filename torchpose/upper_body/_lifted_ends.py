"""Average poses with the elbows and hands that a network lifts, each counting by how sure it is.

A filter knows one person's lengths and where the joints were; a network of single frames (`ArmLifter`) knows
how arms of many persons look from there. They err differently.
"""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.module_state import derived, index_tensor, outside_inference
from torchpose._core.rows import discounted_sums, in_frames, joined, last_known
from torchpose.camera._projection import pixel_rays
from torchpose.errors import InputError
from torchpose.priors._arm_lifter import (
    JOINTS,
    ArmLifter,
    LiftedArms,
    arm_features,
    farthest_so_far,
    from_neck,
    shipped_arm_lifter,
)
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._articulated_frame import ELBOWS, HANDS, LIMBS, SHOULDERS
from torchpose.upper_body._estimator import SeenPoses, TrackerModel
from torchpose.upper_body._fusion import NEAREST

_ARM = ("shoulder", "elbow", "hand")
_ARMS = tuple(UPPER_BODY.index(f"{joint}_{side}") for side in ("left", "right") for joint in _ARM)
_ROWS = tuple(UPPER_BODY.index(name) for name in JOINTS)
_NECK, _HEAD = UPPER_BODY.index("neck"), JOINTS.index("head")
_SHOULDERS = slice(0, len(JOINTS) - 1, len(_ARM))  # of `JOINTS`
_MEMORY = 2.0  # seconds over which a body keeps its factor
_MOST = 1.25  # of that factor, or 1 over it
_AT_ONCE = 4096  # frames whose hidden layers are kept together
_STEADY = 0.05  # square metres of arms in the image that speak for a factor of 1 at the beginning


class LiftedState(NamedTuple):
    """What is kept of the frames before.

    Attributes:
        farthest: how far from the neck each of `JOINTS` was seen, [B, 7].
        sums: of the products of arms, by which a body is moved, [B, 2].
        aside: by how much shoulder, elbow and hand of each arm were moved beside that, when its hand was last
            measured, metres, [B, 2, 3, 3]; 0 before.
    """

    farthest: Tensor
    sums: Tensor
    aside: Tensor


class Ends(NamedTuple):
    """Elbows and hands of both arms from their shoulders, as a network lifts them, in T frames.

    Attributes:
        ends: camera axes, metres, [B, T, 2, 2, 3]. variance: along every axis, metres squared, [B, T, 2, 2].
        told: whether the hand of each arm is measured, and head or both shoulders, which tell the size of a
            body, [B, T, 2].
        farthest: how far from the neck joints were seen so far, [B, T, 7].
    """

    ends: Tensor
    variance: Tensor
    told: Tensor
    farthest: Tensor


class EndsAverage:
    """Averages poses with the elbows and hands that a network lifts.

    Vectors a from a shoulder to its elbow or hand, of variance u along an axis, and those b of the network,
    of variance v, are averaged as of sources whose errors may be alike in an unknown way (covariance
    intersection with equal shares, Julier and Uhlmann 1997):

        c = (v a + m u b) / (m u + v),   C = 2 v / (m u + v) A

    with the covariances A and C before and after; m < 1 is for A that are too wide. The network may know a
    larger or smaller body. So the body is moved along its rays by the factor that explains c best,

        k = sum a c / sum a a

    over x and y of both arms and the last 2 s, from 0.8 to 1.25. Measured joints stay on their rays, and
    shoulders of arms of which the hand alone is measured go where c then has them. An arm of which the hand
    is not measured, or nothing that tells the size of the body, is moved as when it last was.

    Args:
        network: that lifts. matrix: K of the prior's camera. fps: frames per second.
        wrists: whether hands are measured at the wrist. trust: factors on the covariances C of arms of which
            the elbow is measured, and of the others; None leaves covariances as they are. modesty: m.
        unit: how many times as large the person is known to be as those of the network.
        level: whether pixels are known to be those of a level camera. Then it is known from how far below or
            above a body is seen, by a network that looks at its neck (`_seen_from`).
    """

    def __init__(
        self,
        network: ArmLifter,
        matrix: Float[Tensor, "3 3"],
        fps: float,
        wrists: bool,
        trust: tuple[float, float] | None = None,
        modesty: float = 1.0,
        unit: float = 1.0,
        level: bool = False,
    ) -> None:
        self.network, self.matrix, self.fps, self.wrists = network, matrix, fps, wrists
        self.trust, self.modesty, self.unit, self.level = trust, modesty, unit, level
        self.forget = math.exp(-1 / (_MEMORY * fps))

    def init(self, batch_size: int) -> LiftedState:
        """Return the state before the first frame."""
        zeros = self.matrix.new_zeros
        sums = self.matrix.new_full((batch_size, 2), _STEADY * self.unit**2)
        return LiftedState(zeros(batch_size, len(JOINTS)), sums, zeros(batch_size, 2, 3, 3))

    def lift(self, state: LiftedState, poses: SeenPoses, known: Bool[Tensor, "B T 8"]) -> Ends:
        """Return what the network tells of T more frames.

        Args:
            state: before these frames. poses: of which the pixels are taken. known: which joints are
                measured.
        """
        rows, limbs = index_tensor(_ROWS, known.device), index_tensor(LIMBS, known.device)
        rays = pixel_rays(poses.uv, self.matrix)
        given = known.index_select(2, rows)
        seen, axes = from_neck(rays.index_select(2, rows), rays[:, :, _NECK])
        farthest = farthest_so_far(seen, given, state.farthest, self.fps)
        found = self._found(arm_features(seen, given, farthest, self.wrists))
        told = found.ends
        if self.level:
            told = _seen_from(told, rays[:, :, _NECK, 1])
        ends = (told.flatten(2, 3) @ axes.mT).unflatten(2, (2, 2))
        metres = poses.joints.index_select(2, limbs)[..., 2] / self.matrix[0, 0]
        pixels = _along_an_axis(poses.uv_covs.index_select(2, limbs)) * metres.square()
        variance = (self.unit * found.std).square() + pixels.unflatten(2, (2, 2))
        sized = given[..., _HEAD] | given[..., _SHOULDERS].all(-1)
        return Ends(self.unit * ends, variance, known[:, :, HANDS] & sized[..., None], farthest)

    def advance(
        self, state: LiftedState, poses: SeenPoses, lifted: Ends, known: Bool[Tensor, "B T 8"]
    ) -> tuple[LiftedState, SeenPoses]:
        """Return the next state, and the averages of T more frames.

        Args:
            state: before these frames. poses: to be averaged. lifted: what the network tells. known: which
                joints are measured.
        """
        rows = index_tensor(_ARMS, known.device)
        arms = poses.joints.index_select(2, rows).unflatten(2, (2, 3))
        ends = arms[..., 1:, :] - arms[..., :1, :]
        share = self._share(poses, lifted)
        both = ends.lerp(lifted.ends, share[..., None])
        sums = self._sums(state.sums, ends, both, lifted.told)
        factor = (sums[..., 0] / sums[..., 1]).clamp(1 / _MOST, _MOST)[..., None]
        arms = factor[..., None, None] * arms
        seen = known.index_select(2, rows).unflatten(2, (2, 3))
        aside = _placed(arms, both, seen) - arms
        aside = in_frames(last_known(lifted.told), state.aside, aside)
        joints = (factor[..., None] * poses.joints).index_add(2, rows, aside.flatten(2, 3))
        covs = poses.covs
        if self.trust is not None:
            factors = 2 * torch.where(seen[..., 1:2], *self.trust) * (1 - share)
            covs = _scaled(covs, torch.where(lifted.told[..., None], factors, 1.0))
        now, before = _pixels(torch.stack([joints, poses.joints]), self.matrix)
        uv = poses.uv + now - before  # which are not where the mean joints project to
        averaged = poses._replace(joints=joints, covs=covs, uv=uv, place=factor * poses.place)
        return LiftedState(lifted.farthest[:, -1], sums[:, -1], aside[:, -1]), averaged

    def _found(self, features: Float[Tensor, "B T F"]) -> LiftedArms:
        """Return what the network tells, of some frames at a time."""
        frames = features.flatten(0, 1).split(_AT_ONCE)
        if len(frames) == 1:
            return self.network(features)
        ends, std = joined([self.network(part) for part in frames])
        return LiftedArms(*(x.unflatten(0, features.shape[:2]) for x in (ends, std)))

    def _share(self, poses: SeenPoses, lifted: Ends) -> Float[Tensor, "B T 2 2"]:
        """Return the share of the network at each elbow and hand."""
        covs = poses.covs.index_select(2, index_tensor(LIMBS, poses.covs.device))
        ours = self.modesty * _along_an_axis(covs).unflatten(2, (2, 2))
        return ours / (ours + lifted.variance)

    def _sums(
        self,
        before: Float[Tensor, "B 2"],
        ends: Float[Tensor, "B T 2 2 3"],
        both: Float[Tensor, "B T 2 2 3"],
        told: Bool[Tensor, "B T 2"],
    ) -> Float[Tensor, "B T 2"]:
        """Return the discounted sums of a c and a a after each frame; without a hand they stay."""
        level = ends[..., :2] * told[..., None, None]
        products = torch.stack([both[..., :2], ends[..., :2]], 2) * level[:, :, None]
        keep = torch.where(told.any(-1), self.forget, 1.0)[..., None]
        return discounted_sums(before, products.flatten(3).sum(-1), keep)


def ends_average(
    model: TrackerModel,
    lifter: ArmLifter | str | Path | None,
    modesty: float,
    trust: tuple[float, float] | None = None,
    unit: float = 1.0,
) -> EndsAverage:
    """Return the average with lifted arms for a tracker.

    Args:
        model: the model of the tracker; covariances that are not to be calibrated stay.
        lifter: the network that lifts arms, or its file; None is that of the package.
        modesty, trust, unit: as in `EndsAverage`.

    Raises:
        InputError: no network, or no such file. FileFormatError: a file of another kind.
    """
    matrix = model.prior.info.matrix_like(model.measurement_cov)
    network = _network_of(model, lifter, matrix)
    wrists = (model.hand or model.prior.info.hand) == "wrist"
    trusted = trust if model.calibrated else None
    # keypoints of cameras whose tilt is known are turned as level ones have them
    level = model.pitch is not None
    return EndsAverage(network, matrix, model.rate, wrists, trusted, modesty, unit, level)


def _network_of(
    model: TrackerModel, lifter: ArmLifter | str | Path | None, like: Tensor
) -> ArmLifter:
    """Return the network that lifts arms, which the tracker keeps, as a tensor has device and precision."""
    if not isinstance(lifter, ArmLifter | str | Path | None):
        raise InputError(
            f"lifter must be a network that lifts arms or the path of its file, got {type(lifter).__name__}"
        )
    given = tuple(lifter.parameters()) if isinstance(lifter, ArmLifter) else ()
    file = "" if isinstance(lifter, ArmLifter) else str(lifter or "")

    def made() -> ArmLifter:
        if isinstance(lifter, ArmLifter):
            network = lifter
        else:
            network = ArmLifter.load(file) if file else shipped_arm_lifter()
        with outside_inference():
            return copy.deepcopy(network).to(like).eval().requires_grad_(False)

    return derived(model.owner, ("arm lifter", file), (like, *given), made)


def farther_off(
    lifted: Ends,
    ours: Float[Tensor, "B T 8 3"],
    theirs: Float[Tensor, "B T 8 3"],
    known: Bool[Tensor, "B T 8"],
) -> Float[Tensor, "B T"]:
    """Return how much less likely ours are than theirs, by what a network lifts.

        sum_arms mean_elbow,hand (|a - c|^2 - |b - c|^2) / (2 v)

    over arms of which the hand is measured and the elbow is not.

    Args:
        lifted: c and v. ours, theirs: joints, of which a and b are elbows and hands from their shoulders.
        known: which joints are measured.
    """
    limbs = index_tensor(LIMBS, known.device)
    both = torch.stack([ours, theirs])
    ends = both.index_select(3, limbs).unflatten(3, (2, 2)) - both[:, :, :, SHOULDERS, None]
    squared = (ends - lifted.ends).square().sum(-1)
    apart = ((squared[0] - squared[1]) / lifted.variance).mean(-1) / 2
    return (apart * (lifted.told & ~known[:, :, ELBOWS])).sum(-1)


def _placed(
    arms: Float[Tensor, "B T 2 3 3"],
    ends: Float[Tensor, "B T 2 2 3"],
    known: Bool[Tensor, "B T 2 3"],
) -> Float[Tensor, "B T 2 3 3"]:
    """Return shoulders, elbows and hands such that those that are measured stay on their rays.

    Shoulders stay where they or their elbows are measured.

    Args:
        arms: where they are expected. ends: elbows and hands from their shoulders. known: which joints
            are measured.
    """
    shoulders, elbows, hands = arms.unbind(-2)
    shoulder, elbow, hand = known[..., None].unbind(-2)
    wanted = shoulders + ends[..., 1, :]
    hands = torch.where(hand, _nearest_on(hands, wanted), wanted)
    shoulders = torch.where(shoulder | elbow, shoulders, shoulders + hands - wanted)
    wanted = shoulders + ends[..., 0, :]
    elbows = torch.where(elbow, _nearest_on(elbows, wanted), wanted)
    return torch.stack([shoulders, elbows, hands], -2)


def _seen_from(
    ends: Float[Tensor, "B T 2 2 3"], slope: Float[Tensor, "B T"]
) -> Float[Tensor, "B T 2 2 3"]:
    """Return lifted arms as they are of bodies of which it is known from how far above they are seen.

    Where the neck is an angle a below the horizon, arms keep their places across the image, and lean as an
    upright body does in axes that look at its neck:

        z' = z / cos a + y tan a

    Args:
        ends: elbows and hands from their shoulders, of bodies that are upright in these axes.
        slope: tan a.
    """
    slope = slope[..., None, None]
    x, y, z = ends.unbind(-1)
    return torch.stack([x, y, z * (1 + slope.square()).sqrt() + y * slope], -1)


def _nearest_on(rays: Float[Tensor, "*batch 3"], points: Float[Tensor, "*batch 3"]) -> Tensor:
    """Return the points of rays that are nearest to others."""
    along = (rays * points).sum(-1, keepdim=True) / rays.square().sum(-1, keepdim=True)
    return along * rays


def _scaled(
    covs: Float[Tensor, "B T 8 3 3"], factors: Float[Tensor, "B T 2 2"]
) -> Float[Tensor, "B T 8 3 3"]:
    """Return covariances, those of elbows and hands times factors."""
    rows = index_tensor(LIMBS, covs.device)
    ends = covs.index_select(2, rows) * factors.flatten(2)[..., None, None]
    return covs.index_copy(2, rows, ends)


def _along_an_axis(covs: Float[Tensor, "*batch N N"]) -> Float[Tensor, "*batch"]:
    """Return the mean variance along an axis."""
    return covs.diagonal(dim1=-2, dim2=-1).mean(-1)


def _pixels(
    joints: Float[Tensor, "*batch 3"], matrix: Float[Tensor, "3 3"]
) -> Float[Tensor, "*batch 2"]:
    """Return where joints project to; far in front where they are not before the camera."""
    seen = joints @ matrix.mT
    return seen[..., :2] / seen[..., 2:].clamp_min(NEAREST)
