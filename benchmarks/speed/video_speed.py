"""How many frames a second from video to poses, and where the time goes.

    python -m benchmarks.speed.video_speed --data DIR --threads 2 [--mediapipe PYTHON]

The seven clips of video_asl, 640 x 480, one after the other as one H.264 file, decoding included and
drawing not. `--mediapipe` is the interpreter of an environment with mediapipe 0.10.21 (see
`mediapipe_landmarks.py`); its full pose model then reads the same file in the same run.

The first row has another process that looks at the images, whose time the column of CPU leaves out. Stages
are timed by the clock of the thread that they run in, in a run of their own and in one process.
"""

import functools
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks._command import run_command
from benchmarks.speed._timing import Case, Report, Setup, Timing, begin, take_turns

CLIPS = ("again", "brother", "help", "bird", "milk", "book", "learn")
FPS = 30.0
_REST = "- not listed"
_WITHIN = threading.local()  # the time of the calls within one, of each thread


def main(
    setup: Setup = Setup(runs=3),
    *,
    data: Path,
    mediapipe: Path | None = None,
    repeat: int = 2,
) -> None:
    """Print both tables.

    Args:
        setup: see `Setup`.
        data: folder with video_asl/.
        mediapipe: Python of an environment with mediapipe.
        repeat: how often the clips follow each other.
    """
    report = begin("Speed of the video pipeline", setup)
    from torchpose.cli._common import share_cores

    share_cores()  # as the command does
    with tempfile.TemporaryDirectory() as folder:
        clip = Path(folder) / "clips.mp4"
        names = CLIPS[:1] if setup.quick else CLIPS * repeat
        n_frames = join([data / "video_asl" / f"{name}.mkv" for name in names], clip)
        report.add(f"{n_frames} frames of 640 x 480, H.264.")
        whole(report, clip, n_frames, setup, mediapipe)
        stages(report, clip, n_frames)
    report.close(("opencv-python-headless", "av"))


def join(clips: list[Path], path: Path) -> int:
    """Write several clips as one file, and return the number of its frames."""
    from torchpose.video import VideoWriter, open_video

    count = 0
    with VideoWriter(path, FPS, (640, 480)) as writer:
        for clip in clips:
            with open_video(clip, fps=FPS) as source:
                for frame in source:
                    writer.write(frame.image)
                    count += 1
    return count


def make_tracker(**options: Any) -> Any:
    """Return the tracker with its defaults."""
    from torchpose import PinholeCamera, VideoTracker, load_prior

    camera = PinholeCamera.from_image_size(640, 480)
    return VideoTracker(load_prior("kinect-upper-body"), camera, fps=FPS, **options)


def whole(report: Report, clip: Path, n_frames: int, setup: Setup, mediapipe: Path | None) -> None:
    """Time the whole pipeline, beside MediaPipe."""
    from torchpose.video import open_video

    def track(tracker: Any, **options: Any) -> None:
        with open_video(clip) as source:
            tracker(source, **options)

    recorder, alone, camera = make_tracker(), make_tracker(), make_tracker()
    paper, parted = make_tracker(hands="mean-shift"), make_tracker(background=True)
    cases = [
        Case("a recording", lambda: track(recorder, workers=1), n_frames),
        Case("a recording, without another process", lambda: track(alone), n_frames),
        Case(
            "frame by frame, as a camera is",
            lambda: track(camera, watch=lambda *_: None),
            n_frames,
        ),
        Case("hands by mean shift (the paper)", lambda: track(paper), n_frames),
        Case("with the background model", lambda: track(parted), n_frames),
        Case("decoding alone", lambda: decode(clip), n_frames),
    ]
    timings = take_turns(cases, setup.runs)
    rows = [row(timing) for timing in timings]
    if mediapipe is not None:
        rows.append(mediapipe_row(mediapipe, clip, setup))
    report.table(("", "frames/s", "ms a frame", "CPU ms a frame"), rows)


def decode(clip: Path) -> None:
    """Read all frames of a video."""
    from torchpose.video import open_video

    with open_video(clip) as source:
        for _ in source:
            pass


def row(timing: Timing) -> tuple[str, ...]:
    """Return the medians of a timing as a row."""
    return (
        timing.case.name,
        f"{1 / timing.median:.0f}",
        f"{1e3 * timing.median:.1f}",
        f"{1e3 * timing.median_cpu:.1f}",
    )


def mediapipe_row(python: Path, clip: Path, setup: Setup) -> tuple[str, ...]:
    """Time the full pose model of MediaPipe on the same file and cores."""
    script = Path(__file__).parents[1] / "mediapipe_landmarks.py"
    command = [str(python), str(script), str(clip), "--time", "--threads", str(setup.threads)]
    command += ["--repeat", str(setup.runs)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    found = re.search(r"together ([\d.]+) ms", done.stdout)
    if found is None:
        sys.exit(f"no time in what MediaPipe's script printed: {done.stdout!r}")
    ms = float(found[1])
    return "MediaPipe pose, full, decoding included", f"{1e3 / ms:.0f}", f"{ms:.1f}", "-"


def stages(report: Report, clip: Path, n_frames: int) -> None:
    """Time of each part, by the clock of its thread; without the parts within it that are listed too."""
    from torchpose.video import open_video

    tracker = make_tracker()
    parts = parts_of(tracker)
    with open_video(clip) as source, timed_parts(parts) as spent:
        tracker(source)
    start = time.thread_time()
    decode(clip)
    spent["decoding"] = time.thread_time() - start
    every = dict.fromkeys(name for name, _, _ in parts if name != _REST)
    of_hands = [name for name in every if name.startswith("-")] + [_REST]
    order = ["decoding", *every]
    place = order.index(of_hands[0])
    order[place : place + len(of_hands) - 1] = ["hands: all", *of_hands]
    total = sum(spent.values())
    spent["hands: all"] = sum(spent.get(name, 0.0) for name in of_hands)
    rows = [(name, f"{1e3 * spent.get(name, 0.0) / n_frames:.2f}") for name in order]
    rows.append(("sum", f"{1e3 * total / n_frames:.2f}"))
    report.table(("stage", "ms a frame"), rows)
    report.add(
        "Decoding, faces, and what images alone tell of hands run in one thread, the rest in another."
    )


def parts_of(tracker: Any) -> list[tuple[str, Any, str]]:
    """Return the stages, in the order of the table: name, owner and method; some are several methods."""
    from torchpose.measure import _hand_windows as windows
    from torchpose.measure import _hands as module

    measurer = tracker.measurer
    hands = measurer.hand_tracker
    return [
        ("cuts to other scenes", measurer.scene_cuts, "step"),
        ("faces: detection and tracks", measurer, "_follow_faces"),
        (_REST, hands, "look"),
        (_REST, hands, "find"),
        ("- windows", windows, "cut_colours"),
        ("- skin", hands.skin, "byte_bins"),
        ("- skin", windows, "parts_of_persons"),
        ("- skin", hands.skin, "learn"),
        ("- skin", hands.skin, "find"),
        ("- face memory", hands.memory, "step"),
        ("- motion and optical flow", hands.motion, "step"),
        ("- maps about the face", hands.windows, "_prior"),
        ("- maps about the face", hands.windows, "_rebirth"),
        ("- maps about the face", hands.likelihood, "shape_places"),
        ("- likelihood", hands.likelihood, "over_hands"),
        ("- likelihood", hands.likelihood, "means"),
        ("- likelihood", hands.likelihood, "forward"),
        ("- network", hands.network, "see_colours"),
        ("- network", hands.network, "find"),
        ("- beliefs over cells", hands, "_filter"),
        ("- places of the hands", hands, "_measure"),
        ("- elbows", module, "expected_elbows"),
        ("- elbows", module, "find_elbows"),
        ("who is who", measurer.register, "step"),
        ("head and neck", measurer.head_neck, "forward"),
        ("poses, 32 frames at a time", tracker.tracker, "advance"),
    ]


@contextmanager
def timed_parts(parts: Sequence[tuple[str, Any, str]]) -> Iterator[dict[str, float]]:
    """Time methods while a block runs; the seconds by name of the stage are complete after it."""
    spent: dict[str, float] = {}
    kept = [(owner, method, getattr(owner, method)) for _, owner, method in parts]
    for name, owner, method in parts:
        object.__setattr__(owner, method, timed(getattr(owner, method), name, spent))
    try:
        yield spent
    finally:
        for owner, method, own in kept:
            object.__setattr__(owner, method, own)


def timed(call: Any, name: str, spent: dict[str, float]) -> Any:
    """Return `call` wrapped so that its time is added up, without that of wrapped calls in it."""

    @functools.wraps(call)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        outer, _WITHIN.spent = getattr(_WITHIN, "spent", 0.0), 0.0
        start = time.thread_time()
        try:
            return call(*args, **kwargs)
        finally:
            taken = time.thread_time() - start
            spent[name] = spent.get(name, 0.0) + taken - _WITHIN.spent
            _WITHIN.spent = outer + taken

    return wrapped


if __name__ == "__main__":
    run_command(main)
