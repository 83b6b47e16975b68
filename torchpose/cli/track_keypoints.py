"""`torchpose track` on keypoints."""

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING

from jsonargparse import Namespace

from torchpose.cli.common import pictures_possible, positive, show_progress
from torchpose.cli.track_output import (
    camera_text,
    report_failure,
    smoothing_text,
    summary,
    track_results,
    write_pictures,
    write_track,
)
from torchpose.errors import DegenerateFilterWarning, InputError

if TYPE_CHECKING:
    from torchpose.io.keypoints import Keypoints

__all__ = ["track_keypoints"]


def track_keypoints(args: Namespace) -> int:
    """Track, write and report; every check comes before any work."""
    import torch

    from torchpose.cli.camera_option import resolve_camera
    from torchpose.cli.track import tracker_options
    from torchpose.io.keypoints import read_keypoints
    from torchpose.priors.upper_body import load_prior
    from torchpose.upper_body.tracker import UpperBodyTracker

    keypoints = read_keypoints(args.input)
    for option, value in (("--fps", args.fps), ("--max-gap", args.max_gap)):
        positive(option, value)
    prior = load_prior(args.prior)
    camera, notes = resolve_camera(
        args.camera, args.camera_name, keypoints.image_size, keypoints.K, keypoints.path
    )
    names, more = joint_names(keypoints, args.nose_as_head)
    fps = args.fps or keypoints.fps
    if fps is None:
        more += (f"the keypoint file states no frame rate: {prior.info.fps or 30:g} fps assumed",)
    tracker = UpperBodyTracker(
        prior,
        camera,
        measurement_std=args.measurement_std,
        fps=fps,
        neck=kind_of_neck(args.neck, keypoints),
        max_gap=args.max_gap,
        **tracker_options(args),
    )
    pictures = pictures_possible(args.pictures)
    with track_results(args, pictures, video=False) as results:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore", DegenerateFilterWarning
            )  # reported below in plain words
            track = tracker(
                keypoints.keypoints[None],
                None if keypoints.confidence is None else keypoints.confidence[None],
                names,
                generator=torch.Generator().manual_seed(args.seed),
                progress=show_progress(),
            )
        track = replace(track, notes=notes + tuple(keypoints.notes) + more + track.notes)
        written = results.commit(write_track(track, results.stage))
        if pictures:
            written += results.commit(write_pictures(track, results.stage))
    settings = {
        "prior": prior.info.name or args.prior,
        "camera": camera_text(camera),
        "method": track.method + smoothing_text(args.smoothing),
    }
    print(summary(track, written, settings, results.notes))
    return report_failure(track)


def joint_names(
    keypoints: "Keypoints", nose_as_head: bool
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names for the tracker, with the nose as head if asked for, and notes."""
    from torchpose.skeleton.joint_sets import canonical_names

    canonical = canonical_names(keypoints.names)
    if "head" in canonical:
        return keypoints.names, ()
    if not nose_as_head:
        hint = ("there is no head among the keypoints; --nose-as-head true takes the nose for it",)
        return keypoints.names, hint if "nose" in canonical else ()
    if "nose" not in canonical:
        raise InputError(f"--nose-as-head needs a nose, got {', '.join(keypoints.names)}")
    names = tuple(
        "head" if c == "nose" else name for c, name in zip(canonical, keypoints.names, strict=True)
    )
    return names, ("the nose stands for the head",)


def kind_of_neck(given: str | None, keypoints: "Keypoints") -> str | None:
    from torchpose.skeleton.upper_body import NECK_KINDS

    if given is not None and given not in NECK_KINDS:
        raise InputError(f"--neck must be one of {', '.join(NECK_KINDS)}, got {given!r}")
    return given or keypoints.neck
