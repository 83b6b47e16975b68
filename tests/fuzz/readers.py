"""What reads the files of each kind, and what has to hold of what was read."""

import contextlib
import io
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torchpose.cli
from benchmarks.humaneva_files import read_calibration, read_stream_offset
from torchpose.camera import CameraRig, load_cameras
from torchpose.io import read_keypoints, read_recording
from torchpose.priors import ActionBank, ActionSpace, BackConstrainedGPLVM, UpperBodyPrior
from torchpose.priors._body_motion import BodyMotion
from torchpose.priors._limb_conditionals import LimbConditionals
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import PoseTrack
from torchpose.video import open_video
from torchpose.whole_body import BodyTrack

__all__ = ["READERS", "SilentError", "info"]

_LONGEST = 2000  # characters of a message
_FASTEST = 1000.0  # frames per second


class SilentError(Exception):
    """Something was read without complaint that is not what it should be."""


def _need(holds: bool, what: str) -> None:
    if not holds:
        raise SilentError(what)


def _rate(fps: float | None) -> None:
    _need(fps is None or (isinstance(fps, float) and 0 < fps <= _FASTEST), f"fps {fps!r:.60}")


def _words(name: str, words: Sequence[str]) -> None:
    for word in words:
        _need(isinstance(word, str), f"{name} {word!r:.60}")


def _sizes(name: str, tensor: Tensor, sizes: Sequence[int]) -> None:
    _need(tuple(tensor.shape) == tuple(sizes), f"{name} is {list(tensor.shape)}, not {list(sizes)}")


def _finite_or_lost(name: str, points: Tensor) -> Tensor:
    """Which points are there; each is finite or, as a whole, NaN."""
    there = points.isfinite().all(-1)
    _need(bool((there | points.isnan().all(-1)).all()), f"{name} is neither finite nor lost")
    return there


def _covariance(name: str, tensor: Tensor, where: Tensor) -> None:
    kept = tensor.double()[where]
    _need(bool(kept.isfinite().all()), f"{name} not finite where the joints are")
    scale = kept.abs().amax((-2, -1), keepdim=True).clamp_min(1e-300)
    _need(bool(((kept - kept.mT).abs() <= 1e-4 * scale).all()), f"{name} not symmetric")
    least = torch.linalg.eigvalsh(kept / scale)[..., 0]
    _need(bool((least >= -1e-4).all()), f"{name} not positive semidefinite")


def _poses(path: Path) -> None:
    track = PoseTrack.load(path)
    batch, frames = track.joints3d.shape[:2] if track.joints3d.ndim == 4 else (-1, -1)
    _sizes("joints3d", track.joints3d, (batch, frames, 8, 3))
    _sizes("joints2d", track.joints2d, (batch, frames, 8, 2))
    _sizes("covariance3d", track.covariance3d, (batch, frames, 8, 3, 3))
    _sizes("covariance2d", track.covariance2d, (batch, frames, 8, 2, 2))
    _sizes("observed", track.observed, (batch, frames, 8))
    _sizes("log_evidence", track.log_evidence, (batch, frames, 2))
    _sizes("lengths", track.lengths, (batch,))
    _sizes("failed_at", track.failed_at, (batch,))
    _sizes("matrix", track.matrix, (3, 3))
    _need(batch > 0 and frames > 0, "empty")
    for name in ("joints2d", "joints3d", "covariance2d", "covariance3d", "log_evidence", "matrix"):
        _need(getattr(track, name).dtype in (torch.float32, torch.float64), f"type of {name}")
    _need(track.observed.dtype == torch.bool, "type of observed")
    _need(tuple(track.names) == UPPER_BODY, f"names {track.names!r:.60}")
    _need(track.frame in ("camera", "body"), f"frame {track.frame!r:.60}")
    _need(bool(((track.lengths >= 1) & (track.lengths <= frames)).all()), "lengths")
    _need(bool(((track.failed_at >= -1) & (track.failed_at < frames)).all()), "failed_at")
    _need(bool(track.matrix.isfinite().all()) and float(track.matrix[0, 0]) > 0, "K")
    _need(isinstance(track.first_frame, int) and track.first_frame >= 0, "first_frame")
    _need(not bool(track.log_evidence.isposinf().any()), "log_evidence is infinite")
    _rate(track.fps)
    _words("notes", track.notes)
    there = _finite_or_lost("joints3d", track.joints3d)
    _covariance("covariance3d", track.covariance3d, there)
    _covariance("covariance2d", track.covariance2d, _finite_or_lost("joints2d", track.joints2d))
    for b in range(batch):
        failed = int(track.failed_at[b])
        _need(failed < 0 or not bool(there[b, failed].all()), "failed_at a pose that is there")
    _need(len(track.sequence(0)) == 1, "sequence")


def _body_poses(path: Path) -> None:
    poses = BodyTrack.load(path)
    frames, dim = len(poses), poses.body.dim
    _need(frames > 0, "empty")
    for name, sizes in {
        "state": (frames, dim), "state_std": (frames, dim), "joints3d": (frames, 15, 3),
        "covariance3d": (frames, 15, 3, 3), "log_evidence": (frames,),
        "effective_sample_size": (frames,), "coasting": (frames,), "respread": (frames,),
    }.items():  # fmt: skip
        _sizes(name, getattr(poses, name), sizes)
        kinds = (
            (torch.bool,) if name in ("coasting", "respread") else (torch.float32, torch.float64)
        )
        _need(getattr(poses, name).dtype in kinds, f"type of {name}")
    _need(bool(poses.state.isfinite().all() and poses.joints3d.isfinite().all()), "not finite")
    _need(bool((poses.state_std >= 0).all() and poses.state_std.isfinite().all()), "state_std")
    _covariance("covariance3d", poses.covariance3d, torch.ones(frames, dtype=torch.bool))
    joints = poses.body.joints(poses.state.to(poses.body.bone_lengths))
    _need(bool(joints.isfinite().all()), "the body has no joints")
    apart = (joints - poses.joints3d.to(joints)).abs().amax()
    _need(float(apart) < 1e-3, f"joints {float(apart):g} m from those of the states")
    _need(0.3 < float(poses.body.height) < 5, "height of the body")
    for name, value in poses.details.items():
        _need(len(value) == frames, f"detail {name}")
    if "actions" in poses.details:
        _need(poses.details["actions"].shape[-1] == len(poses.action_names), "names of actions")
    _rate(poses.fps)
    _need(isinstance(poses.first_frame, int) and poses.first_frame >= 0, "first_frame")


def _keypoints(path: Path) -> None:
    data = read_keypoints(path)
    n_frames, n_joints = data.keypoints.shape[:2]
    _sizes("keypoints", data.keypoints, (n_frames, len(data.names), 2))
    _need(n_frames > 0 and n_joints > 0, "empty")
    _need(not bool(data.keypoints.isinf().any()), "infinite keypoints")
    _need(bool(data.measured.any()), "nothing measured")
    if data.confidence is not None:
        _sizes("confidence", data.confidence, (n_frames, n_joints))
        _need(bool(data.confidence.isfinite().all() and (data.confidence >= 0).all()), "confidence")
    _rate(data.fps)
    if data.image_size is not None:
        _need(all(isinstance(s, int) and 0 < s < 10**6 for s in data.image_size), "image_size")
    if data.K is not None:
        _sizes("K", data.K, (3, 3))
        _need(bool(data.K.isfinite().all()) and 0 < float(data.K[0, 0]) < 1e9, "K")


def _recordings(path: Path) -> None:
    found = read_recording(path)
    _need(len(found) > 0, "empty")
    for one in found:
        n_frames = len(one.joints)
        _sizes("joints", one.joints, (n_frames, len(one.names), 3))
        _need(n_frames > 0 and not bool(one.joints.isinf().any()), "infinite or empty")
        _need(bool(one.joints.isfinite().any()), "nothing there")
        _rate(one.fps)
        if one.weights is not None:
            _sizes("weights", one.weights, one.joints.shape[:2])
            _need(bool(((one.weights >= 0) & (one.weights <= 1)).all()), "weights")
        _words("facts", (one.person, one.action, one.source))


def _cameras(path: Path) -> None:
    for camera in load_cameras(path).values():
        _usable_camera(camera)
    CameraRig.load(path)


def _usable_camera(camera: Any) -> None:
    R = camera.rotation_matrix
    _need(bool(((R @ R.mT - torch.eye(3, dtype=R.dtype)).abs() < 1e-6).all()), "rotation")
    pixels = camera(torch.tensor([[0.1, 0.2, 3.0]], dtype=torch.float64))
    _need(bool(pixels.isfinite().all()), "pixels are not finite")


def _humaneva(path: Path) -> None:
    if path.suffix == ".cal":
        _usable_camera(read_calibration(path))
    else:
        _need(all(math.isfinite(v) and abs(v) < 1e9 for v in read_stream_offset(path)), "offset")


def _finite(module: torch.nn.Module, but: Sequence[str] = ()) -> None:
    for name, tensor in module.named_buffers():
        if tensor.is_floating_point() and name not in but:
            _need(bool(tensor.isfinite().all()), f"{name} is not finite")


def _json_facts(info: Any) -> None:
    for name in ("persons", "sources", "actions", "names", "limbs", "parts"):
        _words(name, getattr(info, name, ()))
    fps = getattr(info, "fps", None)
    _need(fps is None or (isinstance(fps, int | float) and not isinstance(fps, bool)
                          and 0 < fps <= _FASTEST), f"fps {fps!r:.60}")  # fmt: skip


def _prior(path: Path) -> None:
    prior = UpperBodyPrior.load(path)
    _finite(prior)
    _json_facts(prior.info)
    for side in (prior.left, prior.right):
        _covariance("covariances", side.covariances, torch.ones(side.n_components) > 0)
        _need(side.means.shape[-1] == 21, "dimensions")
    _need(bool(prior.camera.matrix.isfinite().all()), "camera")
    for name, value in prior.noise.items():
        if name.startswith("process_cov"):
            _sizes(name, value, (21, 21))
            _covariance(name, value[None], torch.ones(1, dtype=torch.bool))


def _models(path: Path) -> None:
    kinds = {"manifold": BackConstrainedGPLVM, "limbs": LimbConditionals, "space": ActionSpace,
             "body": BodyMotion}  # fmt: skip
    load = kinds.get(path.stem, ActionBank)
    model = load.load(path)
    unknown = ("std_latent", "std_pose", "std_step") if load is BackConstrainedGPLVM else ()
    _finite(model, unknown)
    _json_facts(model.info)
    for name, tensor in model.named_buffers():
        if name in ("std", "match_std", "residual_std", "background_std", "gamma_x", "scale"):
            _need(bool((tensor >= 0).all()), f"{name} is negative")
        if name in ("acceleration", "decay", "shift_std", "shift_time", "pull_time"):
            _need(bool((tensor > 0).all()), f"{name} is not positive")
        if name in ("covariance", "diffusion"):
            _covariance(name, tensor, torch.ones(len(tensor), dtype=torch.bool))


def _video(path: Path) -> None:
    with open_video(str(path)) as source:
        _rate(float(source.fps))
        frames = [frame for _, frame in zip(range(60), source, strict=False)]
    _need(len(frames) > 0, "no frame")
    _need(len({frame.image.shape for frame in frames}) == 1, "sizes of frames")


READERS: dict[str, Callable[[Path], None]] = {
    "poses": _poses, "body poses": _body_poses, "keypoints npz": _keypoints,
    "keypoints csv": _keypoints, "OpenPose": _keypoints, "recording npz": _recordings,
    "recording text": _recordings, "recording yaml": _recordings, "motion capture": _recordings,
    "cameras": _cameras, "HumanEva": _humaneva, "prior": _prior, "models": _models, "video": _video,
}  # fmt: skip
"""By the kind in `SAMPLES`."""


def info(path: Path) -> str | None:
    """Run `torchpose info`; the line that refuses, or None.

    Raises:
        SilentError: another exit code, or output that is no lines of printable text.
    """
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = torchpose.cli.main(["info", str(path)])
    _need(code in (0, 2), f"exit code {code}")
    text = out.getvalue() + err.getvalue()
    _need(all(line.isprintable() for line in text.split("\n")), "output that is not printable")
    _need(len(text) < 20_000, f"output of {len(text)} characters")
    if code == 2:
        _need(err.getvalue().count("\n") == 1 and not out.getvalue(), "no one line on stderr")
        return err.getvalue()
    return None


def check_message(error: BaseException) -> str:
    """What is wrong with the message of a refusal, if anything."""
    text = str(error)
    if not text or len(text) > _LONGEST:
        return f"a message of {len(text)} characters"
    return "" if text.isprintable() else "a message that is not one printable line"
