"""Weigh hypotheses about depth and turn of a torso by its joints, the face and both arms."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.math._rotations import within_half_turn
from torchpose.skeleton._torso import upright_axes
from torchpose.upper_body._arm_chain import ArmChain, ArmInput, Arms, mirrored
from torchpose.upper_body._articulated_frame import UprightFrame
from torchpose.upper_body._articulated_poses import bones_of
from torchpose.upper_body._articulated_torso import shoulder_places
from torchpose.upper_body._body_lengths import BodyLengths, Sizes
from torchpose.upper_body._face_points import face_evidence
from torchpose.upper_body._lifted_arms import LiftedBones
from torchpose.upper_body._root_grid import RootGrid
from torchpose.upper_body._torso_likelihood import Root, middle_of_shoulders

_ROOTS = 10  # hypotheses of the root that arms are weighed for
_COARSE_ANGLES, _COARSE_AROUND = 11, 24  # of limbs, while roots are weighed
_SLACK = 0.018  # metres: joints of recordings are not the ends of stiff bones
_MISFIT = 3.0  # nats for each measured joint and each arm below which a frame fits nobody
_MODE = math.radians(45.0)  # turns farther than that from the likeliest are another mode


class Roots(NamedTuple):
    """Hypotheses about depth, turn and size of the torso in a frame.

    Attributes:
        root: the M likeliest hypotheses. near: the share of each in the estimate, [B, M].
        mean: the mean of all with these shares, as the only hypothesis.
        middle: the middle of the shoulders given each, [B, M, 3]. shoulders: their places, [B, 2, M, 3].
        directions: the mean directions of both arms given each, [B, 2, M, 6].
    """

    root: Root
    near: Tensor
    mean: Root
    middle: Tensor
    shoulders: Tensor
    directions: Tensor


class _Weighed(NamedTuple):
    """Arms given each of M hypotheses of the root.

    Attributes:
        middle, shoulders: the middle of the shoulders, [B, M, 3], and their places, [B, 2, M, 3].
        arms: the hypotheses about both arms.
        evidence: the log-evidence of both together, [B, M]. of_each: that of each by itself, [B, 2, M].
        variance: the variance across the rays of elbow and hand, metres squared, [B, 2, M, 2].
    """

    middle: Tensor
    shoulders: Tensor
    arms: Arms
    evidence: Tensor
    of_each: Tensor
    variance: Tensor


class RootStep(NamedTuple):
    """Measurement update of the torso, with the arms given it.

    Attributes:
        grid: the point-mass filter over size, depth and turn. chain: the point-mass filter over the arms.
        lengths: the filter of the lengths of bones.
    """

    grid: RootGrid
    chain: ArmChain
    lengths: BodyLengths

    def weigh(
        self,
        belief: Float[Tensor, "B S Z P"],
        frame: UprightFrame,
        last: Float[Tensor, "B 3"] | None,
        sizes: Sizes,
        power: Float[Tensor, " B"],
        fresh: Bool[Tensor, " B"] | None,
        farther: Float[Tensor, " B"] | None,
    ) -> tuple[Float[Tensor, "B S Z P"], Roots, Bool[Tensor, " B"] | None]:
        """Return the posterior over the grid, the likeliest hypotheses, and whether arms that are fresh fit.

        Args:
            belief: the belief at the last update. frame: the measurements, in tilted axes.
            last: the middle of the shoulders in the frame before, in the same axes; None where some joint of
                the torso is measured of everybody.
            sizes: the lengths of the bones. power: the exponent of the likelihood.
            fresh: whose body starts with this frame, so that the depths at which its arms cannot be are
                ruled out before the likeliest hypotheses are picked; None is nobody.
            farther: the log of the factor on the depth since then; None is 0 for everybody.
        """
        likelihood = self.grid.likelihood(frame.torso, sizes.torso, power)
        believed = self.grid.predict(belief, farther) * likelihood
        if frame.face is not None:
            std = frame.given.std.amin(1)
            metres = self.lengths.unit * self.grid.depth  # heads of children are nearly full-grown
            of_face = face_evidence(frame.face, std, metres, self.grid.turn)
            # where no torso is seen, a face that is not seen is not a back
            told = frame.given.torso.any(1) | (frame.face.confidence > 0).any(1)
            believed = believed * (told[:, None, None] * of_face)[:, None].exp()
        if frame.bones is not None:
            of_bones = power[:, None] * _turn_of_lifted(frame.bones, self.grid.turn)
            believed = believed * of_bones[:, None, None].exp()
        if fresh is not None:
            far = self.grid.at_all_depths(believed)
            said, limbs = self._weighed(frame, far, last, sizes), frame.given.limbs
            against = self.grid.ruled_out(said.of_each, limbs.any(2))
            against = torch.where(fresh[:, None, None], against, 0.0)
            believed = believed * against.exp()[:, None]
        root = self.grid.best(believed, _ROOTS)
        middle, shoulders, arms, evidence, _, variance = self._weighed(frame, root, last, sizes)
        fits = None if fresh is None else _fits(frame, root, evidence, variance)
        evidence = power[:, None] * evidence
        if fresh is not None:  # in place of what was said against them
            evidence = evidence - against.flatten(1).gather(1, root.cell)
        belief = self.grid.belief(believed, root, evidence, frame.given.extrapolates)
        root = root._replace(log_weight=root.log_weight + evidence)
        near = _shares_of_mode(root)
        mean = _mean_of(root, near)
        return belief, Roots(root, near, mean, middle, shoulders, arms.mean_directions), fits

    def _weighed(
        self, frame: UprightFrame, root: Root, last: Float[Tensor, "B 3"] | None, sizes: Sizes
    ) -> _Weighed:
        """Return the arms given each hypothesis of the root, and their log-evidence."""
        middle = self.middle(frame, root, last, sizes)
        shoulders = shoulder_places(frame, root, middle, sizes.torso.width)
        arm = _arm_input(frame, root, shoulders, sizes.metres, sizes.slack)
        arms = self._coarse(arm)
        area = 2 * frame.given.limbs.sum(2)[..., None] * root.depth.log()[:, None]
        both = self.chain.evidence_of_both(arms) + area.sum(1)
        return _Weighed(middle, shoulders, arms, both, arms.log_evidence + area, arm.variance)

    def middle(
        self, frame: UprightFrame, root: Root, last: Float[Tensor, "B 3"] | None, sizes: Sizes
    ) -> Float[Tensor, "B M 3"]:
        """Return the middle of the shoulders; on its last ray where no joint of the torso is measured."""
        torso = frame.torso
        found = middle_of_shoulders(torso, root, sizes.torso)
        if last is None:
            return found
        before = (last / last[:, 2:])[:, None] * root.depth[..., None]
        return torch.where(torso.known.any(1)[:, None, None], found, before)

    def arms(
        self, frame: UprightFrame, root: Root, shoulders: Float[Tensor, "B 2 M 3"], sizes: Sizes
    ) -> Arms:
        """Return the hypotheses about both arms for each hypothesis of the root."""
        arm = _arm_input(frame, root, shoulders, sizes.metres, sizes.slack)
        return self.chain.hypotheses(arm)._replace(hand_rays=arm.rays[..., 1, :])

    def evidence_of_lengths(
        self,
        frame: UprightFrame,
        root: Root,
        shoulders: Float[Tensor, "B 2 1 3"],
        lengths: Float[Tensor, "B N 4"],
    ) -> Float[Tensor, "B N"]:
        """Return the log-evidence of both arms under bones of each of these lengths, metres."""
        count = lengths.shape[1]
        stiff = torch.zeros_like(lengths[:, 0, :2])
        arm = _arm_input(frame, root, shoulders, lengths[:, 0], stiff)
        arm = arm._replace(
            shoulder=arm.shoulder.expand(-1, -1, count, -1),
            middle=arm.middle.expand(-1, -1, count, -1),
            lengths=lengths[:, None, :, :2].expand(-1, 2, -1, -1),
        )
        return self._coarse(arm).log_evidence.sum(1)

    def _coarse(self, arm: ArmInput) -> Arms:
        """Return fewer hypotheses about both arms, enough to compare roots and lengths by."""
        return self.chain.hypotheses(arm, angles=_COARSE_ANGLES, around=_COARSE_AROUND)


def covs_of_roots(roots: Roots, lengths: Float[Tensor, "B 4"]) -> Float[Tensor, "B 4 3 3"]:
    """Return the covariances of elbow and hand of the left arm, then the right, over the hypotheses.

    They are the second moments about the mean of the hypotheses near the likeliest turn.
    """
    root, near = roots.root, roots.near
    shoulder = roots.shoulders - roots.middle[:, None]
    bones = bones_of(roots.directions, root.axes[:, None], lengths)
    ends = shoulder[..., None, :] + bones.cumsum(-2)
    used = (near[:, None, :, None, None] * ends).sum(2, keepdim=True)
    off = (ends - used).transpose(2, 3).flatten(1, 2)
    weight = torch.softmax(root.log_weight, 1)[:, None, :, None]
    return (weight * off).mT @ off


def _arm_input(
    frame: UprightFrame,
    root: Root,
    shoulders: Float[Tensor, "B 2 M 3"],
    lengths: Float[Tensor, "B 4"],
    slack: Float[Tensor, "B 2"],
) -> ArmInput:
    """Return the measurements of both arms given each hypothesis of the root."""
    given, depth = frame.given, shoulders[..., 2:].clamp_min(0.1)
    noise = given.own + given.stiff / root.depth.mean(1).square()[:, None, None]
    loose = (slack.square() + _SLACK**2)[:, None, None]
    axes = root.axes
    limbs = frame.limbs[:, :, None].expand(-1, -1, shoulders.shape[2], -1, -1)
    middle = shoulders.mean(1, keepdim=True).expand_as(shoulders)
    # the shoulder and the middle of both, then the rays of elbow and hand
    places = (
        torch.cat([shoulders[..., None, :], middle[..., None, :], limbs], -2) @ axes.mT[:, None]
    )
    joints, rays = mirrored(places).split([2, 2], -2)
    shoulder, middle = joints.unbind(-2)
    bones = lengths[:, None, None, :2].expand(*shoulders.shape[:3], 2)
    borders = None
    if frame.borders is not None:
        turned = (frame.borders[:, None] @ axes.mT)[:, None].expand(-1, 2, -1, -1, -1)
        borders = mirrored(turned)
    return ArmInput(
        shoulder, middle, rays, given.limbs, frame.facts.patterns,
        noise[:, :, None] * depth.square() + loose, axes, bones, borders, given.log_inside,
        None if frame.bones is None else _lifted_arms(frame.bones, axes),
    )  # fmt: skip


def _turn_of_lifted(bones: LiftedBones, turn: Float[Tensor, " P"]) -> Float[Tensor, "B P"]:
    """Return the log-likelihood of each turn of the shoulders given the lifted line between them."""
    left = upright_axes(turn)[:, 0]
    return bones.precision[:, :1] * (bones.directions[:, 0] @ left.mT - 1)


def _lifted_arms(bones: LiftedBones, axes: Float[Tensor, "B M 3 3"]) -> LiftedBones:
    """Return the lifted bones of both arms, the right one mirrored, in upright axes: [B, 2, M, 2, 3]."""
    turned = (bones.directions[:, None, 1:] @ axes.mT).unflatten(2, (2, 2)).transpose(1, 2)
    return LiftedBones(mirrored(turned), bones.precision[:, 1:].unflatten(1, (2, 2)))


def _fits(
    frame: UprightFrame,
    root: Root,
    evidence: Float[Tensor, "B M"],
    variance: Float[Tensor, "B 2 M 2"],
) -> Bool[Tensor, " B"]:
    """Return whether the arms fit any body.

    Their log-evidence is taken relative to that of joints that are exactly where they are expected, with
    the same noise:

        log p(z) - sum_i log N(0; 0, R_i) > -3 (n_joints + n_arms)

    Args:
        frame: the measurements. root: the hypotheses. evidence: the log-evidence of the arms given each.
        variance: the variance across the rays of elbow and hand, metres squared.
    """
    limbs = frame.given.limbs
    peak = 2 * root.depth.log()[:, None, :, None] - (2 * math.pi * variance).log()
    peak = torch.where(limbs[:, :, None], peak, 0.0).sum((1, 3))
    share = torch.log_softmax(root.log_weight, 1)
    relative = torch.logsumexp(share + evidence - peak, 1)
    return relative > -_MISFIT * (limbs.sum((1, 2)) + limbs.any(2).sum(1))


def _mean_of(root: Root, near: Float[Tensor, "B M"]) -> Root:
    """Return the mean of hypotheses with these shares."""
    best = root.turn.gather(1, near.argmax(1, keepdim=True))
    off = within_half_turn(root.turn - best)
    depth = (near * root.depth.log()).sum(1, keepdim=True).exp()
    size = (near * root.size.log()).sum(1, keepdim=True).exp()
    turn = best + (near * off).sum(1, keepdim=True)
    none, cell = torch.zeros_like(depth), torch.zeros_like(root.cell[:, :1])
    return Root(depth, turn, size, none, cell, upright_axes(turn))


def _shares_of_mode(root: Root) -> Float[Tensor, "B M"]:
    """Return the shares of the hypotheses in the estimate: those whose turn is near the likeliest one's."""
    weight = torch.softmax(root.log_weight, 1)
    best = root.turn.gather(1, weight.argmax(1, keepdim=True))
    off = within_half_turn(root.turn - best)
    near = weight * (-0.5 * (off / _MODE).square()).exp()
    return near / near.sum(1, keepdim=True)
