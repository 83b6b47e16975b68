"""The videos of a `torchpose track-body`: opened, turned to silhouettes, read once more to be drawn."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

from jsonargparse import Namespace

if TYPE_CHECKING:
    from torch import Tensor

    from torchpose.camera._pinhole import PinholeCamera
    from torchpose.camera._rig import CameraRig
    from torchpose.video._base import VideoSource
    from torchpose.video._silhouettes import SilhouetteMeasurer

__all__ = ["Recordings"]


class Recordings:
    """The videos, how each becomes silhouettes, and the silhouettes that were seen so far."""

    def __init__(self, args: Namespace, cameras: "Sequence[PinholeCamera]") -> None:
        from torchpose.video._silhouettes import fit_views

        self._args = args
        self.sources = self._open()
        self.views = fit_views(cameras, [s.size for s in self.sources], args.rows)
        self.packed: list[Any] = []
        self.notes: list[str] = []

    def __enter__(self) -> "Recordings":
        return self

    def __exit__(self, *_: object) -> None:
        for source in self.sources:
            source.close()

    @cached_property
    def rig(self) -> "CameraRig":
        """The cameras of the silhouettes."""
        from torchpose.camera._rig import CameraRig

        return CameraRig([view.camera for view in self.views])

    @property
    def fps(self) -> float:
        """Frames per second."""
        return float(self.sources[0].fps)

    @property
    def n_frames(self) -> int | None:
        """How many frames to expect."""
        counts = [s.n_frames for s in self.sources if s.n_frames is not None]
        return min(counts, default=None)

    def silhouettes(self) -> "Iterator[Tensor]":
        """Learn the background; returns silhouettes [C, H, W] of one frame after the other.

        They are kept, a bit per pixel.
        """
        return self._read(self._measurers())

    def _read(self, measurers: "list[SilhouetteMeasurer]") -> "Iterator[Tensor]":
        import numpy as np

        from torchpose.video._silhouettes import read_silhouettes

        for masks in read_silhouettes(self.sources, measurers, self._args.delays):
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
            for frames in frames_in_step(sources, self._args.delays or [0] * len(sources)):
                yield tuple(frame.image for frame in frames)
        finally:
            for source in sources:
                source.close()

    def _open(self) -> "list[VideoSource]":
        from torchpose.video._source import open_video

        return [open_video(path, fps=self._args.fps) for path in self._args.videos]

    def _measurers(self) -> "list[SilhouetteMeasurer]":
        from torchpose.video._silhouettes import (
            SilhouetteMeasurer,
            learning_frames,
            read_empty_scene,
        )
        from torchpose.video._source import open_video

        print("learning the background ...", flush=True)
        empty = [read_empty_scene(path) for path in self._args.background or []]
        if not empty:
            self.notes.append(
                "without --background what stays in the videos is taken for their background; a part "
                "of the person that never moves is taken for it, too"
            )
        measurers = []
        for i, (view, path) in enumerate(zip(self.views, self._args.videos, strict=True)):
            if empty and not self._args.ignore_still:
                measurers.append(SilhouetteMeasurer(view, empty[i]))
                continue
            with open_video(path, fps=self._args.fps) as source:
                frames = learning_frames(source)
                measurers.append(SilhouetteMeasurer(view, empty[i] if empty else None, frames))
        return measurers
