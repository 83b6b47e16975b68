"""Track whole bodies: from keypoints or silhouettes in calibrated cameras to the poses of one person."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Unpack, overload

import torch
from jaxtyping import Bool, Float, Integer
from torch import Tensor

from torchpose._core.checks import check_tensors, check_tracked_rate
from torchpose._core.facade import set_up_facade
from torchpose._core.former_arguments import takes_former_arguments
from torchpose._core.module_state import OwnPrecisionModule, as_one_run
from torchpose._core.moved import warn_of_former
from torchpose._core.stream_settings import StreamSettings, check_settings, settings_of
from torchpose._core.uncompiled import uncompiled
from torchpose.body._kinematics import Body
from torchpose.camera._choice import check_room
from torchpose.camera._rig import CameraRig, Cameras, as_rig, centres_of_cameras
from torchpose.errors import InputError
from torchpose.priors._actions.bank import ActionBank
from torchpose.priors._actions.space import ActionSpace
from torchpose.priors._body_motion import BodyMotion
from torchpose.priors._limb_conditionals import LimbConditionals
from torchpose.priors._manifold.gplvm import BackConstrainedGPLVM
from torchpose.whole_body._body_arguments import (
    check_facing,
    check_filters_one,
    check_kind,
    check_not_refined,
    check_person,
    given_of,
    keypoints_alone,
    method_for,
    refuse,
)
from torchpose.whole_body._body_track import BodyTrack, load_body
from torchpose.whole_body._filter_table import BodyTrackerOptions
from torchpose.whole_body._filters.body_particles import BodyFilterState
from torchpose.whole_body._filters.motion import std_of_covariance
from torchpose.whole_body._keypoints.camera_tilt import CameraTilt, find_camera_tilt
from torchpose.whole_body._keypoints.keypoint_body_tracker import KeypointBodyTracker, LiveBody
from torchpose.whole_body._keypoints.people_body_tracker import LivePeople, PeopleBodyTracker
from torchpose.whole_body._keypoints.track_builder import KEYPOINT_METHOD
from torchpose.whole_body._measured_keypoints import GivenKeypoints, given_keypoints
from torchpose.whole_body._particle_follower import ParticleFollower, set_up_particles

_N_PARTICLES = 1000


class BodyStream(NamedTuple):
    """Holds the state of `BodyTracker.step` between two frames.

    Attributes:
        filter: state of the filter; None before the first keypoints. frame: number of the next frame.
        generator: of random numbers. names: of the keypoints of every frame that states none.
        settings: of the tracker whose state it is, as far as the numbers depend on them; None if they are not
            known.
    """

    filter: BodyFilterState | LiveBody | LivePeople | None
    frame: int
    generator: torch.Generator | None
    names: tuple[str, ...] | None = None
    settings: StreamSettings | None = None


class BodyTracker(OwnPrecisionModule):
    """Tracks one person's whole body through keypoints or silhouettes of calibrated cameras, in 3D.

    `forward` tracks a whole sequence and finds the first pose by itself; `init` and `step` track live,
    `advance` (of particle filters) some frames at a time, with the same numbers.

    Every method takes the keypoints of any detector, in one camera or more. ``kalman`` is an iterated
    extended Kalman filter over root, rotations, their velocities and bone lengths, in which every keypoint
    is its joint's, that of the other side, or nobody's (docs/keypoint-bodies.md). The other methods are
    particle filters, and take silhouettes, keypoints, or both, whose log-likelihoods add:

    - ``mrpf``: also weighted by the distance from a manifold of poses of the same action
      (`ManifoldParticleFilter`); needs `manifold`.
    - ``apf``: annealed, five layers from a broad to a peaked likelihood (`AnnealedParticleFilter`).
    - ``sir``: drawn, weighted, resampled (`SIRParticleFilter`).
    - ``root``: a Gaussian per limb for every hypothesis of the root (`RootUncertaintyTracker`); needs
      `conditionals`.
    - ``constrained``: only postures of a known action, or of several (`ConstrainedParticleFilter`);
      needs `action`.

    Args:
        cameras: a `CameraRig`, or what makes one; silhouettes are undistorted, keypoints are as detected.
        method: "kalman", or a name of `torchpose.whole_body.METHODS`; by default that of the model given,
            else "apf".
        body: the person's body, or a body.npz (`BodyTrack`) whose bone lengths and shape the person has,
            in place of a height.
        height: the height of the person, metres; by default 1.75 with silhouettes, and estimated from
            keypoints.
        manifold: the poses of an action, by a name that `torchpose info` lists, or a file; in Python also
            the model itself. Every method finds the first pose with it.
        conditionals: the rotations of limbs relative to each other and over time, by name, or a file.
        action: the postures of an action, or of several, by name, or a file.
        n_particles: the number of likelihoods computed in a frame, all layers together; a hypothesis of
            "root" counts seven.
        fps: the number of frames per second; noise grows with the time between frames.
        process_cov: the variances of the diffusion per frame [D], or [D, D] without entries off the
            diagonal, in squares of metres for the root and of sines of half angles for rotations; by
            default what suits the method.
        initial_cov: the variances of the particles about the first pose, as `process_cov`; by default
            four times those.
        keypoint_std: how far a detector's joints are from the body's, metres along each axis (default
            0.012, with one camera 0.03); keypoints of low confidence are farther. pixel_std: the same in
            pixels, on top of it (default 1).
        motion: of "kalman", how bodies move, a name that `torchpose info` lists, or a file of `torchpose
            fit body`; in Python also the `BodyMotion` itself.
        up: of "kalman", "y" or "z", the axis of the world that points up; people are then expected upright.
            By default one camera is taken to be about level, and of several nothing is expected.
        camera_height: of "kalman", the height of the only camera above the floor, metres, by which feet on
            the floor tell the size of the person and the distance; needs `up`.
        **options: the options of the method's filter (`torchpose.whole_body._filter_table.method_options`),
            such as sharpness, limits, leg_swap or n_layers.

    Attributes:
        filter: the filter that runs on silhouettes. method: its name.
        upright: the body with which the first pose is found.

    Raises:
        InputError: an unknown method, a model or an option that it does not use, both a body and a height,
            too few particles.
        PriorError: no such model, or one of another skeleton or frame rate.
        CameraError: no cameras, two with the same pose, or some farther away than any room is large.

    Example:
        >>> import torch, torchpose
        >>> from torchpose.body import BODY_15, Body
        >>> from torchpose.camera import PinholeCamera
        >>> from torchpose.whole_body import render
        >>> camera = PinholeCamera(
        ...     80, 80, 39.5, 29.5, 80, 60, rotation=(torch.pi, 0, 0), translation=(0, 0, 3)
        ... )
        >>> standing = torch.zeros(36, dtype=torch.float64)
        >>> silhouettes = render(Body.of_height(BODY_15, 1.8), standing.expand(3, -1), camera, 60, 80)
        >>> tracker = torchpose.BodyTracker(camera, "sir", height=1.8, n_particles=50)
        >>> poses = tracker(silhouettes, standing, generator=torch.Generator().manual_seed(0))
        >>> poses.joints3d.shape
        torch.Size([3, 15, 3])
    """

    cameras: CameraRig

    def __init__(
        self,
        cameras: Cameras,
        method: str | None = None,
        *,
        body: Body | str | Path | None = None,
        height: float | None = None,
        manifold: BackConstrainedGPLVM | str | Path | None = None,
        conditionals: LimbConditionals | str | Path | None = None,
        action: ActionSpace | ActionBank | str | Path | None = None,
        n_particles: int = _N_PARTICLES,
        fps: float = 60.0,
        process_cov: Tensor | None = None,
        initial_cov: Tensor | None = None,
        keypoint_std: float | None = None,
        pixel_std: float | None = None,
        motion: BodyMotion | str | Path | None = None,
        up: str | None = None,
        camera_height: float | None = None,
        **options: Unpack[BodyTrackerOptions],
    ) -> None:
        super().__init__()
        check_tracked_rate(fps)
        check_person(body, height)
        check_kind("motion", motion, BodyMotion)
        given = given_of({"manifold": manifold, "conditionals": conditionals, "action": action})
        of_kalman = given_of({"motion": motion, "up": up, "camera_height": camera_height})
        of_particles = given_of({
            "process_cov": process_cov, "initial_cov": initial_cov,
            "n_particles": None if n_particles == _N_PARTICLES else n_particles,
        })  # fmt: skip
        rig = as_rig(cameras)
        check_room(rig)
        method = method_for(method, given, of_kalman, [*options, *of_particles])
        self.method, self.fps, self.cameras = method, float(fps), rig
        self.notes: tuple[str, ...] = ()
        person = body if body is None or isinstance(body, Body) else load_body(body)
        self._settings = settings_of({
            "method": method, "fps": self.fps, "cameras": _in_words(rig),
            "body": None if person is None else f"{person.height:.4f} m", "height": height,
            "n_particles": n_particles, "keypoint_std": keypoint_std, "pixel_std": pixel_std,
            **of_kalman, **given, **options,
        })  # fmt: skip
        self.by_keypoints: KeypointBodyTracker | None = None
        if method == KEYPOINT_METHOD:
            self.n_particles = 0
            self.by_keypoints = KeypointBodyTracker(
                rig, fps, body=person, height=height, keypoint_std=keypoint_std,
                pixel_std=pixel_std, **of_kalman,
            )  # fmt: skip
            return
        self.n_particles = n_particles
        self._by_particles = set_up_particles(
            method, rig, given, person, height, self.fps, n_particles,
            {**options, **given_of({"process_cov": process_cov})}, (keypoint_std, pixel_std),
        )  # fmt: skip
        self._register(self._by_particles, initial_cov)

    def _register(self, follower: ParticleFollower, initial_cov: Tensor | None) -> None:
        """Hold what is to move with the tracker."""
        self.filter, self.notes = follower.filter, follower.notes
        self._upright, self._search = follower.start_body, follower.start_prior
        std = None
        if initial_cov is not None:
            std = std_of_covariance("initial_cov", initial_cov, self.body.dim)
        self.register_buffer("_initial_std", std, persistent=std is not None)

    _initial_std: Tensor | None

    @property
    def body(self) -> Body:
        """Return the body that is tracked, in the frame and about the centres that the method needs."""
        return self.filter.body  # type: ignore[return-value]

    @property
    def upright(self) -> Body:
        """Return the person's body on which the first pose is looked for."""
        return self._by_particles.upright

    @property
    def process_cov(self) -> Float[Tensor, " D"]:
        """Return the variances of the diffusion per frame."""
        return self.filter.process_cov

    @property
    def initial_cov(self) -> Float[Tensor, " D"]:
        """Return the variances of the particles about the first pose."""
        std = self.filter.start_std() if self._initial_std is None else self._initial_std
        return std.square()

    @property
    def initial_std(self) -> Float[Tensor, " D"]:
        """Return the square root of `initial_cov`; deprecated."""
        warn_of_former("BodyTracker.initial_std is the root of initial_cov; it goes")
        return self.initial_cov.sqrt()

    @uncompiled
    @takes_former_arguments
    @torch.no_grad()
    @as_one_run
    def forward(
        self,
        silhouettes: Iterable[Bool[Tensor, "C H W"]] | None = None,
        initial_state: Float[Tensor, " D"] | None = None,
        *,
        keypoints: Float[Tensor, "*B T C J 2"] | None = None,
        confidence: Float[Tensor, "*B T C J"] | None = None,
        names: Sequence[str] | None = None,
        covariance: Float[Tensor, "*B T C J"] | None = None,
        persons: str | int | None = None,
        smoothing: str = "none",
        refine: str = "none",
        generator: torch.Generator | None = None,
        lengths: Integer[Tensor, " S"] | None = None,
        facing: Float[Tensor, "3"] | None = None,
        n_frames: int | None = None,
        progress: bool = False,
    ) -> BodyTrack | list[BodyTrack]:
        """Track one person from the first frame whose silhouettes all show a person, or that has keypoints.

        Args:
            keypoints: [T, C, J, 2], pixels as detected; NaN where there is none, or exactly (0, 0) or
                (-1, -1), as many detectors write. "kalman" takes [B, T, C, J, 2] as well, and of these
                arguments only the first seven, `lengths` and `progress`. With `persons` [T, C, D, J, 2], of
                D detections in each camera, in any order, NaN where there are fewer.
            confidence: [..., C, J], from 0 (no keypoint) to 1; all 1 by default.
            names: of the J joints, of any known set; those of `BODY_15` by default.
            covariance: [..., C, J], variance along u and v, pixels squared, in place of the usual noise.
            persons: of "kalman", "all" tracks everybody, a number so many persons at most at a time. Which
                detection is whose is decided, and ``details["detection"]`` [T, C] tells it, -1 where a camera
                has none.
            smoothing: of "kalman", "full" lets later frames count too; "none" filters.
            refine: of "kalman", "delays", "extrinsics" or "both" of the cameras are estimated first; of one
                recording in two cameras or more. `details` then hold `camera_delays` [T, C], the frames by
                which cameras began too early, `camera_rotation` (Rodrigues) and `camera_translation`
                [T, C, 3], and `camera_errors_std` [T, C, 7] of rotation (radians), shift (metres) and delay
                (frames).
            silhouettes: bool [T, C, H, W], or frames [C, H, W] one after the other, of which memory then
                holds those that the first pose is found in, and one more.
            initial_state: the pose before that frame [D], of `body`; found in half a second of frames
                if None, in keypoints by the Kalman smoother, else in silhouettes (`find_first_pose`).
            generator: the generator of random numbers.
            lengths: [1], the number of frames of the sequence, if they are fewer, of keypoints
                [B, T, C, J, 2] [B]; past them the last pose is repeated, and nothing there counts.
            facing: [3], the direction in which the person looks at first, world axes, if it is known and the
                first pose is found in silhouettes.
            n_frames: the expected number of frames, for the bar. progress: whether to show one.

        Returns:
            `BodyTrack`, from frame `first_frame`; of keypoints [B, T, ...] a list of B, and with `persons` a
            list of all persons, whose ``details["person"]`` [T] counts them from 1 in the order in which
            they were found.

        Raises:
            NobodySeenError: by all cameras in any frame, or too few keypoints. InputError: silhouettes that
            are not bool, or lengths outside 1..T.
            ShapeError, CameraError: of other sizes than the cameras' images.
        """
        if self.by_keypoints is not None:
            check_tensors(keypoints=keypoints, confidence=confidence, covariance=covariance)
            keypoints = keypoints_alone(self.method, silhouettes, keypoints)
            self._refuse_given(
                initial_state=initial_state, generator=generator, facing=facing, n_frames=n_frames
            )
            options: dict[str, Any] = {
                "covariance": covariance, "smoothing": smoothing, "progress": progress
            }  # fmt: skip
            if persons is None:
                return self.by_keypoints(
                    keypoints, confidence, names, refine=refine, lengths=lengths, **options
                )
            check_not_refined(refine)
            refuse(given_of({"lengths": lengths}), "with persons")
            people = PeopleBodyTracker(self.by_keypoints, persons)
            return people.forward(keypoints, confidence, names, **options)
        check_filters_one(self.method, smoothing, refine, persons)
        check_facing(facing, initial_state, keypoints)
        given = given_keypoints(keypoints, confidence, names, covariance)
        return self._by_particles.track(
            silhouettes, given, initial_state, self.initial_cov, generator,
            facing=facing, lengths=lengths, n_frames=n_frames, progress=progress,
        )  # fmt: skip

    @uncompiled
    @takes_former_arguments
    @torch.no_grad()
    @as_one_run
    def init(
        self,
        silhouettes: Bool[Tensor, "T C H W"] | None = None,
        initial_state: Float[Tensor, " D"] | None = None,
        *,
        keypoints: Float[Tensor, "T C J 2"] | None = None,
        confidence: Float[Tensor, "T C J"] | None = None,
        names: Sequence[str] | None = None,
        covariance: Float[Tensor, "T C J"] | None = None,
        generator: torch.Generator | None = None,
        facing: Float[Tensor, "3"] | None = None,
    ) -> BodyStream:
        """Begin to track a live stream, whose first frame is the first of these, or the one after a pose.

        A stream of "kalman" begins with the first frame that has enough keypoints, and needs no argument.
        `names` given here hold for all frames.

        Args:
            silhouettes: bool, half a second in which the first pose is found; they are to be tracked
                afterwards, with `step` or `advance`.
            keypoints, confidence, names, covariance: of half a second, as in `forward`; the first pose is
                then found in them. initial_state: the pose before the first frame [D], of
                `body`, instead. generator: of random numbers; the state holds it. facing: as in `forward`.

        Returns:
            `BodyStream` before the first frame.

        Raises:
            InputError: neither silhouettes nor a pose, nobody seen in the first frame, what "kalman" does not
            use. ShapeError, CameraError: as `forward`.
        """
        if self.by_keypoints is not None:
            self._refuse_given(
                silhouettes=silhouettes, initial_state=initial_state, generator=generator,
                facing=facing,
            )  # fmt: skip
            return BodyStream(None, 0, None, _names(names), self._settings)
        check_facing(facing, initial_state, keypoints)
        if initial_state is None:
            if silhouettes is None and keypoints is None:
                raise InputError(
                    "tracking begins with silhouettes, keypoints or an initial_state, got none"
                )
            given = given_keypoints(keypoints, confidence, names, covariance)
            frames = list(self._by_particles.observed(silhouettes, given)[0])
            if not frames:
                raise InputError("a first pose needs a frame of silhouettes, got none")
            initial_state = self._by_particles.first_state(frames, generator, facing)
        first = self._by_particles.begin(initial_state, self.initial_cov, generator)
        return BodyStream(first, 0, generator, _names(names), self._settings)

    @overload
    def step(
        self,
        state: BodyStream,
        silhouettes: Bool[Tensor, "C H W"] | None = None,
        *,
        keypoints: Tensor | None = None,
        confidence: Tensor | None = None,
        names: Sequence[str] | None = None,
        covariance: Tensor | None = None,
        persons: None = None,
    ) -> tuple[BodyStream, BodyTrack]: ...

    @overload
    def step(
        self,
        state: BodyStream,
        *,
        keypoints: Tensor | None = None,
        confidence: Tensor | None = None,
        names: Sequence[str] | None = None,
        covariance: Tensor | None = None,
        persons: str | int,
    ) -> tuple[BodyStream, list[BodyTrack]]: ...

    @uncompiled
    @torch.no_grad()
    @as_one_run
    def step(
        self,
        state: BodyStream,
        silhouettes: Bool[Tensor, "C H W"] | None = None,
        *,
        keypoints: Float[Tensor, "C *D J 2"] | None = None,
        confidence: Float[Tensor, "C *D J"] | None = None,
        names: Sequence[str] | None = None,
        covariance: Float[Tensor, "C *D J"] | None = None,
        persons: str | int | None = None,
    ) -> tuple[BodyStream, BodyTrack | list[BodyTrack]]:
        """Track one more frame: the same numbers as that frame of `forward`.

        Args:
            state: the state from `init` or the step before; it is not changed (but a generator goes on).
            silhouettes: the silhouettes of one frame, bool [C, H, W].
            keypoints, confidence, names, covariance, persons: of one frame, as in `forward`.

        Returns:
            The next state, and the `BodyTrack` of this one frame. Until "kalman" has found the person, its
            poses are NaN and `coasting` is True. With `persons` a list of those who are confirmed: a person
            is from the third frame on, and not earlier than a tenth of a second.

        Raises:
            ShapeError, InputError, CameraError: as `forward`.
        """
        names = self._stream_names(state, names)
        if self.by_keypoints is None:
            check_filters_one(self.method, "none", "none", persons)
            given = given_keypoints(keypoints, confidence, names, covariance)
            given = None if given is None else given.alone()
            check_tensors(silhouettes=silhouettes)
            shown = None if silhouettes is None else [silhouettes]
            return self._tracked(state, shown, given)
        check_tensors(keypoints=keypoints, confidence=confidence, covariance=covariance)
        keypoints = keypoints_alone(self.method, silhouettes, keypoints)
        if isinstance(state.filter, BodyFilterState):
            raise InputError(f"expected the state of a tracker with method {self.method}")
        if (isinstance(state.filter, LivePeople) != (persons is not None)) and state.filter:
            raise InputError("persons must be given in all steps of a stream or in none")
        single = self.by_keypoints
        tracker: Any = single if persons is None else PeopleBodyTracker(single, persons)
        after, found = tracker.step(
            state.filter, keypoints, confidence, names, covariance=covariance
        )
        for pose in [found] if persons is None else found:
            pose.first_frame = state.frame
        return state._replace(filter=after, frame=state.frame + 1), found

    @uncompiled
    @torch.no_grad()
    @as_one_run
    def advance(
        self,
        state: BodyStream,
        silhouettes: Iterable[Bool[Tensor, "C H W"]] | None = None,
        *,
        keypoints: Float[Tensor, "T C J 2"] | None = None,
        confidence: Float[Tensor, "T C J"] | None = None,
        names: Sequence[str] | None = None,
        covariance: Float[Tensor, "T C J"] | None = None,
    ) -> tuple[BodyStream, BodyTrack]:
        """Track some more frames: the same numbers as `step` for one after the other.

        Args:
            state: as in `step`. silhouettes: bool [T, C, H, W], or one frame [C, H, W] after the other.
            keypoints, confidence, names, covariance: of T frames, as in `forward`.

        Returns:
            The next state, and the `BodyTrack` of these frames.

        Raises:
            ShapeError, InputError, CameraError: as `forward`. InputError: a stream of "kalman", which takes
            one frame at a time, by `step`.
        """
        names = self._stream_names(state, names)
        if self.by_keypoints is not None:
            raise InputError(f"method {self.method} takes keypoints, one frame at a time, by step")
        given = given_keypoints(keypoints, confidence, names, covariance)
        return self._tracked(state, silhouettes, given)

    def find_tilt(self, tracks: Sequence[BodyTrack]) -> CameraTilt | None:
        """Find by how much the only camera looks up and is rolled, from how people stand in front of it.

        `camera.tilted(pitch, roll).in_level_world()` is the camera as it is held, and `up="y"` goes with it.

        Args:
            tracks: of all persons, by this tracker.

        Returns:
            `pitch`, `roll`, `pitch_std` and `roll_std`, radians; None if nobody stands for half a second.

        Raises:
            InputError: several cameras, another method than "kalman", or a tracker that was told `up`.
        """
        if self.by_keypoints is None or len(self.cameras) > 1 or self.by_keypoints.up is not None:
            raise InputError(
                f"a tilt is found by one camera with method={KEYPOINT_METHOD!r} and without `up`; got method "
                f"{self.method} and {len(self.cameras)} cameras"
            )
        return find_camera_tilt(tracks, self.cameras)

    def _refuse_given(self, **arguments: Any) -> None:
        """Raise `InputError` for arguments, but None, that the method does not use."""
        refuse(given_of(arguments), f"for method {self.method}")

    def _stream_names(self, state: BodyStream, names: Sequence[str] | None) -> Sequence[str] | None:
        """Return the names of a frame's keypoints: those given with it, else those given at first.

        Raises:
            InputError: what is no state of this tracker.
        """
        if not isinstance(state, BodyStream):
            raise InputError(
                f"state must be a BodyStream, got {type(state).__name__}; begin with init, and pass on what "
                "the step before returned"
            )
        check_settings(state.settings, self._settings)
        return state.names if names is None else names

    def _tracked(
        self,
        state: BodyStream,
        silhouettes: Iterable[Bool[Tensor, "C H W"]] | None,
        given: GivenKeypoints | None,
    ) -> tuple[BodyStream, BodyTrack]:
        """Return the next state and the poses in some frames, by particles."""
        frames, _ = self._by_particles.observed(silhouettes, given, fitting=state.frame > 0)
        if not isinstance(state.filter, BodyFilterState):
            raise InputError(f"expected the state of a tracker with method {self.method}")
        after, poses = self._by_particles.follow(state.filter, frames, state.generator, state.frame)
        return state._replace(filter=after, frame=state.frame + len(poses)), poses

    def extra_repr(self) -> str:
        return f"method={self.method!r}, n_particles={self.n_particles}, fps={self.fps:g}"


def _in_words(rig: CameraRig) -> str:
    """Return the names of cameras, and roughly where they are, where they look to, and focal lengths."""
    numbers = torch.cat(
        [centres_of_cameras(rig), rig.rotation[:, 2], rig.matrix[:, 0, :1]], -1
    ).tolist()
    return ", ".join(
        f"{name} at {x:.2f} {y:.2f} {z:.2f} m along {a:.2f} {b:.2f} {c:.2f}, {focal:.0f} px"
        for name, (x, y, z, a, b, c, focal) in zip(rig.names, numbers, strict=True)
    )


def _names(names: Sequence[str] | None) -> tuple[str, ...] | None:
    return None if names is None else tuple(names)


set_up_facade(__name__)
