"""Read and write files of upper-body priors: safetensors, with what they were fitted on in the header."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchpose._core.checks import check_covariance
from torchpose._core.module_state import outside_inference
from torchpose._core.tensor_file import (
    FileKind,
    info_from_json,
    info_to_json,
    read_tensors,
    write_tensors,
)
from torchpose.camera._pinhole import PinholeCamera
from torchpose.errors import FileFormatError, InputError, PriorError
from torchpose.math._rotations import RotationOrder
from torchpose.priors._arm_state import check_rotation_order

SKELETON = "upper-body-8"
CENTRES = ("neck", "head", "sequence")


def _camera_matrix(fx: float, fy: float, cx: float, cy: float) -> Tensor:
    return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)


@lru_cache(maxsize=16)
def _kept_matrix(
    fx: float, fy: float, cx: float, cy: float, dtype: torch.dtype, device: torch.device
) -> Tensor:
    with outside_inference():
        return _camera_matrix(fx, fy, cx, cy).to(device, dtype)


@dataclass(frozen=True)
class PriorInfo:
    """Holds facts about the fit of a prior, and the conventions of its states.

    Attributes:
        name: the name of the prior.
        rotation_order: "zxy" (paper) or "zyx" (released priors).
        fx, fy, cx, cy: camera matrix whose pixels the states are in.
        centre: joint that every pose was centred on ("neck", "head"), or "sequence" for the mean
            neck of each recording.
        neck: kind of neck: "neck", "low-neck" or "mid-shoulder".
        hand: kind of hand: "hand" or "wrist".
        fps: frame rate that process noise refers to.
        persons: ids of the persons in the training recordings.
        sources: recordings, data sets or files.
        licence: the licence of the data, as it allows the prior to be passed on.
        command: that made the prior.
        views: limits of the random viewpoints (`ViewRange` as a dict).
        transition: the transition its noise was learnt for, "paper" or "ou".
        mirrored: the right arm is the mirror image of the left one.
        n_frames: recorded frames used. n_samples: states that each arm was fitted on.
        skeleton: joint set of the states.
        extra: anything else that JSON can hold.
    """

    name: str = ""
    rotation_order: RotationOrder = "zxy"
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
        views = {k: tuple(v) if isinstance(v, list) else v for k, v in self.views.items()}
        for name, value in (("persons", tuple(self.persons)), ("views", views)):
            object.__setattr__(self, name, value)
        object.__setattr__(self, "sources", tuple(self.sources))
        PinholeCamera(self.fx, self.fy, self.cx, self.cy)  # refuses what is no camera

    @property
    def camera(self) -> PinholeCamera:
        """Return the camera whose pixels the states are in."""
        return PinholeCamera(self.fx, self.fy, self.cx, self.cy, name=self.name)

    @property
    def matrix(self) -> Tensor:
        """Return the camera matrix K [3, 3], pixels."""
        return _camera_matrix(self.fx, self.fy, self.cx, self.cy)

    def matrix_like(self, like: Tensor) -> Tensor:
        """Return the camera matrix as another tensor is, the same one each time: not to be written to."""
        return _kept_matrix(self.fx, self.fy, self.cx, self.cy, like.dtype, like.device)

    def to_json(self) -> str:
        """Return text that `from_json` reads back."""
        return info_to_json(self)

    @classmethod
    def from_json(cls, text: str) -> PriorInfo:
        """Read `to_json` back.

        Raises:
            FileFormatError: not JSON, or other fields. PriorError: other skeleton or conventions.
        """
        return info_from_json(cls, text)


# version 1 holds whole covariances; the tensors depend on the windows, so the prior looks for its own
_KIND = FileKind("torchpose-prior", 2, PriorInfo, older=(1,))


def write_prior(path: str | Path, info: PriorInfo, tensors: Mapping[str, Tensor]) -> None:
    """Write tensors and metadata; the file appears whole or not at all.

    Raises:
        OutputError: the file cannot be written. PriorError: `info.extra` is not JSON.
    """
    packed = {key: _pack(key, value.detach().cpu()) for key, value in tensors.items()}
    write_tensors(path, _KIND, info, {key: _compact(value) for key, value in packed.items()})


def _pack(key: str, tensor: Tensor) -> Tensor:
    """Return covariances [K, D, D] as their lower triangles [K, D (D + 1) / 2], row by row."""
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
    """Return the same numbers in single precision, if all of them fit into it."""
    single = tensor.float()
    lossless = tensor.is_floating_point() and torch.equal(single.to(tensor.dtype), tensor)
    return single if lossless else tensor


def read_prior(path: str | Path) -> tuple[PriorInfo, dict[str, Tensor]]:
    """Return metadata and tensors of a prior file.

    Raises:
        InputError: no such file. FileFormatError: truncated, foreign, or of a newer version.
        PriorError: other skeleton, or a rotation order that is not known.
    """
    info, tensors = read_tensors(path, _KIND)
    try:
        return info, {key: _unpack(key, value) for key, value in tensors.items()}
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}; the file is damaged") from error


_STATE = 21
_SIZES = {
    "calibration_scale": ((8,),),
    "calibration_floor": ((8,),),
    "process_cov": ((_STATE,), (_STATE, _STATE)),
    "uniform_weight": ((),),
    "measurement_std": (),
    "gamma": (),
}  # those that are fixed
_MAY_BE_ZERO = ("calibration_floor", "uniform_weight", "process_cov", "gamma")


def check_noise(name: str, value: Tensor) -> None:
    """Check learnt noise that trackers know; other names may hold anything.

    No scale, deviation or variance is negative, and a `process_cov` of 21 x 21 numbers is a covariance.

    Raises:
        InputError: another shape, a number that is not positive. CovarianceError: no covariance.
    """
    kind = next((kind for kind in _SIZES if name == kind or name.startswith(f"{kind}_")), None)
    if kind is None:
        return
    shape = tuple(value.shape)
    if _SIZES[kind] and shape not in _SIZES[kind]:
        sizes = " or ".join(str(list(size)) for size in _SIZES[kind])
        raise InputError(f"noise {name} must have the shape {sizes}, got {list(shape)}")
    if value.ndim == 2 and kind == "process_cov":
        check_covariance(f"noise {name}", value.double())
        return
    low = value < 0 if kind in _MAY_BE_ZERO else value <= 0
    if bool(low.any()):
        least = "at least 0" if kind in _MAY_BE_ZERO else "positive"
        raise InputError(f"noise {name} must be {least}, got {float(value.min()):g}")
