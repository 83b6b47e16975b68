"""Track files of 2D keypoints: the settings, and one tracker for each camera and frame rate."""

import sys
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from torchpose._core.checks import check_choice, check_count
from torchpose._core.inference import in_inference_mode
from torchpose.camera._choice import held_camera, resolve_camera
from torchpose.camera._pinhole import PinholeCamera
from torchpose.errors import DegenerateFilterWarning, InputError
from torchpose.io._keypoints import Keypoints
from torchpose.priors._upper_body_prior import load_prior
from torchpose.skeleton._joint_sets import canonical_names
from torchpose.skeleton._upper_body import NECK_KINDS
from torchpose.upper_body._estimator_table import METHODS, method_options, replace_window
from torchpose.upper_body._keypoint_doubts import doubts_about, refuse_another_size
from torchpose.upper_body._pose_track import PoseTrack
from torchpose.upper_body._upper_body_tracker import UpperBodyTracker

_KEPT_TRACKERS = 8
_SAME_RATE = 1e-3  # frames per second


@dataclass(frozen=True)
class TrackSettings:
    """Settings of tracking; every one is the option of `torchpose track` of that name.

    Args:
        prior: the name of a prior that comes with torchpose, or a .safetensors file.
        method: the name of an estimator; by default the input decides: articulated for videos and for
            wrists, multiple-model for hands in files. Other priors than the shipped ones may lead to
            another default (docs/which-tracker.md).
        camera: the camera: a TOML file, or four numbers fx,fy,cx,cy in pixels; by default K or the image
            size of the input.
        camera_name: the name of the camera in a file that has several.
        tilt: the angle in degrees by which the camera looks up, as most webcams of laptops do; negative if it
            looks down (default: about level).
        roll: the angle in degrees by which the camera is rolled clockwise, as seen from behind it.
        up: the axis of the world that points up, y or z; tilt and roll then follow from the rotation in the
            file of the camera.
        measurement_std: the standard deviation of a keypoint in pixels: one number, or five with commas
            for hand, elbow, shoulder, head, neck; by default as the prior learnt it, else 3.
        smoothing: use this many later frames for each estimate, all of them ("full") or none of them
            ("none"); mkf-sampled, mkf-split and the pf methods have no smoothing.
        n_particles: the number of particles of the pf methods (default 10000).
        n_tracks: the number of tracks of mkf-sampled and mkf-split.
        arms: articulated: the file of a prior over arms; by default the one that comes with torchpose.
        lifter: articulated, multiple-model: the file of a network that lifts arms; by default the one that
            comes with torchpose.
        bone_lengths: articulated: lengths measured on the person in metres, with commas: any of
            upper_arm=, forearm= (to the measured hand or wrist), shoulder_width= and head_height= (above
            Kinect's neck, which is 10.5 cm above the middle of the shoulders).
        height: articulated: the height of the person in metres, if their bones were not measured.
        person: articulated: the .npz of an earlier recording of the same person, whose bone lengths are
            taken; without height and bone_lengths.
        frame: the axes of the 3D poses: those of the camera (default) or of the body.
        static_camera: let the body turn in front of a camera that stays where it is.
        window: deprecated: false stands for the method mkf-fixed, true for window-mixture if the prior
            has windows that suit.
        steady: remove the jitter of poses from windows with filters of constant velocity (default true
            for window-mixture).
        neck: the kind of the keypoints' neck, if their names do not tell: neck, low-neck, mid-shoulder.
        nose_as_head: take a nose for the head where there is none.
        fps: the number of frames per second, if the input does not tell or is wrong; a video file is
            resampled to it.
        max_gap: the longest time without any keypoint in seconds, null for no bound (default 5); in a
            video, a person who is away for longer has no pose until they return.
        outliers: treat keypoints as missing where no joint of this body can be, and correct hands whose
            left and right are exchanged.
        seed: the seed of methods that draw; every recording starts from it.
    """

    prior: str = "kinect-upper-body"
    method: str | None = None
    camera: str | None = None
    camera_name: str | None = None
    tilt: float | None = None
    roll: float | None = None
    up: str | None = None
    measurement_std: float | list[float] | None = None
    smoothing: int | str | None = None
    n_particles: int | None = None
    n_tracks: int | None = None
    arms: str | None = None
    lifter: str | None = None
    bone_lengths: str | None = None
    height: float | None = None
    person: str | None = None
    frame: str = "camera"
    static_camera: bool = False
    window: bool | None = None
    steady: bool | None = None
    neck: str | None = None
    nose_as_head: bool = False
    fps: float | None = None
    max_gap: float | None = 5.0
    outliers: bool = True
    seed: int = 0

    def hold(self, camera: PinholeCamera) -> PinholeCamera:
        """Return the camera with the orientation against gravity that is stated, if one is.

        Raises:
            InputError, CameraError: settings that do not go together, or a camera that looks too far up.
        """
        return held_camera(camera, self.tilt, self.roll, self.up, self.camera)

    def tracker_options(self) -> dict[str, Any]:
        """Return the settings of the tracker and of its filter, as `UpperBodyTracker` takes them.

        Raises:
            InputError: an option that the method does not have.
        """
        method, steady = self.method, self.steady
        if self.window is not None:
            print(
                "torchpose: --window is deprecated; say --method window-mixture or mkf-fixed, or leave "
                "both out",
                file=sys.stderr,
            )
            method, steady = replace_window(method, self.window, steady)
        names = ("smoothing", "frame", "static_camera", "outliers")
        options = {name: getattr(self, name) for name in names}
        options |= {"method": method, "steady": steady}
        if self.smoothing == "none":  # as a configuration may say it
            options["smoothing"] = None
        if self.window and method is None:
            options["window"] = True  # windows, which were the default
        for name in ("n_particles", "n_tracks"):
            value = getattr(self, name)
            if value is not None:
                _check_count(name, value, method)
                options[name] = value
        if self.bone_lengths is not None:
            options["bone_lengths"] = _lengths_of(self.bone_lengths)
        own = {name: getattr(self, name) for name in ("arms", "lifter", "height", "person")}
        return options | {name: value for name, value in own.items() if value is not None}


def _lengths_of(text: str) -> dict[str, float]:
    """Return lengths by name, from text such as upper_arm=0.28,forearm=0.25.

    Raises:
        InputError: anything else.
    """
    try:
        pairs = [part.split("=") for part in text.split(",")]
        lengths = {name.strip(): float(metres) for name, metres in pairs}
    except ValueError as error:
        raise InputError(
            f"bone_lengths must be NAME=METRES with commas, such as upper_arm=0.28,forearm=0.25, got "
            f"{text!r}"
        ) from error
    if len(lengths) < len(pairs):
        raise InputError(f"bone_lengths must name each length once, got {text!r}")
    return lengths


class PreparedTracker(NamedTuple):
    """Tracker, camera and joint names of a file, and what was assumed.

    Attributes:
        tracker: the tracker for the camera, frame rate and neck of the file. camera: its camera.
        names: the names of the joints, as the tracker takes them. notes: the assumptions, in plain words.
    """

    tracker: UpperBodyTracker
    camera: PinholeCamera
    names: tuple[str, ...]
    notes: tuple[str, ...]


class _Key(NamedTuple):
    """Facts about a file that its tracker depends on, beside the settings."""

    matrix: tuple[float, ...]
    size: tuple[int, int] | None
    up: tuple[float, ...] | None
    fps: float | None
    neck: str | None


class KeypointFileTracker:
    """Tracker of one file of keypoints after the other with one prior.

    Trackers are kept by camera, frame rate and kind of neck, the last eight of them.

    Args:
        settings: the settings of tracking. device: the device to track on, such as "cpu", "cuda" or
            "cuda:1". options: the options of the method, beside those of the settings.

    Attributes:
        settings: as given. prior: the prior that was loaded.

    Raises:
        InputError, PriorError: settings that suit no recording, a device that cannot be used.
    """

    def __init__(
        self,
        settings: TrackSettings,
        device: str = "cpu",
        options: Mapping[str, Any] | None = None,
    ) -> None:
        self.settings = settings
        self.prior = load_prior(settings.prior)
        try:
            self.device = torch.device(device)
            torch.empty(0, device=self.device)
        except (RuntimeError, AssertionError) as error:
            reason = str(error).splitlines()[0]
            raise InputError(f"device {device!r} cannot be used: {reason}") from error
        self._options = {
            "measurement_std": settings.measurement_std,
            "max_gap": settings.max_gap,
            **settings.tracker_options(),
            **(options or {}),
        }
        self._trackers: dict[_Key, UpperBodyTracker] = {}

    def check(self) -> None:
        """Raise the errors that every recording would lead to.

        Raises:
            InputError, PriorError, CameraError: settings that suit no recording.
        """
        settings = self.settings
        UpperBodyTracker(self.prior, self.prior.camera, **self._options, neck=settings.neck)
        if settings.camera or settings.camera_name:
            camera, _ = resolve_camera(
                settings.camera, settings.camera_name, None, None, settings.camera
            )
            settings.hold(camera)
        else:
            info = self.prior.info
            settings.hold(PinholeCamera(info.fx, info.fy, info.cx, info.cy))

    def prepare(self, keypoints: Keypoints) -> PreparedTracker:
        """Return the tracker of a file, and what was assumed.

        Raises:
            TorchposeError: keypoints that the settings do not suit.
        """
        settings = self.settings
        camera, notes = resolve_camera(
            settings.camera,
            settings.camera_name,
            keypoints.image_size,
            keypoints.K,
            keypoints.path,
        )
        camera = settings.hold(camera)
        refuse_another_size(keypoints, keypoints.image_size or camera.image_size)
        names, more = _joint_names(keypoints, settings.nose_as_head)
        fps = settings.fps or keypoints.fps
        if fps is None:
            rate = self.prior.info.fps or 30
            more += (f"the keypoint file states no frame rate: {rate:g} fps assumed",)
        elif keypoints.fps is not None and abs(fps - keypoints.fps) > _SAME_RATE:
            more += (f"keypoints of {keypoints.fps:g} fps are taken at the given {fps:g} fps",)
        kind = _kind_of_neck(settings.neck, keypoints)
        if keypoints.neck not in (None, kind):
            more += (
                f"the neck is taken for one of kind {kind}, as --neck says, and not {keypoints.neck}, as the "
                "joint set or the file does",
            )
        key = _Key(
            tuple(camera.matrix.flatten().tolist()),
            camera.image_size,
            None if camera.up is None else tuple(camera.up.tolist()),
            fps,
            kind,
        )
        told = kind is not None or self.prior.info.neck != "neck"
        notes += (*keypoints.notes, *doubts_about(keypoints, told, camera.up), *more)
        return PreparedTracker(self._tracker(key, camera), camera, names, notes)

    @in_inference_mode
    def track(
        self, keypoints: Keypoints, prepared: PreparedTracker | None = None, progress: bool = False
    ) -> PoseTrack:
        """Return the poses of a file; `failed_at` names the frame in which the filter degenerated.

        Args:
            keypoints: the keypoints of the file. prepared: the result of `prepare` for it, if that was
                called. progress: whether to show a progress bar.

        Raises:
            TorchposeError: keypoints that the settings do not suit.
        """
        tracker, _, names, notes = prepared or self.prepare(keypoints)
        confidence = keypoints.confidence
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DegenerateFilterWarning)
            track = tracker(
                keypoints.keypoints[None],
                None if confidence is None else confidence[None].to(self.device),
                names,
                generator=torch.Generator(self.device).manual_seed(self.settings.seed),
                progress=progress,
            )
        return replace(track, notes=notes + track.notes)

    @property
    def camera_file(self) -> Path | None:
        """Return the file of the camera that was given, if it is a file."""
        given = self.settings.camera
        return Path(given) if given and Path(given).is_file() else None

    def _tracker(self, key: _Key, camera: PinholeCamera) -> UpperBodyTracker:
        if key not in self._trackers:
            while len(self._trackers) >= _KEPT_TRACKERS:
                del self._trackers[next(iter(self._trackers))]
            tracker = UpperBodyTracker(
                self.prior, camera, fps=key.fps, neck=key.neck, **self._options
            )
            self._trackers[key] = tracker.to(self.device)
        return self._trackers[key]


def _check_count(name: str, value: int, method: str | None) -> None:
    """Raise `InputError` unless the method has such a number, and it is positive."""
    option = f"--{name.replace('_', '-')}"
    having = [other for other in METHODS if name in method_options(other)]
    if method is None:
        raise InputError(f"{option} needs --method, one of {', '.join(having)}")
    if method in METHODS and method not in having:
        raise InputError(
            f"{option} does not apply to --method {method}; it is of {', '.join(having)}"
        )
    check_count(option, value)


def _joint_names(
    keypoints: Keypoints, nose_as_head: bool
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return names for the tracker, with the nose as head if asked for, and notes."""
    canonical = canonical_names(keypoints.names)
    if "head" in canonical:
        return keypoints.names, ()
    if not nose_as_head:
        hint = ("there is no head among the keypoints; --nose-as-head true takes the nose for it",)
        return keypoints.names, hint if "nose" in canonical else ()
    if "nose" not in canonical:
        raise InputError(f"--nose-as-head needs a nose, got {', '.join(keypoints.names)}")
    names = tuple(
        "head" if c == "nose" else name for c, name in zip(canonical, keypoints.names, strict=True)
    )
    return names, ("the nose stands for the head",)


def _kind_of_neck(given: str | None, keypoints: Keypoints) -> str | None:
    if given is not None:
        check_choice("--neck", given, NECK_KINDS)
    return given or keypoints.neck
