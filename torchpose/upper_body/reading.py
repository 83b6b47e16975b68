"""From the estimates of both arms to a `PoseTrack`, in the frame and the pixels that are asked for."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.camera.pinhole import PinholeCamera
from torchpose.camera.projection import map_pixel_covariance, map_pixels
from torchpose.errors import InputError
from torchpose.math.rotations import RotationOrder
from torchpose.priors.upper_body import UpperBodyPrior
from torchpose.upper_body.arms import first_failure, mending_notes
from torchpose.upper_body.estimator import Estimates, Estimator
from torchpose.upper_body.fusion import (
    MotionStage,
    MotionState,
    ReadOut,
    calibration_mode,
    in_camera_axes,
    on_their_rays,
    read_out,
    recalibrated,
)
from torchpose.upper_body.pose_track import PoseTrack

__all__ = ["PoseReader", "check_frame"]


class PoseReader(NamedTuple):
    """Reads the poses out of the estimates of both arms.

    Attributes:
        prior, camera: whose pixels the estimates and the results are in.
        method, estimator: where the estimates come from.
        stage: steadies the motion; None leaves it as it is.
        lag: number of later frames that the stage may use, None for all.
        frame, static_camera, calibrated, fps: as in `UpperBodyTracker`.
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

    @property
    def order(self) -> RotationOrder:
        """Order of roll, pitch and yaw in the prior."""
        order: RotationOrder = self.prior.info.rotation_order  # type: ignore[assignment]
        return order

    def whole(self, estimates: Estimates, lengths: Int[Tensor, " B"] | None) -> ReadOut:
        """Return the poses of whole sequences, steadied; frames from a failure on play no part.

        Args:
            estimates: of both arms, [B, T, ...]. lengths: frames of each sequence, [B].
        """
        reading = self._read_out(estimates)
        if self.stage is None:
            return reading
        batch, n_frames = reading.uv.shape[:2]
        ends = torch.full((batch,), n_frames) if lengths is None else lengths
        ends = ends.to(reading.uv.device)
        failed_at = first_failure(estimates.left, estimates.right)
        ends = torch.where(failed_at >= 0, torch.minimum(ends, failed_at.clamp_min(1)), ends)
        return self.stage(reading, ends, self.lag)

    def more(
        self, motion: MotionState | None, estimates: Estimates
    ) -> tuple[MotionState | None, ReadOut]:
        """Return the next state of the motion stage, and the poses of some more frames, steadied.

        Args:
            motion: from the call before, None before the first frame. estimates: [B, T, ...].
        """
        reading = self._read_out(estimates)
        if self.stage is None:
            return None, reading
        return self.stage.advance(motion or self.stage.init(reading), reading)

    def _read_out(self, estimates: Estimates) -> ReadOut:
        return read_out(estimates, self.prior.info.matrix.to(estimates.left.mean), self.order)

    def track(
        self,
        reading: ReadOut,
        estimates: Estimates,
        observed: Bool[Tensor, "B T 8"],
        lengths: Int[Tensor, " B"] | None = None,
        notes: tuple[str, ...] = (),
    ) -> PoseTrack:
        """Return the result.

        Args:
            reading: of the poses. estimates: that it was read from. observed: what was measured.
            lengths: frames of each sequence, None for all. notes: what was assumed.
        """
        left, right = estimates.left, estimates.right
        matrix, own = (m.to(reading.uv) for m in (self.prior.info.matrix, self.camera.matrix))
        reading = self._placed(reading, matrix, observed)
        if lengths is None:
            batch, n_frames = reading.uv.shape[:2]
            lengths = torch.full((batch,), n_frames, device=reading.uv.device)
        return PoseTrack(
            joints2d=map_pixels(reading.uv, matrix, own),
            joints3d=reading.joints,
            covariance2d=map_pixel_covariance(reading.uv_covs, matrix, own),
            covariance3d=reading.covs,
            observed=observed,
            log_evidence=torch.stack([left.log_evidence, right.log_evidence], -1),
            effective_sample_size=torch.stack(
                [out.effective_sample_size.double() for out in (left, right)], -1
            ),
            lengths=lengths,
            matrix=self.camera.matrix,
            failed_at=first_failure(left, right),
            fps=self.fps,
            frame=self.frame,
            notes=(*notes, *mending_notes(left, right)),
            method=self.method,
        )

    def _placed(
        self, reading: ReadOut, matrix: Float[Tensor, "3 3"], observed: Bool[Tensor, "B T 8"]
    ) -> ReadOut:
        """Return the poses with calibrated covariances, in the frame that was asked for."""
        if self.estimator.reads_rays:
            reading = on_their_rays(reading, matrix, self.order, observed)
        if self.calibrated:
            mode = self.estimator.calibration or calibration_mode(self.method)
            reading = reading._replace(covs=recalibrated(reading.covs, self.prior.noise, mode))
        if self.frame == "body":
            return reading
        fixed = self.prior.left.moments()[0][18:] if self.static_camera else None
        return in_camera_axes(reading, self.order, fixed)


def check_frame(frame: str, static_camera: bool) -> None:
    """Raise unless the axes of the results are known, and the camera can stand still in them.

    Raises:
        InputError: another frame, or a static camera in the axes of the body.
    """
    if frame not in ("camera", "body"):
        raise InputError(f"frame must be 'camera' or 'body', got {frame!r}")
    if static_camera and frame == "body":
        raise InputError("static_camera needs frame='camera': the body's axes know no camera")
