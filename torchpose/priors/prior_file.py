"""File of an upper-body prior: safetensors, with what it was fitted on as JSON in its header."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from torchpose.camera import PinholeCamera
from torchpose.errors import FileFormatError, PriorError, TorchposeError
from torchpose.io.files import atomic_path, require_file
from torchpose.priors.arm_state import check_rotation_order

__all__ = ["FILE_FORMAT", "FILE_VERSION", "SKELETON", "PriorInfo", "read_prior", "write_prior"]

FILE_FORMAT = "torchpose-prior"
FILE_VERSION = 2
_READABLE = (1, 2)  # version 1 holds whole covariances
SKELETON = "upper-body-8"
CENTRES = ("neck", "head", "sequence")
_HEADER = "torchpose"  # one key: the order of several is not reproducible in safetensors


@dataclass(frozen=True)
class PriorInfo:
    """What a prior was fitted on, and in which conventions its states are.

    Attributes:
        name: of the prior.
        rotation_order: "zxy" (paper) or "zyx" (released priors).
        fx, fy, cx, cy: camera matrix whose pixels the states are in.
        centre: joint that every pose was centred on ("neck", "head"), or "sequence" for the mean
            neck of each recording.
        neck: kind of neck: "neck", "low-neck" or "mid-shoulder".
        hand: kind of hand: "hand" or "wrist".
        fps: frame rate that process noise refers to.
        persons: ids of the persons in the training recordings.
        sources: recordings, data sets or files.
        licence: of the data, as it allows the prior to be passed on.
        command: that made the prior.
        views: limits of the random viewpoints (`ViewRange` as a dict).
        transition: the transition its noise was learnt for, "paper" or "ou".
        mirrored: the right arm is the mirror image of the left one.
        n_frames: recorded frames used. n_samples: states that each arm was fitted on.
        skeleton: joint set of the states.
        extra: anything else that JSON can hold.
    """

    name: str = ""
    rotation_order: str = "zxy"
    fx: float = 525.0
    fy: float = 525.0
    cx: float = 319.5
    cy: float = 239.5
    centre: str = "neck"
    neck: str | None = "neck"
    hand: str | None = "hand"
    fps: float | None = 30.0
    persons: tuple[str, ...] = ()
    sources: tuple[str, ...] = ()
    licence: str = ""
    command: str = ""
    views: dict[str, Any] = field(default_factory=dict)
    transition: str = "paper"
    mirrored: bool = False
    n_frames: int = 0
    n_samples: int = 0
    skeleton: str = SKELETON
    extra: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_rotation_order(self.rotation_order)
        if self.skeleton != SKELETON:
            raise PriorError(
                f"a prior for the skeleton {SKELETON} is needed, got one for {self.skeleton!r}"
            )
        if self.centre not in CENTRES:
            raise PriorError(f"centre must be one of {', '.join(CENTRES)}, got {self.centre!r}")
        object.__setattr__(self, "persons", tuple(self.persons))
        object.__setattr__(self, "sources", tuple(self.sources))
        PinholeCamera(self.fx, self.fy, self.cx, self.cy)  # refuses what is no camera

    @property
    def camera(self) -> PinholeCamera:
        """The camera whose pixels the states are in."""
        return PinholeCamera(self.fx, self.fy, self.cx, self.cy, name=self.name)

    @property
    def matrix(self) -> Tensor:
        """Camera matrix K [3, 3], pixels."""
        rows = [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        return torch.tensor(rows, dtype=torch.float64)

    def to_json(self) -> str:
        """Text that `from_json` reads back."""
        return json.dumps(asdict(self), sort_keys=True, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> PriorInfo:
        """Read `to_json` back.

        Raises:
            FileFormatError: not JSON, or other fields. PriorError: other skeleton or conventions.
        """
        try:
            values = json.loads(text)
            if not isinstance(values, dict):
                raise TypeError("not an object")
        except (TypeError, ValueError) as error:
            raise FileFormatError(
                f"expected the JSON of a prior, got something else: {error}"
            ) from (error)
        _check_fields(values)
        listed = {key: tuple(v) for key, v in values.items() if isinstance(v, list)}
        views = {
            key: tuple(v) if isinstance(v, list) else v
            for key, v in values.get("views", {}).items()
        }
        return cls(**(values | listed | {"views": views}))


def _check_fields(values: Mapping[str, Any]) -> None:
    """Raise `FileFormatError` unless all are fields of `PriorInfo` with values of their kind."""
    defaults = PriorInfo()
    for key, value in values.items():
        if key not in {f.name for f in fields(PriorInfo)}:
            raise FileFormatError(f"unknown field {key!r} in the JSON of a prior")
        kind: Any = type(getattr(defaults, key))
        allowed: Any = {float: (float, int), tuple: list}.get(kind, kind)
        optional = value is None and key in ("neck", "hand", "fps")
        if not optional and not isinstance(value, allowed):
            raise FileFormatError(f"bad value of {key} in the JSON of a prior: {value!r:.60}")


def write_prior(path: str | Path, info: PriorInfo, tensors: Mapping[str, Tensor]) -> None:
    """Write tensors and metadata; the file appears whole or not at all.

    Raises:
        OutputError: the file cannot be written. PriorError: `info.extra` is not JSON.
    """
    try:
        header = {"format": FILE_FORMAT, "version": FILE_VERSION, "info": info.to_json()}
    except (TypeError, ValueError) as error:
        raise PriorError(f"info.extra must hold only what JSON can hold: {error}") from error
    packed = {key: _pack(key, value.detach().cpu()) for key, value in tensors.items()}
    plain = {key: _compact(value).contiguous().clone() for key, value in packed.items()}
    with atomic_path(path) as temporary:
        save_file(plain, temporary, metadata={_HEADER: json.dumps(header, sort_keys=True)})


def _pack(key: str, tensor: Tensor) -> Tensor:
    """Covariances [K, D, D] as their lower triangles [K, D (D + 1) / 2], row by row."""
    if not key.endswith(".covariances") or not torch.equal(tensor, tensor.mT):
        return tensor
    rows, columns = torch.tril_indices(*tensor.shape[-2:])
    return tensor[:, rows, columns]


def _unpack(key: str, tensor: Tensor) -> Tensor:
    if not key.endswith(".covariances") or tensor.ndim != 2:
        return tensor
    dim = round(math.sqrt(2 * tensor.shape[1] + 0.25) - 0.5)
    if dim * (dim + 1) // 2 != tensor.shape[1]:
        raise ValueError(f"{key} with {tensor.shape[1]} columns is no list of triangles")
    rows, columns = torch.tril_indices(dim, dim)
    whole = tensor.new_empty(len(tensor), dim, dim)
    whole[:, rows, columns] = tensor
    whole[:, columns, rows] = tensor
    return whole


def _compact(tensor: Tensor) -> Tensor:
    """The same numbers in single precision, if all of them fit into it."""
    single = tensor.float()
    lossless = tensor.is_floating_point() and torch.equal(single.to(tensor.dtype), tensor)
    return single if lossless else tensor


def read_prior(path: str | Path) -> tuple[PriorInfo, dict[str, Tensor]]:
    """Metadata and tensors of a prior file.

    Raises:
        InputError: no such file. FileFormatError: truncated, foreign, or of a newer version.
        PriorError: other skeleton, or a rotation order that is not known.
    """
    path = require_file(path)
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors: dict[str, Tensor] = {
                key: _unpack(key, file.get_tensor(key))
                for key in file.keys()  # noqa: SIM118
            }
    except (SafetensorError, OSError, ValueError, RuntimeError) as error:
        raise FileFormatError(
            f"{path}: expected a prior as safetensors; the file is truncated or of another kind "
            f"({error})"
        ) from error
    try:
        header = json.loads(metadata.get(_HEADER, "null"))
    except ValueError as error:
        raise FileFormatError(f"{path}: the header is not JSON ({error})") from error
    if not isinstance(header, dict) or header.get("format") != FILE_FORMAT:
        raise FileFormatError(
            f"{path}: expected a prior written by torchpose, got a safetensors file of another kind"
        )
    if header.get("version") not in _READABLE:
        raise FileFormatError(
            f"{path}: expected version {FILE_VERSION} of the prior format or an older one, got "
            f"{header.get('version')!r}; use a torchpose that fits, or fit the prior again"
        )
    try:
        return PriorInfo.from_json(str(header.get("info"))), tensors
    except TorchposeError as error:
        raise type(error)(f"{path}: {error}") from error


def require_tensor(path: str | Path, tensors: Mapping[str, Tensor], key: str) -> Tensor:
    """A tensor of the file, or `FileFormatError`."""
    if key not in tensors:
        found = ", ".join(sorted(tensors)) or "none"
        raise FileFormatError(f"{path}: expected a tensor {key}, found {found}")
    return tensors[key].to(torch.float64)
