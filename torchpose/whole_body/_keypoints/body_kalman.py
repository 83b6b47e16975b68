"""Filter the state of an articulated body from keypoints by an iterated extended Kalman filter.

Prediction: position and angles go on with velocities that decay (an Ornstein-Uhlenbeck process), but hardly
across the room while nothing is measured, and with mean accelerations by pose and velocity. Bone scales are
nearly constant, shifts of joints decay to zero (`body_transition`). A pose prior pulls angles with the share
dt / T of its information, so that alone it would decide about them within its time T.

Correction, iterated at x_i with d = x_i - x_predicted in the tangent space:

    delta = P H^T y',   y' = (I + W G)^-1 (b + W H d),   G = H P H^T,
    P' = P - P H^T (I + W G)^-1 W H P,

with H the derivative of the joints and W, b the information of all keypoints about them
(`keypoint_likelihood`), so the cost hardly depends on the number of cameras. With W = L L^T all factors are
Cholesky factors of I + L^T G L.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose._core.module_state import derived, index_tensor
from torchpose.body._articulation import BodyPoint
from torchpose.body._skeleton import BODY_15
from torchpose.camera._rig import CameraRig
from torchpose.math._gaussian import point_blocks, symmetrise
from torchpose.priors._body_motion import BodyMotion
from torchpose.whole_body._keypoints.adapted_noise import AdaptedNoise
from torchpose.whole_body._keypoints.body_transition import (
    BodyTransition,
    coasting_transition,
    jump_variance,
    transition,
)
from torchpose.whole_body._keypoints.information_step import (
    InformationStep,
    information_step,
    plus_one,
    unit,
)
from torchpose.whole_body._keypoints.joint_triangulation import triangulate
from torchpose.whole_body._keypoints.keypoint_likelihood import (
    LEAST_ODDS,
    NOISE_SCALES,
    Beliefs,
    Exchange,
    KeypointFrame,
    RigMaps,
    Seen,
    Weighed,
    exchange_of,
    information,
    readings_of,
    see,
    squared_errors,
    weigh,
    with_sides_exchanged,
)
from torchpose.whole_body._keypoints.nested import replaced, taken
from torchpose.whole_body._keypoints.upright import Expected, Upright, level_cameras_up, upright_of

FEW_INLIERS = 0.7
"""Share of a camera's keypoints below which its calibration may be wrong, and its noise wider."""

_JUMP = 0.3  # metres, standard deviation of a joint that is elsewhere than predicted
_AGAIN = 0.1  # metres, from where cameras agreed on such a joint to where they do one frame later
_CARRIED = 0.3  # metres in a second, standard deviation, of a pelvis of which no camera sees a hip
_HELD_TRUNK = 20.0  # shares of the information about the lean of its trunk that such a body gets
_HELD_PELVIS = 2.0  # shares of that about the lean of its pelvis
_NO_DOUBT = -12.0
# Factors of the noise's variance in each iteration, and where a joint has jumped.
_USUAL_WIDTHS = (1.0, 1.0, 1.0)
_RECOVERY = (100.0, 50.0, 25.0, 12.0, 6.0, 3.0, 1.5, 1.0)
_DECIDED = 2.0  # factor of the noise above which keypoints do not tell which side they are of
_SCALE_TIME = 2.0  # seconds over which the factors of the cameras' noise are averaged
_WIDTHS = (1.0, 4.0, 16.0, 64.0)  # factors of the noise that are tried for cameras with few inliers
_SCALE_COUNT = 10.0  # values of a frame, at most, that count for it as a whole
HIPS = tuple(BODY_15.joint(name) for name in ("pelvis", "left_hip", "right_hip"))
"""The pelvis and both hips."""


class BodyGaussian(NamedTuple):
    """Holds Gaussians over body states, and beliefs about cameras and joints.

    Attributes:
        mean: points, [B]. cov: [B, N, N], in the tangent spaces of the means.
        log_odds: [B, C, 2], of exchanged sides of arms and legs. scale: [B, C], of the cameras' noise.
        doubt: [B, J], log-odds of a joint elsewhere than the prediction has it.
        told: [B, C], number of frames whose mean the scale is, at most; the usual noise counts as some.
        agreed: [B, J, 3], where cameras agreed in the frame on a joint that was not expected there, else NaN.
        moving: how briskly bodies move.
    """

    mean: BodyPoint
    cov: Tensor
    log_odds: Tensor
    scale: Tensor
    doubt: Tensor
    told: Tensor
    agreed: Tensor
    moving: AdaptedNoise

    @property
    def beliefs(self) -> Beliefs:
        """Return what is believed of cameras."""
        return Beliefs(self.log_odds, self.scale)


class Widened(NamedTuple):
    """Holds how predictions were wider than usual.

    Attributes:
        jumped: [*batch, N], variances they got where joints had jumped. carried: where no camera saw a hip.
        factor: [*batch], of the variances of accelerations.
    """

    jumped: Tensor
    carried: Tensor
    factor: Tensor


class Speeds(NamedTuple):
    """Holds velocities of joints [B, J, 3], metres per second, and their covariances [B, J, 3, 3]."""

    velocity: Tensor
    cov: Tensor


class CorrectedBody(NamedTuple):
    """Holds what a correction gives.

    Attributes:
        state: the posterior. joints: [B, J, 3], metres. joint_cov: [B, J, 3, 3], metres squared.
        weighed: of the keypoints, by the posterior mean. log_evidence: [B], by Laplace's approximation.
        widened: by what the prediction was. speeds: of the joints.
    """

    state: BodyGaussian
    joints: Tensor
    joint_cov: Tensor
    weighed: Weighed
    log_evidence: Tensor
    widened: Widened
    speeds: Speeds


class _Elsewhere(NamedTuple):
    """Holds the log-evidence of joints elsewhere than predicted [B, J], and where cameras agree [B, J, 3]."""

    log_evidence: Tensor
    agreed: Tensor


class _Linearised(NamedTuple):
    """Holds H [B, 3 J, N], H P, G = H P H^T, joints as seen, and the weights of keypoints."""

    H: Tensor
    HP: Tensor
    G: Tensor
    seen: Seen
    weighed: Weighed


class BodyKalmanFilter(nn.Module):
    """Filters Gaussians over body states from keypoints in C cameras.

    Args:
        motion: how bodies move. rig: the cameras. fps: frames per second.
        up: "y" or "z", the axis of the world that points up; without it one camera is taken to be level.
    """

    def __init__(
        self, motion: BodyMotion, rig: CameraRig, fps: float, up: str | None = None
    ) -> None:
        super().__init__()
        self.motion, self.fps, self.up = motion, fps, up
        self.articulation = motion.articulation
        self._rig = (rig,)  # a tuple, so that its tensors are held once
        upright_of(rig, up)  # raises errors of the axis before any work

    @property
    def maps(self) -> RigMaps:
        """Return the maps from world axes to pixels."""
        rig = self._rig[0]
        sources = (rig.matrix, rig.rotation, rig.translation)
        return derived(self, "maps", sources, lambda: RigMaps.of(rig))

    @property
    def upright(self) -> Upright | None:
        """Return how people lean, if it is known which way is up."""
        rig = self._rig[0]
        return derived(self, "upright", (rig.rotation,), lambda: upright_of(rig, self.up))

    @property
    def exchange(self) -> Exchange:
        """Return the groups of joints whose sides may be exchanged."""
        skeleton, like = self.articulation.skeleton, self.motion.acceleration
        return derived(self, "exchange", (like,), lambda: exchange_of(skeleton, like.device))

    @property
    def transition(self) -> BodyTransition:
        """Return the model of one frame."""
        motion, dt = self.motion, 1 / self.fps
        return derived(self, "transition", self._moving, lambda: transition(motion, dt))

    def transition_of(self, coasting: Bool[Tensor, "*batch"]) -> BodyTransition:
        """Return the model of one frame of each body, by whether nothing was measured in the one before."""
        if not bool(coasting.any()):
            return self.transition
        motion, dt = self.motion, 1 / self.fps
        sources = (*self._moving, self._rig[0].rotation)
        unseen = derived(
            self, "coasting", sources, lambda: coasting_transition(motion, dt, self._up.direction)
        )
        return self.transition.where_coasting(unseen, coasting)

    @property
    def _moving(self) -> tuple[Tensor, ...]:
        """Return what the model of one frame is made of."""
        motion = self.motion
        return (
            motion.acceleration, motion.correlation, motion.decay, motion.shift_std, motion.shift_time,
            motion.pull_time,
        )  # fmt: skip

    @property
    def _up(self) -> Upright:
        """Return how people lean, by the cameras where it is not known which way is up."""
        if self.upright is not None:
            return self.upright
        rig = self._rig[0]
        return derived(self, "level", (rig.rotation,), lambda: level_cameras_up(rig))

    @property
    def _jump_variance(self) -> Float[Tensor, " N"]:
        """Return the variances that a part gets whose joint is elsewhere than predicted."""
        motion = self.motion
        return derived(self, "jump", (motion.acceleration,), lambda: jump_variance(motion))

    def predict(
        self, state: BodyGaussian, coasting: Bool[Tensor, " B"] | None = None
    ) -> BodyGaussian:
        """Return the Gaussian one frame later.

        Args:
            state: of a frame. coasting: of whom nothing was measured in it; of nobody if None.
        """
        model = self.transition if coasting is None else self.transition_of(coasting)
        mean, matrix = model.ahead(self.motion, state.mean)
        cov = matrix @ state.cov @ matrix.mT + self.noise_of(model, state.moving.factor)
        log_odds, doubt = model.next_log_odds(state.log_odds), model.next_doubt(state.doubt)
        later = state._replace(mean=mean, cov=cov, log_odds=log_odds, doubt=doubt)
        return self.pulled(later, model.share)

    def noise_of(
        self, model: BodyTransition, factor: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "... N N"]:
        """Return the noise of one frame of bodies whose accelerations vary more or less than on average.

        Args:
            model: of the frame. factor: of the variances of accelerations.
        """
        if len(self.maps.shift) == 1:
            return model.noise
        body = self.articulation
        scale = factor.new_ones(*factor.shape, body.dim)
        scale[..., : body.columns["velocity"].stop] = factor.sqrt()[..., None]
        return model.noise * scale[..., None] * scale[..., None, :]

    def pulled(self, state: BodyGaussian, share: float) -> BodyGaussian:
        """Return the Gaussian after a share of the information of the priors over poses and leans."""
        a, columns = self.articulation, self.articulation.relative_columns
        pull = self.motion.pull(a.relative_angles(state.mean), state.cov[..., columns, columns])
        HP = state.cov[..., columns, :]
        G = HP[..., columns]
        L = torch.linalg.cholesky(share * pull.curvature)
        chol = torch.linalg.cholesky(plus_one(L.mT @ G @ L))
        U = torch.linalg.solve_triangular(chol, L.mT @ HP, upper=False)
        y = share * pull.slope
        solved = torch.cholesky_solve(L.mT @ (G @ y[..., None]), chol)
        step = (HP.mT @ (y[..., None] - L @ solved)).squeeze(-1)
        state = state._replace(mean=a.moved(state.mean, step), cov=state.cov - U.mT @ U)
        if self.upright is None:
            return state
        return self._with_expected(state, self.upright.lean(a, state.mean), share)

    def _with_expected(
        self, state: BodyGaussian, expected: Expected, share: float | Float[Tensor, "B K"]
    ) -> BodyGaussian:
        """Return the Gaussian after a share of the information about what is expected of a body."""
        gap, variance, H = expected
        HP = H @ state.cov
        spread = HP @ H.mT + torch.diag_embed(variance / share)
        chol = torch.linalg.cholesky(symmetrise(spread))
        U = torch.linalg.solve_triangular(chol, HP, upper=False)
        step = (HP.mT @ torch.cholesky_solve(gap[..., None], chol)).squeeze(-1)
        mean = self.articulation.moved(state.mean, step)
        return state._replace(mean=mean, cov=state.cov - U.mT @ U)

    def correct(
        self, state: BodyGaussian, frame: KeypointFrame, widths: Sequence[float] | None = None
    ) -> CorrectedBody:
        """Return the posterior given the keypoints of a frame.

        Args:
            state: the prediction. frame: the keypoints.
            widths: factor of the noise's variance in every iteration, for a start far from the solution;
                by default 1, and more only where a joint has jumped.
        """
        readings = readings_of(frame, self.exchange)
        if widths is not None:
            return self._iterated(state, readings, widths)
        rows = self.without_hips(frame)
        if not len(rows):
            return self._corrected_as_predicted(state, frame, readings)
        carried = torch.zeros_like(state.cov[..., 0])
        carried[rows, self.articulation.columns["position"]] = _CARRIED**2 / self.fps
        state = state._replace(cov=state.cov + torch.diag_embed(carried))
        state = replaced(state, rows, self._with_leans(taken(state, rows)))
        corrected = self._corrected_as_predicted(state, frame, readings)
        return corrected._replace(widened=corrected.widened._replace(carried=carried))

    def without_hips(self, frame: KeypointFrame) -> Int[Tensor, " N"]:
        """Return the elements of whom none of several cameras sees a hip, but something else.

        Such a pelvis has to go along with the trunk. It would lag behind who walks, since its own speed is
        expected to decay, and the trunk would lean over more and more.
        """
        seen = frame.there.any(1)
        hips = index_tensor(HIPS, seen.device)
        rows = seen.any(-1) & ~seen.index_select(-1, hips).any(-1) & (len(self.maps.shift) > 1)
        return rows.nonzero().squeeze(-1)

    def _with_leans(self, state: BodyGaussian) -> BodyGaussian:
        """Return Gaussians after more information about leans, without which hips that are not seen drift."""
        body, share = self.articulation, self.transition.share
        state = self._with_expected(state, self._up.lean(body, state.mean), _HELD_PELVIS * share)
        return self._with_expected(
            state, self._up.trunk_lean(body, state.mean), _HELD_TRUNK * share
        )

    def with_usual_legs(self, state: BodyGaussian, share: Float[Tensor, "B 12"]) -> BodyGaussian:
        """Return Gaussians after shares of the information about where legs are below the hips on average.

        Args:
            state: of [B]. share: of every joint along every axis, as of `Upright.legs`; not zero.
        """
        return self._with_expected(state, self._up.legs(self.articulation, state.mean), share)

    def _corrected_as_predicted(
        self, state: BodyGaussian, frame: KeypointFrame, readings: KeypointFrame
    ) -> CorrectedBody:
        """Return the posterior of a prediction, from a wider one where a joint has jumped."""
        found = self._linearised(state, state.mean, readings)
        doubt, jumped, agreed = self._doubts(state, readings, found)
        state = state._replace(doubt=doubt, agreed=agreed)
        corrected = self._iterated(state, readings, _USUAL_WIDTHS, found)
        rows = jumped.any(-1).nonzero().squeeze(-1)
        if not len(rows):
            return corrected
        exchanged = corrected.weighed.exchanged
        return self._recovered(corrected, state, frame, jumped, rows, exchanged)

    def _recovered(
        self,
        corrected: CorrectedBody,
        state: BodyGaussian,
        frame: KeypointFrame,
        jumped: Bool[Tensor, "B J"],
        rows: Int[Tensor, " N"],
        exchanged: Float[Tensor, "B C 2"],
    ) -> CorrectedBody:
        """Return the posteriors, of elements with jumped joints from a prediction that is wide there.

        Limbs to such joints begin where cameras agree that they are, since none is found by small steps that
        points the other way. While the noise is wide, `exchanged` alone tells which sides keypoints are of.
        """
        widened = (jumped[rows].to(state.cov) @ self.articulation.carriers) * self._jump_variance
        wide = taken(state, rows)
        frame = frame.take(rows)
        exchanged = exchanged[rows]
        sided = with_sides_exchanged(frame, exchanged > 0.5, self.exchange)
        joints = triangulate(self.maps, sided)
        seen = jumped[rows] & joints.isfinite().all(-1)
        mean = self.articulation.swung(wide.mean, joints.nan_to_num(), seen)
        log_odds = torch.logit(exchanged, LEAST_ODDS)
        cov = wide.cov + torch.diag_embed(widened)
        wide = wide._replace(mean=mean, cov=cov, log_odds=log_odds)
        again = self._iterated(wide, readings_of(frame, self.exchange), _RECOVERY)
        again = again._replace(widened=again.widened._replace(jumped=widened))
        return replaced(corrected, rows, again)

    def turned_back(
        self,
        corrected: CorrectedBody,
        state: BodyGaussian,
        frame: KeypointFrame,
        wrong: Bool[Tensor, "B C 2"],
    ) -> CorrectedBody:
        """Return the posteriors; limbs that are on the wrong side begin from a prediction that is wide there.

        Args:
            corrected: of all elements. state: the prediction. frame: the keypoints.
            wrong: the cameras in which arms and legs are taken for exchanged, and are not.
        """
        rows = wrong.flatten(1).any(-1).nonzero().squeeze(-1)
        limbs = wrong.any(1).to(state.cov) @ self.exchange.groups.to(state.cov) > 0
        exchanged = corrected.weighed.exchanged.masked_fill(wrong, self.transition.begin)
        state = state._replace(doubt=corrected.state.doubt, agreed=corrected.state.agreed)
        return self._recovered(corrected, state, frame, limbs, rows, exchanged)

    def _iterated(
        self,
        state: BodyGaussian,
        readings: KeypointFrame,
        widths: Sequence[float],
        found: _Linearised | None = None,
    ) -> CorrectedBody:
        """Return the posterior after steps of Gauss and Newton, the first from what was found already."""
        point, d = state.mean, torch.zeros_like(state.cov[..., 0])
        joint_cov: Tensor | None = None
        for width in widths:
            if found is None:
                found = self._linearised(state, point, readings, joint_cov, width)
            step = self._step(readings, found, d)
            d = step.step
            point = self.articulation.moved(state.mean, d)
            joint_cov = point_blocks(found.G) - step.explained_points(found.G)
            last, found = found, None
        assert joint_cov is not None  # there is a step at least
        return self._corrected(state, readings, point, joint_cov, step, last)

    def _linearised(
        self,
        state: BodyGaussian,
        point: BodyPoint,
        readings: KeypointFrame,
        joint_cov: Tensor | None = None,
        width: float = 1.0,
    ) -> _Linearised:
        """Linearise about a point; weights by the prediction, or by an estimate with its covariance."""
        joints, jacobian = self.articulation.linearise(point)
        H = jacobian.flatten(-3, -2)
        HP = H @ state.cov
        G = HP @ H.mT
        seen = see(self.maps, joints)
        weighed = weigh(
            readings, seen, self.maps, state.beliefs, self.exchange,
            point_blocks(G) if joint_cov is None else joint_cov,
            marginal=joint_cov is None, decide=width < _DECIDED, width=width,
        )  # fmt: skip
        return _Linearised(H, HP, G, seen, weighed)

    def _step(
        self, readings: KeypointFrame, found: _Linearised, d: Float[Tensor, "B N"]
    ) -> InformationStep:
        """Return one step of Gauss and Newton from the prediction."""
        H, HP, G, seen, weighed = found
        return information_step(H, HP, G, *information(readings, seen, weighed), d)

    def _corrected(
        self,
        state: BodyGaussian,
        readings: KeypointFrame,
        point: BodyPoint,
        joint_cov: Tensor,
        step: InformationStep,
        last: _Linearised,
    ) -> CorrectedBody:
        a = self.articulation
        U = step.explained(last.HP)
        cov = state.cov - U.mT @ U
        joints = a.joints(point)
        seen = see(self.maps, joints)
        weighed = weigh(readings, seen, self.maps, state.beliefs, self.exchange)
        moved = (last.G @ step.pulled[..., None]).squeeze(-1)
        off = (step.pulled * moved).sum(-1)
        fit = -0.5 * off - step.chol.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        scale, told = self._next_scale(state, readings, seen, weighed, joint_cov)
        after = BodyGaussian(
            a.swung(point, joints),
            symmetrise(cov),
            torch.logit(weighed.exchanged, LEAST_ODDS),
            scale,
            state.doubt,
            told,
            state.agreed,
            self._next_moving(state, step, moved, off, weighed),
        )
        evidence = weighed.log_evidence + fit
        none = torch.zeros_like(step.step)
        widened = Widened(none, none, state.moving.factor)
        speeds = self._speeds(after, last.H)
        return CorrectedBody(after, joints, joint_cov, weighed, evidence, widened, speeds)

    def _next_moving(
        self,
        state: BodyGaussian,
        step: InformationStep,
        moved: Float[Tensor, "B K"],
        size: Float[Tensor, " B"],
        weighed: Weighed,
    ) -> AdaptedNoise:
        """Return how briskly bodies move; one camera does not tell, since what is lifted errs for long."""
        if len(self.maps.shift) == 1:
            return state.moving
        measured = (weighed.inlier.amax(1) > 0.5).to(moved).mean(-1)
        return state.moving.after(step.pulled, moved, size, measured, 1 / self.fps)

    def _speeds(self, state: BodyGaussian, H: Float[Tensor, "B K N"]) -> Speeds:
        """Return how fast joints move, by the derivative of their places."""
        velocities = self.articulation.columns["velocity"]
        by_pose = H[..., : self.articulation.n_pose]
        velocity = (by_pose @ state.mean.velocity[..., None]).unflatten(-2, (-1, 3)).squeeze(-1)
        cov = by_pose @ state.cov[..., velocities, velocities] @ by_pose.mT
        return Speeds(velocity, point_blocks(cov))

    def held_still(
        self, state: BodyGaussian, variance: Float[Tensor, "B J"], time: float
    ) -> BodyGaussian:
        """Return the Gaussian after a share of the information that joints do not move.

        Args:
            state: of [B]. variance: of their velocities along every axis, infinite where nothing is known.
            time: seconds, within which that would decide alone.
        """
        _, jacobian = self.articulation.linearise(state.mean)
        by_pose = jacobian.flatten(-3, -2)[..., : self.articulation.n_pose]
        H = torch.zeros_like(jacobian.flatten(-3, -2))
        H[..., self.articulation.columns["velocity"]] = by_pose
        gap = -(by_pose @ state.mean.velocity[..., None]).squeeze(-1)
        expected = Expected(gap, variance.repeat_interleave(3, -1), H)
        return self._with_expected(state, expected, 1 / (self.fps * time))

    def _next_scale(
        self,
        state: BodyGaussian,
        readings: KeypointFrame,
        seen: Seen,
        weighed: Weighed,
        joint_cov: Tensor,
    ) -> tuple[Float[Tensor, "B C"], Float[Tensor, "B C"]]:
        """Return the factors of the cameras' noise, averaged over seconds, and how many frames told them."""
        sums, count = squared_errors(readings, seen, weighed, joint_cov)
        if len(self.maps.shift) > 2:  # of two cameras nothing tells which is wrong
            least = FEW_INLIERS * readings.inlier[0].sum(-1)
            few = (weighed.inlier.sum(-1) < least).any(-1, keepdim=True)
            if bool(few.any()):
                beliefs = Beliefs(torch.logit(weighed.exchanged, LEAST_ODDS), state.scale)
                wider = self._by_wider(readings, seen, beliefs, joint_cov)
                sums, count = (
                    torch.where(few, wide, own)
                    for wide, own in zip(wider, (sums, count), strict=True)
                )
        tells = (count / _SCALE_COUNT).clamp_max(1.0)
        told = (state.told + tells).clamp_max(_SCALE_TIME * self.fps)
        ratio = sums / count.clamp_min(1e-6)
        scale = state.scale * (1.0 + tells / told * (ratio - 1.0))
        return scale.clamp(*NOISE_SCALES), told

    def _by_wider(
        self, readings: KeypointFrame, seen: Seen, beliefs: Beliefs, joint_cov: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return sums of squared errors and counts by the noise, as it is or wider, that explains a camera.

        Keypoints of a camera that sees bodies elsewhere, by a wrong calibration, are all outliers by a noise
        that is too narrow, and would tell nothing about it.
        """
        sums, count = torch.zeros_like(beliefs.scale), torch.zeros_like(beliefs.scale)
        best = torch.full_like(sums, -math.inf)
        for width in _WIDTHS:
            weighed = weigh(
                readings, seen, self.maps, beliefs, self.exchange, decide=False, width=width
            )
            explained = weighed.log_joint.sum(-1)
            own_sums, own_count = squared_errors(readings, seen, weighed, joint_cov)
            better = explained > best
            sums = torch.where(better, width * own_sums, sums)
            count = torch.where(better, own_count, count)
            best = torch.maximum(best, explained)
        return sums, count

    # --- joints elsewhere than predicted ------------------------------------------------------------

    def _doubts(
        self, state: BodyGaussian, readings: KeypointFrame, found: _Linearised
    ) -> tuple[Float[Tensor, "B J"], Bool[Tensor, "B J"], Float[Tensor, "B J 3"]]:
        """Return the log-odds of joints elsewhere than predicted, which are, and where cameras agree."""
        far = point_blocks(found.G) + _JUMP**2 * unit(3, found.G)
        at_large = weigh(
            readings, found.seen, self.maps, state.beliefs, self.exchange, far, marginal=True
        )
        elsewhere = _Elsewhere(at_large.log_joint.sum(-2), torch.full_like(state.agreed, torch.nan))
        if len(self.maps.shift) > 1:
            elsewhere = self._or_where_agreed(elsewhere, state, readings, found, far)
        doubt = state.doubt + elsewhere.log_evidence - found.weighed.log_joint.sum(-2)
        jumped = doubt > 0
        return torch.where(jumped, _NO_DOUBT, doubt), jumped, elsewhere.agreed

    def _or_where_agreed(
        self,
        elsewhere: _Elsewhere,
        state: BodyGaussian,
        readings: KeypointFrame,
        found: _Linearised,
        far: Float[Tensor, "B J 3 3"],
    ) -> _Elsewhere:
        """Return the log-evidence of joints elsewhere, at least that of where cameras agree.

        That counts for joints that several cameras see, of which the prediction accepts one at most.
        """
        there, accepted = readings.inlier[0] > 0.0, found.weighed.inlier > 0.5
        unsure = (there.sum(-2) > 1) & (accepted.sum(-2) < 2)
        if not bool(unsure.any()):
            return elsewhere
        exchanged = found.weighed.exchanged > 0.5
        evidence, agreed = self._where_agreed(state, readings, far, exchanged)
        likelier = torch.maximum(elsewhere.log_evidence, evidence)
        return _Elsewhere(
            torch.where(unsure, likelier, elsewhere.log_evidence),
            agreed.masked_fill(~unsure[..., None], torch.nan),
        )

    def _where_agreed(
        self,
        state: BodyGaussian,
        readings: KeypointFrame,
        far: Float[Tensor, "B J 3 3"],
        exchanged: Bool[Tensor, "B C 2"],
    ) -> _Elsewhere:
        """Return the log-evidence of keypoints for joints that are where cameras agree, -inf where none do.

        A joint may be off along the ray of one camera, which then takes it for right, while another one
        rejects it. Only both together tell where it is: by Laplace's approximation about that place t,

            log p(z | t) - (t - p)^T S^-1 (t - p) / 2 - log |1 + S W| / 2,

        with the predicted p, its covariance S and the information W of the keypoints.

        Args:
            state: the prediction. readings: the keypoints. far: S, of joints that are elsewhere.
            exchanged: sides, by the prediction.
        """
        predicted = self.articulation.joints(state.mean)
        frame = readings.map(lambda value: value[0])
        place = triangulate(self.maps, with_sides_exchanged(frame, exchanged, self.exchange))
        known = place.isfinite().all(-1)
        agreed, place = place, torch.where(known[..., None], place, predicted)
        seen = see(self.maps, place)
        weighed = weigh(readings, seen, self.maps, state.beliefs, self.exchange)
        W, _ = information(readings, seen, weighed)
        fit = torch.maximum(_log_fit(place - predicted, far, W), self._fit_again(state, place, W))
        return _Elsewhere((weighed.log_joint.sum(-2) + fit).masked_fill(~known, -math.inf), agreed)

    def _fit_again(
        self, state: BodyGaussian, place: Float[Tensor, "B J 3"], W: Float[Tensor, "B J 3 3"]
    ) -> Float[Tensor, "B J"]:
        """Return the log of how well joints are where they were elsewhere one frame before, -inf if nowhere.

        Cameras that agree on one place for several frames pay only once for a joint that may be anywhere. Of
        the predicted log-odds the share counts that is of joints which were elsewhere before.
        """
        before = state.agreed.isfinite().all(-1)
        off = torch.where(before[..., None], place - state.agreed, 0.0)
        near = _AGAIN**2 * unit(3, W).expand_as(W)
        odds = state.doubt.sigmoid()
        stayed = (1 - self.transition.lost / odds).clamp_min(LEAST_ODDS).log()
        return (stayed + _log_fit(off, near, W)).masked_fill(~before, -math.inf)


def _log_fit(
    off: Float[Tensor, "B J 3"], S: Float[Tensor, "B J 3 3"], W: Float[Tensor, "B J 3 3"]
) -> Float[Tensor, "B J"]:
    """Return -off^T S^-1 off / 2 - log |1 + S W| / 2."""
    L = torch.linalg.cholesky(S)
    off = torch.linalg.solve_triangular(L, off[..., None], upper=False)
    spread = torch.linalg.cholesky(plus_one(L.mT @ W @ L)).diagonal(dim1=-2, dim2=-1).log()
    return -0.5 * off.square().sum((-2, -1)) - spread.sum(-1)
