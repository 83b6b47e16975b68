"""The videos of `torchpose track-body` as silhouettes, and keypoints in the images of these."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

from torchpose.cli._body_keypoint_inputs import BodyKeypoints
from torchpose.cli._body_overlays import project_joints

if TYPE_CHECKING:
    from torch import Tensor

    from torchpose.camera._pinhole import PinholeCamera
    from torchpose.camera._rig import CameraRig
    from torchpose.video._silhouettes import SilhouetteMeasurer, SilhouetteView
    from torchpose.video._source_interface import VideoSource
    from torchpose.whole_body._body_track import BodyTrack


class SilhouetteSettings(NamedTuple):
    """Holds how videos become silhouettes.

    Attributes:
        rows: height of the silhouettes. background: of the empty scene for each camera, or None.
        ignore_still: whether what always looks the same in a video is no person.
    """

    rows: int
    background: list[str] | None
    ignore_still: bool


class Recordings:
    """The videos, how each becomes silhouettes, and the silhouettes that were seen so far.

    A context manager, which closes the videos.

    Args:
        videos: a file or a folder of images for each camera. cameras: in the same order.
        rows: height of the silhouettes. fps: rate at which all are read, by default their own.
        delays: frames by which each began too early. background: of the empty scene for each camera.
        ignore_still: whether what always looks the same in a video is no person.
    """

    def __init__(
        self,
        videos: Sequence[str],
        cameras: "Sequence[PinholeCamera]",
        rows: int,
        *,
        fps: float | None = None,
        delays: Sequence[int] | None = None,
        background: Sequence[str] | None = None,
        ignore_still: bool = False,
    ) -> None:
        from torchpose.camera._choice import fit_to_size
        from torchpose.video._silhouettes import fit_views

        self.videos, self._fps, self.background = videos, fps, background or ()
        self._delays, self._ignore_still = delays or [0] * len(videos), ignore_still
        self.sources = self._open()
        sizes = [source.size for source in self.sources]
        fitted = [fit_to_size(*given) for given in zip(cameras, sizes, videos, strict=True)]
        self.views = fit_views([camera for camera, _ in fitted], sizes, rows)
        self.packed: list[Any] = []
        self.notes: list[str] = [note for _, notes in fitted for note in notes]
        self._check_delays()
        self.notes += self._note_on_lengths()

    def __enter__(self) -> "Recordings":
        return self

    def __exit__(self, *_: object) -> None:
        for source in self.sources:
            source.close()

    @cached_property
    def rig(self) -> "CameraRig":
        """Return the cameras of the silhouettes."""
        from torchpose.camera._rig import CameraRig

        return CameraRig([view.camera for view in self.views])

    @property
    def fps(self) -> float:
        """Return the frames per second."""
        return float(self.sources[0].fps)

    @property
    def names(self) -> Sequence[str]:
        """Return the names of the cameras."""
        return self.rig.names

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Return (width, height) of each video."""
        return [view.size for view in self.views]

    @property
    def n_frames(self) -> int | None:
        """Return how many frames to expect, None if unknown."""
        counts = [
            source.n_frames - delay
            for source, delay in zip(self.sources, self._delays, strict=True)
            if source.n_frames is not None
        ]
        return min(counts, default=None)

    @property
    def all_notes(self) -> tuple[str, ...]:
        """Return the notes of cameras and background, and those of the videos; each once."""
        read = (note for source in self.sources for note in source.notes)
        return tuple(dict.fromkeys((*self.notes, *read)))

    def silhouettes(self) -> "Iterator[Tensor]":
        """Learn the background; return silhouettes [C, H, W] of one frame after the other.

        They are kept, a bit per pixel.
        """
        return self._read(self._measurers())

    def _read(self, measurers: "list[SilhouetteMeasurer]") -> "Iterator[Tensor]":
        import numpy as np

        from torchpose.video._silhouettes import read_silhouettes

        for masks in read_silhouettes(self.sources, measurers, self._delays):
            self.packed.append(np.packbits(masks.numpy(), axis=-1))
            yield masks

    def kept(self, frame: int) -> "Tensor":
        """Return the silhouettes of a frame that was read."""
        import numpy as np
        import torch

        width = self.rig.sizes[0][1]  # type: ignore[index]  # views have sizes
        bits = np.unpackbits(self.packed[frame], axis=-1)[..., :width]
        return torch.from_numpy(bits.astype(bool))

    def images(self) -> Iterator[tuple[Any, ...]]:
        """Read the frames of all cameras once more."""
        from torchpose.video._silhouettes import frames_in_step

        sources = self._open()
        try:
            for frames in frames_in_step(sources, self._delays):
                yield tuple(frame.image for frame in frames)
        finally:
            for source in sources:
                source.close()

    def drawn(self, people: "Sequence[BodyTrack]", t: int, images: Sequence[Any]) -> list[Any]:
        """Return the images of frame t of all cameras with the one body and the outline."""
        from torchpose.video._overlay import draw_body
        from torchpose.whole_body._silhouettes.rendering import render

        (poses,) = people
        k, rig = t - poses.first_frame, self.rig
        height, width = rig.sizes[0]  # type: ignore[misc]  # views have sizes
        model = render(poses.body, poses.state[k], rig, height, width)
        measured = self.kept(t)
        drawn = []
        for c, (view, image) in enumerate(zip(self.views, images, strict=True)):
            part = _inside(view)
            joints = project_joints(poses.joints3d[k], view.source)
            drawn.append(
                draw_body(image, joints, poses.body.skeleton,
                          model=model[c][part], silhouette=measured[c][part])
            )  # fmt: skip
        return drawn

    def _check_delays(self) -> None:
        """Raise `InputError` unless every video has frames after those that are skipped."""
        from torchpose.errors import InputError

        for path, source, delay in zip(self.videos, self.sources, self._delays, strict=True):
            count = source.n_frames
            if delay < 0 or (count is not None and 0 < count <= delay):
                raise InputError(
                    f"--delays must be from 0 to below the number of frames, got {delay} for {path}"
                    + ("" if count is None else f", which has {count}")
                )

    def _note_on_lengths(self) -> list[str]:
        """Note that frames of longer videos are left out, which only some of the cameras have."""
        from torchpose._core.wording import counted

        pairs = zip(self.sources, self._delays, strict=True)
        counts = [None if s.n_frames is None else s.n_frames - delay for s, delay in pairs]
        known = [count for count in counts if count is not None]
        if len(set(known)) < 2:
            return []
        least, most = min(known), max(known)
        path = self.videos[counts.index(least)]
        return [
            f"{path} ends after {counted(least, 'frame')} and others after up to {most}: what only some of "
            "the cameras have is not tracked"
        ]

    def _open(self) -> "list[VideoSource]":
        from torchpose.video._source import open_video

        return [open_video(path, fps=self._fps) for path in self.videos]

    def _measurers(self) -> "list[SilhouetteMeasurer]":
        from torchpose.video._silhouettes import (
            SilhouetteMeasurer,
            learning_frames,
            read_empty_scene,
        )
        from torchpose.video._source import open_video

        print("learning the background ...", flush=True)
        empty = [read_empty_scene(path) for path in self.background]
        if not empty:
            self.notes.append(
                "without --background everything that never changes in a video counts as background, also a "
                "part of the person that never moves"
            )
        measurers = []
        for i, (view, path) in enumerate(zip(self.views, self.videos, strict=True)):
            if empty and not self._ignore_still:
                measurers.append(SilhouetteMeasurer(view, empty[i]))
                continue
            with open_video(path, fps=self._fps) as source:
                frames = learning_frames(source)
                measurers.append(SilhouetteMeasurer(view, empty[i] if empty else None, frames))
        return measurers


def _inside(view: "SilhouetteView") -> tuple[slice, slice]:
    """Return the part of a silhouette that the frame of the video shows."""
    (w, h), (right, below), (inner_w, inner_h) = view.size, view.padding, view.inner
    return slice(0, round(inner_h * h / (h + below))), slice(0, round(inner_w * w / (w + right)))


def in_silhouettes(keypoints: BodyKeypoints, recordings: Recordings) -> BodyKeypoints:
    """Return keypoints as the cameras of silhouettes see them, of the frames that both have.

    Args:
        keypoints: of one person. recordings: of the same cameras.
    """
    import torch

    from torchpose.camera._projection import map_pixels
    from torchpose.camera._rig import CameraRig

    straight = CameraRig(keypoints.cameras).undistort_points(keypoints.points)
    pairs = zip(keypoints.cameras, recordings.views, strict=True)
    points = torch.stack(
        [
            map_pixels(straight[:, c], camera.matrix, view.camera.matrix)
            for c, (camera, view) in enumerate(pairs)
        ],
        1,
    )
    count, there = len(points), recordings.n_frames
    notes = keypoints.notes
    if there is not None and there != count:
        count = min(count, there)
        notes += (
            f"keypoints have {len(points)} frames and videos {there}; the first {count} are used",
        )
    cameras = [view.camera for view in recordings.views]
    return keypoints._replace(
        points=points[:count],
        confidence=keypoints.confidence[:count],
        cameras=cameras,
        notes=notes,
    )


def pixel_scale(keypoints: BodyKeypoints, recordings: Recordings) -> float:
    """Return the size of a pixel of the keypoints in those of the silhouettes, the mean over cameras."""
    scales = [
        float(view.camera.matrix[1, 1] / camera.matrix[1, 1])
        for camera, view in zip(keypoints.cameras, recordings.views, strict=True)
    ]
    return sum(scales) / len(scales)
