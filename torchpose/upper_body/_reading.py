"""Read a `PoseTrack` off the estimates of both arms, and note particles that have collapsed."""

from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.camera._pinhole import PinholeCamera
from torchpose.errors import InputError
from torchpose.filters._lengths import inside_lengths
from torchpose.math._rotations import RotationOrder
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.upper_body._camera_doubts import nearness_notes
from torchpose.upper_body._estimator import (
    Bones,
    Estimates,
    Estimator,
    SeenPoses,
    first_failure,
    mending_notes,
    repeat_poses,
)
from torchpose.upper_body._estimator_table import METHODS
from torchpose.upper_body._fusion import (
    NEAREST,
    MotionStage,
    MotionStageState,
    ReadOut,
    calibration_mode,
    in_body_axes,
    in_camera_axes,
    on_their_rays,
    put_at,
    read_out,
    recalibrated,
)
from torchpose.upper_body._measured_joints import MeasuredJoints, kept_pixel_maps, kept_turn
from torchpose.upper_body._outlier_notes import outlier_notes
from torchpose.upper_body._pose_track import PoseTrack
from torchpose.upper_body._screening import Screened


class PoseReader(NamedTuple):
    """Reader of poses out of the estimates of both arms.

    Attributes:
        prior, camera: the prior and the camera, in whose pixels the estimates and the results are.
        method, estimator: the method, and its estimator that made the estimates.
        stage: the motion stage; None leaves the motion as it is.
        lag: the number of later frames that the stage may use; 0 only filters, None is all.
        frame, static_camera, calibrated, fps: as in `UpperBodyTracker`.
        notes: what was assumed, in plain words.
    """

    prior: UpperBodyPrior
    camera: PinholeCamera
    method: str
    estimator: Estimator
    stage: MotionStage | None
    lag: int | None
    frame: str
    static_camera: bool
    calibrated: bool
    fps: float | None
    notes: tuple[str, ...] = ()

    @property
    def order(self) -> RotationOrder:
        """Return the order of roll, pitch and yaw in the prior."""
        return self.prior.info.rotation_order

    def read(
        self,
        motion: MotionStageState | None,
        estimates: Estimates,
        found: Screened,
        lengths: Int[Tensor, " B"] | None = None,
    ) -> tuple[MotionStageState | None, PoseTrack]:
        """Return the next state of the motion stage, and the poses of T more frames.

        Args:
            motion: the state from the previous call; None before the first frame, and without a stage.
            estimates: the estimates of both arms, [B, T, ...]. found: the measurements they were made from.
            lengths: of whole sequences, the number of frames of each, [B]; past it the last pose is
                repeated. None is T.
        """
        matrix, poses = self.prior.info.matrix_like(estimates.left.mean), estimates.poses
        notes = self.notes
        if poses is None:
            reading = read_out(estimates, matrix, self.order)
            motion, reading = self._steadied(
                motion, reading, estimates, found.measured.mask.any(-1), lengths
            )
            poses = in_camera_axes(reading, self.order)
            if estimates.view is None:  # single poses
                notes += nearness_notes(poses.joints, lengths)
        poses = self._tilted(self._placed(poses, matrix, found.measured), matrix)
        notes += outlier_notes(found.probability, found.exchanged, lengths)
        if lengths is None:
            lengths = torch.full((len(poses.uv),), poses.uv.shape[1], device=poses.uv.device)
        else:
            poses = repeat_poses(poses, lengths)
        return motion, self._track(poses, estimates, found, lengths, notes)

    def _steadied(
        self,
        motion: MotionStageState | None,
        reading: ReadOut,
        estimates: Estimates,
        seen: Bool[Tensor, "B T"],
        lengths: Int[Tensor, " B"] | None,
    ) -> tuple[MotionStageState | None, ReadOut]:
        """Return the next state of the motion stage, and what it makes of the poses.

        A stage that smooths takes whole sequences, of which frames from a failure on play no part.
        """
        if self.stage is None:
            return None, reading
        if self.lag == 0:
            return self.stage.advance(motion or self.stage.init(reading), reading, seen)
        batch, n_frames = reading.uv.shape[:2]
        ends = torch.full((batch,), n_frames) if lengths is None else lengths
        ends = ends.to(reading.uv.device)
        failed_at = first_failure(estimates.left, estimates.right)
        ends = torch.where(failed_at >= 0, torch.minimum(ends, failed_at.clamp_min(1)), ends)
        return None, self.stage(reading, seen, ends, self.lag)

    def _track(
        self,
        poses: SeenPoses,
        estimates: Estimates,
        found: Screened,
        lengths: Int[Tensor, " B"],
        notes: tuple[str, ...],
    ) -> PoseTrack:
        """Return the result, of poses in the axes that were asked for."""
        left, right = estimates.left, estimates.right
        _, to_camera = kept_pixel_maps(self.camera, self.prior)
        return PoseTrack(
            joints2d=to_camera.points(poses.uv),
            joints3d=poses.joints,
            covariance2d=to_camera.covariances(poses.uv_covs),
            covariance3d=poses.covs,
            observed=found.measured.seen,
            log_evidence=torch.stack([left.log_evidence, right.log_evidence], -1),
            effective_sample_size=torch.stack(
                [out.effective_sample_size.double() for out in (left, right)], -1
            ),
            lengths=lengths,
            matrix=self.camera.matrix.clone(),
            up=None if self.camera.up is None else self.camera.up.clone(),
            failed_at=first_failure(left, right),
            fps=self.fps,
            frame=self.frame,
            notes=(*notes, *mending_notes(left, right)),
            method=self.method,
            inlier_probability=found.probability.to(poses.uv),
            **_bone_fields(estimates.bones),
        )

    def _placed(
        self, poses: SeenPoses, matrix: Float[Tensor, "3 3"], measured: MeasuredJoints
    ) -> SeenPoses:
        """Return the poses with calibrated covariances, in the frame that was asked for."""
        if self.estimator.reads_rays:
            poses = on_their_rays(poses, matrix, measured.mask)
        if self.calibrated:
            mode = self.estimator.calibration or calibration_mode(self.method)
            poses = poses._replace(covs=recalibrated(poses.covs, self.prior.noise, mode))
        if measured.bridged is not None:
            poses = _less_sure(poses, matrix, measured.bridged)
        if self.frame == "body":
            return in_body_axes(poses)
        return put_at(poses, self.prior.left.moments()[0][18:]) if self.static_camera else poses

    def _tilted(self, poses: SeenPoses, matrix: Float[Tensor, "3 3"]) -> SeenPoses:
        """Return poses of the level camera in the pixels and the axes of the camera that is tilted."""
        turn = kept_turn(self.camera, self.prior)
        if turn is None:
            return poses
        back = turn.back(matrix.to(turn.rotation))
        uv_covs = back.covariances(poses.uv_covs, poses.uv)
        poses = poses._replace(uv=back.points(poses.uv), uv_covs=uv_covs)
        if self.frame == "body":
            return poses
        rotation = back.rotation.to(poses.joints)
        return poses._replace(
            joints=poses.joints @ rotation.mT,
            covs=rotation @ poses.covs @ rotation.mT,
            rotations=rotation @ poses.rotations,
            place=poses.place @ rotation.mT,
        )


def _less_sure(
    poses: SeenPoses, matrix: Float[Tensor, "3 3"], variance: Float[Tensor, "B T 8"]
) -> SeenPoses:
    """Return poses with more variance of joints along every axis, in space and in the image.

    Args:
        poses: in the camera's axes. matrix: K of the prior's camera. variance: metres squared.
    """
    eye = torch.eye(3).to(poses.covs)
    scale = matrix.diagonal()[:2] / poses.joints[..., 2:].clamp_min(NEAREST)
    return poses._replace(
        covs=poses.covs + variance[..., None, None] * eye,
        uv_covs=poses.uv_covs + torch.diag_embed(variance[..., None] * scale.square()),
    )


def _bone_fields(bones: Bones | None) -> dict[str, Any]:
    """Return the fields of a `PoseTrack` that hold lengths of bones."""
    if bones is None:
        return {}
    return {
        "bone_lengths": bones.metres,
        "bone_covariance": bones.covs,
        "bone_names": bones.names,
    }


def check_frame(frame: str, static_camera: bool) -> None:
    """Check the axes of the results, and that the camera can stand still in them.

    Raises:
        InputError: another frame, or a static camera in the axes of the body.
    """
    if frame not in ("camera", "body"):
        raise InputError(f"frame must be 'camera' or 'body', got {frame!r}")
    if static_camera and frame == "body":
        raise InputError("static_camera needs frame='camera': the body's axes know no camera")


_FEW = 2.0  # particles: below that, one of them has most of the weight
# Share of the frames of an arm with so few, above which it is said: quick movements alone have fewer.
_COLLAPSED_SHARE = 0.25


def note_collapse(track: PoseTrack) -> PoseTrack:
    """Return the track with a note if its particles have collapsed, else the track itself.

    An arm has collapsed where its effective sample size (BL 25) is below 2 in more than a quarter of the
    frames of a sequence. Banks of Kalman filters have no such note: one track that has all the weight
    still is a Gaussian.

    Args:
        track: a track of any method; frames that failed or have no sample size are not counted.
    """
    method = METHODS.get(track.method)
    if method is None or not method.particles:
        return track
    size = track.effective_sample_size
    inside = inside_lengths(track.lengths.to(size.device), size.shape[1])
    counted = size.isfinite() & inside[..., None]
    few = (counted & (size < _FEW)).sum(1)
    collapsed = few > _COLLAPSED_SHARE * counted.sum(1)
    if not bool(collapsed.any()):
        return track
    arms = " and ".join(
        f"{name} arm" for name, lost in zip(("left", "right"), collapsed.any(0).tolist(), strict=True)
        if lost
    )  # fmt: skip
    where = ""
    if len(track) > 1:
        where = f" of {int(collapsed.any(1).sum())} of {len(track)} sequences"
    share = 100 * float(few[collapsed].sum() / counted.sum(1)[collapsed].sum())
    note = (
        f"particles collapsed ({arms}{where}): fewer than two of them carry the weight in {share:.0f} % "
        "of the frames, so that estimate and covariance are those of a single one; process noise much "
        "wider than the motion, too few particles or a camera unlike the prior's do that"
    )
    return replace(track, notes=(*track.notes, note))
