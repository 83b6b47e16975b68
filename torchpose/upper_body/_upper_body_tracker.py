"""Track upper bodies: from 2D keypoints of head, neck and hands to 2D and 3D poses of eight joints."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Unpack

import torch
from jaxtyping import Bool, Float, Integer
from torch import Tensor

from torchpose._core.checks import (
    check_choice,
    check_count,
    check_floating,
    check_shape,
    check_tensors,
    number_of,
    refuse_export,
    refuse_half,
)
from torchpose._core.module_state import (
    WideModule,
    derived,
    one_run,
    register_given,
    wide_or_parameter,
    working_precision,
)
from torchpose._core.stream_settings import StreamSettings, check_settings, settings_of
from torchpose._core.uncompiled import uncompiled
from torchpose.camera._lens import is_distorted
from torchpose.camera._pinhole import PinholeCamera
from torchpose.camera._tilt import angles_of_up
from torchpose.errors import InputError
from torchpose.filters._recursive_filter import Generators, check_generators
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.skeleton._upper_body import NECK_KINDS
from torchpose.upper_body._absence import HANDS, absence_of
from torchpose.upper_body._bridged_gaps import bridged_over_gaps
from torchpose.upper_body._camera_doubts import size_notes
from torchpose.upper_body._estimator import (
    Estimator,
    TrackerModel,
    arm_joints,
    check_model,
    generators_of_arms,
)
from torchpose.upper_body._estimator_table import (
    METHODS,
    check_steady,
    choose_method,
    options_of_window,
)
from torchpose.upper_body._fusion import kept_stage, stage_lag
from torchpose.upper_body._live_pose import (
    LivePose,
    StreamState,
    check_stream,
    check_stream_method,
    joined,
    live_pose,
    returns,
    unseen_frames,
)
from torchpose.upper_body._measured_joints import (
    MeasuredJoints,
    as_lengths,
    check_gaps,
    check_sequences,
    in_prior_pixels,
    joint_covariances,
    kept_turn,
)
from torchpose.upper_body._picked import Picked, pick_joints
from torchpose.upper_body._pose_track import PoseTrack
from torchpose.upper_body._reading import PoseReader, check_frame, note_collapse
from torchpose.upper_body._screen_model import ScreenModel, kept_screen_model
from torchpose.upper_body._screening import screen_joints
from torchpose.upper_body._tracker_options import MethodOptions

_LENS = "the camera's distortions are not applied: undistort keypoints or images beforehand"
_NO_EXPORT = (
    "UpperBodyTracker, which chooses its filters by what was measured,",
    "a step of a filter of torchpose.filters",
)


class UpperBodyTracker(WideModule):
    """Tracks eight joints in 2D and 3D from any of them, typically head and hands.

    Each arm, with head and neck, is estimated from the same measurements (BL section 3.1); head, neck
    and camera of the two are averaged and their covariances bounded, never fused as if they were
    independent. `forward` tracks whole sequences, `init` and `step` live streams.

    The method is an estimator, one of `METHODS` (`register_method` adds others):

    - ``window-mixture``: the prior's mixture over short windows of motion is conditioned on every
      frame and the hands round it, each frame by itself; filters of constant velocity follow. The body
      is seen through a virtual camera that follows it, so that it may move about, farther away or
      beside the views that the prior was fitted to.
    - ``articulated``: arms of bones that keep their lengths, under a prior over directions that
      depends on no camera and no size; for all joints measured, of anybody.
    - ``multiple-model``: both of these, averaged by clues which of them knows the person; for anybody of whom
      few joints are measured.
    - ``mkf-fixed``, ``mkf-sampled``, ``mkf-split``: banks of Kalman filters over single poses (BL
      section 3.4), see `MixtureKalmanFilter`.
    - ``pf-mixture``, ``pf-walk``, ``pf-walk-unscaled``: particles over single poses (BL section 3.3),
      see `BootstrapParticleFilter`.

    A frame passes through five stages, each of which takes and returns values: the keypoints become
    `MeasuredJoints` in the prior's pixels, of which `screen_joints` leaves out outliers, an `Estimator`
    turns them into the `Estimates` of both arms, `read_out` joins these into a `ReadOut` of the body, which
    `MotionStage` steadies, and that becomes `SeenPoses` and a `PoseTrack`. `forward` passes all frames on
    at once, `step` and `advance` some at a time, with the state of each stage. Smoothing over all frames
    puts keypoints into gaps before the estimator (`bridged_over_gaps`).

    Args:
        prior: the prior over upper bodies, from `load_prior` or `fit_upper_body_prior`.
        camera: the camera that took the keypoints. Those of another camera than the prior's are mapped to
            it, and those of a camera that looks up or down or is rolled to a level one, if its `up` tells.
            Its distortions are not applied, which a note says: undistort keypoints or images beforehand.
        method: the name of an estimator, one of `METHODS`. The default depends on what is measured:
            "articulated" where wrists stand for the prior's hands, or an option of bones is given, and
            neither `steady` nor an option of another method is; else "multiple-model" where the prior has
            windows that suit, or "window-mixture" if `steady` or an option of windows is given; else
            "articulated" where both shoulders and an elbow are measured, and "mkf-fixed". The attribute
            `method` is the default for few joints; `PoseTrack.method` is the method that ran.
        measurement_std: the standard deviation of a keypoint in pixels of the camera: one number, or one
            for each of hand, elbow, shoulder, head and neck; by default as the prior learnt it, else 3. Where
            the torso shakes more than that, it is enlarged, unless `outliers` is False.
        fps: the frame rate of the keypoints, by which the process noise is scaled; by default that of
            the prior.
        smoothing: the number of later frames that an estimate may use, "full" for all of them, None or 0 for
            none; only for "multiple-model", "articulated", "window-mixture" and "mkf-fixed". Windows then
            look a few frames ahead. With all of them, keypoints are put into gaps of up to two seconds, on
            the way between both ends; `PoseTrack.observed` is False there, and covariances are larger.
        frame: the axes of the 3D poses: "camera", or "body" for those of the prior's recordings.
        static_camera: whether the body is put in front of a camera that stays at the prior's mean place,
            turned by the estimated rotation, as the authors' released demo does.
        window: deprecated; False stands for method "mkf-fixed", True for "window-mixture" where the prior
            has windows that suit.
        steady: whether filters of constant velocity (`MotionStage`), or smoothers with `smoothing`, remove
            the jitter of poses from windows; by default where a method has windows. False leaves them
            out of "multiple-model" too.
        calibrated: whether `covariance3d` is recalibrated by factors that the prior's training persons
            showed, if the prior has them.
        neck: the kind of neck of the keypoints, where their names do not tell it: "neck", "low-neck" or
            "mid-shoulder". A neck of another kind than the prior's is put where the
            prior has it, between the middle of the shoulders and the head, or else not measured.
        max_gap: the longest time without any keypoint, seconds; None for no bound. Longer ones in recordings
            are refused, and live streams begin anew after them.
        outliers: whether keypoints that belong to no body count as missing, and exchanged hands are
            exchanged back, frame by frame. False takes keypoints as they are.
        **options: the options of the method (`torchpose.upper_body.method_options`), such as
            n_particles, n_tracks, uniform_weight or transition.

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
        outliers: bool = True,
        **options: Unpack[MethodOptions],
    ) -> None:
        super().__init__()
        self.camera = check_model(prior, camera, fps)
        check_frame(frame, static_camera)
        if window is not None:
            method, steady = options_of_window(method, window, steady)
        self.prior = prior
        self.fps = fps or prior.info.fps
        if smoothing == 0 and not isinstance(smoothing, bool):
            smoothing = None
        of_windows = steady is not None or window is not None
        self._chosen = choose_method(prior, method, smoothing, self.fps, options, of_windows)
        self.method, self.notes = self._chosen.method, self._chosen.notes
        distorted = is_distorted(self.camera.distortions, self.camera.fisheye)
        self._lens_notes = (_LENS,) if distorted else ()
        self.smoothing = smoothing
        self.calibrated = calibrated
        self.frame = frame
        self.static_camera = static_camera
        if neck is not None:
            check_choice("neck", neck, NECK_KINDS)
        self.neck = neck
        if max_gap is not None and not number_of(max_gap) >= 0:
            raise InputError(
                f"max_gap must be at least 0 seconds, or None for no bound, got {max_gap!r}"
            )
        self.max_gap = max_gap
        self.outliers = outliers
        self.dtype = working_precision("dtype", options.get("dtype", torch.float64))
        register_given(self, "measurement_std", wide_or_parameter(measurement_std))
        self.options: dict[str, Any] = {**options}
        self._unsteady = steady is False
        for name, value in self.options.items():
            if isinstance(value, Tensor):
                register_given(self, name, wide_or_parameter(value))
        estimator = self.estimator
        self.steady = check_steady(steady, estimator, self.method)
        estimator.check()

    measurement_std: Tensor | None

    @property
    def measurement_cov(self) -> Float[Tensor, "8 2 2"]:
        """Return R of each of the eight joints, the prior's pixels."""
        info, learnt = self.prior.info, getattr(self.prior, "noise_measurement_std", None)
        sources = (self.measurement_std, learnt, self.camera.matrix)
        return derived(
            self,
            ("measurement_cov", info.fx, info.fy, info.cx, info.cy),
            sources,
            lambda: joint_covariances(self.prior, self.measurement_std, self.camera.matrix),
        )

    @property
    def given_options(self) -> dict[str, Any]:
        """Return the options of the method, with tensors as they are registered."""
        return {name: getattr(self, name, value) if isinstance(value, Tensor) else value
                for name, value in self.options.items()}  # fmt: skip

    @property
    def estimator(self) -> Estimator:
        """Return the estimator of the method, on prior, noise and options as they are now."""
        return self._estimator_of(self.method, self.measurement_cov)

    def _estimator_of(self, method: str, cov: Tensor, picked: Picked | None = None) -> Estimator:
        """Return the estimator of a method for these keypoints; without `picked` for the prior's joints."""
        make: Callable[..., Estimator] = METHODS[method]
        model = TrackerModel(
            self, self.prior, cov, self.fps, self.smoothing,
            calibrated=self.calibrated, steadied=not self._unsteady,
            pitch=None if self.camera.up is None else angles_of_up(self.camera.up)[0],
        )  # fmt: skip
        if picked is not None:
            model = model._replace(hand=picked.hand, middle=(picked.middle, picked.middle_alone))
        return make(model, **self.given_options)

    @uncompiled
    def forward(
        self,
        keypoints: Float[Tensor, "B T J 2"],
        confidence: Float[Tensor, "B T J"] | None = None,
        names: Sequence[str] | None = None,
        mask: Bool[Tensor, "B T J"] | None = None,
        generator: Generators = None,
        lengths: Integer[Tensor, " B"] | Sequence[int] | None = None,
        progress: bool = False,
        covariance: Float[Tensor, "B T J 2 2"] | None = None,
        absent: Float[Tensor, "B T J"] | None = None,
    ) -> PoseTrack:
        """Track a batch of sequences.

        Args:
            keypoints: [B, T, J, 2], pixels of the camera; NaN where one is missing, or exactly (0, 0) or
                (-1, -1), as many detectors write.
            confidence: [B, T, J], 0 to 1, by which the measurement covariance is divided, and by which a
                keypoint may be an outlier (docs/mathematics.md, "Outliers"); 0 or NaN where it is missing. Up
                to 2 it counts as 1, as of peaks of heat maps.
            names: the names of the J joints, in any order and spelling of `torchpose.skeleton`;
                may be left out if J = 8 and they are in the order of `UPPER_BODY`. Nose, eyes and ears
                tell "articulated" where the body faces.
            mask: [B, T, J], False where the keypoint is to be ignored.
            generator: the generator of methods that draw, or a list of one for each sequence.
            lengths: [B], the number of frames of each sequence. progress: whether to show a bar.
            covariance: [B, T, J, 2, 2], the covariance of each keypoint in pixels squared, in place of
                `measurement_std`; that of a keypoint that is missing or none of the eight joints is
                ignored. Frames with the same
                covariances share work.
            absent: [B, T, J], the probability that a missing hand cannot be seen, because it is hidden or
                outside of the image, as a detector has it at even odds; NaN where nothing is known. A hand
                is then expected beyond the borders of the image rather than in it, by "multiple-model",
                "articulated" and "window-mixture", whose log-evidence includes it. Needs a camera with the
                size of its image.

        Returns:
            `PoseTrack`.

        Raises:
            ShapeError, InputError: wrong shapes, infinite values, half precision, shares of the image in
            place of pixels, nothing measured in a sequence or for longer than `max_gap`.
            SkeletonError: unknown names.
        """
        refuse_export(*_NO_EXPORT)
        cov = self.measurement_cov
        with one_run(cov.device):
            check_tensors(keypoints=keypoints)
            keypoints = check_sequences(keypoints).to(cov)
            check_generators(generator, len(keypoints))
            picked = self._pick(keypoints.shape[2], names)
            if lengths is not None:
                lengths = as_lengths(lengths, *keypoints.shape[:2])
            given = self._measure(keypoints, confidence, mask, covariance, absent, picked, cov)
            check_gaps(given.mask, lengths, self.max_gap, self.fps or 30.0)
            there = given.mask.flatten(0, 1).any(0).tolist()
            reader = self._reader(there, picked, cov)
            _, found = screen_joints(self._screen(picked, cov), None, given)
            if self._sees_all(keypoints.shape[1]):
                bridged = bridged_over_gaps(found.measured, lengths, self.fps or 30.0)
                found = found._replace(measured=bridged)
            arms = generators_of_arms(generator)
            estimates = reader.estimator.forward(
                found.measured, arm_joints(there), arms, lengths, progress
            )
            _, track = reader.read(None, estimates, found, lengths)
            if self.outliers:
                more = size_notes(self.camera, keypoints, given.mask, picked.indices)
                track = replace(track, notes=track.notes + more)
        return note_collapse(track.in_precision(self.dtype))

    if TYPE_CHECKING:  # nn.Module has Any
        __call__ = forward

    @uncompiled
    def init(
        self, batch_size: int, names: Sequence[str] | None = None, generator: Generators = None
    ) -> StreamState:
        """Begin to track live streams, frame by frame (`step`).

        Args:
            batch_size: B, the number of streams, which begin together; where people come and go, begin one
                for each of them. names: the names of the keypoints, as in `forward`; any of them may be
                missing in any frame. generator: as in `forward`; the state holds it.

        Returns:
            `StreamState` before the first frame. Its `notes` say what is assumed, such as that wrists stand
            for hands or that the camera's distortions are not applied.

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
        self._refuse_smoothing()
        check_count("batch_size", batch_size)
        check_generators(generator, batch_size)
        n_keypoints = len(UPPER_BODY) if names is None else len(names)
        picked = self._pick(n_keypoints, names)
        cov = self.measurement_cov
        with one_run(cov.device):
            reader = self._reader(picked.there, picked, cov)
            joints, arms = arm_joints(picked.there), generators_of_arms(generator)
            state = reader.estimator.init(batch_size, joints, arms)
        unseen = torch.zeros(batch_size, dtype=torch.long, device=cov.device)
        return StreamState(
            state, None, unseen, n_keypoints, picked, method=reader.method, settings=self._settings,
            notes=reader.notes, away=unseen, first=state,
        )  # fmt: skip

    @uncompiled
    def step(
        self,
        state: StreamState,
        keypoints: Float[Tensor, "B J 2"],
        confidence: Float[Tensor, "B J"] | None = None,
        mask: Bool[Tensor, "B J"] | None = None,
        covariance: Float[Tensor, "B J 2 2"] | None = None,
        absent: Float[Tensor, "B J"] | None = None,
    ) -> tuple[StreamState, LivePose]:
        """Track one more frame of each stream: the same numbers as that frame of `forward`.

        A camera does not stop, so `max_gap` raises nothing here: while nothing is measured the prior
        fills in, covariances grow, and `LivePose.unseen` says for how long it has been so. Whoever comes
        after more than `max_gap` may be somebody else, and the stream begins anew; several streams of a
        state do once all of them have shown nobody for so long. Frames that were dropped are to be passed as
        missing (NaN), since a step is one frame at `fps`.
        Keypoints of a network are to be detached, or the state holds the graph of all frames before.

        Args:
            state: the state from `init` or the step before; it is not changed, so a step may be repeated
                (but a generator goes on).
            keypoints, confidence, mask, covariance, absent: the measurements of one frame, as in
                `forward`, without T.

        Returns:
            The next state, and the `LivePose` of this frame.

        Raises:
            ShapeError, InputError: wrong shapes, infinite values, a tracker that smooths, or a state of
            another method, or of a tracker of another frame rate, prior or option.
        """
        check_stream(state)
        given = {"confidence": confidence, "mask": mask, "covariance": covariance, "absent": absent}
        check_tensors(keypoints=keypoints, **given)
        sizes = [len(state.unseen), state.n_keypoints]
        check_shape("keypoints", keypoints, [*sizes, 2])
        for name, value in (("confidence", confidence), ("mask", mask)):
            if value is not None:
                check_shape(name, value, sizes)
        of_frame = (None if x is None else x[:, None] for x in given.values())
        state, track = self.advance(state, keypoints[:, None], *of_frame)
        return state, live_pose(track, state.unseen / (self.fps or 30.0))

    @uncompiled
    def advance(
        self,
        state: StreamState,
        keypoints: Float[Tensor, "B T J 2"],
        confidence: Float[Tensor, "B T J"] | None = None,
        mask: Bool[Tensor, "B T J"] | None = None,
        covariance: Float[Tensor, "B T J 2 2"] | None = None,
        absent: Float[Tensor, "B T J"] | None = None,
    ) -> tuple[StreamState, PoseTrack]:
        """Track some more frames of each stream: the same numbers as `step` for one after the other.

        Long recordings are tracked so in bounded memory, and quicker than frame by frame.

        Args:
            state: as in `step`. keypoints, confidence, mask, covariance, absent: the measurements of
                these frames, as in `forward`.

        Returns:
            The next state, and the poses of these frames.

        Raises:
            ShapeError, InputError: wrong shapes, no frames, infinite values, a tracker that smooths, or a
            state of another method, or of a tracker of another frame rate, prior or option.
        """
        refuse_export(*_NO_EXPORT)
        check_stream(state)
        self._refuse_smoothing()
        check_tensors(keypoints=keypoints)
        check_floating("keypoints", keypoints)
        refuse_half("keypoints", keypoints)
        check_shape("keypoints", keypoints, [len(state.unseen), "T", state.n_keypoints, 2])
        if keypoints.shape[1] == 0:
            raise InputError("keypoints must hold at least one frame, got none")
        cov = self.measurement_cov
        with one_run(cov.device):
            keypoints = keypoints.to(cov)
            given = self._measure(
                keypoints, confidence, mask, covariance, absent, state.picked, cov
            )
            there = given.mask.any(-1)
            back = self._returns(state, there)
            if back and back[-1] > 0:
                others = confidence, mask, covariance, absent
                return self._in_two(state, keypoints, others, back[-1])
            if back:
                state = state.anew()
            reader = self._reader(state.picked.there, state.picked, cov)
            check_stream_method(state, reader.method)
            check_settings(state.settings, self._settings)
            screen, found = screen_joints(self._screen(state.picked, cov), state.screen, given)
            own, estimates = reader.estimator.advance(state.estimator, found.measured)
            motion, track = reader.read(state.motion, estimates, found)
        unseen = unseen_frames(state.unseen, found.measured.mask.any(-1))
        away = None if state.away is None else unseen_frames(state.away, there)
        state = state._replace(
            estimator=own, motion=motion, unseen=unseen, screen=screen, away=away
        )
        return state, track.in_precision(self.dtype)

    def _returns(self, state: StreamState, there: Bool[Tensor, "B T"]) -> list[int]:
        """Return the frames in which streams begin anew."""
        if self.max_gap is None or state.away is None:
            return []
        return returns(state.away, there, self.max_gap * (self.fps or 30.0))

    def _in_two(
        self,
        state: StreamState,
        keypoints: Tensor,
        others: Sequence[Tensor | None],
        frame: int,
    ) -> tuple[StreamState, PoseTrack]:
        """Return `advance` of the frames before one, and then of it and those that follow."""
        earlier, later = (
            [None if other is None else other[:, rows] for other in others]
            for rows in (slice(frame), slice(frame, None))
        )
        state, before = self.advance(state, keypoints[:, :frame], *earlier)
        state, after = self.advance(state, keypoints[:, frame:], *later)
        return state, joined(before, after)

    def _refuse_smoothing(self) -> None:
        """Raise `InputError` where later frames are asked for, which streams do not have."""
        if self.smoothing is not None:
            raise InputError(
                "frame by frame an estimate cannot use later frames: expected smoothing=None, got "
                f"{self.smoothing!r}"
            )

    @property
    def _settings(self) -> StreamSettings:
        """Return the settings on which the meaning of a stream's state depends."""
        own = {"fps": self.fps, "steady": not self._unsteady, "outliers": self.outliers}
        return settings_of(
            {"prior": self.prior.info.name, **own, "neck": self.neck, **self.options}
        )

    def _sees_all(self, n_frames: int) -> bool:
        """Return whether every estimate of a sequence may use all of its frames."""
        if isinstance(self.smoothing, int):
            return self.smoothing >= n_frames - 1
        return self.smoothing is not None

    def _notes_of(self, method: str, estimator: Estimator, picked: Picked) -> tuple[str, ...]:
        """Return the notes about the choice of the method and about the kinds of neck and hands."""
        chosen = self.notes if method == self.method else ()
        return self._lens_notes + chosen + picked.notes + picked.hand_notes(estimator.knows_wrists)

    def _pick(self, n_keypoints: int, names: Sequence[str] | None) -> Picked:
        info = self.prior.info
        return pick_joints(n_keypoints, names, self.neck, info.neck, info.hand)

    def _measure(
        self,
        keypoints: Tensor,
        confidence: Tensor | None,
        mask: Tensor | None,
        covariance: Tensor | None,
        absent: Tensor | None,
        picked: Picked,
        measurement_cov: Float[Tensor, "8 2 2"],
    ) -> MeasuredJoints:
        check_tensors(confidence=confidence, mask=mask, covariance=covariance, absent=absent)
        if mask is not None and mask.dtype != torch.bool:
            raise InputError(
                f"mask must be bool (True = measured), got {mask.dtype}; `confidence` says how sure"
            )
        measured = in_prior_pixels(
            keypoints, confidence, mask, covariance, picked, self.prior, self.camera,
            measurement_cov,
        )  # fmt: skip
        if absent is None:
            return measured
        check_shape("absent", absent, list(keypoints.shape[:3]))
        places = [picked.indices[row] for row in HANDS]
        hands = absent[:, :, [max(place, 0) for place in places]].to(measured.uv)
        unknown = torch.tensor([place < 0 for place in places], device=hands.device)
        hands = hands.masked_fill(unknown, torch.nan)
        turn = kept_turn(self.camera, self.prior)
        absence = absence_of(hands, self.camera, self.prior.info.matrix, turn)
        return measured._replace(absence=absence)

    def _screen(self, picked: Picked, cov: Tensor) -> ScreenModel | None:
        """Return the model of the outlier screening; None if keypoints are taken as they are."""
        given = (self.prior, self.camera, self.fps, picked, cov)
        return kept_screen_model(self, *given) if self.outliers else None

    def _reader(self, there: Sequence[bool], picked: Picked, cov: Tensor) -> PoseReader:
        """Return the reader of poses, with the estimator of the method for these joints.

        Args:
            there: whether each of the eight joints is measured. picked: their places among the keypoints.
            cov: `measurement_cov`.
        """
        method = self._chosen.with_joints(there, picked.wrists_for_hands)
        estimator = self._estimator_of(method, cov, picked)
        stage, ratios = None, estimator.steadied_by
        if self.steady and ratios is not None:
            stage = kept_stage(self, ratios, self.fps or 30.0, cov)
        lag = stage_lag(self.smoothing, estimator.ahead)
        return PoseReader(
            self.prior, self.camera, method, estimator, stage, lag, self.frame,
            self.static_camera, self.calibrated, self.fps, self._notes_of(method, estimator, picked),
        )  # fmt: skip
