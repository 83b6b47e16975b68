"""Particle filters over bodies with silhouettes, with keypoints and with both, beside the Kalman filter.

Bodies, cameras and silhouettes are those of the protocols Silhouette (walks in three cameras), Root
uncertainty (the same walks at few frames per second) and Bend (one camera beside a person who bends); the
walks are also tracked in one camera alone. Keypoints of the same bodies in the same cameras have the faults
of `benchmarks.keypoint_bodies`, in images nine times as large as the silhouettes. Bone lengths are of other
recordings of the person. It writes summary-keypoint-filters.md.

    python -m benchmarks.body_keypoint_filters --data DIR --out DIR
"""

import math
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._command import run_command
from benchmarks._data import data_files
from benchmarks._table_file import save_text
from benchmarks.bend.occlusion import SIDE
from benchmarks.bodies.clips import place_cameras
from benchmarks.bodies.views import Conditions, body_of, view_of
from benchmarks.keypoint_bodies.clips import MHAD, WALKS, detect
from torchpose import BodyTracker
from torchpose._core.files import check_output_folder
from torchpose.body import Body
from torchpose.camera import CameraRig
from torchpose.errors import TorchposeError
from torchpose.evaluation import Report
from torchpose.io import read_mocap
from torchpose.io._mocap import MocapClip

TRACKED = {WALKS: ("s35_35_02_walk", "s35_35_28_walk"), MHAD: ("s10_a03_bend_r1",)}
BODIES = {"s35": "s35_35_0[1]*", "s10": "s10_a11_stand_up_r1*"}
"""Recordings of which bone lengths and radii are fitted, by person."""

INPUTS = ("silhouettes", "keypoints", "both", "keypoints, pose found")
WALK_MODELS: dict[str, dict[str, Any]] = {
    "sir": {}, "apf": {}, "mrpf": {"manifold": "walk"}, "root": {"conditionals": "walk"},
}  # fmt: skip
BEND_MODELS: dict[str, dict[str, Any]] = {
    "sir": {}, "apf": {}, "root": {"conditionals": "exercises"},
    "constrained": {"action": "exercises"},
}  # fmt: skip
_SCALE = 9  # of the detector's images against the silhouettes
_FPS, _SLOW = 30.0, 2


class Seen(NamedTuple):
    """Holds a clip as cameras see it: joints [T, 15, 3], silhouettes, keypoints, confidence."""

    joints: Tensor
    rig: CameraRig
    body: Body
    start: Tensor
    silhouettes: Tensor
    keypoints: Tensor
    confidence: Tensor
    fps: float

    def of_cameras(self, count: int) -> "Seen":
        """Return the clip in the first cameras."""
        parts = (v[:, :count] for v in (self.silhouettes, self.keypoints, self.confidence))
        silhouettes, keypoints, confidence = parts
        return self._replace(
            rig=self.rig.select(range(count)), silhouettes=silhouettes, keypoints=keypoints,
            confidence=confidence,
        )  # fmt: skip

    def every(self, step: int) -> "Seen":
        """Return every so many frames."""
        parts = {n: getattr(self, n)[::step] for n in ("joints", "silhouettes", "keypoints")}
        return self._replace(confidence=self.confidence[::step], fps=self.fps / step, **parts)


def see(clip: MocapClip, others: list[MocapClip], azimuths: tuple[float, ...], seed: int) -> Seen:
    """Return a clip as cameras at these angles see it."""
    conditions = Conditions(
        rig=place_cameras(clip, azimuths), cameras_used=len(azimuths), seed=seed
    )
    own = Conditions(cameras_used=len(azimuths), azimuths=azimuths, seed=seed)
    body = body_of(others, own)
    view = view_of(body, clip, conditions)
    generator = torch.Generator().manual_seed(seed)
    joints = clip.joints.double()
    found = detect(view.rig(joints).pixels * _SCALE, generator)
    return Seen(
        joints, view.rig, body, view.initial_state, view.silhouettes, found.keypoints / _SCALE,
        found.confidence, clip.fps,
    )  # fmt: skip


def clips_of(data: Path, frames: int) -> Iterator[tuple[str, MocapClip, list[MocapClip]]]:
    """Yield the set, the tracked clip and the recordings of which its body is fitted."""
    for folder, names in TRACKED.items():
        for name in names:
            (clip,) = read_mocap(data / folder / f"{name}.npz", fps=_FPS)
            first = max(0, (len(clip) - frames) // 2)
            paths = data_files(data / folder, f"{BODIES[name[:3]]}.npz")[:1]
            others = [one for path in paths for one in read_mocap(path, fps=_FPS)]
            yield folder, clip.cut(first, first + frames), [one.cut(0, frames) for one in others]


def scenes(data: Path, frames: int, seed: int) -> dict[str, list[Seen]]:
    """Return the clips of every column of the table."""
    found: dict[str, list[Seen]] = {name: [] for name in COLUMNS}
    for folder, clip, others in clips_of(data, frames):
        if folder == MHAD:
            found["bend, 1 camera"].append(see(clip, others, (SIDE,), seed))
            continue
        seen = see(clip, others, Conditions().azimuths, seed)
        found["walk, 3 cameras"].append(seen)
        found["walk at 15 Hz, 3 cameras"].append(seen.every(_SLOW))
        found["walk, 1 camera"].append(seen.of_cameras(1))
    return found


COLUMNS = {
    "walk, 3 cameras": WALK_MODELS,
    "walk at 15 Hz, 3 cameras": WALK_MODELS,
    "walk, 1 camera": WALK_MODELS,
    "bend, 1 camera": BEND_MODELS,
}
"""Methods with their models, by columns of the table."""


def error(seen: Seen, joints: Tensor, first: int = 0) -> float:
    """Return the mean distance of joints, mm."""
    return 1000 * float((joints - seen.joints[first:]).norm(dim=-1).nanmean())


def tracked(
    seen: Seen, method: str, models: Mapping[str, Any], given: str, particles: int, seed: int
) -> float:
    """Return the error of a method with some input, mm; NaN where it finds nobody."""
    more = {} if method == "kalman" else {"n_particles": particles, **models}
    tracker = BodyTracker(
        seen.rig, method, body=seen.body, fps=seen.fps, pixel_std=1 / _SCALE, **more
    )
    points = {"keypoints": seen.keypoints, "confidence": seen.confidence}
    try:
        if method == "kalman":
            poses = tracker(**points)
        else:
            outlined = seen.silhouettes if given in ("silhouettes", "both") else None
            start = seen.body.convert(seen.start, tracker.body)
            poses = tracker(
                outlined, None if given.endswith("found") else start,
                **({} if given == "silhouettes" else points),
                generator=torch.Generator().manual_seed(seed),
            )  # fmt: skip
    except TorchposeError:
        return math.nan
    return error(seen, poses.joints3d, poses.first_frame)


def main(
    data: Path,
    out: Path,
    frames: int = 30,
    particles: int = 500,
    seed: int = 0,
    progress: bool = True,
) -> None:
    """Write summary-keypoint-filters.md.

    Args:
        data: folder of the recordings. out: folder for the report.
        frames: of each clip, at 30 Hz. particles: likelihoods per frame.
        seed: of cameras, faults and particles. progress: whether to show a bar.
    """
    out = check_output_folder(out)
    found = scenes(data, frames, seed)
    jobs: list[tuple[str, str, str]] = [
        (column, method, given)
        for column, methods in COLUMNS.items()
        for method in methods
        for given in INPUTS
    ] + [(column, "kalman", "keypoints") for column in COLUMNS]
    errors: dict[tuple[str, str], dict[str, float]] = {
        ("standing still", "-"): {
            column: _mean([error(s, s.joints[:1].expand_as(s.joints)) for s in clips])
            for column, clips in found.items()
        }
    }
    for column, method, given in tqdm(jobs, disable=not progress, unit="method"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            values = [
                tracked(s, method, COLUMNS[column].get(method, {}), given, particles, seed)
                for s in found[column]
            ]
        errors.setdefault((method, given), {})[column] = _mean(values)
    _write(errors, out, frames, particles)


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)


def _write(
    errors: Mapping[tuple[str, str], Mapping[str, float]], out: Path, frames: int, particles: int
) -> None:
    report = Report(
        "Particle filters over bodies with keypoints", {"frames": frames, "particles": particles}
    )
    table = report.table(
        "errors", "Mean distance of the joints (mm)", list(COLUMNS), digits=0,
        note=f"{particles} likelihoods a frame, {frames} frames at 30 Hz of each clip, one seed; "
        "walks s35_35_02 and s35_35_28, bend s10_a03. The first pose is given but for \"pose found\" "
        "and kalman. The shipped models were not learnt from these persons, but for the limb "
        "conditionals of walks, which know other walks of s35.",
    )  # fmt: skip
    for (method, given), row in sorted(errors.items(), key=lambda item: _place(item[0])):
        name = method if given == "-" else f"{method}, {given}"
        table.add(name, [row.get(column) for column in COLUMNS])
    print(report.summary())
    save_text(out / "summary-keypoint-filters.md", table.to_markdown() + "\n")


def _place(key: tuple[str, str]) -> tuple[int, int]:
    methods = ["standing still", "sir", "apf", "mrpf", "root", "constrained", "kalman"]
    return methods.index(key[0]), ["-", *INPUTS].index(key[1])


if __name__ == "__main__":
    run_command(main)
