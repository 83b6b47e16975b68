"""`torchpose track-body` on keypoints: of files, or of a detector in videos."""

import copy
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

from torchpose._core.terminal import show_progress
from torchpose.cli._body_keypoint_inputs import (
    BodyKeypoints,
    DetectorSettings,
    read_body_keypoints,
)
from torchpose.cli._track import is_video
from torchpose.cli._track_body_output import (
    BodyJob,
    body_results,
    draw,
    project_joints,
    summary,
    write_page,
    write_poses,
)
from torchpose.cli._track_output import percent, smoothing_text
from torchpose.errors import NobodySeenError

if TYPE_CHECKING:
    from pathlib import Path

    from torch import Tensor

    from torchpose.camera._pinhole import PinholeCamera
    from torchpose.video._source_interface import VideoSource
    from torchpose.whole_body._body_track import BodyTrack
    from torchpose.whole_body._body_tracker import BodyTracker

__all__ = ["KeypointSettings", "track_keypoints"]

_CAMERAS = "refined_cameras.toml"
_SAME_RATE = 0.01  # relative: of videos that are not resampled


class KeypointSettings(NamedTuple):
    """Holds the options of tracking by keypoints.

    Attributes:
        detector: of keypoints in videos, or None. smoothing: "none" or "full".
        videos: into which the body is drawn, for each camera; None for the inputs, if they are videos.
        fps: of all inputs, None if they tell. delays: frames by which each began too early.
        tracker: the arguments of `BodyTracker`. refine: what of the cameras is estimated.
    """

    detector: DetectorSettings | None
    smoothing: str
    videos: list[str] | None
    fps: float | None
    delays: list[int] | None
    tracker: dict[str, Any]
    refine: str = "none"


def track_keypoints(
    job: BodyJob,
    inputs: Sequence[str],
    cameras: "Sequence[PinholeCamera]",
    settings: KeypointSettings,
) -> int:
    """Track a body, write and report, and return the exit code: 1 if there is nobody or tracking is lost.

    Args:
        job: of the command. inputs: keypoints or videos, for each camera. cameras: calibrated.
        settings: the options.
    """
    _tracker(cameras, 1.0, settings)  # wrong cameras and options are told before any work
    shown = settings.videos
    if shown is None and all(map(is_video, inputs)):
        shown = list(inputs)
    overlay = job.overlay and shown is not None
    with ExitStack() as stack:
        films = None
        if shown is not None and (overlay or job.pictures):
            films = stack.enter_context(Films(shown, cameras, settings.delays))
        results = stack.enter_context(
            body_results(job, cameras, overlay, _more(job, films is not None, settings))
        )
        keypoints = read_body_keypoints(
            inputs, cameras, detector=settings.detector, fps=settings.fps, delays=settings.delays,
            other_rates=[] if films is None else films.rates,
        )  # fmt: skip
        start = time.perf_counter()
        poses = _track(keypoints, settings)
        seconds = time.perf_counter() - start
        if poses is None:
            print("torchpose: no camera has a keypoint, so there are no poses", file=sys.stderr)
            return 1
        stage, drawn = results.stage, []
        keypoints, cameras_file = _refined(keypoints, settings, poses, stage)
        written = results.commit([*write_poses(job, stage, poses), *cameras_file])
        if films is not None:
            drawn = draw(films.showing(keypoints), poses, stage, overlay, job.pictures)
        if job.pictures:
            drawn += [_write_skeleton(stage / "skeleton.png", poses, cameras[0])]
        facts = _facts(keypoints, settings, poses, seconds)
        written += results.commit([*drawn, *write_page(cameras[0], poses, facts, stage)])
    return summary(poses, facts, written, results.notes)


def _more(job: BodyJob, films: bool, settings: KeypointSettings) -> list[str]:
    """Return the names of further files: pictures, cameras."""
    pictures = [*(["overlay.png"] if films else []), "skeleton.png"] if job.pictures else []
    return pictures + [_CAMERAS] * (settings.refine != "none")


def _refined(
    keypoints: BodyKeypoints, settings: KeypointSettings, poses: "BodyTrack", stage: "Path"
) -> tuple[BodyKeypoints, "list[Path]"]:
    """Return keypoints with the refined cameras, and the file of these; both as given without --refine."""
    if settings.refine == "none":
        return keypoints, []
    from torchpose.camera._pinhole import save_cameras

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
    from torchpose.whole_body._keypoints.keypoint_body_tracker import KEYPOINT_METHOD

    return BodyTracker(cameras, KEYPOINT_METHOD, fps=fps, **settings.tracker)


def _track(keypoints: BodyKeypoints, settings: KeypointSettings) -> "BodyTrack | None":
    """Return the poses, or None if there is nobody."""
    tracker = _tracker(keypoints.cameras, keypoints.fps, settings)
    try:
        poses = tracker(
            keypoints=keypoints.points, confidence=keypoints.confidence,
            smoothing=settings.smoothing, refine=settings.refine, progress=show_progress(),
        )  # fmt: skip
    except NobodySeenError:
        return None
    return replace(poses, notes=(*keypoints.notes, *poses.notes))


def _facts(
    keypoints: BodyKeypoints, settings: KeypointSettings, poses: "BodyTrack", seconds: float
) -> dict[str, str]:
    """Return what was tracked, and how, by the name of each fact."""
    source = "files" if settings.detector is None else settings.detector.where
    n_cameras = len(keypoints.cameras)
    return {
        "keypoints": f"{n_cameras} camera{'s' * (n_cameras > 1)}, {keypoints.fps:g} fps, by {source}",
        "method": poses.method + smoothing_text("full" if settings.smoothing == "full" else None),
        "body": _body_text(poses, settings.tracker),
        "agreement": _agreement(keypoints, poses),
        "speed": f"{len(poses) / max(seconds, 1e-9):.1f} frames a second, without drawing",
    }


def _body_text(poses: "BodyTrack", given: dict[str, Any]) -> str:
    """Return whose body it is, or the height that its bones have."""
    if given["body"] is not None:
        return str(given["body"])
    known = "" if given["height"] is None else f", {given['height']:g} m given"
    return f"{poses.body.height:.2f} m by its bones{known}"


def _agreement(keypoints: BodyKeypoints, poses: "BodyTrack") -> str:
    """Return the share of every camera's keypoints that are those of the body."""
    there = keypoints.confidence > 0
    shares = []
    for c, camera in enumerate(keypoints.cameras):
        inlier = poses.details["inlier"][:, c][there[:, c]]
        share = percent(float(inlier.mean())) if len(inlier) else "no keypoints"
        shares.append(f"{camera.name} {share}")
    return ", ".join(shares)


def _write_skeleton(path: "Path", poses: "BodyTrack", camera: "PinholeCamera") -> "Path":
    """Draw some poses as the first camera sees them, and from the side."""
    from torchpose.viz._body_picture import plot_body_strip
    from torchpose.viz._style import save_figure

    seen = poses.seen_by(camera).joints3d[0]
    figure = plot_body_strip(
        seen, poses.body.skeleton, fps=poses.fps or 30.0, first_frame=poses.first_frame
    )
    return save_figure(figure, path)


class Films:
    """The videos that the body is drawn into; a context manager, which closes them.

    Args:
        videos: one for each camera. cameras: calibrated. delays: frames by which each began too early.

    Attributes:
        rates: frames per second of each. sizes: (width, height) of each.

    Raises:
        InputError, FileFormatError: videos that cannot be read. CameraError: of another shape.
    """

    def __init__(
        self,
        videos: Sequence[str],
        cameras: "Sequence[PinholeCamera]",
        delays: Sequence[int] | None,
    ) -> None:
        from torchpose.camera._choice import fit_to_size
        from torchpose.video._source import open_video

        self._videos, self._delays = videos, delays or [0] * len(videos)
        self.names = [camera.name for camera in cameras]
        self._sources = [open_video(path) for path in videos]
        self.rates = [float(source.fps) for source in self._sources]
        self.sizes = [source.size for source in self._sources]
        self._cameras = [
            fit_to_size(camera, size, path)[0]
            for camera, size, path in zip(cameras, self.sizes, videos, strict=True)
        ]

    def __enter__(self) -> "Films":
        return self

    def __exit__(self, *_: object) -> None:
        for source in self._sources:
            source.close()

    def showing(self, keypoints: BodyKeypoints) -> "Films":
        """Return the same with keypoints to be drawn, at whose frame rate the videos are read."""
        self.fps, self._keypoints = keypoints.fps, keypoints
        for shown, camera in zip(self._cameras, keypoints.cameras, strict=True):
            shown.rotation, shown.translation = camera.rotation, camera.translation
        return self

    def images(self) -> Iterator[tuple[Any, ...]]:
        """Read the frames of all cameras."""
        from torchpose.video._silhouettes import frames_in_step

        with ExitStack() as stack:
            sources = [stack.enter_context(self._open(i)) for i in range(len(self._videos))]
            for frames in frames_in_step(sources, self._delays):
                yield tuple(frame.image for frame in frames)

    def drawn(self, poses: "BodyTrack", t: int, images: Sequence[Any]) -> list[Any]:
        """Return the images of frame t of all cameras with the body and its keypoints."""
        import torch

        from torchpose.video._overlay import draw_body

        delays = poses.details.get("camera_delays", torch.zeros(1, len(images)))[0].round().long()
        at = (t - poses.first_frame - delays).clamp(0, len(poses) - 1)
        return [
            draw_body(
                image,
                project_joints(poses.joints3d[at[c]], camera),
                poses.body.skeleton,
                keypoints=self._seen(t, c),
            )
            for c, (image, camera) in enumerate(zip(images, self._cameras, strict=True))
        ]

    def _open(self, i: int) -> "VideoSource":
        from torchpose.video._source import open_video

        same = abs(self.rates[i] / self.fps - 1) < _SAME_RATE
        return open_video(self._videos[i], fps=None if same else self.fps)

    def _seen(self, t: int, c: int) -> "Tensor":
        """Return the keypoints of a camera in pixels of its video."""
        measured, shown = self._keypoints.cameras[c].matrix, self._cameras[c].matrix
        scale = shown.diagonal()[:2] / measured.diagonal()[:2]
        return (self._keypoints.points[t, c] + 0.5) * scale - 0.5
