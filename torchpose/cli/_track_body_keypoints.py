"""`torchpose track-body` on keypoints: of files, or of a detector in videos."""

import copy
import sys
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING, Any, NamedTuple

from torchpose._core.terminal import show_progress
from torchpose._core.wording import counted
from torchpose.cli._body_keypoint_inputs import (
    BodyKeypoints,
    DetectorSettings,
    read_body_keypoints,
)
from torchpose.cli._body_overlays import Films, draw
from torchpose.cli._body_recordings import (
    Recordings,
    SilhouetteSettings,
    in_silhouettes,
    pixel_scale,
)
from torchpose.cli._track import is_video
from torchpose.cli._track_body_output import (
    CAMERA_FILE,
    KALMAN,
    BodyJob,
    action_text,
    body_results,
    gate_is_in_a_note,
    report_nobody,
    summary,
    write_page,
    write_people,
)
from torchpose.cli._track_output import percent, person_suffix, smoothing_text
from torchpose.cli._uncalibrated import tilt_of
from torchpose.errors import NobodySeenError

if TYPE_CHECKING:
    from pathlib import Path

    from torch import Tensor

    from torchpose.camera._pinhole import PinholeCamera
    from torchpose.whole_body._body_track import BodyTrack
    from torchpose.whole_body._body_tracker import BodyTracker

_CAMERAS = "refined_cameras.toml"
_TILT_SECONDS = 60.0  # of the beginning, in which people tell how the camera is held
_AGREES = 0.5  # share of the keypoints of a camera in a frame, above which it agrees with the body
_OTHERS = 0.1  # share of frames with more people than are tracked, from which on it is said
_DISAGREE = (
    "no two cameras agree on where the person is in more than half of the frames, so the poses are not to be "
    "trusted; the notes say what to check"
)
_FPS = 30.0  # frames per second with which options are checked before inputs are read


class KeypointSettings(NamedTuple):
    """Holds the options of tracking by keypoints.

    Attributes:
        detector: of keypoints in videos, or None. smoothing: "none" or "full".
        videos: into which the body is drawn, for each camera; None for the inputs, if they are videos.
        fps: of all inputs, None if they tell. delays: frames by which each began too early.
        tracker: the arguments of `BodyTracker`. refine: what of the cameras is estimated.
        persons: "all", or how many there are at most at a time; None for the one who is followed.
        method: of tracking. initial_pose, seed: of particle filters, as of the command.
        silhouettes: how the videos become some, which count beside the keypoints; None for none.
        without_file: whether the camera has no file, so that one is written. finds_tilt: whether it is to be
            found how it is held.
    """

    detector: DetectorSettings | None
    smoothing: str
    videos: list[str] | None
    fps: float | None
    delays: list[int] | None
    tracker: dict[str, Any]
    refine: str
    persons: str | int | None
    method: str
    initial_pose: str | None
    seed: int
    silhouettes: SilhouetteSettings | None
    without_file: bool
    finds_tilt: bool


def track_keypoints(
    job: BodyJob,
    inputs: Sequence[str],
    cameras: "Sequence[PinholeCamera]",
    settings: KeypointSettings,
) -> int:
    """Track bodies, write and report, and return the exit code: 1 if there is nobody or tracking is lost.

    Args:
        job: of the command. inputs: keypoints or videos, for each camera. cameras: calibrated.
        settings: the options.
    """
    # wrong cameras and options are told before any work
    _tracker(cameras, settings.fps or _FPS, settings)
    shown = settings.videos
    if shown is None and all(map(is_video, inputs)):
        shown = list(inputs)
    overlay = job.overlay and shown is not None
    with ExitStack() as stack:
        films = stack.enter_context(_films(job, shown, cameras, settings))
        results = stack.enter_context(
            body_results(job, cameras, overlay, _further_files(job, shown is not None, settings))
        )
        keypoints = read_body_keypoints(
            inputs, cameras, detector=settings.detector, fps=settings.fps, delays=settings.delays,
            other_rates=[] if films is None else films.rates,
            everybody=settings.persons is not None,
        )  # fmt: skip
        rate = keypoints.fps if films is None else films.rate_beside(keypoints)
        if films is not None and rate is None:
            keypoints = _with_note_on_rates(keypoints, films.rates)
        recordings = stack.enter_context(_recordings(shown, cameras, rate, settings))
        start = time.perf_counter()
        if settings.finds_tilt:
            keypoints, settings = _with_tilt(keypoints, settings)
            cameras = keypoints.cameras
        people = _track(keypoints, settings, recordings)
        seconds = time.perf_counter() - start
        if not people:
            return report_nobody(_nobody(keypoints), results.folder)
        stage = results.stage
        keypoints, cameras_file = _refined(keypoints, settings, people[0], stage)
        written = results.commit([*write_people(job, stage, people), *cameras_file])
        drawn, short = _drawn(job, people, films, keypoints, cameras[0], stage)
        facts = _facts(keypoints, settings, people, seconds)
        written += results.commit([*drawn, *write_page(cameras[0], people, facts, stage)])
    code = summary(people, facts, written, [*job.notes, *short, *results.notes])
    if settings.persons is None and settings.method == KALMAN and _disagree(keypoints, people[0]):
        print(f"torchpose: {_DISAGREE}", file=sys.stderr)
        return 1
    return code


def _films(
    job: BodyJob,
    videos: list[str] | None,
    cameras: "Sequence[PinholeCamera]",
    settings: KeypointSettings,
) -> AbstractContextManager[Films | None]:
    """Return the videos into which the body is drawn, if there are some.

    Videos that are named are read for their rate, also if nothing is drawn into them.
    """
    drawn = job.overlay or job.pictures
    read = settings.silhouettes is not None or settings.videos is not None
    if videos is None or not (drawn or read):
        return nullcontext()
    return Films(videos, cameras, settings.delays)


def _recordings(
    videos: list[str] | None,
    cameras: "Sequence[PinholeCamera]",
    fps: float | None,
    settings: KeypointSettings,
) -> AbstractContextManager[Recordings | None]:
    """Return the videos whose silhouettes count beside the keypoints, if they are to.

    Args:
        fps: at which they are read, None for their own.
    """
    if videos is None or settings.silhouettes is None:
        return nullcontext()
    own = settings.silhouettes._asdict()
    return Recordings(videos, cameras, fps=fps, delays=settings.delays, **own)


def _with_note_on_rates(keypoints: BodyKeypoints, stated: Sequence[float]) -> BodyKeypoints:
    """Return keypoints with a note that videos are read frame by frame, though they state other rates."""
    rates = ", ".join(f"{rate:g}" for rate in sorted(set(stated)))
    note = (
        f"videos state {rates} frames per second and have a frame for each of the keypoints, which count as "
        f"{keypoints.fps:g}: they are read frame by frame"
    )
    return keypoints._replace(notes=(*keypoints.notes, note))


def _nobody(keypoints: BodyKeypoints) -> str:
    if not bool((keypoints.confidence > 0).any()):
        return "no camera has a keypoint"
    return "nobody was seen for long enough by cameras that agree"


def _further_files(job: BodyJob, films: bool, settings: KeypointSettings) -> list[str]:
    """Return the names of further files: pictures, cameras."""
    pictures = [*(["overlay.png"] if films else []), "skeleton.png"] if job.pictures else []
    return (
        pictures + [_CAMERAS] * (settings.refine != "none") + [CAMERA_FILE] * settings.without_file
    )


def _with_tilt(
    keypoints: BodyKeypoints, settings: KeypointSettings
) -> tuple[BodyKeypoints, KeypointSettings]:
    """Return keypoints in a camera that is held as people in the first minute show, and settings for it."""
    n = round(_TILT_SECONDS * keypoints.fps)
    begun = keypoints._replace(points=keypoints.points[:n], confidence=keypoints.confidence[:n])
    people = _track(begun, settings._replace(smoothing="none"))
    camera, note = tilt_of(people, keypoints.cameras[0])
    keypoints = keypoints._replace(notes=(*keypoints.notes, note))
    if camera is None:
        return keypoints, settings
    tracker = {**settings.tracker, "up": "y"}
    return keypoints._replace(cameras=[camera]), settings._replace(tracker=tracker)


def _refined(
    keypoints: BodyKeypoints, settings: KeypointSettings, poses: "BodyTrack", stage: "Path"
) -> tuple[BodyKeypoints, "list[Path]"]:
    """Return keypoints with the refined cameras, and the file of these; both as given without --refine.

    A camera that has no file gets one too.
    """
    from torchpose.camera._pinhole import save_cameras

    if settings.without_file:
        save_cameras(keypoints.cameras, stage / CAMERA_FILE)
        return keypoints, [stage / CAMERA_FILE]
    if settings.refine == "none":
        return keypoints, []
    rotations = poses.details["camera_rotation"][0]
    translations = poses.details["camera_translation"][0]
    cameras = [copy.deepcopy(camera) for camera in keypoints.cameras]
    for camera, rotation, translation in zip(cameras, rotations, translations, strict=True):
        camera.rotation.copy_(rotation)
        camera.translation.copy_(translation)
    save_cameras(cameras, stage / _CAMERAS)
    return keypoints._replace(cameras=cameras), [stage / _CAMERAS]


def _tracker(
    cameras: "Sequence[PinholeCamera]", fps: float, settings: KeypointSettings
) -> "BodyTracker":
    from torchpose.whole_body._body_tracker import BodyTracker

    return BodyTracker(cameras, settings.method, fps=fps, **settings.tracker)


def _track(
    keypoints: BodyKeypoints, settings: KeypointSettings, recordings: Recordings | None = None
) -> "list[BodyTrack]":
    """Return the poses of everybody, by keypoints and the silhouettes of recordings, if there are some."""
    if recordings is not None:
        settings = _in_pixels_of(settings, pixel_scale(keypoints, recordings))
        keypoints = in_silhouettes(keypoints, recordings)
    tracker = _tracker(keypoints.cameras, keypoints.fps, settings)
    options: dict[str, Any] = {
        "persons": settings.persons, "smoothing": settings.smoothing, "refine": settings.refine,
    }  # fmt: skip
    if settings.method != KALMAN:
        import torch

        options = {
            "initial_state": first_state(tracker, settings.initial_pose),
            "generator": torch.Generator().manual_seed(settings.seed),
        }
    if recordings is not None:
        options["silhouettes"] = islice(recordings.silhouettes(), len(keypoints.points))
    with gate_is_in_a_note():
        try:
            found = tracker(
                keypoints=keypoints.points, confidence=keypoints.confidence, names=keypoints.names,
                **options,
                progress=show_progress(),
            )  # fmt: skip
        except NobodySeenError:
            return []
    people = [found] if settings.persons is None else found
    notes = (*keypoints.notes, *_note_on_others(keypoints, settings.persons))
    notes += () if recordings is None else recordings.all_notes
    return [replace(poses, notes=(*notes, *poses.notes)) for poses in people]


def _note_on_others(keypoints: BodyKeypoints, persons: str | int | None) -> tuple[str, ...]:
    """Return a note if cameras often show more people than are tracked at a time."""
    if not isinstance(persons, int):
        return ()
    shown = (keypoints.confidence > 0).any(-1).sum(-1).amax(1)
    share = float((shown > persons).double().mean())
    if share < _OTHERS:
        return ()
    return (
        f"a camera shows up to {int(shown.max())} people at a time, in {percent(share)} of the frames more "
        f"than the {persons} who may be tracked: others are left out (--persons all)",
    )


def _in_pixels_of(settings: KeypointSettings, scale: float) -> KeypointSettings:
    """Return settings for images of another size, whose pixels are 1 / scale of those of the keypoints."""
    from torchpose.whole_body._keypoints.keypoint_body_tracker import PIXEL_STD

    std = settings.tracker["pixel_std"]
    own = {"pixel_std": scale * (PIXEL_STD if std is None else std)}
    return settings._replace(tracker={**settings.tracker, **own})


def first_state(tracker: "BodyTracker", file: str | None) -> "Tensor | None":
    """Return the state in which a particle filter begins, of the first pose of a body.npz, or None."""
    if not file:
        print("finding the pose of the first frame ...", flush=True)
        return None
    from torchpose.body._fitting import fit_state
    from torchpose.whole_body._body_track import BodyTrack

    return fit_state(tracker.body, BodyTrack.load(file).joints3d[:1])[0]


def _facts(
    keypoints: BodyKeypoints,
    settings: KeypointSettings,
    people: "Sequence[BodyTrack]",
    seconds: float,
) -> dict[str, str]:
    """Return what was tracked, and how, by the name of each fact."""
    source = "files" if settings.detector is None else settings.detector.where
    source += ", with silhouettes" if settings.silhouettes is not None else ""
    n_cameras = len(keypoints.cameras)
    tracked = len(people[0]) if len(people) == 1 else len(keypoints.points)
    everybody = settings.persons is not None
    agreement = {}
    if everybody:
        agreement = {"persons": str(len(people)), "detected": _detected(keypoints, people)}
    elif settings.method == KALMAN:
        agreement = {"agreement": _agreement(keypoints, people[0])}
    else:
        agreement = {
            "particles": str(settings.tracker["n_particles"]),
            "actions": action_text(people[0]),
        }
    return {
        "keypoints": f"{counted(n_cameras, 'camera')}, {keypoints.fps:g} fps, by {source}",
        "method": people[0].method
        + smoothing_text("full" if settings.smoothing == "full" else None),
        "body": _body_text(people, settings),
        **{name: fact for name, fact in agreement.items() if fact},
        "speed": f"{tracked / max(seconds, 1e-9):.1f} frames a second, without drawing",
    }


def _body_text(people: "Sequence[BodyTrack]", settings: KeypointSettings) -> str:
    """Return whose body it is, or the heights that the bones have."""
    given = settings.tracker
    if given["body"] is not None:
        return str(given["body"])
    if settings.method != KALMAN:
        return f"average proportions, {people[0].body.height:.3g} m"
    known = "" if given["height"] is None else f", {given['height']:g} m given"
    heights = ", ".join(f"{poses.body.height:.2f} m" for poses in people)
    return f"{heights} by {'its' if len(people) == 1 else 'their'} bones{known}"


def _detected(keypoints: BodyKeypoints, people: "Sequence[BodyTrack]") -> str:
    """Return the share of the persons' frames in which each camera had a detection of theirs."""
    import torch

    there = torch.cat([poses.details["detection"] >= 0 for poses in people]).double().mean(0)
    pairs = zip(keypoints.cameras, there.tolist(), strict=True)
    return ", ".join(f"{camera.name} {percent(share)}" for camera, share in pairs)


def _agreement(keypoints: BodyKeypoints, poses: "BodyTrack") -> str:
    """Return the share of every camera's keypoints that are those of the body."""
    there = keypoints.confidence[poses.first_frame :][: len(poses)] > 0
    shares = []
    for c, camera in enumerate(keypoints.cameras):
        inlier = poses.details["inlier"][:, c][there[:, c, : len(poses.names)]]
        share = percent(float(inlier.mean())) if len(inlier) else "no keypoints"
        shares.append(f"{camera.name} {share}")
    return ", ".join(shares)


def _disagree(keypoints: BodyKeypoints, poses: "BodyTrack") -> bool:
    """Return whether in most frames no two of the cameras with keypoints agree with the body."""
    import torch

    there = keypoints.confidence[poses.first_frame :][: len(poses), :, : len(poses.names)] > 0
    inlier = poses.details["inlier"]
    mean = torch.where(there, inlier, 0.0).sum(-1) / there.sum(-1).clamp_min(1)
    several = there.any(-1).sum(-1) >= 2
    apart = several & ((mean > _AGREES).sum(-1) < 2)
    return 2 * int(apart.sum()) > len(poses)


def _drawn(
    job: BodyJob,
    people: "Sequence[BodyTrack]",
    films: Films | None,
    keypoints: BodyKeypoints,
    camera: "PinholeCamera",
    out: "Path",
) -> tuple["list[Path]", tuple[str, ...]]:
    """Draw what is wanted: bodies into videos, skeletons; return the files, and a note on short videos."""
    drawn: list[Path] = []
    short: tuple[str, ...] = ()
    if films is not None and (job.overlay or job.pictures):
        drawn, short = draw(films.showing(keypoints), people, out, job.overlay, job.pictures)
    if job.pictures:
        drawn += _write_skeletons(out, people, camera)
    return drawn, short


def _write_skeletons(
    out: "Path", people: "Sequence[BodyTrack]", camera: "PinholeCamera"
) -> "list[Path]":
    """Draw everybody's skeleton: skeleton.png, skeleton_p02.png and so on."""
    return [
        _write_skeleton(out / f"skeleton{person_suffix(place)}.png", poses, camera)
        for place, poses in enumerate(people, 1)
    ]


def _write_skeleton(path: "Path", poses: "BodyTrack", camera: "PinholeCamera") -> "Path":
    """Draw some poses as the first camera sees them, and from the side."""
    from torchpose.viz._body_picture import plot_body_strip
    from torchpose.viz._style import save_figure

    seen = poses.seen_by(camera)
    joints, feet = seen.joints3d[0].tensor_split([len(poses.names)], 1)
    figure = plot_body_strip(
        joints, poses.body.skeleton, fps=poses.fps or 30.0, first_frame=poses.first_frame,
        observed=seen.observed[0], feet=feet if poses.feet is not None else None,
    )  # fmt: skip
    return save_figure(figure, path)
