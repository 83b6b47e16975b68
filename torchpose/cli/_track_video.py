"""`torchpose track` on video: a file, a folder of images, or a camera."""

import contextlib
import itertools
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from torchpose._core.terminal import show_progress
from torchpose._core.wording import counted
from torchpose.cli._common import HANG_UP, UntilInterrupted, pictures_possible, share_cores
from torchpose.cli._picture_process import PictureProcess
from torchpose.cli._track_output import (
    TrackingJob,
    camera_text,
    notes_of_all,
    person_suffix,
    report_failure,
    smoothing_text,
    summary,
    track_results,
    write_pictures,
    write_track,
)
from torchpose.errors import FileFormatError, InputError, OutputError

if TYPE_CHECKING:
    from torchpose._core.images import Image
    from torchpose.camera._pinhole import PinholeCamera
    from torchpose.io._results import ResultsFolder
    from torchpose.priors._upper_body_prior import UpperBodyPrior
    from torchpose.upper_body._keypoint_files import TrackSettings
    from torchpose.upper_body._pose_track import PoseTrack
    from torchpose.video._measurers import Found
    from torchpose.video._recording import TrackedPerson
    from torchpose.video._source_interface import VideoFrame, VideoSource
    from torchpose.video._video_tracker import VideoTracker
    from torchpose.video._writer import VideoWriter

_OVERLAY = "overlay.mp4"
_GREY = 8  # range of R, G and B up to which a pixel is grey
_DARK = 50  # brightness of an image too dark to tell
_LATEST = 300  # frames that are passed over at most for one with a person
_THROUGHOUT = 0.9  # share of the frames in which a face is seen that nobody doubts
_KEYPOINTS = "keypoints are expected as .npz, .csv or a folder of OpenPose JSON files"


class _Tracked(NamedTuple):
    """Holds everybody, the numbers of frames read and in all, and the error that ended it, if one did."""

    people: "list[TrackedPerson]"
    n_read: int
    n_frames: int
    failure: Exception | None = None


def track_video(
    job: TrackingJob,
    options: dict[str, Any],
    face_model: str | None,
    overlay: bool,
    workers: int,
) -> int:
    """Track everybody, write and report, and return the exit code: 1 if there is nobody.

    Args:
        job: of the command. options: of `VideoTracker`. face_model: file of a face detector, or None.
        overlay: whether the video and the page that show the poses are written.
        workers: of `VideoTracker.forward`, for a recording; with 0 this process draws the pictures.
    """
    from torchpose.camera._choice import resolve_camera
    from torchpose.priors._upper_body_prior import load_prior

    settings, detector = job.settings, options["detector"]
    _refuse_options(job, detector, face_model)
    _refuse_own_folder(job)
    share_cores()
    prior = load_prior(settings.prior)
    pictures = pictures_possible(job.pictures)
    with contextlib.ExitStack() as stack:
        with _open(job.input, settings.fps) as source:
            camera, notes = resolve_camera(
                settings.camera, settings.camera_name, source.size, None, job.input
            )
            camera = settings.hold(camera)
            tracker = _tracker(job, options, face_model, prior, camera, source.fps)
            results = stack.enter_context(track_results(job.out, job.files, pictures, overlay))
            other = PictureProcess(pictures and source.reopenable and workers > 0)
            stack.enter_context(contextlib.closing(other))
            start = time.perf_counter()
            people, n_read, n_frames, failure = (
                _track_recording(tracker, source, results.stage, workers)
                if source.reopenable
                else _track_camera(tracker, source, results.stage, overlay, stack)
            )
            seconds = time.perf_counter() - start
        notes += tuple(source.notes)  # some of them are known once it is closed
        if source.reopenable and detector is None:
            notes += _note_on_turn(source, people, n_frames)
        if failure is not None and not people:
            raise failure
        if not people:
            return _nobody(job.input, n_frames, source.fps, notes, results.folder, detector)
        if source.reopenable and detector is None:
            notes += _note_on_colours(source, people[0].first_frame)
        notes += _note_on_facts(settings, len(people))
        rate = n_read / max(seconds, 1e-9)
        facts = _facts(job, options, source, prior, camera, people[0].track.method, rate)
        people = [replace(p, track=replace(p.track, notes=notes + p.track.notes)) for p in people]
        names = _names(people, source.reopenable)
        notes = notes_of_all([person.track.notes for person in people], names)
        written = _write_poses(people, source, n_frames, results, pictures, overlay, other)
        if overlay:
            title = Path(job.input).name
            shown = _write_report(results.stage, people, names, n_frames, facts, notes, title)
            written += results.commit(shown)
    print(_summary(people, names, written, facts, (*notes, *results.notes)))
    if failure is not None:
        raise failure
    return max(report_failure(person.track) for person in people)


def _note_on_turn(
    source: "VideoSource", people: list["TrackedPerson"], n_frames: int
) -> tuple[str, ...]:
    """Return a note if the video lies on its side, which is looked at where no face is seen throughout."""
    from torchpose.video._turned import turn_to_upright

    head = [int(p.track.observed[0, :, p.track.names.index("head")].sum()) for p in people]
    if max(head, default=0) >= _THROUGHOUT * n_frames:
        return ()
    with source.reopen() as again:
        turn = turn_to_upright(again)
    if not turn:
        return ()
    return (
        f"faces are upright if the video is turned by {turn} degrees clockwise: turn it, and track it again",
    )


def _note_on_colours(source: "VideoSource", first_frame: int) -> tuple[str, ...]:
    """Return a note if a video is grey, by the frame in which a person is first seen, or one before."""
    import numpy as np

    with source.reopen() as again:
        image = next(itertools.islice(again, min(first_frame, _LATEST), None)).image[::4, ::4]
    colour = np.quantile(image.max(-1) - image.min(-1), 0.99)
    if colour > _GREY or image.max() < _DARK:
        return ()
    return (
        "the video has no colours, by which skin is told from clothes: hands and elbows are found in wrong "
        "places more often",
    )


def _write_poses(
    people: list["TrackedPerson"],
    source: "VideoSource",
    n_frames: int,
    results: "ResultsFolder",
    pictures: bool,
    overlay: bool,
    other: PictureProcess,
) -> list[Path]:
    """Write the poses of everybody, then what shows them: pictures, and the overlay of a recording.

    Where one cannot be written, as on a full disk, those before it are kept.
    """
    whole: list[Path] = []
    try:
        whole.extend(write_people(people, results.stage))
    except Exception:
        if whole:
            results.commit(whole)
        raise
    written = results.commit(whole)
    # without another process Python is free for the pictures for most of the time that the encoder takes
    with ThreadPoolExecutor(1) as beside:
        drawing = beside.submit(_pictures_of, people[0], results.stage, pictures, other)
        try:
            if overlay and source.reopenable:
                write_overlay(results.stage / _OVERLAY, source.reopen(), people, n_frames)
        finally:
            written += results.commit(drawing.result())
    return written


def _pictures_of(
    person: "TrackedPerson", out: Path, wanted: bool, other: PictureProcess
) -> list[Path]:
    return write_pictures(person.track, out, other) if wanted else []


def _open(where: str, fps: float | None) -> "VideoSource":
    from torchpose.video import open_video

    try:
        return open_video(where, fps=fps)
    except FileFormatError as error:
        raise FileFormatError(f"{error}; {_KEYPOINTS}") from error


def _refuse_options(job: TrackingJob, detector: str | None, face_model: str | None) -> None:
    """Raise `InputError` for options that the measurer does not have."""
    given = {"--nose-as-head": job.settings.nose_as_head}
    if detector is None:
        given |= {
            "--neck": job.settings.neck is not None,
            "--measurement-std": job.settings.measurement_std is not None,
        }
    for option, used in given.items():
        if used:
            raise InputError(f"{option} is for keypoints; {job.input} is taken for a video")
    if detector is not None and face_model is not None:
        raise InputError(
            "--face-model is for faces, whose place --detector takes; give one of them"
        )


def _refuse_own_folder(job: TrackingJob) -> None:
    """Raise `InputError` for results among the images, of which their pictures would be the next ones."""
    images, out = Path(job.input), Path(job.out)
    if images.is_dir() and out.is_dir() and images.samefile(out):
        raise InputError(
            f"--out {job.out} is the folder of the images, and pictures of the results would be taken for "
            f"images of the next run; choose another folder, such as {out / 'result'}"
        )


def _tracker(
    job: TrackingJob,
    options: dict[str, Any],
    face_model: str | None,
    prior: "UpperBodyPrior",
    camera: "PinholeCamera",
    fps: float,
) -> "VideoTracker":
    from torchpose.measure._mediapipe import MediaPipeFaceDetector
    from torchpose.video._video_tracker import VideoTracker

    faces = None if face_model is None else MediaPipeFaceDetector(face_model)
    of_keypoints = {name: getattr(job.settings, name) for name in ("neck", "measurement_std")}
    of_keypoints = {name: value for name, value in of_keypoints.items() if value is not None}
    return VideoTracker(
        prior, camera, fps=fps, face_detector=faces, max_gap=job.settings.max_gap,
        seed=job.settings.seed, **options, **job.settings.tracker_options(), **of_keypoints,
        **job.options,
    )  # fmt: skip


def _track_recording(
    tracker: "VideoTracker", source: "VideoSource", out: Path, workers: int
) -> _Tracked:
    """Return everybody in a file or folder; Ctrl-C ends the recording."""
    with UntilInterrupted(source) as frames:
        people = tracker(
            frames, show_progress(), n_frames=source.n_frames, folder=out, workers=workers
        )
    if frames.interrupted:
        of = "" if source.n_frames is None else f" of {source.n_frames}"
        source.notes.append(
            f"stopped by Ctrl-C after {frames.count}{of} frames: the rest was not tracked"
        )
    return _Tracked(people, frames.count, frames.count)


def _track_camera(
    tracker: "VideoTracker",
    source: "VideoSource",
    out: Path,
    overlay: bool,
    signals: contextlib.ExitStack,
) -> _Tracked:
    """Return everybody before a camera until q, stop, Ctrl-C or an error; a page shows them while it runs.

    Args:
        signals: until its end, when results are written, no other signal than a second Ctrl-C ends that.
    """
    from torchpose.video._live_view import LiveView
    from torchpose.video._recording import TrackedRecording
    from torchpose.video._video_tracker import record
    from torchpose.video._writer import VideoWriter

    recording = TrackedRecording(tracker.tracker, tracker.stream.names, tracker.gap, out)
    failure: Exception | None = None
    n_frames, shown, drawn = 0, None, None
    writers: list[VideoWriter] = []
    view = LiveView()

    def watch(image: "Image", measured: "Found", poses: "dict[int, PoseTrack]") -> None:
        nonlocal n_frames, shown, drawn
        n_frames += 1
        if image is not shown:  # the frames missed before it have the same one
            shown, drawn = image, _drawn(image, poses, -1, measured)
            view.show(drawn)
        if writers:
            _record(writers, drawn)

    stop = UntilInterrupted(source, lambda: view.stop_requested, _stopping())
    frames = signals.enter_context(stop)
    try:
        with contextlib.ExitStack() as stack:
            stack.enter_context(view)
            print(f"live at {view.url}; q, the button on the page or Ctrl-C stop it")
            if overlay:
                writer = VideoWriter(out / _OVERLAY, source.fps, source.size)
                writers.append(stack.enter_context(writer))
            try:
                record(tracker, recording, frames, show_progress(), watch=watch)
            except OutputError:
                raise  # there is no overlay then: on a full disk that leaves room for the poses
            except Exception as error:
                failure = error
    except OutputError as error:
        failure = error
    if failure is not None:
        source.notes.append(f"an error ended the recording after {counted(n_frames, 'frame')}")
    return _Tracked(recording.finish(tracker.smoother), frames.count, n_frames, failure)


def _stopping() -> list[signal.Signals]:
    """Return the signals that end a camera, whose frames are nowhere else: none that `nohup` ignores."""
    ends = [signal.SIGINT, signal.SIGTERM]
    if HANG_UP is not None and signal.getsignal(HANG_UP) is not signal.SIG_IGN:
        ends.append(HANG_UP)
    return ends


def _record(writers: list["VideoWriter"], image: "Image") -> None:
    """Write a frame; where that is not possible any more, say so and stop writing."""
    try:
        writers[0].write(image)
    except OutputError as error:
        writers.clear()
        print(f"torchpose: {error}; tracking goes on without the overlay", file=sys.stderr)


def write_overlay(
    path: Path, source: "VideoSource", people: list["TrackedPerson"], n_frames: int
) -> None:
    """Draw the poses into the video that they were made from.

    Raises:
        OutputError: it cannot be written.
    """
    from tqdm.auto import tqdm

    from torchpose.video._prefetch import prefetch
    from torchpose.video._writer import VideoWriter

    with source, VideoWriter(path, source.fps, source.size) as writer:
        bar = tqdm(total=n_frames, disable=not show_progress(), unit="frame", desc="overlay")
        for frame in prefetch(_first(source, n_frames)):
            at = {place: frame.index - p.first_frame for place, p in enumerate(people)}
            there = {place: p.track for place, p in enumerate(people) if 0 <= at[place] < len(p)}
            writer.write(_drawn(frame.image, there, at))
            bar.update()
        bar.close()


def _first(source: "VideoSource", n_frames: int) -> Iterator["VideoFrame"]:
    for frame in source:
        if frame.index >= n_frames:
            return
        yield frame


def _drawn(
    image: "Image",
    tracks: "dict[int, PoseTrack]",
    frame: int | dict[int, int],
    measured: "Found | None" = None,
) -> "Image":
    """Return a frame with poses drawn into it, by number of the person, from a frame of their tracks.

    Args:
        measured: the measurements in the frame, whose faces are drawn.
    """
    import torch

    from torchpose.video._overlay import draw_overlay

    at = {n: frame if isinstance(frame, int) else frame[n] for n in tracks}
    faces: dict[str, Any] = {}
    if measured is not None and measured.faces is not None:
        faces = {"faces": measured.faces, "face_tints": measured.person.tolist()}
    if not tracks:
        nobody = torch.zeros(0, 8, 2), None, torch.zeros(0, 8, dtype=torch.bool)
        return draw_overlay(image, *nobody, **faces)
    joints, cov, observed = (
        torch.stack([getattr(track, name)[0, at[n]] for n, track in tracks.items()])
        for name in ("joints2d", "covariance2d", "observed")
    )
    labels = [_name(n) for n in tracks] if len(tracks) > 1 else None
    return draw_overlay(image, joints, cov, observed, labels=labels, tints=list(tracks), **faces)


def _name(number: int) -> str:
    return f"person {number + 1}"


def _names(people: list["TrackedPerson"], longest_first: bool) -> list[str]:
    """Return the names of the persons in the overlay.

    Args:
        longest_first: whether it was drawn once it was known who was seen longest; while a camera runs,
            only the order of appearance is.
    """
    return [_name(place if longest_first else p.number) for place, p in enumerate(people)]


def write_people(people: list["TrackedPerson"], out: Path) -> Iterator[Path]:
    """Write the poses of everybody and yield each path: poses, and poses_p02 and so on of the others."""
    for place, person in enumerate(people, 1):
        yield from write_track(person.track, out, person_suffix(place))


def _note_on_facts(settings: "TrackSettings", n_people: int) -> tuple[str, ...]:
    """Return a note where what was told of one person was taken for each of several."""
    facts = [
        name for name in ("height", "bone_lengths", "person") if getattr(settings, name) is not None
    ]
    if n_people == 1 or not facts:
        return ()
    flag = f"--{facts[0].replace('_', '-')}"
    return (
        f"{flag} was taken for each of the {n_people} persons; --max-persons 1 tracks one of them",
    )


def _write_report(
    out: Path,
    people: list["TrackedPerson"],
    names: list[str],
    n_frames: int,
    facts: dict[str, str],
    notes: tuple[str, ...],
    title: str,
) -> list[Path]:
    from torchpose.viz._report.page import write_report

    overlay = out / _OVERLAY
    written = [overlay] if overlay.exists() else []
    write_report(
        out / "report.html",
        [person.track for person in people],
        overlay=overlay if written else None,
        title=title,
        facts=facts,
        notes=notes,
        first_frames=[person.first_frame for person in people],
        n_frames=n_frames,
        labels=names,
    )
    return [*written, out / "report.html"]


def _facts(
    job: TrackingJob,
    options: dict[str, Any],
    source: "VideoSource",
    prior: "UpperBodyPrior",
    camera: "PinholeCamera",
    method: str,
    rate: float,
) -> dict[str, str]:
    """Return what was tracked, and how, by the name of each fact; `rate` in frames a second."""
    detector = options["detector"]
    measured = f"hands: {options['hands']}" if detector is None else f"keypoints by {detector}"
    return {
        "video": f"{job.input}, {source.size[0]} x {source.size[1]}, {source.fps:g} fps",
        "prior": prior.info.name or job.settings.prior,
        "camera": camera_text(camera),
        "method": f"{method}{smoothing_text(job.settings.smoothing)}, {measured}",
        "speed": f"{rate:.0f} frames a second, without drawing",
    }


def _nobody(
    where: str,
    n_frames: int,
    fps: float,
    notes: tuple[str, ...],
    out: Path,
    detector: str | None,
) -> int:
    """Print that there is no pose and the reason; return the exit code."""
    from torchpose.video._recording import LEAST_SECONDS

    if (out / "poses.npz").exists():
        notes += (f"{out / 'poses.npz'} is of an earlier run",)
    for note in notes:
        print(f"note     {note}")
    length = f"{counted(n_frames, 'frame')} ({n_frames / fps:.2g} s)"
    if n_frames < LEAST_SECONDS * fps:
        print(
            f"torchpose: {where} has {length}, too few for poses: persons count who are seen for half a "
            "second or longer",
            file=sys.stderr,
        )
        return 1
    if detector is None:
        what = "face"
        wants = (
            "The detector wants faces from the front, tilted little and at least 16 pixels high; "
            "keypoints of another detector can be tracked instead (--detector)"
        )
    else:
        what = "person"
        wants = f"{detector} has to give three keypoints of the upper body; --min-confidence says how sure"
    print(
        f"torchpose: no {what} was seen for half a second or longer in the {length} of {where}, "
        f"so there are no poses. {wants}",
        file=sys.stderr,
    )
    return 1


def _summary(
    people: list["TrackedPerson"],
    names: list[str],
    written: list[Path],
    facts: dict[str, str],
    notes: Sequence[str],
) -> str:
    """Return the summary that is printed: the persons, and the poses of the first."""
    first = summary(replace(people[0].track, notes=()), written, facts, notes)
    if len(people) == 1:
        return first
    others = [
        f"{name}: frames {p.first_frame} to {p.first_frame + len(p) - 1}, in poses{person_suffix(place)}.npz"
        for place, (name, p) in enumerate(zip(names, people, strict=True), 1)
    ]
    return "\n".join([*others, f"of {names[0]}:", first])
