"""`torchpose demo --input walk`: a walk in three cameras, rendered, tracked with a manifold, and scored."""

import re
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor

    from torchpose.demo._rendering.walk import Walk

_FPS = 30.0
_HEIGHT = 1.8
_PARTICLES = 500
_MANIFOLD = "walk"
_SAID = """\
Somebody walks past three cameras. The walk is animated by hand, from joint angles of textbooks on gait: it
is neither recorded nor drawn from the manifold, which was fitted to other people's walks. The body that is
rendered is not the tracker's, which has average proportions and {height:g} m. It is a smoke test, and no
measure of how well the tracker does on people: see `python -m benchmarks.body_models`.
"""
_PARTS = ("neck", "elbow", "wrist", "hip", "knee", "ankle")


def demo_walk(folder: str, seconds: float, seed: int, pictures: bool) -> int:
    """Render, track by `torchpose track-body`, score; return exit code 1 if standing still is not beaten."""
    from torchpose.cli import _track_body as track_body
    from torchpose.demo._rendering.walk import walk
    from torchpose.whole_body._body_track import BodyTrack

    print(_SAID.format(height=_HEIGHT))
    walker, out = walk(seconds, _FPS, _HEIGHT, seed), Path(folder)
    videos, scenes = _render(walker, out, seed)
    started = time.process_time()
    line = [
        str(out / "cameras.toml"), *map(str, videos), "--background", *map(str, scenes),
        "--manifold", _MANIFOLD, "--height", str(_HEIGHT), "--n-particles", str(_PARTICLES),
        "--seed", str(seed), "--out", str(out), "--overlay", str(pictures).lower(),
        "--pictures", str(pictures).lower(),
    ]  # fmt: skip
    print(f"torchpose track-body {' '.join(line)}\n", flush=True)
    code = track_body.main(line)
    if code or not (out / "body.npz").is_file():
        print("torchpose: the demo failed: the walker was not tracked", file=sys.stderr)
        return 1
    elapsed = time.process_time() - started
    poses = BodyTrack.load(out / "body.npz")
    truth = walker.joints[poses.first_frame :][: len(poses)]
    scores = {"tracked": _errors(poses.joints3d, truth), "standing still": _still(truth)}
    print(
        f"\n{_report(scores, list(poses.names))}\n\n{elapsed:.0f} s of processor time, drawing included"
    )
    good = float(scores["tracked"].mean()) < float(scores["standing still"].mean())
    if not good:
        print(
            "torchpose: the demo failed: the tracked poses are no better than standing still",
            file=sys.stderr,
        )
    if pictures:
        print(f"The poses drawn into frames of all cameras: {out / 'overlay.png'}")
    return 0 if good else 1


def _render(walker: "Walk", out: Path, seed: int) -> tuple[list[Path], list[Path]]:
    """Write videos, pictures of the empty scenes, cameras and truth; return videos and pictures."""
    from torchpose.camera._pinhole import save_cameras
    from torchpose.demo._rendering.walk import cameras_around, render_body_video, walk_clip
    from torchpose.io._results import ResultsFolder

    cameras = cameras_around(walk_clip(walker))
    expected = ["cameras.toml", "truth.npz"]
    expected += [f"{camera.name}{end}" for camera in cameras for end in (".mp4", "-empty.png")]
    with ResultsFolder(out, "walk", "|".join(map(re.escape, expected)), expected) as results:
        print(f"rendering {len(walker.joints)} frames of {len(cameras)} cameras ...", flush=True)
        videos, scenes = render_body_video(results.stage, walker, cameras, seed)
        save_cameras(cameras, results.stage / "cameras.toml")
        _write_truth(results.stage / "truth.npz", walker)
        results.commit([results.stage / name for name in expected])
    return [out / path.name for path in videos], [out / path.name for path in scenes]


def _errors(joints: "Tensor", truth: "Tensor") -> "Tensor":
    """Return the distance of every joint [T, 15], millimetres."""
    return 1000 * (joints - truth).norm(dim=-1)


def _still(truth: "Tensor") -> "Tensor":
    """Return the errors of the baseline that keeps the pose of the first frame."""
    return _errors(truth[:1].expand_as(truth), truth)


def _report(scores: dict[str, Any], names: list[str]) -> str:
    """Return the table of errors, one column for each estimate."""
    rows = {"all joints": list(range(len(names)))}
    rows |= {part: [i for i, name in enumerate(names) if name.endswith(part)] for part in _PARTS}
    n_frames = len(next(iter(scores.values())))
    lines = [
        f"Error of the joints in mm over {n_frames} frames, in the room (nothing is aligned)",
        "",
    ]
    lines.append(f"{'':<14}" + "".join(f"{name:>16}" for name in scores))
    lines += [
        f"{part:<14}" + "".join(f"{float(e[:, own].mean()):>16.0f}" for e in scores.values())
        for part, own in rows.items()
    ]
    return "\n".join(lines)


def _write_truth(path: Path, walker: "Walk") -> None:
    """Write the true joints as a recording, which `torchpose info` reads."""
    import numpy as np

    from torchpose._core.files import write_npz

    write_npz(
        path,
        {
            "joints": walker.joints.numpy().astype(np.float32),
            "names": np.array(walker.body.skeleton.names), "fps": np.array(walker.fps),
            "axes": np.array("y-up"), "subject": np.array("walker"), "action": np.array("walk"),
            "source": np.array("animated by hand"),
        },
    )  # fmt: skip
