"""Read and write fitted models: tensors as safetensors, what they were fitted on as JSON in the header.

Every kind of file is a `FileKind`: its name and version, a dataclass of facts, and the tensors that
belong in it. `write_tensors` and `read_tensors` do the rest.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Generic, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from torchpose._core.checks import check_finite, check_flat_covariance, check_rate
from torchpose._core.files import atomic_path
from torchpose._core.reading import reading, require_file, sizes_fit
from torchpose.errors import FileFormatError, OutputError, PriorError

_LARGEST = 2**63  # of whole numbers in facts
_HEADER = "torchpose"  # one key: the order of several is not reproducible in safetensors
Info = TypeVar("Info")


@dataclass(frozen=True)
class FileKind(Generic[Info]):
    """Describes a kind of file.

    Attributes:
        format: name that the header carries, such as "torchpose-manifold".
        version: that is written. older: versions that are read as well.
        info: dataclass of what the tensors were fitted on, of strings, numbers, tuples, dicts.
        tensors: sizes of each floating-point tensor by its name, such as {"mean": "E 3",
            "covariance": "E 3 3"}; a letter stands for the same size in all of them.
        indices: the same of tensors of whole numbers. Where both are empty any tensors will do.
        newer: which tensors files of older versions may lack.
        positive, covariances: which tensors hold deviations or scales, and which covariances.
        unknown: which tensors are NaN, as a whole, as long as they are not known; all others are finite.
    """

    format: str
    version: int
    info: type[Info]
    older: tuple[int, ...] = ()
    tensors: Mapping[str, str] = field(default_factory=dict)
    indices: Mapping[str, str] = field(default_factory=dict)
    newer: tuple[str, ...] = ()
    positive: tuple[str, ...] = ()
    covariances: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """Return the kind in words: "an action space"."""
        name = self.format.removeprefix("torchpose-").replace("-", " ")
        return f"{'an' if name[0] in 'aeiou' else 'a'} {name}"


def write_tensors(
    path: str | Path, kind: FileKind[Info], info: Info, tensors: Mapping[str, Tensor]
) -> None:
    """Write tensors and what they were fitted on; the file appears whole or not at all.

    The same tensors and facts give the same bytes.

    Args:
        path: the file, *.safetensors by custom. kind: of the file. info: of `kind.info`.
        tensors: the tensors by name, on any device.

    Raises:
        OutputError: the file cannot be written. PriorError: `info` holds what is not JSON.

    >>> import tempfile
    >>> @dataclass(frozen=True)
    ... class Facts:
    ...     fps: float | None = None
    ...     persons: tuple[str, ...] = ()
    >>> kind = FileKind("my-means", 1, Facts, tensors={"mean": "E 3"})
    >>> file = Path(tempfile.mkdtemp()) / "means.safetensors"
    >>> write_tensors(file, kind, Facts(60.0, ("s07",)), {"mean": torch.zeros(2, 3)})
    >>> read_tensors(file, kind)
    (Facts(fps=60.0, persons=('s07',)), {'mean': tensor([[0., 0., 0.],
            [0., 0., 0.]])})
    """
    header = {"format": kind.format, "version": kind.version, "info": info_to_json(info)}
    plain = {key: value.detach().cpu().contiguous().clone() for key, value in tensors.items()}
    with atomic_path(path) as temporary:
        try:
            save_file(plain, temporary, metadata={_HEADER: json.dumps(header, sort_keys=True)})
        except SafetensorError as error:
            raise OutputError(f"{path}: cannot be written ({error})") from error


def read_tensors(path: str | Path, kind: FileKind[Info]) -> tuple[Info, dict[str, Tensor]]:
    """Return the facts about the fit of a file's tensors, and the tensors by name, on the CPU.

    Raises:
        InputError: no such file. FileFormatError: truncated, of another kind or version, or facts or
            tensors are missing, unknown or of another type or size. Other errors of torchpose: the
            dataclass does not allow the facts.
    """
    path = require_file(path)
    with reading(path, f"{kind.words} as safetensors ({kind.format})"):
        with _opened(path) as file:
            metadata = file.metadata() or {}
            tensors: dict[str, Tensor] = {
                key: file.get_tensor(key)
                for key in file.keys()  # noqa: SIM118
            }
        header = json.loads(metadata.get(_HEADER, "null"))
        info = info_from_json(kind.info, _checked_info(header, kind))
        lacking = () if header["version"] == kind.version else kind.newer
        _check_tensors(tensors, kind, [name for name in lacking if name not in tensors])
        _check_values(tensors, kind)
    return info, tensors


def format_of(path: str | Path) -> str | None:
    """Return the name of a file's kind, `FileKind.format`, or None if `write_tensors` did not make it.

    Raises:
        InputError: no such file.
    """
    try:
        with _opened(require_file(path)) as file:
            header = json.loads((file.metadata() or {}).get(_HEADER, "null"))
    except (ValueError, OSError, RuntimeError):
        return None
    found = header.get("format") if isinstance(header, dict) else None
    return found if isinstance(found, str) else None


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Return a file of safetensors; what its library raises becomes a `ValueError`."""
    try:
        with safe_open(path, framework="pt") as file:
            yield file
    except SafetensorError as error:
        raise ValueError(str(error)) from error


def require_tensor(path: str | Path, tensors: Mapping[str, Tensor], key: str) -> Tensor:
    """Return a tensor of a file in double precision, or `FileFormatError`."""
    if key not in tensors:
        found = ", ".join(sorted(tensors)) or "none"
        raise FileFormatError(f"{path}: expected a tensor {key}, found {found}")
    if not tensors[key].is_floating_point():
        raise FileFormatError(
            f"{path}: expected floating-point numbers in {key}, got {tensors[key].dtype}"
        )
    return tensors[key].to(torch.float64)


def info_to_json(info: Any) -> str:
    """Return the text of a dataclass that `info_from_json` reads back.

    Raises:
        PriorError: it holds what is not JSON.
    """
    try:
        return json.dumps(asdict(info), sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise PriorError(f"info must hold only what JSON can hold: {error}") from error


def info_from_json(cls: type[Info], text: str) -> Info:
    """Return a dataclass from the text of `info_to_json`; lists become tuples where its fields are tuples.

    Raises:
        FileFormatError: not JSON, other fields, or values of another type. What the dataclass raises.
    """
    what = f"in the JSON of a {cls.__name__}"
    try:
        values = json.loads(text, parse_constant=_no_number, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"expected the JSON of a {cls.__name__}: {error}") from error
    if not isinstance(values, dict):
        raise FileFormatError(f"expected the JSON of a {cls.__name__}, got {text!r:.60}")
    hints = get_type_hints(cls)
    known = [f.name for f in fields(cls)]  # type: ignore[arg-type]
    for key, value in values.items():
        if key not in known:
            raise FileFormatError(
                f"unknown field {key!r} {what}, known are {', '.join(known)}; use a torchpose that fits"
            )
        if not _fits(value, hints[key]):
            raise FileFormatError(f"bad value of {key} {what}: {value!r:.60}")
        if key == "fps" and value is not None:
            check_rate(f"fps {what}", value)
    return cls(**{k: _tuples(v) if isinstance(v, list) else v for k, v in values.items()})


def _checked_info(header: Any, kind: FileKind[Any]) -> str:
    """Return the facts' JSON in a header, or `FileFormatError`."""
    found = header.get("format") if isinstance(header, dict) else None
    if found != kind.format:
        named = "" if found is None else f" ({found})"
        raise FileFormatError(f"expected a {kind.format}, got a file of another kind{named}")
    if header.get("version") not in (kind.version, *kind.older):
        older = " or an older one" if kind.older else ""
        raise FileFormatError(
            f"expected version {kind.version} of {kind.format}{older}, got "
            f"{header.get('version')!r}; use a torchpose that fits, or fit it again"
        )
    return str(header.get("info"))


def _check_tensors(
    tensors: Mapping[str, Tensor], kind: FileKind[Any], lacking: Sequence[str]
) -> None:
    """Raise `FileFormatError` unless the tensors are those of the kind, some of which may be lacking."""
    expected = {**kind.tensors, **kind.indices}
    if not expected:
        return
    expected = {name: text for name, text in expected.items() if name not in lacking}
    if tensors.keys() != expected.keys():
        raise FileFormatError(
            f"expected the tensors {', '.join(sorted(expected))}, found "
            f"{', '.join(sorted(tensors)) or 'none'}; fit it again"
        )
    letters: dict[str, int] = {}
    for name, text in expected.items():
        tensor = tensors[name]
        whole = not (
            tensor.is_floating_point() or tensor.is_complex() or tensor.dtype == torch.bool
        )
        if not (whole if name in kind.indices else tensor.is_floating_point()):
            numbers = "whole" if name in kind.indices else "floating-point"
            raise FileFormatError(f"expected {numbers} numbers in {name}, got {tensor.dtype}")
        if not sizes_fit(text, tuple(tensor.shape), letters):
            known = ", ".join(f"{letter} = {size}" for letter, size in letters.items())
            raise FileFormatError(
                f"expected the sizes [{', '.join(text.split())}] of {name}, got {list(tensor.shape)}"
                + (f" where {known}" if known else "")
            )


def _check_values(tensors: Mapping[str, Tensor], kind: FileKind[Any]) -> None:
    """Raise unless the numbers are finite, deviations positive and covariances some."""
    for name, tensor in tensors.items():
        if name in kind.unknown and bool(tensor.isnan().all()):
            continue
        if tensor.is_floating_point():
            check_finite(name, tensor, hint="the file is damaged; fit it again")
        if name in kind.positive and not bool((tensor > 0).all()):
            raise FileFormatError(
                f"{name} must be positive, got {float(tensor.min()):g}; fit it again"
            )
        if name in kind.covariances:
            check_flat_covariance(name, tensor)


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a value from JSON is of a type, with all that it holds."""
    origin, parts = get_origin(hint) or hint, get_args(hint)
    if origin in (Union, UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is tuple:
        return isinstance(value, list) and (not parts or all(_fits(v, parts[0]) for v in value))
    if origin is dict:
        return isinstance(value, dict)
    if origin is Any:
        return True
    if origin is Literal:  # which of the values it is, the dataclass checks
        return isinstance(value, type(parts[0]))
    if origin is float:
        whole = isinstance(value, int) and not isinstance(value, bool) and abs(value) < _LARGEST
        return whole or isinstance(value, float)
    if origin is int:
        return isinstance(value, int) and not isinstance(value, bool) and abs(value) < _LARGEST
    return value is None if origin is NoneType else isinstance(value, origin)


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no number of JSON")


def _finite(text: str) -> float:
    number = float(text)
    if math.isinf(number):
        raise ValueError(f"{text:.40} is beyond double precision")
    return number


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value
