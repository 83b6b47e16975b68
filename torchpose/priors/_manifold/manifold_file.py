"""Record what a manifold was fitted on and whose body its columns are of; read and write its file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Unpack

from torch import Tensor

from torchpose._core.tensor_file import (
    FileKind,
    info_from_json,
    info_to_json,
    read_tensors,
    write_tensors,
)
from torchpose.errors import PriorError
from torchpose.priors._facts import ManifoldFacts

_GROWTH = "noise_growth"  # in `extra`: exponents of standard deviations over time
_SAME_FRAME_RATE = 0.01  # relative difference of frame rates that count as the same
_SAME_CENTRE = 1e-6  # difference of quaternion vectors that count as the same


@dataclass(frozen=True)
class ManifoldInfo:
    """Holds facts about the fit of a manifold; fields that are not known are empty.

    Attributes:
        name: the name of the manifold.
        skeleton: joints of the body whose states the poses are of.
        columns: names of the columns of a pose, a part and an axis each.
        frame: "parent" or "body", what part rotations are relative to.
        centres: quaternion vector of each part that rotations are centred on (DX 1).
        fps: frame rate that its standard deviations refer to.
        persons: ids of the persons. actions: what they did. sources: recordings or data sets.
        sequences: a name for each sequence, for pictures.
        licence: the licence of the data. command: that made it.
        extra: anything else that JSON can hold.
    """

    name: str = ""
    skeleton: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    frame: str = "parent"
    centres: tuple[tuple[float, ...], ...] = ()
    fps: float | None = None
    persons: tuple[str, ...] = ()
    actions: tuple[str, ...] = ()
    sources: tuple[str, ...] = ()
    sequences: tuple[str, ...] = ()
    licence: str = ""
    command: str = ""
    extra: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of_body(cls, body: Any, **facts: Unpack[ManifoldFacts]) -> ManifoldInfo:
        """Return info with the skeleton, columns, frame and centres of a body.

        Args:
            body: a `torchpose.body.Body`.
            **facts: other fields.

        Returns:
            `ManifoldInfo`.
        """
        return cls(
            skeleton=tuple(body.skeleton.names),
            columns=tuple(f"{part} {axis}" for part in body.skeleton.parts[1:] for axis in "xyz"),
            frame=str(body.frame),
            centres=_centres(body),
            **facts,
        )

    def check_for(self, body: Any, dim: int) -> None:
        """Check that poses of a body are poses of the manifold.

        Args:
            body: whose skeleton, frame and centres are compared.
            dim: Q, number of columns of the manifold's poses.

        Raises:
            PriorError: another skeleton, frame, centres or number of columns.
        """
        theirs = ManifoldInfo.of_body(body)
        found = []
        for name in ("skeleton", "columns", "frame"):
            mine, other = getattr(self, name), getattr(theirs, name)
            if mine and mine != other:
                found.append(f"its {name} is {_short(mine)}, the body's is {_short(other)}")
        if self.skeleton and not _same_centres(self.centres, theirs.centres):
            found.append("its part rotations are centred elsewhere than the body's")
        if len(theirs.columns) != dim:
            found.append(f"it has {dim} columns, poses of the body have {len(theirs.columns)}")
        if found:
            raise PriorError(
                f"the manifold {self.name!r} is of another body: {'; '.join(found)}; fit one to "
                "poses of this body with torchpose.learning.fit_gplvm"
            )

    def check_rate(self, fps: float, known: bool) -> None:
        """Check that the standard deviations are known, and for this frame rate.

        Args:
            fps: frames per second of the frames to be tracked.
            known: whether the manifold has standard deviations.

        Raises:
            PriorError: there are none, or those of another frame rate.
        """
        if not known:
            raise PriorError(
                f"the manifold {self.name!r} has no standard deviations yet; call fit_gplvm_noise with "
                "validation poses"
            )
        if self.fps is not None and abs(fps / self.fps - 1) > _SAME_FRAME_RATE:
            raise PriorError(
                f"the standard deviations of the manifold {self.name!r} are for {self.fps:g} frames "
                f"per second, got {fps:g}; call fit_gplvm_noise with validation poses at that rate"
            )

    def with_noise(self, fps: float, growth: Mapping[str, float]) -> ManifoldInfo:
        """Return the same info with the frame rate of the standard deviations, and how they grow with time.

        Args:
            fps: frames per second.
            growth: exponents g of "latent" (sigma x->z) and "step" (sigma x->x), see `noise_factors`.

        Returns:
            `ManifoldInfo`.
        """
        return replace(self, fps=float(fps), extra={**self.extra, _GROWTH: dict(growth)})

    def noise_factors(self, fps: float, known: bool) -> tuple[float, float]:
        """Return the factors of sigma x->z and sigma x->x for another frame rate.

        Args:
            fps: frames per second.
            known: whether the manifold has standard deviations.

        Returns:
            Both factors, (fps_0 / fps)^g with the exponent g of each.

        Raises:
            PriorError: as `check_rate`, if nothing says how they grow.
        """
        growth = self.extra.get(_GROWTH)
        if not isinstance(growth, Mapping) or self.fps is None or not 0 < fps < math.inf:
            self.check_rate(fps, known)
            return 1.0, 1.0
        ratio = self.fps / fps
        return float(ratio ** growth["latent"]), float(ratio ** growth["step"])

    def to_json(self) -> str:
        """Return text that `from_json` reads back."""
        return info_to_json(self)

    @classmethod
    def from_json(cls, text: str) -> ManifoldInfo:
        """Read what `to_json` has written.

        Args:
            text: JSON.

        Returns:
            `ManifoldInfo`.

        Raises:
            FileFormatError: not JSON, other fields, or values of another kind.
        """
        return info_from_json(cls, text)


_KIND = FileKind(
    "torchpose-manifold",
    1,
    ManifoldInfo,
    tensors={
        "poses": "T Q", "scale": "Q", "weights": "T d", "bias": "d", "gamma_x": "",
        "log_kernel": "4", "std_latent": "d", "std_pose": "Q", "std_step": "Q",
    },
    indices={"lengths": "S"},
    positive=("scale", "gamma_x", "std_latent", "std_pose", "std_step"),
    unknown=("std_latent", "std_pose", "std_step"),
)  # fmt: skip
TENSORS = (*_KIND.tensors, *_KIND.indices)  # names of those that a manifold's file holds


def write_manifold(path: str | Path, info: ManifoldInfo, tensors: Mapping[str, Tensor]) -> None:
    """Write info and `TENSORS` as safetensors; the file appears whole or not at all.

    Raises:
        OutputError: the file cannot be written. PriorError: `info` holds what is not JSON.
    """
    write_tensors(path, _KIND, info, tensors)


def read_manifold(path: str | Path) -> tuple[ManifoldInfo, dict[str, Tensor]]:
    """Return info and tensors of a manifold's file.

    Raises:
        InputError: no such file. FileFormatError: truncated, of another kind or version, or tensors
            are missing or of other sizes.
    """
    return read_tensors(path, _KIND)


def _centres(body: Any) -> tuple[tuple[float, ...], ...]:
    centres = getattr(body, "centres", None)
    return () if centres is None else tuple(tuple(row) for row in centres.detach().cpu().tolist())


def _same_centres(mine: Sequence[Sequence[float]], theirs: Sequence[Sequence[float]]) -> bool:
    """Return whether centres are alike up to rounding; none at all are zeros."""
    a, b = ([v for row in rows for v in row] for rows in (mine, theirs))
    size = max(len(a), len(b))
    a, b = a or [0.0] * size, b or [0.0] * size
    return len(a) == len(b) and all(
        math.isclose(x, y, rel_tol=0, abs_tol=_SAME_CENTRE) for x, y in zip(a, b, strict=True)
    )


def _short(value: Any) -> str:
    text = ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return text if len(text) <= 60 else f"{text[:40]}... ({len(value)})"
