"""Check estimates that were read from a file: numbers that agree, valid covariances."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_rate
from torchpose._core.reading import one_number, texts
from torchpose.errors import FileFormatError, InputError

_ASYMMETRY = _BELOW_ZERO = 1e-4  # of the largest entry; poses are kept in single precision as well


def to_tensor(array: np.ndarray) -> Tensor:
    """Return a tensor of an array of either byte order."""
    kind = array.dtype.newbyteorder("=")
    return torch.from_numpy(np.ascontiguousarray(array, kind).reshape(array.shape))


def frame_facts(path: str | Path, arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the facts that results of all kinds hold beside their frames: `fps`, `notes`, `first_frame`.

    Raises:
        FileFormatError: of another type, a rate that no camera has, or a negative frame.
    """
    fps = one_number(path, "fps", arrays["fps"])
    try:
        rate = None if np.isnan(fps) else check_rate("fps", fps)
    except InputError as error:
        raise FileFormatError(f"{path}: {error}") from error
    first = one_number(path, "first_frame", arrays.get("first_frame", np.zeros(())))
    if not (0 <= first < 2**53 and first == int(first)):
        raise FileFormatError(f"{path}: first_frame must be a frame's number, got {first:g}")
    return {"fps": rate, "first_frame": int(first), "notes": texts(path, "notes", arrays["notes"])}


def check_number_range(path: str | Path, name: str, values: Tensor, low: int, high: int) -> None:
    """Raise `FileFormatError` unless all whole numbers are in low..high."""
    if bool(((values < low) | (values > high)).any()):
        raise FileFormatError(
            f"{path}: {name} must be from {low} to {high}, got {values.reshape(-1)[:8].tolist()}"
        )


def check_estimates(
    path: str | Path,
    name: str,
    values: Float[Tensor, "*batch D"],
    covariance: Float[Tensor, "*batch D D"],
) -> None:
    """Check that each point is finite with a covariance, or lost.

    Args:
        path: the file. name: the name of the values. values: NaN, as a whole, where there are none.
        covariance: finite, symmetric and positive semidefinite where there are values.

    Raises:
        FileFormatError: it is not so; the place is named.
    """
    there = values.isfinite().all(-1)
    _refuse(path, ~(there | values.isnan().all(-1)), f"{name} must be finite, or NaN as a whole")
    finite = covariance.isfinite().flatten(-2).all(-1)
    _refuse(path, there & ~finite, f"the covariance of {name} must be finite where {name} is")
    eye = torch.eye(covariance.shape[-1], dtype=torch.float64)
    cov = torch.where((there & finite)[..., None, None], covariance.double(), eye)
    scale = cov.abs().amax((-2, -1), keepdim=True).clamp_min(torch.finfo(torch.float32).tiny)
    cov = cov / scale
    skew = (cov - cov.mT).abs().amax((-2, -1)) > _ASYMMETRY
    _refuse(path, skew, f"the covariance of {name} must be symmetric")
    wrong = torch.linalg.cholesky_ex(cov + _BELOW_ZERO * eye).info != 0
    _refuse(
        path, wrong, f"the covariance of {name} must have no negative variance in any direction"
    )


def _refuse(path: str | Path, wrong: Tensor, what: str) -> None:
    if bool(wrong.any()):
        at = torch.nonzero(wrong)[0].tolist()
        raise FileFormatError(
            f"{path}: {what}; it is not so at {at} ({int(wrong.sum())} such places)"
        )
