"""Does the memory of the video pipeline grow with the length of the video?

    python -m benchmarks.speed.video_memory --data DIR --minutes 60

A clip of video_asl is read over and over as one recording at 30 frames a second, tracked as
`torchpose track` does, and the resident memory is looked at after every minute of video. At the end
the poses of the whole recording are written.
"""

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks._command import run_command
from benchmarks.speed._timing import Report, Setup, begin

FPS = 30.0
PAGE = 4096


def main(setup: Setup = Setup(), *, data: Path, minutes: float = 60.0) -> None:
    """Track, and print how memory went.

    Args:
        setup: see `Setup`.
        data: folder with video_asl/.
        minutes: of video.
    """
    report = begin("Memory over a long video", setup)
    n_frames = 300 if setup.quick else round(60 * FPS * minutes)
    with tempfile.TemporaryDirectory() as folder:
        measure(report, data / "video_asl" / "book.mkv", n_frames, Path(folder))
    report.close(("opencv-python-headless", "av"))


def measure(report: Report, clip: Path, n_frames: int, folder: Path) -> None:
    """Report the resident memory at some minutes, and while the result is written."""
    from tqdm.auto import tqdm

    from torchpose import PinholeCamera, VideoTracker, load_prior

    tracker = VideoTracker(
        load_prior("kinect-upper-body"), PinholeCamera.from_image_size(640, 480), fps=FPS
    )
    seen: list[tuple[float, float]] = []

    def frames() -> Iterator[Any]:
        every = max(1, min(n_frames // 6, round(60 * FPS)))
        for index, frame in enumerate(loop(clip, n_frames)):
            if index % every == every - 1:
                seen.append(((index + 1) / FPS / 60, resident()))
                tqdm.write(f"minute {seen[-1][0]:.1f}: {seen[-1][1]:.0f} MB")
            yield frame

    start = time.perf_counter()
    people = tracker(tqdm(frames(), total=n_frames, unit="frame"), folder=folder)
    seconds = time.perf_counter() - start
    before = resident()
    for number, person in enumerate(people):
        person.track.save(folder / f"poses{number}.npz")
    shown = seen if len(seen) <= 8 else [seen[round(i * (len(seen) - 1) / 7)] for i in range(8)]
    rows = [(f"{minute:.1f}", f"{memory:.0f}") for minute, memory in shown]
    report.table(("minute of the video", "resident (MB)"), rows)
    later = [memory for minute, memory in seen if minute >= 0.2 * seen[-1][0]]
    size = sum(path.stat().st_size for path in folder.glob("*.npz")) / 2**20
    report.add(
        f"{n_frames} frames in {seconds:.0f} s; {len(people)} person, "
        f"{len(people[0]) if people else 0} poses. Largest less smallest after the first fifth: "
        f"{max(later) - min(later):.0f} MB. Writing poses.npz ({size:.0f} MB) took it from "
        f"{before:.0f} to {resident():.0f} MB."
    )


def loop(path: Path, n_frames: int) -> Iterator[Any]:
    """Yield the frames of a clip again and again, decoded anew each time."""
    from torchpose.video import open_video

    count = 0
    while True:
        with open_video(path, fps=FPS) as source:
            for frame in source:
                if count == n_frames:
                    return
                count += 1
                yield frame


def resident() -> float:
    """Return the resident memory of this process, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE / 2**20


if __name__ == "__main__":
    run_command(main)
