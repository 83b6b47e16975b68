"""MediaPipe's landmarks of a video, as a keypoint file for `torchpose track`; and how long they take.

MediaPipe 0.10.21 is the last release that brings its models. It needs NumPy 1 and an OpenCV of its
own, so it gets an environment of its own, in which torchpose is not installed:

    python -m venv .venv-mediapipe
    .venv-mediapipe/bin/python -m pip install mediapipe==0.10.21
    .venv-mediapipe/bin/python -m benchmarks.mediapipe_landmarks clip.mp4 --out clip_landmarks.npz
    torchpose track clip_landmarks.npz --out result

Keys of the file: joints2d [T, 33, 2] (pixels), joints3d [T, 33, 3] (MediaPipe's own estimate: metres,
from the middle of the hips, x right in the image, y down, z away from the camera), visibility [T, 33],
names, fps, image_size and model. In frames without a person joints are NaN and visibility is 0.

With `--time` the last line says how long decoding and MediaPipe take for a frame.
"""

import argparse
import os
import platform
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

try:
    import cv2
    import mediapipe
except ImportError:
    mediapipe = None

MODELS = ("lite", "full", "heavy")
RELEASE = "0.10.21"


def main() -> int:
    """Read, detect, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("video", type=Path)
    parser.add_argument("--out", type=Path, help=".npz file of the landmarks")
    parser.add_argument("--complexity", type=int, default=1, choices=(0, 1, 2), help="default 1")
    parser.add_argument("--time", action="store_true", help="print milliseconds per frame")
    parser.add_argument("--repeat", type=int, default=1, help="runs to time; the median is printed")
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="cores")
    args = parser.parse_args()
    if args.out is None and not args.time:
        parser.error("give --out FILE, --time, or both")
    if not args.video.is_file():
        parser.error(f"{args.video}: no such video file")
    if args.out is not None and (args.out.suffix != ".npz" or not args.out.parent.is_dir()):
        parser.error(
            f"--out {args.out}: expected a name that ends in .npz, in a folder that is there"
        )
    if not hasattr(mediapipe, "solutions"):
        parser.error(f"needs an environment with MediaPipe: pip install mediapipe=={RELEASE}")
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[: args.threads]))
    runs = [detect(args.video, args.complexity) for _ in range(max(1, args.repeat))]
    arrays, _, _ = runs[0]
    if not len(arrays["joints2d"]):
        print(f"{args.video}: no frame could be decoded", file=sys.stderr)
        return 1
    if args.out is not None:
        save(args.out, arrays)
        seen = int((arrays["visibility"] > 0).any(1).sum())
        print(f"{args.out}: {len(arrays['joints2d'])} frames, a person in {seen}")
    if args.time:
        print(timing(runs, args))
    return 0


def detect(video: Path, complexity: int) -> tuple[dict[str, Any], list[float], list[float]]:
    """Return the arrays of the landmarks, and seconds for decoding and for MediaPipe of every frame."""
    capture = cv2.VideoCapture(str(video))
    size = [int(capture.get(k)) for k in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
    fps = capture.get(cv2.CAP_PROP_FPS)
    pose = mediapipe.solutions.pose
    names = [landmark.name.lower() for landmark in pose.PoseLandmark]
    rows, decoding, detecting = [], [], []
    with pose.Pose(model_complexity=complexity) as model:
        while True:
            started = time.perf_counter()
            read, frame = capture.read()
            if not read:
                break
            image = cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
            decoded = time.perf_counter()
            found = model.process(image)
            detecting.append(time.perf_counter() - decoded)
            decoding.append(decoded - started)
            rows.append(as_row(found, len(names), size))
    table = np.array(rows, dtype=np.float32).reshape(-1, len(names), 6)
    arrays = {
        "joints2d": table[..., :2],
        "visibility": table[..., 2],
        "joints3d": table[..., 3:],
        "names": np.array(names),
        "fps": fps,
        "image_size": np.array(size),
        "model": f"mediapipe {mediapipe.__version__} pose, {MODELS[complexity]}",
    }
    return arrays, decoding, detecting


def save(path: Path, arrays: dict[str, Any]) -> None:
    """Write an .npz file, the whole of it or none."""
    part = path.with_name(f"{path.name}.part")
    try:
        with part.open("wb") as file:
            np.savez_compressed(file, **arrays)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def as_row(found: Any, n_joints: int, size: list[int]) -> list[tuple[float, ...]]:
    """Return (u, v, visibility, x, y, z) of every joint."""
    if found.pose_landmarks is None or found.pose_world_landmarks is None:
        return [(np.nan, np.nan, 0.0, np.nan, np.nan, np.nan)] * n_joints
    pairs = zip(found.pose_landmarks.landmark, found.pose_world_landmarks.landmark, strict=True)
    return [(p.x * size[0], p.y * size[1], p.visibility, w.x, w.y, w.z) for p, w in pairs]


def timing(runs: list[tuple[dict[str, Any], list[float], list[float]]], args: Any) -> str:
    """Return the time of a frame: medians over runs of the mean, without the first ten frames."""
    means = [
        (1000 * statistics.fmean(d[10:] or d), 1000 * statistics.fmean(m[10:] or m))
        for _, d, m in runs
    ]
    decoding, detecting = (statistics.median(values) for values in zip(*means, strict=True))
    arrays = runs[0][0]
    width, height = arrays["image_size"]
    whole = decoding + detecting
    return (
        f"mediapipe {mediapipe.__version__} {MODELS[args.complexity]}, {width}x{height}, "
        f"{args.threads} cores ({platform.machine()}): decoding {decoding:.2f} ms, "
        f"MediaPipe {detecting:.2f} ms, together {whole:.2f} ms = {1000 / whole:.1f} frames per second"
    )


if __name__ == "__main__":
    sys.exit(main())
