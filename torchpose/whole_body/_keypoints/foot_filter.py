"""Filter both feet of tracked bodies from keypoints of heels and toes.

A foot is a rigid part beyond the shank. With the shank's rotation S and the ankle a as the body was tracked,
both off by errors e that are part of the state (`foot_motion`), its points are

    p_k = a + e_a + R l (o_k + s_k),     R = exp(e_S) S exp(m) exp(x),

with the length l of the shank, the points o of an average foot and their shifts s, the rotation m that the
pose of the legs lets expect, and the turn x from there. Keypoints are weighed as those of the body are
(`keypoint_likelihood`), with the factors of the cameras' noise and the probability of exchanged legs that the
body was tracked with. The body itself gets nothing from its feet.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchpose._core.module_state import derived
from torchpose.body._articulation import Articulation
from torchpose.body._feet import ANKLES, FEET
from torchpose.body._skeleton import BODY_15, other_side
from torchpose.math._gaussian import point_blocks, safe_cholesky, symmetrise
from torchpose.math._rotations import cross_matrix, exponential
from torchpose.priors._foot_prior import FootPrior
from torchpose.whole_body._keypoints.foot_motion import (
    ERRORS,
    N_FOOT,
    SHAPE,
    TURN,
    FootMotion,
    Legs,
    foot_motion,
)
from torchpose.whole_body._keypoints.information_step import information_step
from torchpose.whole_body._keypoints.keypoint_likelihood import (
    LEAST_ODDS,
    Beliefs,
    Exchange,
    KeypointFrame,
    RigMaps,
    information,
    readings_of,
    see,
    weigh,
)
from torchpose.whole_body._keypoints.keypoint_poses import KeypointPoses

_FOLLOWS = 0.5  # share of a change of what legs let expect that feet go along with at once
_KNEES = tuple(BODY_15.parents[ankle] for ankle in ANKLES)
_SHANKS = tuple(BODY_15.part_of[ankle] for ankle in ANKLES)


class FootGaussian(NamedTuple):
    """Holds Gaussians over the states of both feet: mean [B, 2, N], cov [B, 2, N, N]; centre [B, 2, 3]."""

    mean: Tensor
    cov: Tensor
    centre: Tensor


class FootPoses(NamedTuple):
    """Holds the feet of B persons, as `DETAILS_OF_FEET`; of T frames [B, T, ...], or of one [B, ...].

    Attributes:
        points: [..., 6, 3], of `FEET`, metres, world axes. covariance: [..., 6, 3, 3], metres squared.
        inlier: [..., C, 6], probability that a keypoint was a point's.
        rotation: [..., 2, 3, 3], of the feet relative to the shanks.
        rotation_cov: [..., 2, 3, 3], of rotation vectors in the axes of the feet, radians squared.
    """

    points: Tensor
    covariance: Tensor
    inlier: Tensor
    rotation: Tensor
    rotation_cov: Tensor


class _Linearised(NamedTuple):
    """Holds points [..., 2, 3, 3], metres, and their derivative [..., 2, 9, N] by the state."""

    points: Tensor
    jacobian: Tensor


class FootFilter(nn.Module):
    """Filters Gaussians over feet beyond shanks that are tracked already.

    Args:
        articulation: of the bodies. prior: over feet. fps: frames per second.
        doubt: factor on the standard deviations of shanks and ankles as the bodies were tracked.
    """

    def __init__(
        self, articulation: Articulation, prior: FootPrior, fps: float, doubt: float = 1.0
    ) -> None:
        super().__init__()
        self.articulation, self.prior, self.fps, self.doubt = articulation, prior, fps, doubt
        mirror = torch.tensor([FEET.index(other_side(name)) for name in FEET])
        self.register_buffer("_mirror", mirror, persistent=False)
        above = torch.tensor([[_carries(part, shank) for part in range(len(BODY_15.parts))]
                              for shank in _SHANKS])  # fmt: skip
        turns = above[:, articulation.axis_part].double()
        axes = (3 * articulation.axis_part + articulation.axis).expand(len(_SHANKS), -1)
        self.register_buffer("_unit", torch.eye(3, dtype=torch.float64), persistent=False)
        self.register_buffer(
            "_legs", torch.ones(1, len(FEET), dtype=torch.float64), persistent=False
        )
        self.register_buffer("_axes", axes, persistent=False)
        self.register_buffer("_turns", turns[..., None], persistent=False)

    _mirror: Tensor
    _unit: Tensor
    _legs: Tensor
    _axes: Tensor
    _turns: Tensor

    @property
    def motion(self) -> FootMotion:
        """Return the model of one frame."""
        sources = (self.prior.turn_std, self.prior.turn_rate)
        return derived(self, "motion", sources, lambda: foot_motion(self.prior, 1 / self.fps))

    # --- the legs ---------------------------------------------------------------------------------

    def legs(self, poses: KeypointPoses) -> Legs:
        """Return what tracked bodies tell of their feet; errors of shanks and ankles count as independent."""
        a = self.articulation
        rotations = a.world_rotations(poses.point)
        axes = rotations.mT.flatten(-3, -2)[..., self._axes, :] * self._turns
        columns = a.columns["rotations"]
        cov = axes.mT @ poses.state_cov[..., None, columns, columns] @ axes
        of_ankle = poses.joint_cov[..., ANKLES, :, :]
        roots = self.doubt * safe_cholesky(torch.stack([cov, of_ankle]))
        ankle = poses.joints[..., ANKLES, :]
        return Legs(
            ankle, rotations[..., _SHANKS, :, :], self.prior.centre(poses.point), roots[0], roots[1],
            (ankle - poses.joints[..., _KNEES, :]).norm(dim=-1),
            poses.covariance[..., ANKLES, :, :] - of_ankle,
        )  # fmt: skip

    # --- one frame --------------------------------------------------------------------------------

    def advance(
        self,
        before: FootGaussian | None,
        legs: Legs,
        frame: KeypointFrame,
        maps: RigMaps,
        beliefs: Beliefs,
        fresh: Bool[Tensor, " B"],
    ) -> tuple[FootGaussian, FootPoses]:
        """Track the feet of one more frame.

        Args:
            before: of the frame before, None before the first. legs: of the bodies. frame: [B, C, 6].
            maps: of the cameras. beliefs: about the cameras, log-odds [B, C, 1] of exchanged legs.
            fresh: of whom nothing is known from the frame before.
        """
        state = self.predict(before, legs, fresh)
        points, H = self.linearise(state.mean, legs)
        HP = H @ state.cov
        G = HP @ H.mT
        covs = point_blocks(G)
        inlier = torch.zeros_like(frame.inlier)
        if bool(frame.there.any()):
            exchange = Exchange(self._mirror, self._legs)
            readings, seen = readings_of(frame, exchange), see(maps, points.flatten(1, 2))
            weighed = weigh(
                readings, seen, maps, beliefs, exchange, covs.flatten(1, 2), marginal=True
            )
            W, b = (value.unflatten(1, (2, 3)) for value in information(readings, seen, weighed))
            step = information_step(H, HP, G, W, b, torch.zeros_like(state.mean))
            U = step.explained(HP)
            cov = state.cov - U.mT @ U
            state = state._replace(mean=state.mean + step.step, cov=symmetrise(cov))
            points = points + (H @ step.step[..., None]).unflatten(-2, (3, 3)).squeeze(-1)
            covs, inlier = covs - step.explained_points(G), weighed.inlier
        return state, self._poses(state, legs, points, covs, inlier)

    def predict(
        self, before: FootGaussian | None, legs: Legs, fresh: Bool[Tensor, " B"]
    ) -> FootGaussian:
        """Return the Gaussian one frame later; the prior where nothing is known."""
        model, centre = self.motion, legs.centre
        cov = model.cov.expand(*centre.shape[:-1], N_FOOT, N_FOOT)
        mean = torch.zeros_like(cov[..., 0])
        if before is None:
            return FootGaussian(mean, cov, centre)
        ahead = self.carried(before.mean, before.centre, centre)
        cov_ahead = model.matrix @ before.cov @ model.matrix.mT + model.noise
        return FootGaussian(
            torch.where(fresh[:, None, None], mean, ahead),
            torch.where(fresh[:, None, None, None], cov, cov_ahead),
            centre,
        )

    def carried(self, mean: Tensor, centre: Tensor, after: Tensor) -> Float[Tensor, "*batch 2 N"]:
        """Return means one frame later.

        Args:
            mean: [..., 2, N]. centre, after: [..., 2, 3], what legs let expect in both frames.
        """
        ahead = mean @ self.motion.matrix.mT
        ahead[..., TURN] += (1 - _FOLLOWS) * (centre - after)
        return ahead

    def poses(self, state: FootGaussian, legs: Legs, inlier: Tensor) -> FootPoses:
        """Return the feet of states."""
        points, H = self.linearise(state.mean, legs)
        return self._poses(state, legs, points, point_blocks(H @ state.cov @ H.mT), inlier)

    def _poses(
        self, state: FootGaussian, legs: Legs, points: Tensor, cov: Tensor, inlier: Tensor
    ) -> FootPoses:
        """Return the feet of states with points [..., 2, 3, 3] that have a covariance [..., 2, 3, 3, 3]."""
        turn = exponential(cross_matrix(torch.stack([state.centre, state.mean[..., TURN]])))
        return FootPoses(
            points.flatten(-3, -2), (cov + legs.more.unsqueeze(-3)).flatten(-4, -3), inlier,
            turn[0] @ turn[1], state.cov[..., TURN, TURN],
        )  # fmt: skip

    def linearise(self, mean: Float[Tensor, "*batch 2 N"], legs: Legs) -> _Linearised:
        """Return the points of feet and their derivative.

        A turn of the foot by x changes p by -[r]x R J(x), with the lever r from the ankle to p and the right
        Jacobian J of the exponential.
        """
        x = mean[..., TURN]
        turned, moved = mean[..., ERRORS].unflatten(-1, (2, 3)).unbind(-2)
        skew = cross_matrix(torch.stack([_product(legs.turn_root, turned), legs.centre, x]))
        wrong, centre, turn = exponential(skew).unbind(0)
        R = wrong @ legs.shank @ centre @ turn
        X, eye = skew[2], self._unit
        right = eye - X / 2 + X @ X / 6
        scaled = legs.length[..., None, None] * R
        levers = (self.motion.shape + mean[..., SHAPE].unflatten(-1, (3, 3))) @ scaled.mT
        points = (legs.ankle + _product(legs.ankle_root, moved)).unsqueeze(-2) + levers
        across = -cross_matrix(levers)  # [..., 2, 3, 3, 3]
        by_turn = across @ (R @ right).unsqueeze(-3)
        by_shape = (eye[:, None, :, None] * scaled[..., None, :, None, :]).flatten(-2)
        by_shank = across @ legs.turn_root.unsqueeze(-3)
        by_ankle = legs.ankle_root.unsqueeze(-3).expand_as(by_turn)
        none = torch.zeros_like(by_turn)
        jacobian = torch.cat([by_turn, none, by_shape, by_shank, by_ankle], -1)
        return _Linearised(points, jacobian.flatten(-3, -2))


def _product(
    matrix: Float[Tensor, "*batch 3 3"], vector: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    return (matrix @ vector[..., None]).squeeze(-1)


def exchanged_legs(
    exchanged: Float[Tensor, "*batch C 2"], scale: Float[Tensor, "*batch C"]
) -> Beliefs:
    """Return what the tracked body tells of cameras: log-odds of exchanged legs, and the noise."""
    return Beliefs(torch.logit(exchanged[..., 1:], LEAST_ODDS), scale)


def _carries(part: int, limb: int) -> bool:
    """Return whether a limb is a part or beyond it."""
    while limb >= 0:
        if limb == part:
            return True
        limb = BODY_15.part_parents[limb]
    return False
