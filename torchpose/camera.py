"""Pinhole camera as a module, its TOML file, and random viewpoints.

Camera axes: x right, y down, z forward. Metres, pixels, radians. The functions on tensors are in
`torchpose.projection` and `torchpose.rotations`, and can be imported from here as well.
"""

import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose.errors import CameraError, FileFormatError, InputError
from torchpose.projection import (
    backproject,
    check_intrinsics,
    intrinsics,
    lift,
    map_pixel_covariance,
    map_pixels,
    project,
)
from torchpose.rotations import (
    ROTATION_ORDERS,
    RotationOrder,
    euler_to_matrix,
    matrix_to_euler,
    rotvec_to_matrix,
)

__all__ = [
    "PAPER_VIEWS",
    "ROTATION_ORDERS",
    "PinholeCamera",
    "RotationOrder",
    "ViewRange",
    "Viewpoints",
    "backproject",
    "check_intrinsics",
    "euler_to_matrix",
    "lift",
    "load_cameras",
    "map_pixel_covariance",
    "map_pixels",
    "matrix_to_euler",
    "project",
    "rotvec_to_matrix",
    "sample_viewpoints",
    "save_cameras",
]

FOCAL_PER_WIDTH = 525 / 640  # Kinect's colour camera, and a fair guess for a webcam


# --- random viewpoints ----------------------------------------------------------------------------


class Viewpoints(NamedTuple):
    """Camera poses: angles (roll, pitch, yaw) [N, 3] in radians, translation [N, 3] in metres."""

    angles: Tensor
    translation: Tensor


@dataclass(frozen=True)
class ViewRange:
    """Limits of random viewpoints; the defaults are the paper's, at a nominal distance of 2 m.

    Args:
        roll, pitch, yaw: largest absolute angle, radians.
        tx, ty, tz: (low, high) of the translation, metres, in camera axes.
    """

    roll: float = math.radians(30)
    pitch: float = math.radians(30)
    yaw: float = math.radians(30)
    tx: tuple[float, float] = (-0.5, 0.5)
    ty: tuple[float, float] = (-0.5, 0.5)
    tz: tuple[float, float] = (1.5, 2.5)

    def __post_init__(self) -> None:
        for name in ("roll", "pitch", "yaw"):
            angle = getattr(self, name)
            if not 0 <= angle <= math.pi:
                raise InputError(f"ViewRange.{name} must be in [0, pi] radians, got {angle}")
        for name in ("tx", "ty", "tz"):
            low, high = getattr(self, name)
            if not -math.inf < low <= high < math.inf:
                raise InputError(
                    f"ViewRange.{name} must be (low, high) in metres with low <= high, "
                    f"got ({low}, {high})"
                )

    def scaled(self, factor: float) -> "ViewRange":
        """Limits of another width about the same middle; 1 changes nothing."""

        def about_middle(limits: tuple[float, float]) -> tuple[float, float]:
            low, high = limits
            middle, half = (low + high) / 2, factor * (high - low) / 2
            return middle - half, middle + half

        return ViewRange(
            factor * self.roll,
            factor * self.pitch,
            factor * self.yaw,
            about_middle(self.tx),
            about_middle(self.ty),
            about_middle(self.tz),
        )


PAPER_VIEWS = ViewRange()


def sample_viewpoints(
    n: int,
    view_range: ViewRange = PAPER_VIEWS,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> Viewpoints:
    """Draw camera poses, every angle and translation uniform within its limits.

    Args:
        n: how many.
        view_range: the limits.
        generator: source of random numbers; its device is that of the result.
        dtype: of the result.

    Returns:
        `Viewpoints` with angles [n, 3] and translation [n, 3].

    Reference: Burke & Lasenby, section 3.1 (angles up to 30 degrees, translations up to 0.5 m).
    """
    if n < 0:
        raise InputError(f"n must not be negative, got {n}")
    r = view_range
    limits = [(-r.roll, r.roll), (-r.pitch, r.pitch), (-r.yaw, r.yaw), r.tx, r.ty, r.tz]
    device = generator.device if generator is not None else None
    low, high = torch.tensor(limits, dtype=dtype, device=device).unbind(-1)
    unit = torch.rand((n, 6), generator=generator, dtype=dtype, device=device)
    drawn = low + (high - low) * unit
    return Viewpoints(drawn[:, :3], drawn[:, 3:])


# --- camera and its file --------------------------------------------------------------------------


class PinholeCamera(nn.Module):
    """A calibrated camera: K in pixels and, when it has one, its pose in the room.

    Args:
        fx, fy: focal lengths, pixels. cx, cy: principal point, pixels.
        width, height: image size, pixels, if known.
        name: what the camera is called.
        skew: K[0, 1], pixels; nearly always 0.
        distortions: OpenCV's k1, k2, p1, p2, ...; kept and saved, not applied by `forward`.
        rotation, translation: pose, x_camera = R(rotation) x_world + translation; a Rodrigues
            vector in radians, and metres. The identity without them.
        fisheye: the distortions are OpenCV's fisheye model.

    Buffers: matrix [3, 3], distortions [n], rotation [3], translation [3], all float64.

    Raises:
        CameraError: a focal length is not positive and finite, or another value is not finite.

    >>> PinholeCamera(525, 525, 319.5, 239.5).matrix[0]
    tensor([525.0000,   0.0000, 319.5000], dtype=torch.float64)
    """

    matrix: Tensor
    distortions: Tensor
    rotation: Tensor
    translation: Tensor

    def __init__(
        self,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        width: float | None = None,
        height: float | None = None,
        name: str = "",
        *,
        skew: float = 0.0,
        distortions: Sequence[float] = (),
        rotation: Sequence[float] = (0.0, 0.0, 0.0),
        translation: Sequence[float] = (0.0, 0.0, 0.0),
        fisheye: bool = False,
    ) -> None:
        super().__init__()
        self.name = name
        label = f"camera {name!r}" if name else "the camera"
        matrix = _vector(f"matrix of {label}", [fx, skew, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], 9)
        check_intrinsics(f"matrix of {label}", matrix.reshape(3, 3))
        self.width = _image_side(f"width of {label}", width)
        self.height = _image_side(f"height of {label}", height)
        self.fisheye = bool(fisheye)
        self.register_buffer("matrix", matrix.reshape(3, 3))
        self.register_buffer("distortions", _vector(f"distortions of {label}", distortions, None))
        self.register_buffer("rotation", _vector(f"rotation of {label}", rotation, 3))
        self.register_buffer("translation", _vector(f"translation of {label}", translation, 3))

    @classmethod
    def from_matrix(
        cls, matrix: Any, width: float | None = None, height: float | None = None, name: str = ""
    ) -> Self:
        """Camera of a matrix K [3, 3] (tensor, array or nested list).

        Raises:
            CameraError: wrong shape, singular, or not of the form (BL 4).
        """
        try:
            K = torch.as_tensor(matrix, dtype=torch.float64).detach().cpu()
        except (TypeError, ValueError, RuntimeError) as error:
            raise CameraError(f"matrix must be 3 x 3 numbers, got {matrix!r}") from error
        if tuple(K.shape) != (3, 3):
            raise CameraError(f"matrix must have shape [3, 3], got {list(K.shape)}")
        if float(K[2, 2]) not in (0.0, 1.0):
            K = K / K[2, 2]  # a camera matrix is defined up to scale
        check_intrinsics("matrix", K)
        fx, fy, skew, cx, cy = (float(e) for e in intrinsics(K))
        return cls(fx, fy, cx, cy, width, height, name, skew=skew)

    @classmethod
    def from_image_size(cls, width: float, height: float, name: str = "") -> Self:
        """A guess from the image size alone: f = 525/640 of the longer side, centre in the middle.

        >>> PinholeCamera.from_image_size(640, 480).matrix[0].tolist()
        [525.0, 0.0, 319.5]
        """
        w = _image_side("width", width)
        h = _image_side("height", height)
        if w is None or h is None:
            raise CameraError(f"an image size is (width, height) in pixels, got {(width, height)}")
        focal = FOCAL_PER_WIDTH * max(w, h)
        return cls(focal, focal, (w - 1) / 2, (h - 1) / 2, w, h, name)

    @classmethod
    def load(cls, path: str | Path, name: str | None = None) -> "PinholeCamera":
        """Read one camera of a TOML file; `name` is needed when there are several.

        Raises:
            FileFormatError: not such a file. CameraError: no such camera, or several and no name.
        """
        cameras = load_cameras(path)
        if name is None and len(cameras) == 1:
            return next(iter(cameras.values()))
        if name is None or name not in cameras:
            wanted = "a name must say which camera is meant" if name is None else f"no {name!r}"
            raise CameraError(f"{path}: {wanted}; it holds {', '.join(sorted(cameras))}")
        return cameras[name]

    def save(self, path: str | Path) -> None:
        """Write this camera as TOML; the file appears whole or not at all."""
        save_cameras([self], path)

    @property
    def image_size(self) -> tuple[int, int] | None:
        """(width, height) in pixels, or None."""
        return None if self.width is None or self.height is None else (self.width, self.height)

    @property
    def rotation_matrix(self) -> Tensor:
        """R [3, 3] of the Rodrigues vector `rotation`, world axes to camera axes."""
        return rotvec_to_matrix(self.rotation)

    def forward(self, points: Float[Tensor, "... J 3"]) -> Float[Tensor, "... J 3"]:
        """(u, v, lambda) of world points [..., J, 3] by K, rotation and translation (BL 3)."""
        K, R, t = (m.to(points) for m in (self.matrix, self.rotation_matrix, self.translation))
        return project(points, K, R, t)

    def extra_repr(self) -> str:
        fx, fy, _, cx, cy = (float(e) for e in intrinsics(self.matrix))
        size = "" if self.image_size is None else f", width={self.width}, height={self.height}"
        return f"fx={fx:g}, fy={fy:g}, cx={cx:g}, cy={cy:g}{size}, name={self.name!r}"


def load_cameras(path: str | Path) -> dict[str, PinholeCamera]:
    """Read every camera of a TOML file.

    One table per camera with `matrix` (3 x 3, pixels) and, optionally, `size` (width, height),
    `distortions`, `rotation` (Rodrigues vector), `translation` (metres), `name`, `fisheye`. A table
    `[metadata]` is passed over. Pose2Sim and Anipose write such files.

    Returns:
        Cameras by the name of their table, in the order of the file.

    Raises:
        InputError: no such file. FileFormatError: not TOML, or no camera in it.
        CameraError: a camera lacks its matrix or has values that no camera has.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such camera file")
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise FileFormatError(f"{path}: expected a TOML camera file, but {error}") from error
    tables = {k: v for k, v in content.items() if isinstance(v, Mapping) and k != "metadata"}
    if not tables:
        raise FileFormatError(f"{path}: expected a table per camera with `matrix`, found none")
    return {name: _camera_from_table(f"{path} [{name}]", name, t) for name, t in tables.items()}


def save_cameras(cameras: Sequence[PinholeCamera], path: str | Path) -> None:
    """Write cameras as TOML, one table each; the file appears whole or not at all.

    Raises:
        InputError: two cameras share a name. OutputError: the file cannot be written.
    """
    from torchpose.io.files import atomic_path  # io imports this module

    names = [c.name or (f"cam_{i:02d}" if len(cameras) > 1 else "camera")
             for i, c in enumerate(cameras, start=1)]  # fmt: skip
    if not names or len(set(names)) != len(names):
        raise InputError(f"cameras must be one or more with names of their own, got {names}")
    text = "\n".join(_camera_to_toml(n, c) for n, c in zip(names, cameras, strict=True))
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


# --- helpers --------------------------------------------------------------------------------------


def _vector(name: str, values: Any, length: int | None) -> Tensor:
    try:
        vector = torch.as_tensor(values, dtype=torch.float64).detach().clone()
    except (TypeError, ValueError, RuntimeError) as error:
        raise CameraError(f"{name} must be numbers, got {values!r}") from error
    if vector.ndim != 1 or (length is not None and len(vector) != length):
        wanted = "a list of numbers" if length is None else f"{length} numbers"
        raise CameraError(f"{name} must be {wanted}, got shape {list(vector.shape)}")
    if not bool(torch.isfinite(vector).all()):
        raise CameraError(f"{name} must be finite, got {vector.tolist()}")
    return vector


def _image_side(name: str, value: Any) -> int | None:
    if value is None:
        return None
    try:
        side = int(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise CameraError(f"{name} must be a number of pixels, got {value!r}") from error
    if side <= 0 or side != float(value):
        raise CameraError(f"{name} must be a positive whole number of pixels, got {value!r}")
    return side


def _camera_from_table(where: str, name: str, table: Mapping[str, Any]) -> PinholeCamera:
    if "matrix" not in table:
        raise CameraError(f"{where}: a camera needs `matrix` (3 x 3, pixels), got {sorted(table)}")
    size = table.get("size", (None, None))
    try:
        if not isinstance(size, Sequence) or len(size) != 2:
            raise CameraError(f"size must be [width, height], got {size!r}")
        base = PinholeCamera.from_matrix(table["matrix"])
        fx, fy, skew, cx, cy = (float(e) for e in intrinsics(base.matrix))
        return PinholeCamera(
            fx, fy, cx, cy, size[0], size[1], str(table.get("name", name)), skew=skew,
            distortions=table.get("distortions", ()),
            rotation=table.get("rotation", (0.0, 0.0, 0.0)),
            translation=table.get("translation", (0.0, 0.0, 0.0)),
            fisheye=bool(table.get("fisheye", False)),
        )  # fmt: skip
    except CameraError as error:
        raise CameraError(f"{where}: {error}") from error


def _toml_string(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in escaped) + '"'


def _camera_to_toml(name: str, camera: PinholeCamera) -> str:
    header = name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _toml_string(name)
    lines = [f"[{header}]", f"name = {_toml_string(name)}"]
    if camera.image_size is not None:
        lines.append(f"size = {[float(s) for s in camera.image_size]}")
    for key in ("matrix", "distortions", "rotation", "translation"):
        # repr of a Python float is the shortest text that reads back to the same number
        lines.append(f"{key} = {getattr(camera, key).double().tolist()}")
    lines.append(f"fisheye = {str(camera.fisheye).lower()}")
    return "\n".join(lines) + "\n"
