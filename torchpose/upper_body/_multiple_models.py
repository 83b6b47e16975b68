"""Weigh two models of the same body by what each has predicted, and mix what they and a network estimate."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.rows import discounted_sums, in_frames, last_known
from torchpose.filters._lengths import inside_lengths
from torchpose.filters._outputs import first_not_finite
from torchpose.priors._arm_lifter import ArmLifter
from torchpose.priors._arms import ArmPrior
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._articulated import ArticulatedFilter, ArticulatedState
from torchpose.upper_body._articulated_frame import ELBOWS, HANDS, SHOULDERS
from torchpose.upper_body._estimator import (
    ArmGenerators,
    ArmJoints,
    Estimates,
    Estimator,
    SeenPoses,
    TrackerModel,
    repeat_last,
)
from torchpose.upper_body._fusion import (
    MotionStage,
    MotionStageState,
    in_camera_axes,
    kept_stage,
    on_their_rays,
    read_out,
    recalibrated,
    stage_lag,
)
from torchpose.upper_body._lifted_ends import Ends, LiftedState, ends_average, farther_off
from torchpose.upper_body._measured_joints import MeasuredJoints
from torchpose.upper_body._window_view import suitable_window
from torchpose.upper_body._windows import WindowMixture, WindowState

_NECK = UPPER_BODY.index("neck")
_MEMORY = 4.0  # seconds after which a clue counts for 1/e
_FIRST = 1.0  # log-odds of windows without any clue
# Share of the mean evidence that counts: frames are alike, so many tell no more than few.
_EVIDENCE_SHARE = 0.5
_LENGTH_SPREAD = 0.1  # of the log of arms' lengths; by windows, more than this tells against them
# For each e-fold by which windows put a body nearer than bones do, and at most.
_NEARNESS_WEIGHT, _MOST_NEARNESS = 15.0, 1.2
_SIGHT_WEIGHT = 2.0  # of what a network of single frames says for bones
_USUAL_TIME = 0.25  # seconds of usual frames that clues begin with
_USUAL = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.06**2, 0.06**2)
# Share by which covariances are too wide where both models have the same weight: the truth is most often
# between the two. As four sets have it that were in no fit.
_BETWEEN = 0.5
# Factors on the covariances of arms that are averaged with lifted ones, of which the elbow is measured, and
# of the others.
_TRUST = 0.5, 0.6
_MODESTY = 0.25  # factor on the variances of this average, to find its share beside lifted arms


class MultipleModelState(NamedTuple):
    """State of `MultipleModelFilter` between two frames.

    Attributes:
        windows, articulated: the states of both models. motion: the state of the motion stage of windows.
        clues: the discounted sums of what tells which model knows the person (`_clues`), [B, 8].
        apart: how far windows were from bones when an arm was last measured (`_packed`), [B, 43].
        lifted: what is kept for the network that lifts arms.
    """

    windows: WindowState
    articulated: ArticulatedState
    motion: MotionStageState | None
    clues: Tensor
    apart: Tensor
    lifted: LiftedState


class MultipleModelFilter(Estimator):
    """Estimator that averages "window-mixture" and "articulated" by clues which of them knows the person.

    Windows know the persons and the motions of their prior well and others badly; arms of bones are the
    other way round. Both say how likely elbow and hand of each arm are, given the torso (d_s). Hands alone
    tell little, so two more clues count: lengths of arms that change from frame to frame (x_s), and bodies
    that are nearer, so smaller, than bones have them (y_s). All are averaged over the last seconds, since
    frames of one motion err alike (dynamic model averaging, Raftery et al. 2010, with a tempered
    likelihood). The log-odds l of windows are

        d_s = sum_arms log p_windows(z_s | ...) - log p_articulated(z_s | ...)
        x_s = log(length of the arm by windows / by bones)
        y_s = log(depth of the neck by windows / by bones)
        n_s = -log p(windows) + log p(bones), by a network that lifts arms (`farther_off`)
        l_t = 1 + 0.5 E[d] - 2 E[n] - log(1 + Var[x] / 0.1^2) - min(1.2, 15 max(0, -E[y]))

    with means E and variances Var, over both arms, of weights a^(t-s), a = e^(-1 / (4 s f)). They begin as
    if a quarter of a second with d = y = 0 and Var[x] = 0.06^2 had preceded.

    Where no arm is measured windows know less than where the arms were. There they are as far from bones
    as when an arm was last measured.

    Joints are averaged in camera axes with weights sigma(l_t) and 1 - sigma(l_t), and covariances
    include how far the two are apart. So lengths of bones change where both have weight; `bone_lengths` are
    those of "articulated".

    Elbows and hands of this average are averaged once more, with those that a network lifts from single
    frames (`EndsAverage`). That network also tells which of both models is nearer to it, where elbows are not
    measured.

    Args:
        model: the model of the tracker, whose prior has a window that suits.
        arms: as in `ArticulatedFilter`.
        lifter: the network that lifts arms, or its file; by default the one that comes with the package.

    Raises:
        InputError: no window suits, or no network; as `ArticulatedFilter`.
    """

    calibration = "articulated"
    smooths = True

    def __init__(
        self,
        model: TrackerModel,
        arms: ArmPrior | str | Path | None = None,
        lifter: ArmLifter | str | Path | None = None,
    ) -> None:
        self.model = model
        self.windows = self.causal = _windows_of_limbs(model)
        if (
            model.smoothing is not None
            and suitable_window(model.prior, None, model.rate) is not None
        ):
            self.causal = _windows_of_limbs(model._replace(smoothing=None))
        self.articulated = ArticulatedFilter(model, arms)
        self.forget = math.exp(-1 / (_MEMORY * model.rate))
        self.matrix = model.prior.info.matrix_like(model.measurement_cov)
        self.order = model.prior.info.rotation_order
        self.ends = ends_average(model, lifter, _MODESTY, _TRUST)
        self._usual = _USUAL_TIME * model.rate * self.matrix.new_tensor(_USUAL)

    def init(
        self, batch_size: int, joints: ArmJoints, arm_generators: ArmGenerators
    ) -> MultipleModelState:
        """Return the state before the first frame; see `Estimator`."""
        return MultipleModelState(
            self.windows.init(batch_size, joints, arm_generators),
            self.articulated.init(batch_size, joints, arm_generators),
            None,
            self._usual.expand(batch_size, -1),
            self._unknown(batch_size),
            self.ends.init(batch_size),
        )

    def advance(
        self, state: MultipleModelState, measured: MeasuredJoints, progress: bool = False
    ) -> tuple[MultipleModelState, Estimates]:
        """Return the next state and the estimates of T more frames; see `Estimator`."""
        windows, seen = self.windows.advance(state.windows, measured)
        articulated, bodies = self.articulated.advance(state.articulated, measured, progress)
        reading, motion = read_out(seen, self.matrix, self.order), state.motion
        if self._stage is not None:
            motion = motion or self._stage.init(reading)
            motion, reading = self._stage.advance(motion, reading, measured.mask.any(-1))
        poses = in_camera_axes(reading, self.order)
        poses, apart = _held(poses, bodies, measured, state.apart)
        ends = self.ends.lift(state.lifted, bodies.seen_poses, measured.mask)
        sums = discounted_sums(
            state.clues, _clues(seen, bodies, poses, ends, measured), self.forget
        )
        lifted, mixed = self._mixed(state.lifted, sums, poses, seen, bodies, ends, measured)
        return MultipleModelState(windows, articulated, motion, sums[:, -1], apart, lifted), mixed

    def forward(
        self,
        measured: MeasuredJoints,
        joints: ArmJoints,
        arm_generators: ArmGenerators,
        lengths: Tensor | None = None,
        progress: bool = False,
    ) -> Estimates:
        """Return the estimates of whole sequences; see `Estimator`.

        The log-odds are those of the frames before and of the later ones that smoothing uses. Windows with
        later frames in them are surer of persons whom they do not know, and not better. So their evidence is
        that of the windows that end with the frame, and their poses are averaged with those of these. The
        evidence of bones, too, is that of keypoints as they are measured.
        """
        if self.model.smoothing is None:
            return super().forward(measured, joints, arm_generators, lengths, progress)
        seen = told = self.windows.forward(measured, joints, arm_generators, lengths)
        bodies = self.articulated.forward(measured, joints, arm_generators, lengths, progress)
        poses = self._steadied(seen, measured, lengths)
        if self.causal is not self.windows:
            told = self.causal.forward(measured, joints, arm_generators, lengths)
            half = torch.full_like(poses.place[..., 0], 0.5)
            poses = _averaged(half, poses, self._steadied(told, measured, lengths))
        poses, _ = _held(poses, bodies, measured, self._unknown(len(poses.joints)))
        predicted = bodies
        if self.articulated.ahead:
            predicted = self.articulated.filtered(
                measured, joints, arm_generators, lengths, progress
            )
        begun = self.ends.init(len(poses.joints))
        ends = self.ends.lift(begun, bodies.seen_poses, measured.mask)
        clues = _clues(told, predicted, poses, ends, measured)
        if lengths is not None:
            inside = inside_lengths(lengths.to(clues.device), clues.shape[1])
            clues = clues * inside[..., None]
        sums = discounted_sums(self._usual.expand(len(clues), -1), clues, self.forget)
        sums = sums + self._later_sums(clues) - clues
        _, mixed = self._mixed(begun, sums, poses, seen, bodies, ends, measured)
        return repeat_last(mixed, lengths)

    def _unknown(self, batch_size: int) -> Float[Tensor, "B 43"]:
        """Return how far both models are apart before an arm was measured."""
        return self.matrix.new_full((batch_size, 43), math.nan)

    def _steadied(
        self, seen: Estimates, measured: MeasuredJoints, lengths: Tensor | None
    ) -> SeenPoses:
        """Return the poses of windows over whole sequences, after their motion stage."""
        reading, stage = read_out(seen, self.matrix, self.order), self._stage
        if stage is not None:
            lag = stage_lag(self.model.smoothing, self.windows.ahead)
            reading = stage(reading, measured.mask.any(-1), lengths, lag)
        return in_camera_axes(reading, self.order)

    @property
    def _stage(self) -> MotionStage | None:
        """Return the motion stage of windows; None if it is switched off or the prior brings no ratios."""
        ratios, model = self.windows.steadied_by, self.model
        if ratios is None or not model.steadied:
            return None
        return kept_stage(model.owner, ratios, model.rate, model.measurement_cov)

    def _later_sums(self, clues: Float[Tensor, "B T K"]) -> Float[Tensor, "B T K"]:
        """Return the discounted sums of each frame and of the later ones that smoothing uses."""
        later = discounted_sums(torch.zeros_like(clues[:, 0]), clues.flip(1), self.forget).flip(1)
        lag = self.model.smoothing
        if not isinstance(lag, int) or lag + 1 >= clues.shape[1]:
            return later
        beyond = torch.zeros_like(later)
        beyond[:, : -lag - 1] = self.forget ** (lag + 1) * later[:, lag + 1 :]
        return later - beyond

    def _mixed(
        self,
        lifted: LiftedState,
        sums: Float[Tensor, "B T K"],
        poses: SeenPoses,
        seen: Estimates,
        bodies: Estimates,
        ends: Ends,
        measured: MeasuredJoints,
    ) -> tuple[LiftedState, Estimates]:
        """Return the mixture of both models, averaged with what is lifted, with its log-evidence.

        Args:
            lifted: what is kept of lifted arms. sums: the discounted sums of clues.
            poses: those of windows, after their motion stage.
            seen, bodies: the estimates of windows and of bones. ends: what is lifted.
            measured: the measurements.

        Returns:
            What is kept of lifted arms after the last frame, and the estimates.
        """
        poses = on_their_rays(poses, self.matrix, measured.mask)
        if self.model.calibrated:
            noise, mode = self.model.prior.noise, str(self.windows.calibration)
            poses = poses._replace(covs=recalibrated(poses.covs, noise, mode))
        share = torch.sigmoid(_log_odds(sums))
        mixed = _averaged(share, poses, bodies.seen_poses)
        if self.model.calibrated:
            trust = 1 - _BETWEEN * 4 * share * (1 - share)
            mixed = mixed._replace(covs=trust[..., None, None, None] * mixed.covs)
        lifted, mixed = self.ends.advance(lifted, mixed, ends, measured.mask)
        logs = share.log(), torch.log1p(-share)
        failed_at = first_not_finite(mixed.joints.flatten(2))
        ours, theirs = (
            torch.stack([found.left.log_evidence, found.right.log_evidence])
            for found in (seen, bodies)
        )
        evidence = torch.logaddexp(logs[0] + ours, logs[1] + theirs).unbind()
        left, right = (
            arm._replace(log_evidence=own, failed_at=failed_at)
            for arm, own in zip(bodies[:2], evidence, strict=True)
        )
        return lifted, Estimates(left, right, None, mixed, bodies.bones)


def _windows_of_limbs(model: TrackerModel) -> WindowMixture:
    """Return the estimator over windows, whose evidence is that of elbow and hand alone."""
    windows = WindowMixture(model)
    windows.of_limbs = True
    return windows


def _held(
    poses: SeenPoses, bodies: Estimates, measured: MeasuredJoints, before: Float[Tensor, "B 43"]
) -> tuple[SeenPoses, Float[Tensor, "B 43"]]:
    """Return the poses of windows, as far from those of bones as they were last where no arm is measured.

    Args:
        poses: those of windows. bodies: the estimates of bones. measured: what both measured, or what was
            put into gaps. before: how far apart both were when an arm was last measured, else NaN.

    Returns:
        The poses, and how far apart both are after the last frame.
    """
    told, theirs = _some_arm(measured.mask), _packed(bodies.seen_poses)
    ours = _packed(poses)
    if bool(told.all()):
        return poses, ours[:, -1] - theirs[:, -1]
    apart = in_frames(last_known(told), before, ours - theirs)
    packed = torch.where(told[..., None] | apart.isnan(), ours, theirs + apart)
    joints, uv, place = packed.split([24, 16, 3], -1)
    held = poses._replace(
        joints=joints.unflatten(-1, (8, 3)), uv=uv.unflatten(-1, (8, 2)), place=place
    )
    return held, apart[:, -1]


def _packed(poses: SeenPoses) -> Float[Tensor, "B T 43"]:
    """Return joints, pixels and places of poses in one tensor."""
    return torch.cat([poses.joints.flatten(2), poses.uv.flatten(2), poses.place], -1)


def _some_arm(mask: Bool[Tensor, "B T 8"]) -> Bool[Tensor, "B T"]:
    """Return where the elbow or the hand of an arm is measured."""
    return (mask[..., ELBOWS] | mask[..., HANDS]).any(-1)


def _clues(
    windows: Estimates,
    bodies: Estimates,
    poses: SeenPoses,
    ends: Ends,
    measured: MeasuredJoints,
) -> Float[Tensor, "B T 8"]:
    """Return the clues of each frame: 1 and d, n, y, x and x^2 of both arms; zero where no limb is measured.

    Args:
        windows, bodies: the estimates of windows and of bones. poses: those of windows. ends: what is
            lifted. measured: what both measured.
    """
    ours, theirs = (x.left.log_evidence + x.right.log_evidence for x in (windows, bodies))
    both = torch.stack([poses.joints, bodies.seen_poses.joints])
    shoulders, elbows, hands = (both[..., rows, :] for rows in (SHOULDERS, ELBOWS, HANDS))
    lengths = (elbows - shoulders).norm(dim=-1) + (hands - elbows).norm(dim=-1)
    logs = torch.cat([both[..., _NECK, 2:], lengths], -1).log()
    apart = logs[0] - logs[1]
    ratio = (ours - theirs)[..., None]
    off = farther_off(ends, both[0], both[1], measured.seen)[..., None]
    clues = torch.cat([torch.ones_like(ratio), ratio, off, apart, apart[..., 1:].square()], -1)
    return torch.where(_some_arm(measured.seen)[..., None], clues.nan_to_num(0.0), 0.0)


def _log_odds(sums: Float[Tensor, "*frames 8"]) -> Float[Tensor, " *frames"]:
    """Return the log-odds of windows, by discounted sums of clues (`_clues`)."""
    means = sums / sums[..., :1].clamp_min(1e-12)  # minutes without an arm are as no frame at all
    _, ratio, off, nearness, *_ = means.unbind(-1)
    varied = (means[..., 6:] - means[..., 4:6].square()).clamp_min(0.0).mean(-1)
    unsteady = torch.log1p(varied / _LENGTH_SPREAD**2)
    nearer = (-_NEARNESS_WEIGHT * nearness).clamp(0.0, _MOST_NEARNESS)
    return _FIRST + _EVIDENCE_SHARE * ratio - _SIGHT_WEIGHT * off - unsteady - nearer


def _averaged(share: Float[Tensor, "B T"], ours: SeenPoses, theirs: SeenPoses) -> SeenPoses:
    """Return the average of two poses, with the moments of a mixture.

    Args:
        share: the weight of the first. ours, theirs: the two.
    """
    both = ours, theirs
    rotations = torch.stack([poses.rotation for poses in both], 2)
    place = theirs.place.lerp(ours.place, share[..., None])
    weight = share[..., None, None]
    joints, covs = _moments(weight, *((poses.joints, poses.covs) for poses in both))
    uv, uv_covs = _moments(weight, *((poses.uv, poses.uv_covs) for poses in both))
    shares = torch.stack([share, 1.0 - share], -1)
    return SeenPoses(joints, covs, rotations, shares, place, uv, uv_covs)


def _moments(
    weight: Float[Tensor, "B T 1 1"], ours: tuple[Tensor, Tensor], theirs: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Return mean and covariance of a mixture of two components, given theirs and the first one's weight."""
    apart = ours[0] - theirs[0]
    pulled = weight * apart
    spread = pulled[..., :, None] * (apart - pulled)[..., None, :]
    return theirs[0] + pulled, theirs[1].lerp(ours[1], weight[..., None]) + spread
