"""Track one recording of a batch as `torchpose track` does, and store the origin of its result."""

import json
import time
import zipfile
from collections.abc import Mapping
from dataclasses import asdict
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

import torchpose
from torchpose._core.checks import check_positive, check_seed
from torchpose._core.digests import digest_of
from torchpose._core.files import atomic_path
from torchpose.errors import InputError, OutputError
from torchpose.io import read_keypoints
from torchpose.priors import UpperBodyPrior
from torchpose.upper_body import PoseTrack
from torchpose.upper_body._keypoint_files import KeypointFileTracker, TrackSettings
from train.predict_recordings import KeypointRecording, content_of

__all__ = ["BatchTracker", "digest_of_prior", "facts_of", "read_origin", "save_result"]

_FORMAT = 1  # of what is stored in a result; another one is made again
_ORIGIN = "origin.npy"


class BatchTracker:
    """Tracks one recording after the other with one prior.

    Args:
        settings: how. device: where, such as "cpu", "cuda" or "cuda:1".

    Raises:
        InputError, PriorError, CameraError: settings that suit no recording.
    """

    def __init__(self, settings: TrackSettings, device: str = "cpu") -> None:
        for option, value in (("track.fps", settings.fps), ("track.max_gap", settings.max_gap)):
            if value is not None:
                check_positive(option, value)
        check_seed("track.seed", settings.seed)
        self._tracker = KeypointFileTracker(settings, device)
        self._tracker.check()

    def origin(self, recording: KeypointRecording) -> dict[str, str]:
        """Return what a result is made from: digests of the input, the prior and the settings.

        Two results with the same origin hold the same poses; where they were computed, and where the
        files lay, plays no part.
        """
        return {"input": content_of(recording.path)} | self.task

    @cached_property
    def task(self) -> dict[str, str]:
        """Return what is the same for every recording: digests of prior and settings, the version."""
        tracker = self._tracker
        settings = {k: v for k, v in asdict(tracker.settings).items() if k != "prior"}
        files = {
            "camera": tracker.camera_file,
            "arms": settings["arms"],
            "lifter": settings["lifter"],
            "person": settings["person"],
        }
        settings |= {key: content_of(Path(file)) for key, file in files.items() if file}
        return {
            "format": str(_FORMAT),
            "torchpose": torchpose.__version__,
            "prior": digest_of_prior(tracker.prior),
            "settings": digest_of([json.dumps(settings, sort_keys=True)]),
        }

    def __call__(self, recording: KeypointRecording) -> PoseTrack:
        """Return the poses of a recording.

        Raises:
            TorchposeError: the file, or what it holds.
        """
        return self._tracker.track(read_keypoints(recording.path))


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
    """Return origin and facts of a result, without reading its poses; None if it is damaged.

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
    """Return what is said about a result.

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
        "notes": list(track.notes),
    }


def digest_of_prior(prior: UpperBodyPrior) -> str:
    """Return SHA-256 of everything in a prior: numbers, and what its file says about them."""
    parts: list[str | Tensor] = [prior.info.to_json()]
    for name, value in sorted(prior.state_dict().items()):
        parts += f"{name}{tuple(value.shape)}{value.dtype}", value
    return digest_of(parts)
