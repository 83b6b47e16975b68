"""`torchpose demo`: a rendered performer, tracked in video, and scored against the truth."""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from torchpose.cli.common import save_pictures, share_cores, show_progress
from torchpose.cli.demo_scores import MEAN_POSE, beaten, report, score, score_mean_pose
from torchpose.cli.track_output import camera_text, track_pictures
from torchpose.cli.track_video import write_overlay, write_people

if TYPE_CHECKING:
    from torchpose.demo import Performance
    from torchpose.pose_track import PoseTrack
    from torchpose.priors import UpperBodyPrior
    from torchpose.recording import TrackedPerson
    from torchpose.video_tracker import VideoTracker

__all__ = ["demo_video"]

_FPS = 30.0
_DISTANCE = 1.8  # metres: near enough for the face, far enough for raised arms


def demo_video(
    prior: "UpperBodyPrior", out: Path, seconds: float, seed: int, pictures: bool
) -> int:
    """Render, track, score, draw; exit code 1 if the mean pose is not beaten."""
    from torchpose import VideoTracker
    from torchpose.demo import demo_camera, performer
    from torchpose.video import open_video

    share_cores()
    performance, camera = (
        performer(round(seconds * _FPS), _FPS, seed, distance=_DISTANCE),
        demo_camera(),
    )
    clip = out / "clip.mp4"
    _render(clip, performance, seed)
    tracker = VideoTracker(prior, camera, fps=_FPS)
    start = time.perf_counter()
    with open_video(clip) as source:
        people = tracker(source, progress=show_progress(), n_frames=source.n_frames, folder=out)
    elapsed = time.perf_counter() - start
    if not people:
        print("torchpose: the demo failed: nobody was found in its video", file=sys.stderr)
        return 1
    person, n_frames = people[0], len(performance.joints)
    tracks = {"filtered": person.track, "smoothed": _smoothed(tracker, person)}
    truth = performance.joints[person.first_frame :][: len(person)]
    scores = {name: score(track, truth) for name, track in tracks.items()}
    scores[MEAN_POSE] = score_mean_pose(prior, truth)
    print(report(scores, "measured in the video: head and neck from the face, and the hands"))
    print(f"\n{_seen(person)}; {n_frames / elapsed:.0f} frames a second, drawing apart")
    with open_video(clip) as source:
        write_overlay(out / "overlay.mp4", source, people, n_frames)
    write_people(people, out, pictures=False)
    _write_report(out, people, performance, camera_text(camera))
    if pictures:
        _draw(out, person.track, performance, person.first_frame)
    good = beaten(scores)
    print(
        f"\nThe video: {clip}, its truth: {out / 'truth.npz'}\nThe poses drawn into it: "
        f"{out / 'overlay.mp4'}\nThe report, with the skeleton to turn: {out / 'report.html'}"
    )
    return 0 if good else 1


def _render(clip: Path, performance: "Performance", seed: int) -> None:
    from torchpose.demo import demo_camera
    from torchpose.rendering import render_video

    print(f"rendering {len(performance.joints)} frames ...", flush=True)
    render_video(clip, performance, demo_camera(), seed=seed)


def _smoothed(tracker: "VideoTracker", person: "TrackedPerson") -> "PoseTrack":
    """The poses from the same measurements, all frames together."""
    from torchpose import UpperBodyTracker
    from torchpose.recording import smoothed

    smoother = UpperBodyTracker(
        tracker.tracker.prior, tracker.tracker.camera, fps=_FPS, smoothing="full", max_gap=None
    )
    return smoothed(person, smoother, tracker.measurer.names, tracker.gap)


def _seen(person: "TrackedPerson") -> str:
    hands = person.keypoints[:, 2:4].isfinite().all(-1).double().mean(0).tolist()
    return (
        f"measured in {100 * hands[0]:.0f} % (left hand) and {100 * hands[1]:.0f} % of the frames"
    )


def _write_report(
    out: Path, people: "list[TrackedPerson]", performance: "Performance", camera: str
) -> None:
    from torchpose.report import write_report

    first = people[0].first_frame
    write_report(
        out / "report.html",
        [person.track for person in people],
        overlay=out / "overlay.mp4",
        title="Animated performer",
        facts={"video": "rendered, a smoke test", "camera": camera},
        first_frames=[person.first_frame for person in people],
        n_frames=len(performance.joints),
        truth=performance.joints[first:][: len(people[0])],
    )


def _draw(out: Path, track: "PoseTrack", performance: "Performance", first: int) -> None:
    rows = slice(first, first + track.joints3d.shape[1])
    save_pictures(out, track_pictures(track, performance.joints[rows], performance.labels[rows]))
