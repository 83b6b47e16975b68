"""What a manifold was fitted on, whose body its columns are of, and the file that it is kept in."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from torchpose.errors import FileFormatError, PriorError
from torchpose.io.files import atomic_path, require_file

__all__ = ["FILE_FORMAT", "FILE_VERSION", "ManifoldInfo", "read_manifold", "write_manifold"]

FILE_FORMAT, FILE_VERSION = "torchpose-manifold", 1
_HEADER = "torchpose"  # one key: the order of several is not reproducible in safetensors
_SAME_FRAME_RATE = 0.01  # of it
_SAME_CENTRE = 1e-6  # of a quaternion vector


@dataclass(frozen=True)
class ManifoldInfo:
    """What a manifold was fitted on; fields that are not known are empty.

    Attributes:
        name: of the manifold.
        skeleton: joints of the body whose states the poses are of.
        columns: names of the columns of a pose, a part and an axis each.
        frame: "parent" or "body", what part rotations are relative to.
        centres: quaternion vector of each part that rotations are centred on (DX 1).
        fps: frame rate that its standard deviations refer to.
        persons: ids of the persons. actions: what they did. sources: recordings or data sets.
        sequences: a name for each sequence, for pictures.
        licence: of the data. command: that made it.
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
    def of_body(cls, body: Any, **facts: Any) -> ManifoldInfo:
        """Info with the skeleton, columns, frame and centres of a body, and other facts as given."""
        return cls(
            skeleton=tuple(body.skeleton.names),
            columns=tuple(f"{part} {axis}" for part in body.skeleton.parts[1:] for axis in "xyz"),
            frame=str(body.frame),
            centres=_centres(body),
            **facts,
        )

    def check_for(self, body: Any, dim: int) -> None:
        """Raise `PriorError` unless poses of a body, of so many columns, are those of the manifold."""
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
                "poses of this body with BackConstrainedGPLVM.fit"
            )

    def check_rate(self, fps: float, known: bool) -> None:
        """Raise `PriorError` unless the standard deviations are known, and for this frame rate."""
        if not known:
            raise PriorError(
                f"the manifold {self.name!r} has no standard deviations yet; call fit_noise with "
                "validation poses"
            )
        if self.fps is not None and abs(fps / self.fps - 1) > _SAME_FRAME_RATE:
            raise PriorError(
                f"the standard deviations of the manifold {self.name!r} are for {self.fps:g} frames "
                f"per second, got {fps:g}; call fit_noise with validation poses at that rate"
            )

    def to_json(self) -> str:
        """Text that `from_json` reads back."""
        return json.dumps(asdict(self), sort_keys=True, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> ManifoldInfo:
        """Read `to_json` back.

        Raises:
            FileFormatError: not JSON, other fields, or values of another kind.
        """
        try:
            values = json.loads(text)
        except ValueError as error:
            raise FileFormatError(f"expected the JSON of a manifold: {error}") from error
        if not isinstance(values, dict):
            raise FileFormatError("expected the JSON of a manifold, got something else")
        unknown = sorted(set(values) - {f.name for f in fields(cls)})
        if unknown:
            raise FileFormatError(f"unknown field {unknown[0]!r} in the JSON of a manifold")
        for key, default in asdict(cls()).items():
            allowed: Any = {tuple: list, str: str, dict: dict}.get(
                type(default), float | int | None
            )
            if key in values and not isinstance(values[key], allowed):
                raise FileFormatError(
                    f"bad value of {key} in the JSON of a manifold: {values[key]!r:.60}"
                )
        return cls(**{key: _tuples(value) for key, value in values.items()})


def write_manifold(path: str | Path, info: ManifoldInfo, tensors: Mapping[str, Tensor]) -> None:
    """Write tensors and info as safetensors; the file appears whole or not at all.

    Raises:
        OutputError: the file cannot be written. PriorError: `info` holds what is not JSON.
    """
    try:
        header = {"format": FILE_FORMAT, "version": FILE_VERSION, "info": info.to_json()}
    except (TypeError, ValueError) as error:
        raise PriorError(f"info must hold only what JSON can hold: {error}") from error
    plain = {key: value.detach().cpu().contiguous().clone() for key, value in tensors.items()}
    with atomic_path(path) as temporary:
        save_file(plain, temporary, metadata={_HEADER: json.dumps(header, sort_keys=True)})


def read_manifold(
    path: str | Path, expected: Sequence[str]
) -> tuple[ManifoldInfo, dict[str, Tensor]]:
    """Info and tensors of a manifold's file.

    Args:
        path: the file. expected: names of the tensors.

    Raises:
        InputError: no such file. FileFormatError: truncated, of another kind or version.
    """
    path = require_file(path)
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors: dict[str, Tensor] = {
                key: file.get_tensor(key)
                for key in file.keys()  # noqa: SIM118
            }
        header = json.loads(metadata.get(_HEADER, "null"))
    except (SafetensorError, OSError, ValueError, RuntimeError) as error:
        raise FileFormatError(
            f"{path}: expected a manifold as safetensors; the file is truncated or of another kind "
            f"({error})"
        ) from error
    if not isinstance(header, dict) or header.get("format") != FILE_FORMAT:
        kind = header.get("format") if isinstance(header, dict) else "another kind"
        raise FileFormatError(f"{path}: expected a {FILE_FORMAT}, got a file of {kind}")
    if header.get("version") != FILE_VERSION:
        raise FileFormatError(
            f"{path}: expected version {FILE_VERSION} of the manifold format, got "
            f"{header.get('version')!r}; use a torchpose that fits, or fit the manifold again"
        )
    if set(tensors) != set(expected):
        raise FileFormatError(
            f"{path}: expected the tensors {', '.join(sorted(expected))}, found "
            f"{', '.join(sorted(tensors)) or 'none'}"
        )
    try:
        return ManifoldInfo.from_json(str(header.get("info"))), tensors
    except FileFormatError as error:
        raise FileFormatError(f"{path}: {error}") from error


def _centres(body: Any) -> tuple[tuple[float, ...], ...]:
    centres = getattr(body, "centres", None)
    return () if centres is None else tuple(tuple(row) for row in centres.detach().cpu().tolist())


def _same_centres(mine: Sequence[Sequence[float]], theirs: Sequence[Sequence[float]]) -> bool:
    """Alike up to rounding; none at all are zeros."""
    a, b = ([v for row in rows for v in row] for rows in (mine, theirs))
    size = max(len(a), len(b))
    a, b = a or [0.0] * size, b or [0.0] * size
    return len(a) == len(b) and all(
        math.isclose(x, y, rel_tol=0, abs_tol=_SAME_CENTRE) for x, y in zip(a, b, strict=True)
    )


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


def _short(value: Any) -> str:
    text = ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return text if len(text) <= 60 else f"{text[:40]}... ({len(value)})"
