"""Poses of a long recording, kept on disk while it is tracked."""

import shutil
import tempfile
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpose.errors import InputError, OutputError
from torchpose.upper_body.collapse import note_collapse
from torchpose.upper_body.pose_track import FRAME_FIELDS, PoseTrack

__all__ = ["PoseSpool"]


class PoseSpool:
    """Appends blocks of poses of one sequence to files, and reads them as one `PoseTrack`.

    The files go with the spool; poses that were read from it stay readable as long as they are held.

    Args:
        folder: where the files are; None is the system's folder for temporary files.

    Raises:
        OutputError: the folder cannot be written to.
    """

    def __init__(self, folder: str | Path | None = None) -> None:
        try:
            self._folder = Path(tempfile.mkdtemp(prefix=".poses-", dir=folder))
        except OSError as error:
            raise OutputError(
                f"{folder}: poses cannot be kept here ({error.strerror or error})"
            ) from error
        weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        self._like: PoseTrack | None = None
        self._n_frames = 0
        self.failed_at = -1

    def __len__(self) -> int:
        return self._n_frames

    def append(self, block: PoseTrack) -> None:
        """Add the frames of one sequence.

        Raises:
            InputError: not one sequence. OutputError: the disk is full.
        """
        if len(block) != 1:
            raise InputError(f"a spool holds one sequence, got a block of {len(block)}")
        try:
            for name in FRAME_FIELDS:
                with self._path(name).open("ab") as file:
                    file.write(_array(getattr(block, name)).tobytes())
        except OSError as error:
            raise OutputError(
                f"{self._folder}: poses cannot be kept here ({error.strerror or error})"
            ) from error
        if self.failed_at < 0 <= int(block.failed_at[0]):
            self.failed_at = self._n_frames + int(block.failed_at[0])
        self._like = block if self._like is None else self._like
        self._n_frames += block.joints3d.shape[1]

    def track(self, n_frames: int | None = None) -> PoseTrack:
        """Return the poses so far, or the first of them, read from the files as they are used.

        Raises:
            InputError: there are none.
        """
        like, count = self._like, self._n_frames if n_frames is None else n_frames
        if like is None or not 0 < count <= self._n_frames:
            raise InputError(f"expected 1 to {self._n_frames} poses, got {count}")
        fields: dict[str, Any] = {}
        for name in FRAME_FIELDS:
            sample = _array(getattr(like, name))
            shape = (self._n_frames, *sample.shape[1:])
            stored = np.memmap(self._path(name), sample.dtype, mode="c", shape=shape)
            fields[name] = torch.from_numpy(stored[:count])[None]
        fields["lengths"] = torch.tensor([count])
        fields["failed_at"] = torch.tensor([self.failed_at])
        return note_collapse(replace(like, **fields))

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.bin"


def _array(values: Tensor) -> np.ndarray:
    return values[0].detach().cpu().contiguous().numpy()
