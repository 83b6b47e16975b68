"""Weigh two models of the same body by what each has predicted, and mix what they estimate."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.filters._outputs import first_not_finite
from torchpose.priors._arms import ArmPrior
from torchpose.upper_body._articulated import ArticulatedFilter, ArticulatedState
from torchpose.upper_body._articulated_frame import ELBOWS, HANDS
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
from torchpose.upper_body._measured_joints import MeasuredJoints
from torchpose.upper_body._window_view import suitable_window
from torchpose.upper_body._windows import WindowMixture, WindowState

_MEMORY = 4.0  # seconds after which evidence counts for 1/e
# Share of the mean evidence that counts: frames are alike, so many tell no more than few.
_EVIDENCE_SHARE = 0.5
_FIRST = 0.5  # log-odds of windows before the first frame
# Share by which covariances are too wide where both models have the same weight: the truth is most often
# between the two. As four sets have it that were in no fit.
_BETWEEN = 0.5


class MultipleModelState(NamedTuple):
    """State of `MultipleModelFilter` between two frames.

    Attributes:
        windows, articulated: the states of both models. motion: the state of the motion stage of windows.
        ratios: the discounted sums of the log-likelihood ratios of windows and of their weights, [B, 2].
    """

    windows: WindowState
    articulated: ArticulatedState
    motion: MotionStageState | None
    ratios: Tensor


class MultipleModelFilter(Estimator):
    """Estimator that averages "window-mixture" and "articulated" by their evidence.

    Windows know the persons and the motions of their prior well and others badly; arms of bones are the
    other way round. Both say how likely elbow and hand of each arm are, given the torso. The log-odds l
    of windows are these, averaged over the last seconds, since frames of one motion err alike (dynamic
    model averaging, Raftery et al. 2010, with a tempered likelihood):

        d_s = sum_arms log p_windows(z_s | ...) - log p_articulated(z_s | ...)
        l_t = l_0 + c sum_s a^(t-s) d_s / sum_s a^(t-s),   a = e^(-1 / (4 s f)),   c = 1/2

    Joints are averaged in camera axes with weights sigma(l_t) and 1 - sigma(l_t), and covariances
    include how far the two are apart. So lengths of bones change where both have weight; `bone_lengths` are
    those of "articulated".

    Args:
        model: the model of the tracker, whose prior has a window that suits.
        arms: as in `ArticulatedFilter`.

    Raises:
        InputError: no window suits; as `ArticulatedFilter`.
    """

    calibration = "articulated"
    smooths = True

    def __init__(self, model: TrackerModel, arms: ArmPrior | str | Path | None = None) -> None:
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

    def init(
        self, batch_size: int, joints: ArmJoints, arm_generators: ArmGenerators
    ) -> MultipleModelState:
        """Return the state before the first frame; see `Estimator`."""
        return MultipleModelState(
            self.windows.init(batch_size, joints, arm_generators),
            self.articulated.init(batch_size, joints, arm_generators),
            None,
            self.matrix.new_zeros(batch_size, 2),
        )

    def advance(
        self, state: MultipleModelState, measured: MeasuredJoints, progress: bool = False
    ) -> tuple[MultipleModelState, Estimates]:
        """Return the next state and the estimates of T more frames; see `Estimator`."""
        windows, seen = self.windows.advance(state.windows, measured)
        articulated, bodies = self.articulated.advance(state.articulated, measured, progress)
        reading, motion = read_out(seen, self.matrix, self.order), state.motion
        if self._stage is not None:
            motion, reading = self._stage.advance(motion or self._stage.init(reading), reading)
        sums = self._sums(state.ratios, _log_ratios(seen, bodies, measured))
        poses = in_camera_axes(reading, self.order)
        mixed = self._mixed(sums, poses, seen, bodies, measured)
        return MultipleModelState(windows, articulated, motion, sums[:, -1]), mixed

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
        poses = self._steadied(seen, lengths)
        if self.causal is not self.windows:
            told = self.causal.forward(measured, joints, arm_generators, lengths)
            half = torch.full_like(poses.place[..., 0], 0.5)
            poses = _averaged(half, poses, self._steadied(told, lengths))
        predicted = bodies
        if self.articulated.ahead:
            predicted = self.articulated.filtered(
                measured, joints, arm_generators, lengths, progress
            )
        ratios = _log_ratios(told, predicted, measured)
        if lengths is not None:
            frames = torch.arange(ratios.shape[1], device=ratios.device)
            ratios = ratios * (frames < lengths.to(ratios.device)[:, None])[..., None]
        none = ratios.new_zeros(len(ratios), 2)
        sums = self._sums(none, ratios)
        sums = sums + self._later_sums(ratios) - ratios
        return repeat_last(self._mixed(sums, poses, seen, bodies, measured), lengths)

    def _steadied(self, seen: Estimates, lengths: Tensor | None) -> SeenPoses:
        """Return the poses of windows over whole sequences, after their motion stage."""
        reading, stage = read_out(seen, self.matrix, self.order), self._stage
        if stage is not None:
            reading = stage(reading, lengths, stage_lag(self.model.smoothing, self.windows.ahead))
        return in_camera_axes(reading, self.order)

    @property
    def _stage(self) -> MotionStage | None:
        """Return the motion stage of windows; None if it is switched off or the prior brings no ratios."""
        ratios, model = self.windows.steadied_by, self.model
        if ratios is None or not model.steadied:
            return None
        return kept_stage(model.owner, ratios, model.rate, model.measurement_cov)

    def _sums(
        self, before: Float[Tensor, "B 2"], ratios: Float[Tensor, "B T 2"]
    ) -> Float[Tensor, "B T 2"]:
        """Return the discounted sums of the log-likelihood ratios and of their weights after each frame."""
        sums = []
        for now in ratios.unbind(1):
            before = self.forget * before + now
            sums.append(before)
        return torch.stack(sums, 1)

    def _later_sums(self, ratios: Float[Tensor, "B T 2"]) -> Float[Tensor, "B T 2"]:
        """Return the discounted sums of each frame and of the later ones that smoothing uses."""
        later = self._sums(torch.zeros_like(ratios[:, 0]), ratios.flip(1)).flip(1)
        lag = self.model.smoothing
        if not isinstance(lag, int) or lag + 1 >= ratios.shape[1]:
            return later
        beyond = torch.zeros_like(later)
        beyond[:, : -lag - 1] = self.forget ** (lag + 1) * later[:, lag + 1 :]
        return later - beyond

    def _mixed(
        self,
        sums: Float[Tensor, "B T 2"],
        poses: SeenPoses,
        seen: Estimates,
        bodies: Estimates,
        measured: MeasuredJoints,
    ) -> Estimates:
        """Return the mixture of both models, with its log-evidence.

        Args:
            sums: the discounted sums of the log-likelihood ratios and of their weights.
            poses: those of windows, after their motion stage.
            seen, bodies: the estimates of windows and of bones. measured: the measurements.
        """
        if bodies.poses is None:
            raise RuntimeError("an articulated filter reads its poses itself")
        poses = on_their_rays(poses, self.matrix, measured.mask)
        if self.model.calibrated:
            noise, mode = self.model.prior.noise, str(self.windows.calibration)
            poses = poses._replace(covs=recalibrated(poses.covs, noise, mode))
        mean_ratio = sums[..., 0] / sums[..., 1].clamp_min(1e-12)
        share = torch.sigmoid(_FIRST + _EVIDENCE_SHARE * mean_ratio)
        mixed = _averaged(share, poses, bodies.poses)
        if self.model.calibrated:
            trust = 1 - _BETWEEN * 4 * share * (1 - share)
            mixed = mixed._replace(covs=trust[..., None, None, None] * mixed.covs)
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
        return Estimates(left, right, None, mixed, bodies.bones)


def _windows_of_limbs(model: TrackerModel) -> WindowMixture:
    """Return the estimator over windows, whose evidence is that of elbow and hand alone."""
    windows = WindowMixture(model)
    windows.of_limbs = True
    return windows


def _log_ratios(
    windows: Estimates, bodies: Estimates, measured: MeasuredJoints
) -> Float[Tensor, "B T 2"]:
    """Return the log-likelihood ratio of windows to bones for both arms, and 1 where a limb is measured."""
    ours, theirs = (x.left.log_evidence + x.right.log_evidence for x in (windows, bodies))
    seen = measured.seen
    some = (seen[..., ELBOWS] | seen[..., HANDS]).any(-1)
    apart = torch.where(some, (ours - theirs).nan_to_num(0.0), 0.0)
    return torch.stack([apart, some.to(apart)], -1)


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
