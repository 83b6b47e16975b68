"""One recording of a batch: tracked as `torchpose track` does it, with where the result came from."""

import hashlib
import json
import time
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jsonargparse import Namespace

import torchpose
from torchpose._core.files import atomic_path
from torchpose.cli.camera_option import resolve_camera
from torchpose.cli.common import positive
from torchpose.cli.track import tracker_options
from torchpose.cli.track_keypoints import joint_names, kind_of_neck
from torchpose.errors import DegenerateFilterWarning, InputError, OutputError
from torchpose.io import read_keypoints
from torchpose.priors import UpperBodyPrior, load_prior
from torchpose.upper_body import PoseTrack, UpperBodyTracker
from train.predict_recordings import Recording, content_of

__all__ = [
    "BatchTracker",
    "TrackSettings",
    "digest_of_prior",
    "facts_of",
    "read_origin",
    "save_result",
]

_FORMAT = 1  # of what is stored in a result; another one is made again
_ORIGIN = "origin.npy"
_KEPT_TRACKERS = 8


@dataclass(frozen=True)
class TrackSettings:
    """How recordings are tracked; every setting is the option of `torchpose track` of that name.

    Args:
        prior: a prior that comes with torchpose, or a .safetensors file.
        method: window-mixture, mkf-fixed, mkf-sampled, mkf-split, pf-mixture, pf-walk or
            pf-walk-unscaled; null is window-mixture where the prior brings windows that suit.
        camera: a TOML file or fx,fy,cx,cy in pixels; without it K or the image size of each file.
        camera_name: which camera of a file with several.
        measurement_std: pixels, one number or five: hand, elbow, shoulder, head, neck.
        smoothing: later frames that an estimate may use, or "full".
        n_particles: of the pf methods. n_tracks: of mkf-sampled and mkf-split.
        frame: axes of the 3D poses: camera or body.
        static_camera: let the body turn in front of a camera that stays where it is.
        window: deprecated, see `method`. steady: take out the trembling of windows.
        neck: kind of the keypoints' neck if their names do not tell.
        nose_as_head: take a nose for the head where there is none.
        fps: frames per second, if the files do not say or err.
        max_gap: longest stretch without any keypoint, seconds; null for no bound.
        seed: of the methods that draw; every recording starts from it.
    """

    prior: str = "kinect-upper-body"
    method: str | None = None
    camera: str | None = None
    camera_name: str | None = None
    measurement_std: float | list[float] | None = None
    smoothing: int | str | None = None
    n_particles: int | None = None
    n_tracks: int | None = None
    frame: str = "camera"
    static_camera: bool = False
    window: bool | None = None
    steady: bool | None = None
    neck: str | None = None
    nose_as_head: bool = False
    fps: float | None = None
    max_gap: float | None = 5.0
    seed: int = 0


class _Input(NamedTuple):
    """What a tracker depends on beside the settings."""

    matrix: tuple[float, ...]
    size: tuple[int, int] | None
    fps: float | None
    neck: str | None


class BatchTracker:
    """Tracks one recording after the other with one prior.

    Args:
        settings: how. device: where, such as "cpu", "cuda" or "cuda:1".

    Raises:
        InputError, PriorError, CameraError: settings that suit no recording.
    """

    def __init__(self, settings: TrackSettings, device: str = "cpu") -> None:
        self.settings = settings
        for option, value in (("track.fps", settings.fps), ("track.max_gap", settings.max_gap)):
            positive(option, value)
        self.prior = load_prior(settings.prior)
        try:
            self.device = torch.device(device)
            torch.empty(0, device=self.device)
        except (RuntimeError, AssertionError) as error:
            reason = str(error).splitlines()[0]
            raise InputError(f"device {device!r} cannot be used: {reason}") from error
        self._options: dict[str, Any] = tracker_options(Namespace(**asdict(settings)))
        # refuses here what would be refused for every recording
        UpperBodyTracker(self.prior, self.prior.camera, **self._settings(), neck=settings.neck)
        camera = settings.camera
        if camera:
            resolve_camera(camera, settings.camera_name, None, None, camera)
        self._camera_file = camera if camera and Path(camera).is_file() else None
        self._trackers: dict[_Input, UpperBodyTracker] = {}

    def origin(self, recording: Recording) -> dict[str, str]:
        """What a result is made from: digests of the input, the prior and the settings.

        Two results with the same origin hold the same poses; where they were computed, and where the
        files lay, plays no part.
        """
        return {"input": content_of(recording.path)} | self.task

    @property
    def task(self) -> dict[str, str]:
        """What is the same for every recording: digests of prior and settings, the version."""
        if not hasattr(self, "_task"):
            settings = {k: v for k, v in asdict(self.settings).items() if k != "prior"}
            if self._camera_file:
                settings["camera"] = content_of(Path(self._camera_file))
            self._task = {
                "format": str(_FORMAT),
                "torchpose": torchpose.__version__,
                "prior": digest_of_prior(self.prior),
                "settings": _digest(json.dumps(settings, sort_keys=True)),
            }
        return self._task

    def __call__(self, recording: Recording) -> PoseTrack:
        """Read and track a recording.

        Raises:
            TorchposeError: the file, or what it holds.
        """
        settings = self.settings
        keypoints = read_keypoints(recording.path)
        camera, notes = resolve_camera(
            settings.camera,
            settings.camera_name,
            keypoints.image_size,
            keypoints.K,
            keypoints.path,
        )
        names, more = joint_names(keypoints, settings.nose_as_head)
        fps = settings.fps or keypoints.fps
        if fps is None:
            rate = self.prior.info.fps or 30
            more += (f"the keypoint file states no frame rate: {rate:g} fps assumed",)
        key = _Input(
            tuple(camera.matrix.flatten().tolist()),
            camera.image_size,
            fps,
            kind_of_neck(settings.neck, keypoints),
        )
        tracker = self._tracker(key, camera)
        confidence = keypoints.confidence
        with warnings.catch_warnings(), torch.inference_mode():
            warnings.simplefilter(
                "ignore", DegenerateFilterWarning
            )  # it is a column of the summary
            track = tracker(
                keypoints.keypoints[None],
                None if confidence is None else confidence[None].to(self.device),
                names,
                generator=torch.Generator(self.device).manual_seed(settings.seed),
            )
        return replace(track, notes=notes + tuple(keypoints.notes) + more + track.notes)

    def _settings(self) -> dict[str, Any]:
        """Settings of a tracker that are the same for every recording."""
        names = ("measurement_std", "max_gap")
        return {name: getattr(self.settings, name) for name in names} | self._options

    def _tracker(self, key: _Input, camera: torchpose.PinholeCamera) -> UpperBodyTracker:
        """The tracker for a camera and a frame rate; the last ones are kept."""
        if key not in self._trackers:
            while len(self._trackers) >= _KEPT_TRACKERS:
                del self._trackers[next(iter(self._trackers))]
            tracker = UpperBodyTracker(
                self.prior, camera, fps=key.fps, neck=key.neck, **self._settings()
            )
            self._trackers[key] = tracker.to(self.device)
        return self._trackers[key]


def save_result(
    path: Path, track: PoseTrack, origin: Mapping[str, str], facts: Mapping[str, Any]
) -> None:
    """Write poses as `torchpose track` does, with their origin and facts for the summary inside.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path.parent}: cannot be made ({error.strerror or error})") from error
    text = np.array(json.dumps({"origin": dict(origin), "facts": dict(facts)}, sort_keys=True))
    buffer = BytesIO()
    np.lib.format.write_array(buffer, text, allow_pickle=False)
    with atomic_path(path) as temporary:
        track.save(temporary)
        with zipfile.ZipFile(temporary, "a") as archive:
            archive.writestr(_ORIGIN, buffer.getvalue())


def read_origin(path: Path, known: bool = True) -> dict[str, Any] | None:
    """Origin and facts of a result, without reading its poses; None if it is damaged.

    Args:
        path: of the file. known: whether a result was written there before.

    Raises:
        InputError: the file is not a result with an origin, or damaged and not known to be one.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if _ORIGIN in archive.namelist():
                with archive.open(_ORIGIN) as stream:
                    text = np.lib.format.read_array(stream, allow_pickle=False)
                return json.loads(str(text))
    except (zipfile.BadZipFile, ValueError, EOFError):
        if known:
            return None
    raise InputError(
        f"{path}: is there already, but was not written by this command; move it or choose another "
        "--out"
    )


def facts_of(track: PoseTrack, started: float) -> dict[str, Any]:
    """What the summary says about a result.

    Args:
        started: `time.monotonic()` before the work.
    """
    observed = track.observed[0].double()
    measured = observed.any(0)
    evidence = track.log_evidence[0].sum(-1)
    n_frames = int(track.lengths[0])
    return {
        "frames": n_frames,
        "fps": track.fps,
        "seconds": n_frames / track.fps if track.fps else None,
        "log_evidence": float(evidence[evidence.isfinite()].sum()),
        "missing": 1.0 - float(observed[:, measured].mean()),
        "failed_at": int(track.failed_at[0]),
        "took_seconds": round(time.monotonic() - started, 3),
    }


def _digest(text: str | bytes) -> str:
    return hashlib.sha256(text.encode() if isinstance(text, str) else text).hexdigest()


def digest_of_prior(prior: UpperBodyPrior) -> str:
    """SHA-256 of everything in a prior: numbers, and what its file says about them."""
    digest = hashlib.sha256(prior.info.to_json().encode())
    for name, value in sorted(prior.state_dict().items()):
        digest.update(f"{name}{tuple(value.shape)}{value.dtype}".encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
