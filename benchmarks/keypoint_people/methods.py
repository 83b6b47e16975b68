"""Ways to follow several persons, from detections in any order to bodies; and how long the tracker takes."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

import torchpose
from benchmarks.keypoint_people.clips import People, see_people
from benchmarks.keypoint_people.grouping import filled, grouped
from benchmarks.keypoint_people.scoring import Found
from torchpose.whole_body import BodyTrack

_REPEATS = 3


def alone(clip: People, smoothing: str) -> list[Found]:
    """Track each person alone, told which detection is whose."""
    parts = [clip.of_person(person) for person in range(clip.joints.shape[1])]
    keypoints, confidence = (torch.stack(values) for values in zip(*parts, strict=True))
    tracker = torchpose.BodyTracker(clip.rig, "kalman", fps=clip.fps)
    return _found(tracker(keypoints=keypoints, confidence=confidence, smoothing=smoothing))


def together(clip: People, smoothing: str) -> list[Found]:
    """Track everybody, told nothing."""
    tracker = torchpose.BodyTracker(clip.rig, "kalman", fps=clip.fps)
    return _found(
        tracker(
            keypoints=clip.keypoints, confidence=clip.confidence, persons="all", smoothing=smoothing
        )
    )


def _found(tracks: list[BodyTrack]) -> list[Found]:
    return [Found(track.first_frame, track.joints3d) for track in tracks]


METHODS: dict[str, Callable[[People], list[Found]]] = {
    "grouped": grouped,
    "grouped, filled, 6 Hz": lambda clip: filled(grouped(clip), clip.fps),
    "torchpose": lambda clip: together(clip, "none"),
    "torchpose, smoothed": lambda clip: together(clip, "full"),
    "alone, known": lambda clip: alone(clip, "none"),
    "alone, known, smoothed": lambda clip: alone(clip, "full"),
}


def milliseconds(clip: People, count: int, seed: int = 0) -> float:
    """Return the time for a frame with the first persons of a clip, the least of three runs."""
    generator = torch.Generator().manual_seed(seed)
    some = see_people(clip.name, clip.fps, clip.joints[:, :count], clip.rig, generator)
    taken = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        together(some, "none")
        taken.append(time.perf_counter() - start)
    return 1000 * min(taken) / len(some.joints)
