"""Draw bodies into the videos of all cameras, by what `torchpose track-body` was given."""

import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from torchpose._core.wording import counted

if TYPE_CHECKING:
    from torch import Tensor

    from torchpose.camera._pinhole import PinholeCamera
    from torchpose.cli._body_keypoint_inputs import BodyKeypoints
    from torchpose.video._source_interface import VideoSource
    from torchpose.whole_body._body_track import BodyTrack

_FOLDED = 0.01  # distance of a ray from what its pixel is undistorted to, at most, over its length
_NO_FILE_NAME = re.compile(r'[\x00-\x1f"*/:<>?\\|]')
_SAME_RATE = 0.01  # relative: of videos that are not resampled


@runtime_checkable
class DrawnVideos(Protocol):
    """Declares the videos of all cameras, and how bodies are drawn into them."""

    @property
    def names(self) -> Sequence[str]:
        """Return the names of the cameras."""
        ...

    @property
    def sizes(self) -> Sequence[tuple[int, int]]:
        """Return (width, height) of each video."""
        ...

    @property
    def fps(self) -> float:
        """Return the frames per second."""
        ...

    def images(self) -> Iterator[tuple[Any, ...]]:
        """Read the frames of all cameras; None where the video of a camera has ended."""
        ...

    def drawn(self, people: "Sequence[BodyTrack]", t: int, images: Sequence[Any]) -> list[Any]:
        """Return the images of frame t of all cameras with the bodies that are there; None stays None."""
        ...


def overlay_name(camera: str) -> str:
    """Return the name of a camera's video, without what a name of a file cannot have.

    >>> overlay_name("rig/left")
    'overlay_rig_left.mp4'
    """
    return f"overlay_{_NO_FILE_NAME.sub('_', camera)}.mp4"


def span_of(people: "Sequence[BodyTrack]") -> tuple[int, int]:
    """Return the first frame with somebody, and the one after the last."""
    first = min(poses.first_frame for poses in people)
    return first, max(poses.first_frame + len(poses) for poses in people)


def draw(
    films: DrawnVideos, people: "Sequence[BodyTrack]", out: Path, videos: bool, picture: bool
) -> tuple[list[Path], tuple[str, ...]]:
    """Draw all bodies into the frames of every camera: videos, and some frames as one picture.

    Returns:
        The files, and a note for each video that ends before the poses do.
    """
    from torchpose.video._writer import VideoWriter

    files = [out / overlay_name(name) for name in films.names] if videos else []
    first, end = span_of(people)
    chosen = {round(i * (end - first - 1) / 5) + first for i in range(6)}
    strip: list[list[Any]] = []
    counts = [0] * len(films.names)
    with ExitStack() as stack:
        writers = [
            stack.enter_context(VideoWriter(file, films.fps, size))
            for file, size in zip(files, films.sizes, strict=False)
        ]
        for t, images in enumerate(films.images()):
            if t >= end:
                break
            counts = [c if x is None else t + 1 for c, x in zip(counts, images, strict=True)]
            if t < first:
                continue
            if not videos and t not in chosen:
                continue
            drawn = films.drawn(people, t, images)
            for writer, image in zip(writers, drawn, strict=False):
                if image is not None:
                    writer.write(image)
            if t in chosen:
                strip.append(drawn)
    files = [file for file, count in zip(files, counts, strict=False) if count > first]
    if picture and strip:
        files.append(_write_strip(out / "overlay.png", strip, films))
    return files, tuple(
        f"the video of camera {name} ends after {counted(count, 'frame')}, so its overlay does not show the "
        "poses after that"
        for name, count in zip(films.names, counts, strict=True)
        if count < end
    )


def _write_strip(path: Path, strip: list[list[Any]], films: DrawnVideos) -> Path:
    """Write frames as columns and cameras as rows with their names; black where there is no image."""
    import cv2
    import numpy as np

    from torchpose._core.files import atomic_path
    from torchpose.video._overlay import named

    height = 320

    def small(image: Any) -> Any:
        width = max(1, round(image.shape[1] * height / image.shape[0]))
        return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)

    black = [np.zeros((rows, columns, 3), np.uint8) for columns, rows in films.sizes]
    rows = []
    for c, (name, blank) in enumerate(zip(films.names, black, strict=True)):
        first, *others = [small(blank if frame[c] is None else frame[c]) for frame in strip]
        rows.append(np.hstack([named(first, name) if len(black) > 1 else first, *others]))
    widest = max(row.shape[1] for row in rows)
    rows = [np.pad(row, ((0, 4), (0, widest - row.shape[1]), (0, 0))) for row in rows]
    with atomic_path(path) as temporary:
        coded = cv2.imencode(".png", cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR))[1]
        temporary.write_bytes(coded.tobytes())
    return path


def project_joints(joints: "Tensor", camera: "PinholeCamera") -> "Tensor":
    """Return the pixels [J, 2] of world points [J, 3] in the images of a camera, its distortions applied.

    Points have none, NaN, behind the camera, and where the distortions, which were fitted to the image alone,
    fold back into it what lies far beside it.
    """
    import torch

    from torchpose.camera._lens import distort_rays, straighten_rays

    points = joints.detach().cpu().double() @ camera.rotation_matrix.mT + camera.translation
    straight, lens = points[:, :2] / points[:, 2:], (camera.distortions, camera.fisheye)
    rays = distort_rays(straight, *lens)
    size = 1 + straight.norm(dim=-1, keepdim=True)
    off = (straighten_rays(rays, *lens) - straight).norm(dim=-1, keepdim=True) / size
    pixels = rays @ camera.matrix[:2, :2].mT + camera.matrix[:2, 2]
    return torch.where((points[:, 2:] > 0) & (off < _FOLDED), pixels, torch.nan)


def as_seen(points: "Tensor", camera: "PinholeCamera", turn: "Tensor") -> "Tensor":
    """Return the points c + turn^T (points - c), which a camera would see where it sees the given ones.

    A turned camera has the rotation R turn^T about its centre c, in place of the R of its calibration.

    Args:
        points: [J, 3], world axes. camera: as it was calibrated. turn: [3, 3], of `BodyTrack.details`.
    """
    centre = -camera.rotation_matrix.mT @ camera.translation
    return centre + (points.detach().cpu().double() - centre) @ turn.cpu().double()


class Films:
    """The videos that bodies are drawn into; a context manager, which closes them.

    Args:
        videos: one for each camera. cameras: calibrated. delays: frames by which each began too early.

    Attributes:
        rates: frames per second of those that state a rate. sizes: (width, height) of each.

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
        self.rates = [float(source.fps) for source in self._sources if source.knows_rate]
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

    def rate_beside(self, keypoints: "BodyKeypoints") -> float | None:
        """Return the rate at which the videos are read beside keypoints: theirs, or None for the videos' own.

        Where the videos have a frame for each of the keypoints, these are of another rate than the videos
        state, as in slow motion.
        """
        own = resampled = 0.0
        for source, length in zip(self._sources, keypoints.lengths, strict=True):
            if source.n_frames is not None and length is not None:
                factor = keypoints.fps / source.fps if source.knows_rate else 1.0
                own += abs(source.n_frames - length)
                resampled += abs(factor * source.n_frames - length)
        return None if own < resampled else keypoints.fps

    def showing(self, keypoints: "BodyKeypoints") -> "Films":
        """Return the same with keypoints to be drawn, beside which the videos are read."""
        self.fps, self._keypoints = keypoints.fps, keypoints
        self._rate = self.rate_beside(keypoints)
        for shown, camera in zip(self._cameras, keypoints.cameras, strict=True):
            shown.rotation, shown.translation = camera.rotation, camera.translation
        return self

    def images(self) -> Iterator[tuple[Any, ...]]:
        """Read the frames of all cameras; None where the video of a camera has ended."""
        from torchpose.video._silhouettes import skip_frames

        with ExitStack() as stack:
            sources = [stack.enter_context(self._open(i)) for i in range(len(self._videos))]
            skip_frames(sources, self._delays)
            for frames in zip_longest(*sources):
                yield tuple(None if frame is None else frame.image for frame in frames)

    def drawn(self, people: "Sequence[BodyTrack]", t: int, images: Sequence[Any]) -> list[Any]:
        """Return the images of frame t of all cameras with the bodies and all keypoints; None stays None."""
        there = [
            (place, poses)
            for place, poses in enumerate(people)
            if 0 <= t - poses.first_frame < len(poses)
        ]
        drawn = list(images)
        for order, (place, poses) in enumerate(there, 1):
            tint = None if len(people) == 1 else place
            drawn = [
                None if image is None
                else self._drawn(image, poses, t, c, tint, order == len(there))
                for c, image in enumerate(drawn)
            ]  # fmt: skip
        return drawn

    def _drawn(
        self, image: Any, poses: "BodyTrack", t: int, c: int, tint: int | None, crosses: bool
    ) -> Any:
        """Return the image of camera c with one body; `tint` is the place of one of several."""
        import torch

        from torchpose.video._overlay import draw_body

        delays = poses.details.get("camera_delays", torch.zeros(1, len(self._cameras)))[0]
        at = int((t - poses.first_frame - delays[c].round().long()).clamp(0, len(poses) - 1))
        feet = None
        if poses.feet is not None:
            feet = self._projected(poses.feet.points3d[at], poses, at, c)
        return draw_body(
            image, self._projected(poses.joints3d[at], poses, at, c), poses.body.skeleton,
            keypoints=self._seen(t, c) if crosses else None,
            label="" if tint is None else f"person {tint + 1}", tint=tint, feet=feet,
        )  # fmt: skip

    def _projected(self, points: "Tensor", poses: "BodyTrack", at: int, c: int) -> "Tensor":
        """Return the pixels of points of a pose in camera c, which is turned as its keypoints say."""
        from torchpose.whole_body._keypoints.track_builder import CAMERA_TURN

        camera = self._cameras[c]
        if CAMERA_TURN in poses.details:
            points = as_seen(points, camera, poses.details[CAMERA_TURN][at, c])
        return project_joints(points, camera)

    def _open(self, i: int) -> "VideoSource":
        from torchpose.video._source import open_video

        rate = self._rate
        if rate is not None and abs(self._sources[i].fps / rate - 1) < _SAME_RATE:
            rate = None
        return open_video(self._videos[i], fps=rate)

    def _seen(self, t: int, c: int) -> "Tensor":
        """Return the keypoints of a camera in pixels of its video, [K, 2] of all detections."""
        measured, shown = self._keypoints.cameras[c].matrix, self._cameras[c].matrix
        scale = shown.diagonal()[:2] / measured.diagonal()[:2]
        return (self._keypoints.points[t, c].reshape(-1, 2) + 0.5) * scale - 0.5
