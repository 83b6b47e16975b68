"""`torchpose demo`: a rendered performer, tracked in video, and scored against the truth."""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from torchpose._core.terminal import show_progress
from torchpose.cli._common import save_pictures, share_cores
from torchpose.cli._demo_keypoints import MEAN_POSE, Scores, beaten, report, score, score_mean_pose
from torchpose.cli._track_output import camera_text, track_pictures
from torchpose.cli._track_video import write_overlay, write_people

if TYPE_CHECKING:
    from torchpose.demo._performer import Performance
    from torchpose.io._results import ResultsFolder
    from torchpose.priors._upper_body_prior import UpperBodyPrior
    from torchpose.upper_body._pose_track import PoseTrack
    from torchpose.video._recording import TrackedPerson
    from torchpose.video._video_tracker import VideoTracker

_FPS = 30.0
_DISTANCE = 1.8  # metres: near enough for the face, far enough for raised arms


def demo_video(
    prior: "UpperBodyPrior", results: "ResultsFolder", seconds: float, seed: int, pictures: bool
) -> int:
    """Render, track, score and draw; return exit code 1 if the mean pose is not beaten."""
    from torchpose.demo._performer import demo_camera, performer
    from torchpose.video._source import open_video
    from torchpose.video._video_tracker import VideoTracker

    share_cores()
    performance = performer(round(seconds * _FPS), _FPS, seed, distance=_DISTANCE)
    camera = demo_camera()
    stage = results.stage
    clip, truth_file = stage / "clip.mp4", stage / "truth.npz"
    _render(clip, performance, seed)
    tracker = VideoTracker(prior, camera, fps=_FPS)
    start = time.perf_counter()
    with open_video(clip) as source:
        people = tracker(source, progress=show_progress(), n_frames=source.n_frames, folder=stage)
    elapsed = time.perf_counter() - start
    if not people:
        results.commit([clip, truth_file])
        print("torchpose: the demo failed: nobody was found in its video", file=sys.stderr)
        return 1
    person, n_frames = people[0], len(performance.joints)
    scores = _scores(prior, tracker, person, performance)
    print(report(scores, "measured in the video: head and neck from the face, hands and elbows"))
    print(f"\n{_measured_shares(person)}; {n_frames / elapsed:.0f} frames a second, drawing apart")
    overlay = stage / "overlay.mp4"
    with open_video(clip) as source:
        write_overlay(overlay, source, people, n_frames)
    poses = list(write_people(people, stage))
    page = _write_report(stage, people, performance, camera_text(camera))
    drawn = _draw(stage, person.track, performance, person.first_frame) if pictures else []
    at = results.commit([clip, truth_file, overlay, page, *poses, *drawn])
    good = beaten(scores)
    print(
        f"\nThe video: {at[0]}, its truth: {at[1]}\nThe poses drawn into it: {at[2]}\n"
        f"The report, with the skeleton to turn: {at[3]}"
    )
    for note in results.notes:
        print(f"note: {note}")
    return 0 if good else 1


def _render(clip: Path, performance: "Performance", seed: int) -> None:
    from torchpose.demo._performer import demo_camera
    from torchpose.demo._rendering.performer import render_video

    print(f"rendering {len(performance.joints)} frames ...", flush=True)
    render_video(clip, performance, demo_camera(), seed=seed)


def _scores(
    prior: "UpperBodyPrior",
    tracker: "VideoTracker",
    person: "TrackedPerson",
    performance: "Performance",
) -> dict[str, Scores]:
    """Return the errors of the poses, filtered and smoothed, and of the mean pose of the prior."""
    truth = performance.joints[person.first_frame :][: len(person)]
    return {
        "filtered": score(person.track, truth),
        "smoothed": score(_smoothed(tracker, person), truth),
        MEAN_POSE: score_mean_pose(prior, truth),
    }


def _smoothed(tracker: "VideoTracker", person: "TrackedPerson") -> "PoseTrack":
    """Return the poses from the same measurements, all frames together."""
    from torchpose.upper_body._upper_body_tracker import UpperBodyTracker
    from torchpose.video._recording import smoothed

    smoother = UpperBodyTracker(
        tracker.tracker.prior, tracker.tracker.camera, fps=_FPS, smoothing="full", max_gap=None
    )
    return smoothed(person, smoother, tracker.measurer.names, tracker.gap)


def _measured_shares(person: "TrackedPerson") -> str:
    hands = person.keypoints[:, 2:4].isfinite().all(-1).double().mean(0).tolist()
    return (
        f"measured in {100 * hands[0]:.0f} % (left hand) and {100 * hands[1]:.0f} % of the frames"
    )


def _write_report(
    out: Path, people: "list[TrackedPerson]", performance: "Performance", camera: str
) -> Path:
    from torchpose.viz._report.page import write_report

    first = people[0].first_frame
    return write_report(
        out / "report.html",
        [person.track for person in people],
        overlay=out / "overlay.mp4",
        title="Animated performer",
        facts={"video": "rendered, a smoke test", "camera": camera},
        first_frames=[person.first_frame for person in people],
        n_frames=len(performance.joints),
        truth=performance.joints[first:][: len(people[0])],
    )


def _draw(out: Path, track: "PoseTrack", performance: "Performance", first: int) -> list[Path]:
    rows = slice(first, first + track.joints3d.shape[1])
    drawn = track_pictures(track, performance.joints[rows], performance.labels[rows])
    return save_pictures(out, drawn)
