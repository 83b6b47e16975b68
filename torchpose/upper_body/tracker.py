"""The main job: 2D keypoints of head, neck and hands to 2D and 3D poses of eight joints."""

import warnings
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.module_state import (
    WideModule,
    derived,
    one_run,
    register_given,
    wide_or_parameter,
    working_precision,
)
from torchpose.camera.pinhole import PinholeCamera
from torchpose.camera.projection import map_pixel_covariance, map_pixels
from torchpose.camera.virtual_camera import BodyView
from torchpose.errors import (
    CameraError,
    InputError,
    PriorError,
    check_floating,
    check_rate,
    check_shape,
    refuse_export,
)
from torchpose.filters.base import Generators, RecursiveFilter
from torchpose.filters.mkf import MixtureKalmanFilter
from torchpose.filters.outputs import FilterOutput
from torchpose.math.rotations import RotationOrder, euler_to_matrix
from torchpose.priors.gaussian_mixture import GaussianMixture
from torchpose.priors.upper_body import UpperBodyPrior
from torchpose.priors.window import WindowLayout
from torchpose.upper_body import live as streaming
from torchpose.upper_body.arms import (
    ARMS,
    first_failure,
    generators_of_arms,
    in_double,
    joints_of_arm,
    mending_notes,
)
from torchpose.upper_body.collapse import note_collapse
from torchpose.upper_body.fusion import (
    MotionStage,
    ReadOut,
    calibration_mode,
    on_their_rays,
    read_out,
    recalibrated,
)
from torchpose.upper_body.live import LivePose, StreamState
from torchpose.upper_body.measurements import (
    MeasuredJoints,
    Picked,
    arm_measurements,
    check_gaps,
    known_covariances,
    measure_joints,
    pick_joints,
    pixels_per_metre,
    place_measured_neck,
)
from torchpose.upper_body.methods import (
    METHODS,
    SINGLE_POSES,
    WINDOWS,
    choose_method,
    options_of_before,
)
from torchpose.upper_body.pose_track import PoseTrack
from torchpose.upper_body.single_poses import joint_covariances, pose_filter
from torchpose.upper_body.windows import (
    SeenInView,
    pose_of_window,
    see_in_view,
    suitable_window,
    window_filter,
    window_inputs,
)

__all__ = ["METHODS", "PoseTrack", "UpperBodyTracker"]


class UpperBodyTracker(WideModule):
    """Tracks eight joints in 2D and 3D from the keypoints of any of them, typically head and hands.

    Two filters, one for each arm with head and neck, run on the same measurements (BL section 3.1);
    head, neck and camera of the two are averaged and their covariances bounded, never fused as if
    they were independent. `forward` tracks whole sequences, `init` and `step` live streams.

    The method is an estimator:

    - ``window-mixture``: the prior's mixture over short windows of motion is conditioned on every
      frame and the hands round it, each frame by itself; filters of constant velocity follow. The body
      is seen through a virtual camera that follows it, so that it may move about, farther away or
      beside the views that the prior was fitted to.
    - ``mkf-fixed``, ``mkf-sampled``, ``mkf-split``: banks of Kalman filters over single poses (BL
      section 3.4), see `MixtureKalmanFilter`.
    - ``pf-mixture``, ``pf-walk``, ``pf-walk-unscaled``: particles over single poses (BL section 3.3),
      see `BootstrapParticleFilter`.

    Args:
        prior: from `load_prior` or `fit_upper_body_prior`.
        camera: of the keypoints. One other than the prior's is mapped to it.
        method: one of `METHODS`; by default "window-mixture" where the prior has windows that suit, else
            "mkf-fixed". The attribute `method` and `PoseTrack.method` say which one runs.
        measurement_std: standard deviation of a keypoint in the camera's pixels, one number or one
            for each of hand, elbow, shoulder, head, neck; by default what the prior brings, else 3.
        fps: frame rate of the keypoints; by default that of the prior. Process noise is scaled.
        smoothing: None, the number of later frames that an estimate may use, or "full"; only for
            "window-mixture", whose windows then look a few frames ahead, and "mkf-fixed".
        frame: "camera" (axes of the camera) or "body" (of the prior's recordings).
        static_camera: put the body, turned by the estimated rotation, in front of a camera that
            stays at the prior's mean place, as the authors' released demo does.
        window: deprecated; False stands for method "mkf-fixed", True for the default.
        steady: pass what windows give through filters of constant velocity (`MotionStage`), which take
            the trembling out; smoothers if `smoothing` is asked for. By default where there are windows.
        calibrated: recalibrate `covariance3d` as the prior's training persons showed, if it says how.
        neck: kind of neck of the keypoints, where their names do not tell it (see
            `torchpose.skeleton.NECK_KINDS`). A neck of another kind than the prior's is put where the
            prior has it, between the middle of the shoulders and the head, or else not measured.
        max_gap: seconds over which nothing at all may be measured; None is no bound.
        options: of the method's filter (`torchpose.upper_body.methods.method_options`), such as n_particles,
            n_tracks, uniform_weight or transition.

    Raises:
        InputError: an unknown method, or an option that the method does not use. CameraError: no
            camera. PriorError: no such prior.

    Example:
        >>> import torch, torchpose
        >>> prior = torchpose.load_prior("kinect-upper-body")
        >>> tracker = torchpose.UpperBodyTracker(prior, camera=prior.camera)
        >>> keypoints = torch.full((1, 10, 3, 2), 240.0)
        >>> keypoints[..., 0] = torch.tensor([320.0, 420.0, 220.0])
        >>> track = tracker(keypoints, names=["head", "hand_left", "hand_right"])
        >>> track.joints3d.shape
        torch.Size([1, 10, 8, 3])
    """

    def __init__(
        self,
        prior: UpperBodyPrior,
        camera: PinholeCamera | None = None,
        method: str | None = None,
        *,
        measurement_std: float | Sequence[float] | Tensor | None = None,
        fps: float | None = None,
        smoothing: int | str | None = None,
        frame: str = "camera",
        static_camera: bool = False,
        window: bool | None = None,
        steady: bool | None = None,
        calibrated: bool = True,
        neck: str | None = None,
        max_gap: float | None = 5.0,
        **options: Any,
    ) -> None:
        super().__init__()
        _check_settings(prior, smoothing, frame, static_camera, fps)
        if window is not None:
            warnings.warn(
                f"window={window} is deprecated: method={WINDOWS!r} follows windows of motion, "
                f"{SINGLE_POSES!r} single poses, and without a method the tracker chooses",
                DeprecationWarning,
                stacklevel=2,
            )
            method, steady = options_of_before(method, window, steady)
        self.prior = prior
        self.camera = _require_camera(camera)
        self.fps = fps or prior.info.fps
        self.method, self.notes = choose_method(prior, method, smoothing, self.fps, options)
        self.smoothing = smoothing
        self.steady = self._can_steady() if steady is None else steady
        if self.steady and not self._can_steady():
            raise InputError(
                f"steady=True needs method {WINDOWS!r} and a prior that says how brisk its motions "
                f"are, got method {self.method!r}; leave it out"
            )
        self.calibrated = calibrated
        self.frame = frame
        self.static_camera = static_camera
        self.neck = neck
        self.max_gap = max_gap
        self.dtype = working_precision("dtype", options.get("dtype", torch.float64))
        register_given(self, "measurement_std", wide_or_parameter(measurement_std))
        self.options = options
        for name, value in options.items():
            if isinstance(value, Tensor):
                register_given(self, name, wide_or_parameter(value))
        for side in ARMS:
            self._models(side, ("hand", "head", "neck"))

    def _models(self, side: str, joints: tuple[str, ...]) -> tuple[RecursiveFilter, ...]:
        """The filter of an arm that measures these joints; with windows, also that of their hands alone."""
        window = self._window()
        if window is None:
            return (self._filter(side, joints),)
        return tuple(self._window_filter(side, window[0], measured) for measured in (joints, ()))

    measurement_std: Tensor | None

    @property
    def measurement_cov(self) -> Float[Tensor, "8 2 2"]:
        """R of each of the eight joints in the prior's pixels."""
        info, learnt = self.prior.info, getattr(self.prior, "noise_measurement_std", None)
        sources = (self.measurement_std, learnt, self.camera.matrix)
        return derived(
            self,
            ("measurement_cov", info.fx, info.fy, info.cx, info.cy),
            sources,
            lambda: joint_covariances(self.prior, self.measurement_std, self.camera.matrix),
        )

    def _given_options(self) -> dict[str, Any]:
        """The options, with tensors as they are registered."""
        return {name: getattr(self, name, value) if isinstance(value, Tensor) else value
                for name, value in self.options.items()}  # fmt: skip

    def _filter(self, side: str, joints: tuple[str, ...]) -> RecursiveFilter:
        """The filter of an arm that measures these joints."""
        options, cov = self._given_options(), self.measurement_cov
        tensors = [value for value in options.values() if isinstance(value, Tensor)]
        mixture: GaussianMixture = getattr(self.prior, side)
        sources = (*mixture.parameters_tuple(), *self.prior.noise.values(), cov, *tensors)
        info = self.prior.info
        return derived(
            self,
            (side, joints, info.fps, info.transition, info.fx, info.fy),
            sources,
            lambda: pose_filter(self.prior, side, joints, cov, self.method, self.fps, options),
        )

    def forward(
        self,
        keypoints: Float[Tensor, "B T J 2"],
        confidence: Float[Tensor, "B T J"] | None = None,
        names: Sequence[str] | None = None,
        mask: Bool[Tensor, "B T J"] | None = None,
        generator: Generators = None,
        lengths: Int[Tensor, " B"] | None = None,
        progress: bool = False,
        covariance: Float[Tensor, "B T J 2 2"] | None = None,
    ) -> PoseTrack:
        """Track a batch of sequences.

        Args:
            keypoints: [B, T, J, 2], pixels of the camera; NaN = missing.
            confidence: [B, T, J] in 0..1; 0 or NaN is missing, and the measurement covariance is
                divided by what is between.
            names: of the J joints, in any order and spelling that `torchpose.skeleton` knows; may be
                left out if J = 8 and they are in the order of `UPPER_BODY`.
            mask: [B, T, J], False = ignore the keypoint.
            generator: for the methods that draw: one, or a list of one for each sequence.
            lengths: [B], frames of each sequence. progress: whether to show a bar.
            covariance: of every single keypoint, pixels squared, in place of `measurement_std`; that
                of a missing keypoint is not looked at. Frames with the same covariances share work.

        Returns:
            `PoseTrack`.

        Raises:
            ShapeError, InputError: wrong shapes, infinite values, nothing measured in a sequence or
            for longer than `max_gap`. SkeletonError: unknown names.
        """
        _refuse_export()
        with one_run(self.measurement_cov.device):
            measured, notes = self._measure(keypoints, confidence, names, mask, lengths, covariance)
            sources = generators_of_arms(generator)
            seen = self._look(measured, lengths)
            arms = {
                side: self._run_arm(side, measured, seen, lengths, source, progress)
                for side, source in zip(ARMS, sources, strict=True)
            }
            view = None if seen is None else seen.view
            left, right = arms["left"], arms["right"]
            reading = self._steady(self._read_out(left, right, view), left, right, lengths)
            notes = self.notes + notes
            poses = self._poses(reading, left, right, measured.mask, lengths, notes)
        return note_collapse(poses)

    def init(
        self, batch_size: int, names: Sequence[str] | None = None, generator: Generators = None
    ) -> StreamState:
        """Begin to track live streams, frame by frame (`step`).

        Args:
            batch_size: B, number of streams. names: of the keypoints, as in `forward`; any of them
                may be missing in any frame. generator: as in `forward`; the state holds it.

        Raises:
            InputError: a tracker that smooths, no stream. SkeletonError: unknown names.

        Example:
            >>> import torch, torchpose
            >>> prior = torchpose.load_prior("kinect-upper-body")
            >>> tracker = torchpose.UpperBodyTracker(prior, camera=prior.camera)
            >>> state = tracker.init(1, names=["head", "hand_left", "hand_right"])
            >>> frame = torch.tensor([[[320.0, 120.0], [420.0, 240.0], [220.0, 240.0]]])
            >>> state, pose = tracker.step(state, frame)
            >>> pose.joints3d.shape
            torch.Size([1, 8, 3])
        """
        with one_run(self.measurement_cov.device):
            return streaming.begin(self, batch_size, names, generator)

    def step(
        self,
        state: StreamState,
        keypoints: Float[Tensor, "B J 2"],
        confidence: Float[Tensor, "B J"] | None = None,
        mask: Bool[Tensor, "B J"] | None = None,
        covariance: Float[Tensor, "B J 2 2"] | None = None,
    ) -> tuple[StreamState, LivePose]:
        """Track one more frame of each stream: the same numbers as that frame of `forward`.

        A camera does not stop, so `max_gap` raises nothing here: while nothing is measured the prior
        fills in, covariances grow, and `LivePose.unseen` says for how long it has been so. Frames
        that were dropped are to be passed as missing (NaN), since a step is one frame at `fps`.

        Args:
            state: from `init` or the step before; it is not changed, so a step may be repeated
                (but a generator goes on). keypoints, confidence, mask, covariance: of one frame, as
                in `forward`.

        Returns:
            The next state, and the `LivePose` of this frame.

        Raises:
            ShapeError, InputError: wrong shapes, infinite values.
        """
        _refuse_export()
        with one_run(self.measurement_cov.device):
            return streaming.track_frame(self, state, keypoints, confidence, mask, covariance)

    def advance(
        self,
        state: StreamState,
        keypoints: Float[Tensor, "B T J 2"],
        confidence: Float[Tensor, "B T J"] | None = None,
        mask: Bool[Tensor, "B T J"] | None = None,
        covariance: Float[Tensor, "B T J 2 2"] | None = None,
    ) -> tuple[StreamState, PoseTrack]:
        """Track some more frames of each stream: the same numbers as `step` for one after the other.

        Long recordings are tracked so in bounded memory, and quicker than frame by frame.

        Args:
            state: as in `step`. keypoints, confidence, mask, covariance: as in `forward`.

        Returns:
            The next state, and the poses of these frames.

        Raises:
            ShapeError, InputError: wrong shapes, no frames, infinite values.
        """
        _refuse_export()
        with one_run(self.measurement_cov.device):
            return streaming.track_frames(self, state, keypoints, confidence, mask, covariance)

    def _measure(
        self,
        keypoints: Tensor,
        confidence: Tensor | None,
        names: Sequence[str] | None,
        mask: Tensor | None,
        lengths: Tensor | None,
        covariance: Tensor | None,
    ) -> tuple[MeasuredJoints, tuple[str, ...]]:
        """The eight joints in the prior's pixels, checked; and what was assumed."""
        check_floating("keypoints", keypoints)
        check_shape("keypoints", keypoints, ["B", "T", "J", 2])
        keypoints = keypoints.to(self.measurement_cov)
        if keypoints.shape[0] == 0 or keypoints.shape[1] == 0:
            raise InputError(
                f"keypoints must hold at least one sequence of one frame, got {list(keypoints.shape)}"
            )
        info = self.prior.info
        picked = pick_joints(keypoints.shape[2], names, self.neck, info.neck, info.hand)
        measured = self._in_prior_pixels(keypoints, confidence, mask, picked, covariance)
        check_gaps(measured.mask, lengths, self.max_gap, self.fps or 30.0)
        return measured, picked.notes

    def _in_prior_pixels(
        self,
        keypoints: Tensor,
        confidence: Tensor | None,
        mask: Tensor | None,
        picked: Picked,
        covariance: Tensor | None,
    ) -> MeasuredJoints:
        own, prior = self.camera.matrix.to(keypoints), self.prior.info.matrix.to(keypoints)
        if covariance is not None:
            covariance = known_covariances(covariance, keypoints)
            covariance = map_pixel_covariance(covariance, own, prior)
        measured = measure_joints(
            keypoints, confidence, mask, picked.indices, self.measurement_cov, covariance
        )
        measured = measured._replace(uv=map_pixels(measured.uv, own, prior))
        if not picked.middle:
            return measured
        return place_measured_neck(measured, pixels_per_metre(self.prior))

    def _run_arm(
        self,
        side: str,
        measured: MeasuredJoints,
        seen: SeenInView | None,
        lengths: Tensor | None,
        generator: Generators,
        progress: bool,
    ) -> FilterOutput:
        joints = joints_of_arm(side, measured.mask.flatten(0, 1).any(0).tolist())
        if seen is not None:
            return self._run_window(side, joints, seen, lengths, progress)
        z, mask, cov = arm_measurements(ARMS[side], joints, measured)
        model = self._filter(side, joints)
        if self.smoothing is not None and isinstance(model, MixtureKalmanFilter):
            lag = None if self.smoothing == "full" else int(self.smoothing)
            return in_double(model.smooth(z, mask, cov, lengths, lag=lag, return_cov=True))
        out = model(z, mask, cov, lengths, generator, return_cov=True, progress=progress)
        return in_double(out)

    def _window(self) -> tuple[str, WindowLayout] | None:
        """The window that suits what was asked for: its name, and its lags at this frame rate."""
        if self.method != WINDOWS:
            return None
        return suitable_window(self.prior, self.smoothing, self.fps or 30.0)

    def _look(
        self, measured: MeasuredJoints, lengths: Tensor | None = None, start: int = 0
    ) -> SeenInView | None:
        """The measurements of windows in a virtual camera that follows the body, from a frame on.

        None where no window is used.
        """
        window = self._window()
        if window is None:
            return None
        return see_in_view(measured, self.prior, *window, self.measurement_cov, lengths, start)

    def _run_window(
        self,
        side: str,
        joints: tuple[str, ...],
        seen: SeenInView,
        lengths: Tensor | None,
        progress: bool,
    ) -> FilterOutput:
        """Fixed tracks over window states; the evidence is that of this frame given the window."""
        window = self.prior.windows[seen.window]
        both, noise, hands = window_inputs(seen, window, side, joints, self.measurement_cov)
        model = self._window_filter(side, seen.window, joints)
        out = model(*both, noise, lengths, return_cov=True, progress=progress)
        context = self._window_filter(side, seen.window, ())(*hands, None, lengths)
        return pose_of_window(in_double(out), context, seen, ARMS[side], window.layout)

    def _window_filter(self, side: str, name: str, joints: tuple[str, ...]) -> MixtureKalmanFilter:
        """Fixed tracks over window states that measure these joints and all hands of the window."""
        window, cov = self.prior.windows[name], self.measurement_cov
        mixture: GaussianMixture = getattr(window, side)
        return derived(
            self,
            (name, side, joints, window.layout, *window.settings.items()),
            (*mixture.parameters_tuple(), cov),
            lambda: window_filter(window, side, joints, cov, self._given_options()),
        )

    def _poses(
        self,
        reading: ReadOut,
        left: FilterOutput,
        right: FilterOutput,
        observed: Tensor,
        lengths: Tensor | None,
        notes: tuple[str, ...],
    ) -> PoseTrack:
        """The result in the frame and the pixels that were asked for."""
        info = self.prior.info
        order: RotationOrder = info.rotation_order  # type: ignore[assignment]
        if self._window() is not None:
            reading = on_their_rays(reading, info.matrix.to(reading.uv), order, observed)
        joints3d, covs3d = reading.joints, self._calibrated(reading.covs)
        if self.frame == "camera":
            rotation = euler_to_matrix(reading.angles, order)[..., None, :, :]
            place = reading.place[..., None, :]
            if self.static_camera:
                place = self.prior.left.moments()[0][18:].to(place).expand_as(place)
            joints3d = (rotation @ joints3d[..., None])[..., 0] + place
            covs3d = rotation @ covs3d @ rotation.mT
        matrix, own = info.matrix.to(reading.uv), self.camera.matrix.to(reading.uv)
        batch, n_frames = reading.uv.shape[:2]
        if lengths is None:
            lengths = torch.full((batch,), n_frames, device=reading.uv.device)
        return PoseTrack(
            joints2d=map_pixels(reading.uv, matrix, own),
            joints3d=joints3d,
            covariance2d=map_pixel_covariance(reading.uv_covs, matrix, own),
            covariance3d=covs3d,
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
        ).in_precision(self.dtype)

    def _read_out(self, left: FilterOutput, right: FilterOutput, view: BodyView | None) -> ReadOut:
        info = self.prior.info
        order: RotationOrder = info.rotation_order  # type: ignore[assignment]
        return read_out(left, right, info.matrix.to(left.mean), order, view)

    def _motion_stage(self) -> MotionStage | None:
        """The filter over what windows give."""
        window = self._window()
        if window is None or not self.steady:
            return None
        name = window[0]
        settings = self.prior.windows[name].settings
        joint, pixel, placement = (
            settings[f"{kind}_ratio"] for kind in ("joint", "pixel", "placement")
        )
        cov = self.measurement_cov
        return derived(
            self,
            ("stage", joint, pixel, placement),
            (cov,),
            lambda: MotionStage(joint, pixel, placement, self.fps or 30.0).to(cov.device),
        )

    def _can_steady(self) -> bool:
        """Whether there are windows, and the prior says how brisk its motions are."""
        window = self._window()
        return window is not None and "joint_ratio" in self.prior.windows[window[0]].settings

    def _steady(
        self, reading: ReadOut, left: FilterOutput, right: FilterOutput, lengths: Tensor | None
    ) -> ReadOut:
        """The reading after the motion stage; frames from a failure on play no part."""
        stage, window = self._motion_stage(), self._window()
        if stage is None or window is None:
            return reading
        batch, n_frames = reading.uv.shape[:2]
        ends = torch.full((batch,), n_frames) if lengths is None else lengths
        ends = ends.to(reading.uv.device)
        failed_at = first_failure(left, right)
        ends = torch.where(failed_at >= 0, torch.minimum(ends, failed_at.clamp_min(1)), ends)
        lag: int | None = 0
        if self.smoothing is not None:
            lag = None if self.smoothing == "full" else int(self.smoothing) - window[1].ahead
        return stage(reading, ends, lag)

    def _calibrated(self, covs: Tensor) -> Tensor:
        """Covariances recalibrated per joint on the prior's training persons, if it brings that."""
        if not self.calibrated:
            return covs
        window = self._window()
        mode = calibration_mode(self.method) if window is None else window[0]
        return recalibrated(covs, self.prior.noise, mode)


def _refuse_export() -> None:
    refuse_export(
        "UpperBodyTracker, which chooses its filters by what was measured,",
        "a step of a filter of torchpose.filters",
    )


def _require_camera(camera: PinholeCamera | None) -> PinholeCamera:
    if camera is None:
        raise CameraError(
            "a camera is needed, got None; pass camera=PinholeCamera(fx, fy, cx, cy), "
            "PinholeCamera.from_image_size(width, height), or prior.camera if it is the same"
        )
    return camera


def _check_settings(
    prior: UpperBodyPrior,
    smoothing: int | str | None,
    frame: str,
    static_camera: bool,
    fps: float | None,
) -> None:
    if not isinstance(prior, UpperBodyPrior):
        raise PriorError(
            f"prior must be an UpperBodyPrior, got {type(prior).__name__}; see torchpose.load_prior"
        )
    if frame not in ("camera", "body"):
        raise InputError(f"frame must be 'camera' or 'body', got {frame!r}")
    if static_camera and frame == "body":
        raise InputError("static_camera needs frame='camera': the body's axes know no camera")
    if fps is not None:
        check_rate("fps", fps)
    wrong_lag = isinstance(smoothing, int) and smoothing < 0
    if wrong_lag or (isinstance(smoothing, str) and smoothing != "full"):
        raise InputError(f"smoothing must be None, a number of frames or 'full', got {smoothing!r}")
