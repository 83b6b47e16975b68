"""`torchpose track` on keypoints."""

from jsonargparse import Namespace

from torchpose._core.terminal import check_positive, show_progress
from torchpose.cli.common import pictures_possible
from torchpose.cli.track_output import (
    camera_text,
    report_failure,
    smoothing_text,
    summary,
    track_results,
    track_settings,
    write_pictures,
    write_track,
)

__all__ = ["track_keypoints"]


def track_keypoints(args: Namespace) -> int:
    """Track, write and report, and return the exit code; every check comes before any work."""
    from torchpose.io._keypoints import read_keypoints
    from torchpose.upper_body._keypoint_files import KeypointFileTracker

    keypoints = read_keypoints(args.input)
    for option, value in (("--fps", args.fps), ("--max-gap", args.max_gap)):
        check_positive(option, value)
    tracker = KeypointFileTracker(track_settings(args))
    prepared = tracker.prepare(keypoints)
    pictures = pictures_possible(args.pictures)
    with track_results(args, pictures, video=False) as results:
        track = tracker.track(keypoints, prepared, show_progress())
        written = results.commit(write_track(track, results.stage))
        if pictures:
            written += results.commit(write_pictures(track, results.stage))
    settings = {
        "prior": tracker.prior.info.name or args.prior,
        "camera": camera_text(prepared.camera),
        "method": track.method + smoothing_text(args.smoothing),
    }
    print(summary(track, written, settings, results.notes))
    return report_failure(track)
