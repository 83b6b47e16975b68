"""`torchpose info`: the version, the priors that are there, and what a file holds."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

from torchpose.cli._command import Command
from torchpose.errors import InputError, PriorError

if TYPE_CHECKING:
    from torch import Tensor

    from torchpose.io._keypoints import Keypoints
    from torchpose.priors._upper_body_prior import UpperBodyPrior

_EXAMPLES = """
torchpose info
torchpose info kinect-upper-body
torchpose info walk
torchpose info limbs.safetensors
torchpose info result/poses.npz
torchpose info keypoints.csv"""

_RECORDINGS = (".csv", ".txt", ".json", ".skeleton", ".bvh", ".c3d")
_SNIFFED = 65536  # characters of a table that tell what it is
_NAME = 60  # characters of what stands on the left


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    return Command("info", run, _EXAMPLES).main(arguments)


def run(what: str | None = None) -> int:
    """Print the version and the available priors, or a description of a file.

    That is a prior, a manifold, limb conditionals, an action space or bank, a prior over the motion of
    bodies, a file of poses, keypoints or recordings, or a camera file.

    Args:
        what: name of a prior or a model of whole bodies, a file or a folder.
    """
    print(_installation() if what is None else _describe(what))
    return 0


def _installation() -> str:
    import torch

    import torchpose
    from torchpose.priors._shipped import KINDS, known_models
    from torchpose.priors._upper_body_prior import known_priors

    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    return _table(
        {
            "torchpose": torchpose.__version__,
            "torch": torch.__version__,
            "CUDA device": device,
            "priors": ", ".join(known_priors()) or "none in this installation",
            **{kind: ", ".join(known_models(kind)) for kind in KINDS},
            "folder": str(Path(torchpose.__file__).parent),
        }
    )


def _describe(what: str) -> str:
    from torchpose.io._formats.openpose import holds_openpose
    from torchpose.priors._upper_body_prior import known_priors, load_prior

    path = Path(what)
    files = _models_of(what) or (
        [path] if path.suffix == ".safetensors" and os.path.isfile(path) else []
    )
    if files and what not in known_priors():
        from torchpose._core.tensor_file import format_of
        from torchpose.cli._info_models import DESCRIBED

        found = [(DESCRIBED.get(format_of(file) or ""), file) for file in files]
        tables = [_table(describe(file)) for describe, file in found if describe is not None]
        if tables:
            return "\n\n".join(tables)
    if what not in known_priors() and not os.path.exists(path):
        raise _nothing_found(what)
    if what in known_priors() or path.suffix == ".safetensors":
        return describe_prior(load_prior(what))
    if path.suffix == ".toml":
        return _describe_cameras(path)
    if path.suffix == ".npz":
        return _describe_npz(path)
    if path.is_dir() and not holds_openpose(path):
        return _describe_recordings(path)
    if _holds_recordings(path):
        return _describe_recordings(path)
    from torchpose.io._keypoints import read_keypoints

    return describe_keypoints(read_keypoints(path))


def _nothing_found(what: str) -> PriorError:
    """Return the error of what is no file and no name."""
    from torchpose.priors._shipped import KINDS, known_models
    from torchpose.priors._upper_body_prior import known_priors

    priors = ", ".join(known_priors()) or "none in this installation"
    models = ", ".join(sorted({name for kind in KINDS for name in known_models(kind)})) or "none"
    return PriorError(
        f"expected the name of a prior ({priors}) or of a model of whole bodies ({models}), or a file, got "
        f"{what!r}, which is none of them"
    )


def _models_of(name: str) -> list[Path]:
    """Return the files of the models of whole bodies that come with the package under this name."""
    from torchpose.priors._shipped import KINDS, find_model, known_models

    return [find_model(kind, name) for kind in KINDS if name in known_models(kind)]


def _describe_npz(path: Path) -> str:
    """Return a description of an .npz file of poses, recordings or keypoints, told apart by its keys."""
    from torchpose._core.reading import npz_keys
    from torchpose.io._keypoints import read_keypoints

    keys = set(npz_keys(path))
    if {"state", "body_frame"} <= keys:
        from torchpose.cli._info_models import describe_body_poses

        return _table(describe_body_poses(path))
    if {"joints3d", "covariance3d"} <= keys:
        return describe_poses(path)
    if "joints" in keys:
        return _describe_recordings(path)
    if keys & {"keypoints", "joints2d"}:
        return describe_keypoints(read_keypoints(path))
    raise InputError(
        f"{path}: expected poses (joints3d, covariance3d), keypoints (keypoints, names) or a "
        f"recording (joints, names), got the keys {', '.join(sorted(keys)) or 'none'}"
    )


def describe_prior(prior: "UpperBodyPrior") -> str:
    """Return a description of a prior: what it was fitted on, its noise and its camera."""
    from torchpose.cli._track_output import camera_text

    info = prior.info
    noise = ", ".join(f"{name} {list(value.shape)}" for name, value in prior.noise.items())
    same = ", right arm mirrored from the left" if info.mirrored else ""
    frames = f"{info.n_samples} per arm from {info.n_frames} recorded frames"
    return _table(
        {
            "prior": info.name or "without a name",
            "components": f"{prior.left.n_components} left, {prior.right.n_components} right{same}",
            "skeleton": info.skeleton,
            "neck, hand": f"{info.neck or 'not stated'}, {info.hand or 'not stated'}",
            "centred on": info.centre,
            "camera": camera_text(prior.camera),
            "rotations": info.rotation_order,
            "fps": f"{info.fps:g}" if info.fps else "",
            "transition": info.transition,
            "windows": ", ".join(prior.windows),
            "noise": noise or "not learnt: the tracker's defaults",
            "states": frames if info.n_samples else "",
            "persons": f"{len(info.persons)}: {', '.join(info.persons)}" if info.persons else "",
            "sources": "; ".join(info.sources),
            "licence": info.licence,
            "command": info.command,
        }
    )


def describe_poses(path: Path) -> str:
    """Return the frames, shares, uncertainty (as `BodyTrack.joints_std`) and notes of a file of poses."""
    from torchpose.math._gaussian import mean_std
    from torchpose.upper_body._pose_track import PoseTrack

    track = PoseTrack.load(path)
    std = mean_std(track.covariance3d)
    n_frames = track.joints3d.shape[1]
    facts = {
        "poses": str(path),
        "sequences": "" if len(track) == 1 else str(len(track)),
        "frames": _length(n_frames, track.fps),
        "frame": {"camera": "camera axes: x right, y down, z forward"}.get(
            track.frame, track.frame
        ),
        "score": f"{float(track.log_evidence.sum(-1).mean()):.3f} per frame (log evidence, both arms)",
        "sample size": _sample_sizes(track.effective_sample_size),
        "failed at": ", ".join(str(int(i)) for i in track.failed_at if i >= 0),
        "notes": "; ".join(track.notes),
    }
    rows = ["joint            measured   std per axis (cm)"]
    shares = track.observed.double().mean((0, 1)).tolist()
    spreads = std.nanmean((0, 1)).tolist()
    for name, share, spread in zip(track.names, shares, spreads, strict=True):
        rows.append(f"{name:<16}{100 * share:>7.1f} %{100 * spread:>20.1f}")
    return _table(facts) + "\n\n" + "\n".join(rows)


def _sample_sizes(size: "Tensor") -> str:
    """Return the median effective sample size of each arm; empty where a file does not say."""
    known = size[size.isfinite().all(-1)]
    if not len(known):
        return ""
    left, right = known.quantile(0.5, 0).tolist()
    return f"{left:.3g} (left arm), {right:.3g} (right arm), median"


def describe_keypoints(keypoints: "Keypoints") -> str:
    """Return the frames, joints and camera of a file of keypoints."""
    from torchpose.camera._pinhole import PinholeCamera
    from torchpose.cli._track_output import camera_text, percent
    from torchpose.io._keypoints import said_of_crowd
    from torchpose.skeleton._joint_sets import UPPER_BODY
    from torchpose.skeleton._upper_body import upper_body_indices

    found = upper_body_indices(keypoints.names)
    shares = keypoints.measured.double().mean(0).tolist()
    used = {
        joint: percent(shares[i])
        for joint, i in zip(UPPER_BODY, found.indices, strict=True)
        if i >= 0
    }
    size, K = keypoints.image_size, keypoints.K
    camera = "not stated: give --camera" if size is None else "not stated: guessed from the image"
    return _table(
        {
            "keypoints": str(keypoints.path),
            "frames": _length(len(keypoints), keypoints.fps),
            "names": ", ".join(keypoints.names),
            "measured": ", ".join(f"{joint} {share}" for joint, share in used.items()),
            "missing": ", ".join(found.missing),
            "neck, hand": f"{keypoints.neck or found.neck or 'not stated'}, {found.hand or 'none'}",
            "image": "" if size is None else f"{size[0]} x {size[1]} pixels",
            "camera": camera if K is None else camera_text(PinholeCamera.from_matrix(K)),
            "people": said_of_crowd(keypoints.n_people, keypoints.keypoints),
            "notes": "; ".join(keypoints.notes),
        }
    )


def _describe_recordings(path: Path) -> str:
    from torchpose.io._recordings import (
        find_recordings,
        notes_on_unread_files,
        read_recordings,
    )
    from torchpose.learning._curation.curate import notes_on_recordings

    found = find_recordings(path)
    recordings = read_recordings(found)
    frames = sum(len(r) for r in recordings)
    rates = {r.fps for r in recordings}
    length = _length(frames, rates.pop() if len(rates) == 1 else None)
    if len(rates) > 1 and None not in rates:
        seconds = sum(len(r) / r.fps for r in recordings if r.fps)
        low, high = min(filter(None, rates)), max(filter(None, rates))
        length = f"{frames} ({seconds:.1f} s at {low:.4g} to {high:.4g} fps)"
    necks = {str(r.upper_body().neck) for r in recordings}
    notes = [*notes_on_recordings(recordings), *notes_on_unread_files(path, found)]
    return _table(
        {
            "recordings": f"{len(recordings)} in {path}",
            "frames": length,
            "persons": ", ".join(sorted({r.person_id for r in recordings})),
            "joint sets": ", ".join(sorted({r.skeleton or "other" for r in recordings})),
            "necks": ", ".join(sorted(necks)),
            "notes": "\n".join(notes),
        }
    )


def _describe_cameras(path: Path) -> str:
    from torchpose.camera._pinhole import read_cameras
    from torchpose.cli._track_output import camera_text

    cameras, notes = read_cameras(path)
    rows = {name: camera_text(camera) for name, camera in cameras.items()}
    return _table({**rows, "note": "\n".join(notes)})


def _holds_recordings(path: Path) -> bool:
    """Return whether a file that is no .npz is to be read as recordings; tables of keypoints look alike."""
    from torchpose.io._recordings import looks_recorded

    suffix = path.suffix.lower()
    if suffix in (".yaml", ".yml"):
        return True
    if suffix == ".csv" and not _starts_as_keypoints(path):
        return True
    return suffix in _RECORDINGS and looks_recorded(path)


def _starts_as_keypoints(path: Path) -> bool:
    """Return whether a table begins with a header, as keypoints do and recordings of a Kinect do not."""
    from torchpose._core.reading import reading, require_file
    from torchpose.io._formats.keypoint_files import is_keypoint_header
    from torchpose.io._formats.table_rows import split_row

    path = require_file(path)
    with reading(path, "a table"), path.open(encoding="utf-8-sig", errors="replace") as stream:
        lines = stream.read(_SNIFFED).splitlines()
    first = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    return is_keypoint_header(split_row(first))


def _length(n_frames: int, fps: float | None) -> str:
    return (
        f"{n_frames} ({n_frames / fps:.1f} s at {fps:g} fps)"
        if fps
        else f"{n_frames} (rate unknown)"
    )


def _table(facts: dict[str, str]) -> str:
    """Return lines of a name and a value, whose further lines are indented; empty values are left out."""
    from torchpose.errors import printable

    rows = {printable(name, _NAME): value.split("\n") for name, value in facts.items() if value}
    width = max(len(name) for name in rows) + 2
    lines = {name: [printable(line) for line in value] for name, value in rows.items()}
    indent = "\n" + " " * width
    return "\n".join(f"{name:<{width}}{indent.join(value)}" for name, value in lines.items())
