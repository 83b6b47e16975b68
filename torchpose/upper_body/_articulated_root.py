"""Weigh hypotheses about depth and turn of a torso by its joints, the face and both arms."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.math._rotations import within_half_turn
from torchpose.skeleton._torso import upright_axes
from torchpose.upper_body._arm_chain import ArmChain, ArmInput, Arms
from torchpose.upper_body._articulated_frame import ArticulatedState, UprightFrame
from torchpose.upper_body._articulated_poses import ELBOWS, HANDS, SHOULDERS, SIDES, bones_of
from torchpose.upper_body._articulated_torso import shoulder_places
from torchpose.upper_body._body_lengths import BodyLengths
from torchpose.upper_body._face_points import face_evidence
from torchpose.upper_body._root_grid import RootGrid
from torchpose.upper_body._torso_likelihood import (
    STIFF_SHOULDER,
    Root,
    Torso,
    middle_of_shoulders,
)

__all__ = ["RootStep", "Roots", "covs_of_roots"]

_ROOTS = 10  # hypotheses of the root that arms are weighed for
_COARSE_ANGLES, _COARSE_AROUND = 11, 24  # of limbs, while roots are weighed
_MODE = math.radians(45.0)  # turns farther than that from the likeliest are another mode


class Roots(NamedTuple):
    """Hypotheses about depth, turn and size of the torso in a frame.

    Attributes:
        belief: the posterior over the grid, [B, S, Z, P]. root: the M likeliest hypotheses.
        near: the share of each in the estimate, [B, M]. arms: the hypotheses about the arms given each.
        middle: the middle of the shoulders given each, [B, M, 3].
    """

    belief: Tensor
    root: Root
    near: Tensor
    arms: Arms
    middle: Tensor

    @property
    def mean(self) -> Root:
        """Return the mean of the hypotheses with their shares in the estimate, as the only one."""
        root, near = self.root, self.near
        best = root.turn.gather(1, near.argmax(1, keepdim=True))
        off = within_half_turn(root.turn - best)
        depth = (near * root.depth.log()).sum(1, keepdim=True).exp()
        size = (near * root.size.log()).sum(1, keepdim=True).exp()
        turn = best + (near * off).sum(1, keepdim=True)
        return Root(depth, turn, size, torch.zeros_like(depth), torch.zeros_like(root.cell[:, :1]))


class RootStep(NamedTuple):
    """Measurement update of the torso, with the arms given it.

    Attributes:
        grid: the point-mass filter over size, depth and turn. chain: the point-mass filter over the arms.
        lengths: the filter of the lengths of bones.
        stride: the number of frames that count as one, since they are alike.
    """

    grid: RootGrid
    chain: ArmChain
    lengths: BodyLengths
    stride: int

    def weigh(
        self, state: ArticulatedState, frame: UprightFrame, lengths: Tensor, slack: Tensor
    ) -> Roots:
        """Return the posterior over the grid and the likeliest hypotheses.

        Args:
            state: the state before the frame. frame: the measurements, in tilted axes.
            lengths: the lengths of the bones, metres, [B, 4]. slack: standard deviations of the ends of
                both bones of an arm for want of their lengths, metres, [B, 2].
        """
        power = 1.0 if state.arms is None else 1 / self.stride
        size = self.lengths.torso(state.lengths)
        believed = self.grid.predict(state.root).log()
        believed = believed + power * self.grid.evidence(frame.torso, size)
        if frame.face is not None:
            std = frame.std.amin(1)
            of_face = face_evidence(frame.face, std, self.grid.depth, self.grid.turn)
            believed = believed + of_face[:, None]
        root = self.grid.best(believed, _ROOTS)
        middle = self.middle(state, frame.torso, root)
        arms = self.coarse_arms(frame, root, middle, lengths, slack)
        seen = frame.known[:, [ELBOWS, HANDS]].sum((1, 2)).to(root.depth)
        evidence = power * (
            self.chain.evidence_of_both(arms) + 2 * seen[:, None] * root.depth.log()
        )
        belief = self.grid.belief(believed, root, evidence, _extrapolates(frame))
        root = root._replace(log_weight=root.log_weight + evidence)
        return Roots(belief, root, _shares_of_mode(root), arms, middle)

    def middle(self, state: ArticulatedState, torso: Torso, root: Root) -> Float[Tensor, "B M 3"]:
        """Return the middle of the shoulders; on its last ray where no joint of the torso is measured."""
        size = self.lengths.torso(state.lengths)
        found = middle_of_shoulders(torso, root, size)
        before = (state.middle / state.middle[:, 2:])[:, None] * root.depth[..., None]
        return torch.where(torso.known.any(1)[:, None, None], found, before)

    def arms(
        self,
        frame: UprightFrame,
        root: Root,
        middle: Float[Tensor, "B M 3"],
        lengths: Float[Tensor, "B 4"],
        slack: Float[Tensor, "B 2"],
    ) -> Arms:
        """Return the hypotheses about both arms for each hypothesis of the root."""
        return self.chain.hypotheses(_arm_input(frame, root, middle, lengths, slack))

    def coarse_arms(
        self,
        frame: UprightFrame,
        root: Root,
        middle: Float[Tensor, "B M 3"],
        lengths: Float[Tensor, "B 4"],
        slack: Float[Tensor, "B 2"],
    ) -> Arms:
        """Return fewer hypotheses about both arms, enough to compare roots and lengths by."""
        arm = _arm_input(frame, root, middle, lengths, slack)
        return self.chain.hypotheses(arm, angles=_COARSE_ANGLES, around=_COARSE_AROUND)

    def evidence_of_lengths(
        self,
        frame: UprightFrame,
        root: Root,
        middle: Float[Tensor, "B 1 3"],
        lengths: Float[Tensor, "B 4"],
    ) -> Float[Tensor, " B"]:
        """Return the log-evidence of both arms under bones of these lengths, metres."""
        stiff = torch.zeros_like(lengths[:, :2])
        arms = self.coarse_arms(frame, root, middle, lengths, stiff)
        return arms.log_evidence.sum((1, 2))


def covs_of_roots(
    frame: UprightFrame, roots: Roots, lengths: Float[Tensor, "B 4"]
) -> Float[Tensor, "B 4 3 3"]:
    """Return the covariances of both elbows, then both hands, over the hypotheses of the root.

    They are the second moments about the mean of the hypotheses near the likeliest turn.
    """
    _, root, near, arms, middle = roots
    shoulder = shoulder_places(frame, root, middle, lengths[:, 2]) - middle[:, None]
    bones = bones_of(arms.mean_directions, upright_axes(root.turn)[:, None], lengths)
    ends = shoulder[..., None, :] + bones.cumsum(-2)
    used = (near[:, None, :, None, None] * ends).sum(2, keepdim=True)
    off = (ends - used).permute(0, 3, 1, 2, 4).flatten(1, 2)
    weight = torch.softmax(root.log_weight, 1)[:, None, :, None]
    return (weight * off).mT @ off


def _arm_input(
    frame: UprightFrame,
    root: Root,
    middle: Float[Tensor, "B M 3"],
    lengths: Float[Tensor, "B 4"],
    slack: Float[Tensor, "B 2"],
) -> ArmInput:
    """Return the measurements of both arms given each hypothesis of the root."""
    flip = root.depth.new_tensor(SIDES)
    shoulder = shoulder_places(frame, root, middle, lengths[:, 2]) * flip[:, None]
    rays = torch.stack([frame.rays[:, ELBOWS], frame.rays[:, HANDS]], 2) * flip[:, None]
    std = _noise_along(frame, root)
    known = torch.stack([frame.known[:, ELBOWS], frame.known[:, HANDS]], -1)
    axes = upright_axes(root.turn)
    axes = torch.stack([axes, flip[1, :, None] * axes * flip[1]], 1)
    bones = lengths[:, None, None, :2].expand(*shoulder.shape[:3], 2)
    return ArmInput(shoulder, rays, known, std, axes, bones, slack)


def _noise_along(frame: UprightFrame, root: Root) -> Float[Tensor, "B 2 2"]:
    """Return the standard deviation of elbow and hand over the focal length, with their near ends'.

    A shoulder that is not measured is as uncertain as its place in a stiff torso, and an elbow that is
    not measured as uncertain as its shoulder.
    """
    joints = [SHOULDERS, ELBOWS, HANDS]
    seen, known = frame.std[:, joints].square(), frame.known[:, joints]
    stiff = (STIFF_SHOULDER / root.depth.mean(1)).square()[:, None]
    shoulder = torch.where(known[:, 0], seen[:, 0], stiff)
    elbow = torch.where(known[:, 1], seen[:, 1], shoulder)
    return torch.stack([shoulder + seen[:, 1], elbow + seen[:, 2]], -1).sqrt()


def _shares_of_mode(root: Root) -> Float[Tensor, "B M"]:
    """Return the shares of the hypotheses in the estimate: those whose turn is near the likeliest one's."""
    weight = torch.softmax(root.log_weight, 1)
    best = root.turn.gather(1, weight.argmax(1, keepdim=True))
    off = within_half_turn(root.turn - best)
    near = weight * (-0.5 * (off / _MODE).square()).exp()
    return near / near.sum(1, keepdim=True)


def _extrapolates(frame: UprightFrame) -> Bool[Tensor, " B"]:
    """Return whether the evidence of the hypotheses is extrapolated to the depths beyond them.

    It is where hands are the only limbs, since elbows are sharper than a trend. A torso of one joint has
    no size in the image, and arms alone are a poor witness of how far it is.
    """
    return (frame.torso.known.sum(1) > 1) & ~frame.known[:, ELBOWS].any(1)
