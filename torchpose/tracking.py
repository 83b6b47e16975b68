"""The main job: 2D keypoints of head, neck and hands to 2D and 3D poses of eight joints."""

import math
from collections.abc import Sequence
from typing import Any, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose import streaming
from torchpose.arms import SeenInView, generators_of_arms, pose_of_window
from torchpose.body_view import (
    BodyView,
    PathModel,
    body_path,
    to_view,
    view_body,
    view_jacobian,
)
from torchpose.camera import PinholeCamera
from torchpose.errors import (
    CameraError,
    InputError,
    PriorError,
    check_covariance,
    check_finite,
    check_shape,
)
from torchpose.filters import BootstrapParticleFilter, FilterOutput, MixtureKalmanFilter
from torchpose.filters.base import Generators, RecursiveFilter
from torchpose.measurements import (
    MeasuredJoints,
    Picked,
    append_blocks,
    arm_measurements,
    check_gaps,
    measure_joints,
    pick_joints,
    pixel_indices,
    place_measured_neck,
)
from torchpose.pose_track import PoseTrack
from torchpose.priors.arm_state import STATE_DIM
from torchpose.priors.upper_body import UpperBodyPrior, released_process_cov
from torchpose.priors.window import WindowLayout, window_measurements
from torchpose.projection import map_pixel_covariance, map_pixels
from torchpose.read_out import MotionStage, ReadOut, read_out
from torchpose.rotations import RotationOrder, euler_to_matrix
from torchpose.skeleton import ARM_JOINTS, LEFT_ARM, RIGHT_ARM, UPPER_BODY
from torchpose.streaming import LivePose, StreamState

__all__ = ["METHODS", "PoseTrack", "UpperBodyTracker"]

METHODS = ("mkf-fixed", "mkf-sampled", "mkf-split", "pf-mixture", "pf-walk", "pf-walk-unscaled")
_PROPOSALS = {
    "pf-mixture": "mixture",
    "pf-walk": "random-walk",
    "pf-walk-unscaled": "random-walk-unscaled",
}
_SIDES = {"left": LEFT_ARM, "right": RIGHT_ARM}
_HEAD, _NECK = UPPER_BODY.index("head"), UPPER_BODY.index("neck")
_HANDS = [UPPER_BODY.index("hand_left"), UPPER_BODY.index("hand_right")]
_DEFAULT_STD = 3.0
# These options are those of a filter over single poses.
_POSE_OPTIONS = {"transition", "gamma", "subspace", "initial_cov", "process_cov"}


class UpperBodyTracker(nn.Module):
    """Tracks eight joints in 2D and 3D from the keypoints of any of them, typically head and hands.

    Two filters, one for each arm with head and neck, run on the same measurements (BL section 3.1);
    head, neck and camera of the two are averaged and their covariances bounded, never fused as if
    they were independent. Mixtures over windows see the body through a virtual camera that follows
    it, so that it may move about, farther away or beside the views that the prior was fitted to.
    `forward` tracks whole sequences, `init` and `step` live streams.

    Args:
        prior: from `load_prior` or `fit_upper_body_prior`.
        camera: of the keypoints. One other than the prior's is mapped to it.
        method: one of `METHODS`.
        measurement_std: standard deviation of a keypoint in the camera's pixels, one number or one
            for each of hand, elbow, shoulder, head, neck; by default what the prior brings, else 3.
        fps: frame rate of the keypoints; by default that of the prior. Process noise is scaled.
        smoothing: None, the number of later frames that an estimate may use, or "full"; only for
            "mkf-fixed".
        frame: "camera" (axes of the camera) or "body" (of the prior's recordings).
        static_camera: put the body, turned by the estimated rotation, in front of a camera that
            stays at the prior's mean place, as the authors' released demo does.
        window: use the prior's mixtures over short windows of motion where it brings them (only for
            "mkf-fixed"; smoothed estimates then look a few frames ahead); False tracks single poses,
            as the paper does, and so do options that only make sense there (transition, gamma).
        steady: pass what windows give through filters of constant velocity (`MotionStage`), which take
            the trembling out; smoothers if `smoothing` is asked for.
        calibrated: recalibrate `covariance3d` as the prior's training persons showed, if it says how.
        neck: kind of neck of the keypoints, where their names do not tell it (see
            `torchpose.skeleton.NECK_KINDS`). A neck of another kind than the prior's is put where the
            prior has it, between the middle of the shoulders and the head, or else not measured.
        max_gap: seconds over which nothing at all may be measured; None is no bound.
        options: to the filter, such as n_particles, n_tracks, uniform_weight or transition.

    Raises:
        InputError: an unknown method or option. CameraError: no camera. PriorError: no such prior.

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
        method: str = "mkf-fixed",
        *,
        measurement_std: float | Sequence[float] | Tensor | None = None,
        fps: float | None = None,
        smoothing: int | str | None = None,
        frame: str = "camera",
        static_camera: bool = False,
        window: bool = True,
        steady: bool = True,
        calibrated: bool = True,
        neck: str | None = None,
        max_gap: float | None = 5.0,
        **options: Any,
    ) -> None:
        super().__init__()
        _check_settings(prior, method, smoothing, frame, fps)
        self.prior = prior
        self.camera = _require_camera(camera)
        self.method = method
        self.fps = fps or prior.info.fps
        self.smoothing = smoothing
        self.window = window
        self.steady = steady
        self.calibrated = calibrated
        self.frame = frame
        self.static_camera = static_camera
        self.neck = neck
        self.max_gap = max_gap
        self.options = options
        self.register_buffer("measurement_cov", self._measurement_cov(measurement_std))
        self.measurement_cov: Tensor
        self.filters = nn.ModuleDict()
        self.stages = nn.ModuleDict()
        for side in _SIDES:
            self._filter(side, ("hand", "head", "neck"))

    def _measurement_cov(self, std: float | Sequence[float] | Tensor | None) -> Tensor:
        """R of each of the eight joints in the prior's pixels, [8, 2, 2]."""
        learnt = self.prior.noise.get("measurement_std")
        if std is None and learnt is not None:
            by_joint = learnt.double().expand(5) if learnt.ndim == 0 else learnt.double()
            matrix = None
        else:
            given = torch.as_tensor(_DEFAULT_STD if std is None else std, dtype=torch.float64)
            by_joint = given.expand(5) if given.ndim == 0 else given
            matrix = self.camera.matrix
        check_shape("measurement_std", by_joint, [5])
        check_finite("measurement_std", by_joint)
        if bool((by_joint <= 0).any()):
            raise InputError(f"measurement_std must be positive, got {by_joint.tolist()}")
        cov = torch.diag_embed(by_joint.square()[:, None].expand(5, 2))
        if matrix is not None:
            cov = map_pixel_covariance(cov, matrix, self.prior.info.matrix)
        order = [_arm_index(joint) for joint in UPPER_BODY]
        return cov[order]

    def _filter(self, side: str, joints: tuple[str, ...]) -> RecursiveFilter:
        """The filter of an arm that measures these joints."""
        key = "_".join((side, *joints))
        if key not in self.filters:
            self.filters[key] = self._make_filter(side, joints)
        return cast(RecursiveFilter, self.filters[key])

    def _make_filter(self, side: str, joints: tuple[str, ...]) -> RecursiveFilter:
        mixture = getattr(self.prior, side)
        observed = pixel_indices(joints)
        arm = _SIDES[side]
        blocks = [self.measurement_cov[arm[ARM_JOINTS.index(joint)]] for joint in joints]
        options = self._noise_options(side) | self.options
        process_cov = options.pop("process_cov")
        arguments = (mixture, process_cov, torch.block_diag(*blocks), observed)
        try:
            if self.method in _PROPOSALS:
                return BootstrapParticleFilter(
                    *arguments, proposal=_PROPOSALS[self.method], **options
                )
            tracks = self.method.removeprefix("mkf-")
            return MixtureKalmanFilter(*arguments, tracks=tracks, **options)
        except TypeError as error:
            raise InputError(
                f"an option does not fit the method {self.method!r}: {error}"
            ) from error

    def _noise_options(self, side: str) -> dict[str, Any]:
        """Noise and transition that the prior brings, scaled to the frame rate."""
        noise, info = self.prior.noise, self.prior.info
        ratio = 1.0 if not self.fps or not info.fps else info.fps / self.fps
        process_cov = noise.get(f"process_cov_{side}", noise.get("process_cov"))
        if process_cov is None:
            process_cov = default_process_cov(self.prior)
        options: dict[str, Any] = {"process_cov": process_cov * ratio}
        if self.method in _PROPOSALS:
            return options
        options["transition"] = info.transition
        gamma = noise.get(f"gamma_{side}", noise.get("gamma"))
        if gamma is not None and info.transition == "ou":
            options["gamma"] = gamma**ratio
        epsilon = noise.get("uniform_weight")
        if epsilon is not None and self.method == "mkf-fixed":
            options["uniform_weight"] = float(epsilon)
        return options

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
        measured, notes = self._measure(keypoints, confidence, names, mask, lengths, covariance)
        sources = generators_of_arms(generator)
        seen = self._look(measured, lengths)
        arms = {
            side: self._run_arm(side, measured, seen, lengths, source, progress)
            for side, source in zip(_SIDES, sources, strict=True)
        }
        view = None if seen is None else seen.view
        left, right = arms["left"], arms["right"]
        reading = self._steady(self._read_out(left, right, view), left, right, lengths)
        return self._poses(reading, left, right, measured.mask, lengths, notes)

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
            covariance = _checked_covariance(covariance, keypoints)
            covariance = map_pixel_covariance(covariance, own, prior)
        measured = measure_joints(
            keypoints, confidence, mask, picked.indices, self.measurement_cov, covariance
        )
        measured = measured._replace(uv=map_pixels(measured.uv, own, prior))
        if not picked.middle:
            return measured
        return place_measured_neck(measured, self._pixels_per_metre())

    def _pixels_per_metre(self) -> float:
        """Of the prior's camera at its mean pose's neck."""
        depth = float(self.prior.left.moments()[0][14] + self.prior.right.moments()[0][14]) / 2
        return math.sqrt(self.prior.info.fx * self.prior.info.fy) / depth

    def _run_arm(
        self,
        side: str,
        measured: MeasuredJoints,
        seen: SeenInView | None,
        lengths: Tensor | None,
        generator: Generators,
        progress: bool,
    ) -> FilterOutput:
        joints = self._measured_joints(side, measured.mask)
        if seen is not None:
            return self._run_window(side, joints, seen, lengths, progress)
        z, mask, cov = arm_measurements(_SIDES[side], joints, measured)
        model = self._filter(side, joints)
        if self.smoothing is not None and isinstance(model, MixtureKalmanFilter):
            lag = None if self.smoothing == "full" else int(self.smoothing)
            return model.smooth(z, mask, cov, lengths, lag=lag, return_cov=True)
        return model(z, mask, cov, lengths, generator, return_cov=True, progress=progress)

    def _window(self) -> tuple[str, WindowLayout] | None:
        """The window that suits the smoothing asked for: its name, and its lags at this frame rate."""
        if self.method != "mkf-fixed" or not self.window or _POSE_OPTIONS & self.options.keys():
            return None
        name = "causal" if self.smoothing is None else "full"
        if name not in self.prior.windows:
            return None
        layout = self.prior.windows[name].layout.at_rate(self.fps or 30.0)
        too_far = isinstance(self.smoothing, int) and self.smoothing < layout.ahead
        return None if too_far else (name, layout)

    def _look(
        self, measured: MeasuredJoints, lengths: Tensor | None = None, start: int = 0
    ) -> SeenInView | None:
        """The measurements of windows in a virtual camera that follows the body, from a frame on.

        None where no window is used.
        """
        window = self._window()
        if window is None:
            return None
        name, layout = window
        uv, mask, matrix = measured.uv, measured.mask, self.prior.info.matrix.to(measured.uv)
        if lengths is not None:
            frames = torch.arange(mask.shape[1], device=mask.device)
            mask = mask & (frames < lengths.to(mask.device)[:, None])[..., None]
        start = start % mask.shape[1]
        model = self._path_model(uv)
        noise = None
        if measured.cov.ndim > 3:
            noise = _of_anchors(measured.cov)
        else:
            model = model._replace(variance=_of_anchors(measured.cov))
        path = body_path(uv, mask, layout.lags, layout.ahead, layout.fps, model, start, noise)
        neck, height = path.at(0)
        apart = (uv[:, start:, _HANDS] - neck[:, :, None]).norm(dim=-1)
        reach = torch.where(mask[:, start:, _HANDS], apart, torch.zeros_like(apart)).amax(-1)
        view = view_body(neck, height, model, matrix, reach)
        hands = {}
        for side in _SIDES:
            values, known = window_measurements(uv, mask, layout, side, path, start)
            hands[side] = to_view(values, view, matrix).flatten(-2), known.repeat_interleave(2, -1)
        now = to_view(uv[:, start:], view, matrix)
        now = torch.where(mask[:, start:, :, None], now, torch.zeros_like(now))
        cov = measured.cov if measured.cov.ndim == 3 else measured.cov[:, start:]
        log_scale = -view_jacobian(now, view, matrix).det().abs().log()
        return SeenInView(name, MeasuredJoints(now, mask[:, start:], cov), hands, view, log_scale)

    def _path_model(self, like: Tensor) -> PathModel:
        """Head and neck of the prior's mean pose, and their measurement noise."""
        both = (self.prior.left.moments()[0] + self.prior.right.moments()[0]) / 2
        head, neck = both[9:11].to(like), both[12:14].to(like)
        return PathModel(
            neck, head - neck, _of_anchors(self.measurement_cov), self._pixels_per_metre()
        )

    def _run_window(
        self,
        side: str,
        joints: tuple[str, ...],
        seen: SeenInView,
        lengths: Tensor | None,
        progress: bool,
    ) -> FilterOutput:
        """Fixed tracks over window states; the evidence is that of this frame given the window."""
        both, noise, hands = self._window_inputs(side, joints, seen)
        model = self._window_filter(side, seen.window, joints)
        out = model(*both, noise, lengths, return_cov=True, progress=progress)
        context = self._window_filter(side, seen.window, ())(*hands, None, lengths)
        return pose_of_window(out, context, seen, _SIDES[side])

    def _window_inputs(
        self, side: str, joints: tuple[str, ...], seen: SeenInView
    ) -> tuple[tuple[Tensor, Tensor], Tensor, tuple[Tensor, Tensor]]:
        """Values and mask of joints and hands, their R, and values and mask of the hands alone."""
        z, mask, cov = arm_measurements(_SIDES[side], joints, seen.measured)
        hands, known = seen.hands[side]
        hand_cov = self._window_hand_cov(side, seen.window)
        noise = append_blocks(cov, hand_cov, hands.shape[-1] // 2)
        return (torch.cat([z, hands], -1), torch.cat([mask, known], -1)), noise, (hands, known)

    def _window_filter(self, side: str, name: str, joints: tuple[str, ...]) -> MixtureKalmanFilter:
        """Fixed tracks over window states that measure these joints and all hands of the window."""
        key = "_".join(("window", name, side, *joints))
        if key not in self.filters:
            window = self.prior.windows[name]
            arm = _SIDES[side]
            blocks = [self.measurement_cov[arm[ARM_JOINTS.index(joint)]] for joint in joints]
            n_hands = (window.layout.dim - STATE_DIM) // 2
            blocks += [self._window_hand_cov(side, name)] * n_hands
            observed = pixel_indices(joints) + list(range(STATE_DIM, window.layout.dim))
            settings = {"likelihood_power": window.settings["likelihood_power"]}
            # Poses of consecutive frames are tied by the window itself: no memory beyond it.
            self.filters[key] = MixtureKalmanFilter(
                getattr(window, side),
                torch.ones(window.layout.dim, dtype=torch.float64),
                torch.block_diag(*blocks),
                observed,
                transition="ou",
                gamma=0.0,
                weighting="frame",
                **(settings | self.options),
            )
        return cast(MixtureKalmanFilter, self.filters[key])

    def _window_hand_cov(self, side: str, name: str) -> Tensor:
        """Noise of a hand of the window: that of a hand now, and what moving it here adds."""
        std = self.prior.windows[name].settings["hand_std"]
        own = self.measurement_cov[_SIDES[side][0]]
        return own + std**2 * torch.eye(2, dtype=own.dtype, device=own.device)

    def _measured_joints(self, side: str, mask: Tensor) -> tuple[str, ...]:
        """Hand, head and neck, and any other joint of the arm that is measured somewhere."""
        anywhere = mask.flatten(0, 1).any(0)[list(_SIDES[side])].tolist()
        usual = ("hand", "head", "neck")
        return tuple(
            j for j, there in zip(ARM_JOINTS, anywhere, strict=True) if there or j in usual
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
            lengths=lengths,
            matrix=self.camera.matrix,
            failed_at=_first_failure(left, right),
            fps=self.fps,
            frame=self.frame,
            notes=notes,
        )

    def _read_out(self, left: FilterOutput, right: FilterOutput, view: BodyView | None) -> ReadOut:
        info = self.prior.info
        order: RotationOrder = info.rotation_order  # type: ignore[assignment]
        return read_out(left, right, info.matrix.to(left.mean), order, view)

    def _motion_stage(self) -> MotionStage | None:
        """The filter over what windows give, if the prior says how brisk its motions are."""
        window = self._window()
        if window is None or not self.steady:
            return None
        name = window[0]
        settings = self.prior.windows[name].settings
        if "joint_ratio" not in settings:
            return None
        if name not in self.stages:
            joint, pixel, placement = (
                settings[f"{kind}_ratio"] for kind in ("joint", "pixel", "placement")
            )
            stage = MotionStage(joint, pixel, placement, self.fps or 30.0)
            self.stages[name] = stage.to(self.measurement_cov.device)
        return cast(MotionStage, self.stages[name])

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
        failed_at = _first_failure(left, right)
        ends = torch.where(failed_at >= 0, torch.minimum(ends, failed_at.clamp_min(1)), ends)
        lag: int | None = 0
        if self.smoothing is not None:
            lag = None if self.smoothing == "full" else int(self.smoothing) - window[1].ahead
        return stage(reading, ends, lag)

    def _calibrated(self, covs: Tensor) -> Tensor:
        """Covariances recalibrated per joint on the prior's training persons, if it brings that."""
        noise, window = self.prior.noise, self._window()
        mode = "pose" if window is None else window[0]
        scale = noise.get(f"calibration_scale_{mode}")
        floor = noise.get(f"calibration_floor_{mode}")
        if scale is None or floor is None or not self.calibrated:
            return covs
        eye = torch.eye(3, dtype=covs.dtype, device=covs.device)
        return covs * scale.to(covs)[:, None, None] + floor.to(covs)[:, None, None] * eye


def default_process_cov(prior: UpperBodyPrior) -> Float[Tensor, " 21"]:
    """Diagonal of Q per frame where a prior brings none: that of the authors' released tracker.

    They set it by hand for f = 1550 pixels, a person 4.5 m away and 25 frames per second; the same
    movement in metres is f / depth times as many pixels elsewhere.

    Args:
        prior: whose camera, mean depth and frame rate are used.
    """
    depth = prior.left.moments()[0][2:15:3].mean().clamp_min(0.1)
    pixels = math.sqrt(prior.info.fx * prior.info.fy) / depth / (1550 / 4.5)
    released = released_process_cov().to(pixels)
    in_pixels = torch.zeros(STATE_DIM, dtype=torch.bool, device=released.device)
    in_pixels[pixel_indices(ARM_JOINTS)] = True
    scaled = torch.where(in_pixels, released * pixels.square(), released)
    return scaled * (25.0 / (prior.info.fps or 30.0))


def _first_failure(left: FilterOutput, right: FilterOutput) -> Tensor:
    """The first frame at which either arm degenerated, -1 where none did, [B]."""
    n_frames = left.mean.shape[1]
    failures = torch.stack([left.failed_at, right.failed_at])
    first = failures.where(failures >= 0, n_frames).amin(0)
    return torch.where((failures >= 0).any(0), first, -1)


def _checked_covariance(
    covariance: Float[Tensor, "B T J 2 2"], keypoints: Float[Tensor, "B T J 2"]
) -> Float[Tensor, "B T J 2 2"]:
    """The covariances of the keypoints that are there, and the identity for the others."""
    check_shape("covariance", covariance, [*keypoints.shape, 2])
    eye = torch.eye(2).to(keypoints)
    there = keypoints.isfinite().all(-1)[..., None, None]
    covariance = torch.where(there, covariance.to(keypoints), eye)
    check_covariance("covariance", covariance)
    return covariance


def _of_anchors(cov: Float[Tensor, "*batch 8 2 2"]) -> Float[Tensor, "*batch 2"]:
    """Variance of a coordinate of head and neck, pixels squared."""
    return cov[..., [_HEAD, _NECK], :, :].diagonal(dim1=-2, dim2=-1).mean(-1)


def _arm_index(joint: str) -> int:
    """Index in `ARM_JOINTS` of one of the eight joints."""
    return ARM_JOINTS.index(joint.split("_")[0])


def _require_camera(camera: PinholeCamera | None) -> PinholeCamera:
    if camera is None:
        raise CameraError(
            "a camera is needed, got None; pass camera=PinholeCamera(fx, fy, cx, cy), "
            "PinholeCamera.from_image_size(width, height), or prior.camera if it is the same"
        )
    return camera


def _check_settings(
    prior: UpperBodyPrior,
    method: str,
    smoothing: int | str | None,
    frame: str,
    fps: float | None,
) -> None:
    if not isinstance(prior, UpperBodyPrior):
        raise PriorError(
            f"prior must be an UpperBodyPrior, got {type(prior).__name__}; see torchpose.load_prior"
        )
    if method not in METHODS:
        raise InputError(f"method must be one of {', '.join(METHODS)}, got {method!r}")
    if frame not in ("camera", "body"):
        raise InputError(f"frame must be 'camera' or 'body', got {frame!r}")
    if fps is not None and not (fps > 0 and math.isfinite(fps)):
        raise InputError(f"fps must be positive, got {fps}")
    wrong_lag = isinstance(smoothing, int) and smoothing < 0
    if wrong_lag or (isinstance(smoothing, str) and smoothing != "full"):
        raise InputError(f"smoothing must be None, a number of frames or 'full', got {smoothing!r}")
    if smoothing is not None and method != "mkf-fixed":
        raise InputError(f"smoothing needs method 'mkf-fixed', got {method!r}")
