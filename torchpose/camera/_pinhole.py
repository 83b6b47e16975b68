"""Define the pinhole camera as a module, and read and write its TOML file.

Camera axes: x right, y down, z forward. Metres, pixels, radians. The functions on tensors are in
`torchpose.camera._projection` and `torchpose.math._rotations`.
"""

import math
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_choice, check_floating, check_real
from torchpose._core.module_state import NoHalfModule
from torchpose.camera._camera_tables import camera_tables, check_keys, table_text
from torchpose.camera._projection import (
    check_intrinsics,
    intrinsics,
    project,
)
from torchpose.camera._tilt import level_rotation, unit_up, up_of_angles
from torchpose.errors import CameraError, InputError
from torchpose.math._rotations import matrix_to_rotvec, rotvec_to_matrix

_FARTHEST = 1e9  # pixels or metres: no number of a camera is larger
_LARGEST_TURN = 100.0  # radians; a few full turns mean the same as none
_LARGEST_SIDE = 100_000  # pixels of an image
_NOT_SQUARE = 1e-3  # by which R R^T may differ from the identity
FOCAL_PER_WIDTH = 525 / 640  # Kinect's colour camera, and a fair guess for a webcam


class PinholeCamera(NoHalfModule):
    """Holds a calibrated camera: K in pixels and, if it is known, its pose in the room.

    Args:
        fx, fy: focal lengths, pixels. cx, cy: principal point, pixels.
        width, height: image size, pixels, if known.
        name: the name of the camera.
        skew: K[0, 1], pixels; nearly always 0.
        distortions: OpenCV's k1, k2, p1, p2, ...; kept and saved, not applied by `forward`.
        rotation, translation: pose, x_camera = R(rotation) x_world + translation; a Rodrigues
            vector in radians or a matrix R [3, 3], and metres. The identity without them. Lists, arrays or
            tensors; vectors may be rows or columns, as OpenCV returns them.
        fisheye: the distortions are OpenCV's fisheye model.
        up: the direction that points up, against gravity, in the axes of the camera, of any length; None is
            unknown, and trackers take the camera to be about level, (0, -1, 0). `tilted` makes it of angles,
            `with_world_up` of the rotation.

    Buffers: matrix [3, 3], distortions [n], rotation [3], translation [3], all float64; up [3], of length
        one, or None.

    Raises:
        CameraError: a focal length is not positive and finite, another value is not finite, or the camera
            looks up or down by more than 60 degrees.

    >>> PinholeCamera(525, 525, 319.5, 239.5).matrix[0]
    tensor([525.0000,   0.0000, 319.5000], dtype=torch.float64)
    """

    matrix: Tensor
    distortions: Tensor
    rotation: Tensor
    translation: Tensor
    up: Tensor | None

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
        rotation: Any = (0.0, 0.0, 0.0),
        translation: Any = (0.0, 0.0, 0.0),
        fisheye: bool = False,
        up: Sequence[float] | None = None,
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
        self.register_buffer("rotation", _turn(f"rotation of {label}", rotation))
        self.register_buffer("translation", _vector(f"translation of {label}", translation, 3))
        where = f"up of {label}"
        self.register_buffer("up", None if up is None else unit_up(where, _vector(where, up, 3)))

    @classmethod
    def from_matrix(
        cls, matrix: Any, width: float | None = None, height: float | None = None, name: str = ""
    ) -> Self:
        """Build a camera from its matrix K.

        Args:
            matrix: K [3, 3] in pixels, up to scale: a tensor, an array or a nested list.
            width, height: image size, pixels, if known.
            name: the name of the camera.

        Returns:
            Camera at the origin without distortions.

        Raises:
            CameraError: wrong shape, singular, or not of the form (BL 4).
        """
        K = _numbers("matrix", matrix, "3 x 3 numbers")
        if tuple(K.shape) != (3, 3):
            raise CameraError(f"matrix must have shape [3, 3], got {list(K.shape)}")
        if float(K[2, 2]) not in (0.0, 1.0):
            K = K / K[2, 2]  # a camera matrix is defined up to scale
        check_intrinsics("matrix", K)
        fx, fy, skew, cx, cy = (float(e) for e in intrinsics(K))
        return cls(fx, fy, cx, cy, width, height, name, skew=skew)

    @classmethod
    def from_image_size(cls, width: float, height: float, name: str = "") -> Self:
        """Guess a camera from the image size alone: f = 525/640 of the longer side, centre in the middle.

        Args:
            width, height: image size, pixels.
            name: the name of the camera.

        Returns:
            Camera at the origin without distortions.

        Raises:
            CameraError: a side is missing or not positive.

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

        Args:
            path: TOML file, see `load_cameras`.
            name: the name of the camera: that of its table, or else its `name`; may be left out where the
                file holds one camera.

        Returns:
            The camera.

        Raises:
            InputError: no such file. FileFormatError: not such a file.
            CameraError: no such camera, or several and no name.
        """
        cameras = load_cameras(path)
        if name is None and len(cameras) == 1:
            return next(iter(cameras.values()))
        found = None if name is None else camera_of_name(cameras, name)
        if found is None:
            wanted = "a name must say which camera is meant" if name is None else f"no {name!r}"
            raise CameraError(f"{path}: {wanted}; it holds {list_names(cameras)}")
        return found

    def save(self, path: str | Path) -> None:
        """Write this camera as TOML, atomically: an interrupted write leaves no partial file.

        Args:
            path: the file, which is replaced.

        Raises:
            OutputError: the file cannot be written.
        """
        save_cameras([self], path)

    @property
    def image_size(self) -> tuple[int, int] | None:
        """Return (width, height) in pixels, or None."""
        return None if self.width is None or self.height is None else (self.width, self.height)

    @property
    def rotation_matrix(self) -> Tensor:
        """Return R [3, 3] of the Rodrigues vector `rotation`, world axes to camera axes."""
        return rotvec_to_matrix(self.rotation)

    @property
    def level_rotation(self) -> Float[Tensor, "3 3"]:
        """Return the rotation from camera axes to those of a level camera with the same heading.

        It is the identity where `up` is unknown. `joints3d @ camera.level_rotation.mT` are upright.
        """
        return torch.eye(3).to(self.matrix) if self.up is None else level_rotation(self.up)

    def tilted(self, pitch: float, roll: float = 0.0) -> Self:
        """Return the camera with the orientation against gravity that these angles say.

        Args:
            pitch: the angle by which it looks up, radians; negative is down.
            roll: the angle by which it is rolled clockwise, as one who stands behind it sees it, radians. The
                image then shows upright things rolled the other way.

        Returns:
            A copy with `up` = (-sin r cos p, -cos r cos p, sin p).

        Raises:
            CameraError: angles that are not finite, a roll of more than pi, as an angle in degrees would be,
                or a pitch of more than pi / 3, 60 degrees.

        >>> import math
        >>> camera = PinholeCamera(525, 525, 319.5, 239.5).tilted(math.radians(30))
        >>> round(float(camera.up[2]), 3)
        0.5
        """
        pitch, roll = _vector("pitch and roll", [pitch, roll], 2).tolist()
        if abs(pitch) > math.pi / 2 or abs(roll) > math.pi:
            raise CameraError(
                f"pitch = {pitch:g} and roll = {roll:g} radians are more than pi / 2 and pi; angles in "
                "degrees need math.radians(angle)"
            )
        return self._with_up(up_of_angles(pitch, roll))

    def with_world_up(self, axis: str) -> Self:
        """Return the camera of a calibrated rig with the orientation against gravity that its rotation says.

        Args:
            axis: "y" or "z", the axis of the world that points up.

        Returns:
            A copy with `up` = R(rotation) e_axis.

        Raises:
            InputError: another axis. CameraError: it looks up or down by more than 60 degrees.
        """
        check_choice("axis", axis, ("y", "z"))
        return self._with_up(self.rotation_matrix[:, "xyz".index(axis)].tolist())

    def in_level_world(self) -> Self:
        """Return the camera in a world of its own, whose y axis points up as `up` says.

        The origin is in the lens, z points towards the viewer, horizontally, and x to the right. Without `up`
        the camera is taken to be level.

        >>> camera = PinholeCamera(525, 525, 319.5, 239.5).tilted(0.2).in_level_world()
        >>> torch.allclose(camera.rotation_matrix[:, 1], camera.up)
        True
        """
        camera = self._with_up(None if self.up is None else self.up.tolist())
        flip = torch.tensor([1.0, -1.0, -1.0]).to(self.matrix)
        camera.rotation = matrix_to_rotvec(self.level_rotation.mT * flip)
        camera.translation = torch.zeros_like(self.translation)
        return camera

    def _with_up(self, up: Sequence[float] | None) -> Self:
        fx, fy, skew, cx, cy = (float(e) for e in intrinsics(self.matrix))
        return type(self)(
            fx, fy, cx, cy, self.width, self.height, self.name, skew=skew,
            distortions=self.distortions.tolist(), rotation=self.rotation.tolist(),
            translation=self.translation.tolist(), fisheye=self.fisheye, up=up,
        ).to(self.matrix)  # fmt: skip

    def forward(self, points: Float[Tensor, "... J 3"]) -> Float[Tensor, "... J 3"]:
        """Project world points by K, rotation and translation (BL 3); distortions are not applied.

        Args:
            points: [..., J, 3], world axes, metres.

        Returns:
            (u, v, lambda) [..., J, 3]: pixels, and the depth along the optical axis in metres.

        Raises:
            ShapeError: the last dimension is not 3. InputError: not floating-point numbers.
        """
        check_floating("points", points)
        K, R, t = (m.to(points) for m in (self.matrix, self.rotation_matrix, self.translation))
        return project(points, K, R, t)

    if TYPE_CHECKING:  # nn.Module has Any
        __call__ = forward

    def extra_repr(self) -> str:
        fx, fy, _, cx, cy = (float(e) for e in intrinsics(self.matrix))
        size = "" if self.image_size is None else f", width={self.width}, height={self.height}"
        up = "" if self.up is None else f", up={[round(x, 3) for x in self.up.tolist()]}"
        return f"fx={fx:g}, fy={fy:g}, cx={cx:g}, cy={cy:g}{size}{up}, name={self.name!r}"


def load_cameras(path: str | Path) -> dict[str, PinholeCamera]:
    """Read every camera of a TOML file.

    One table per camera with `matrix` (3 x 3, pixels) and, optionally, `size` (width, height),
    `distortions`, `rotation` (Rodrigues vector, or a 3 x 3 matrix), `translation` (metres), `name`,
    `fisheye`, `up` (the direction that points up, camera axes). Pose2Sim, Anipose and Caliscope write such
    files; the last may put the tables into one that is called `cameras`. Tables of other things, such as
    `[metadata]` and `[charuco]`, are passed over.

    Args:
        path: the file.

    Returns:
        Cameras by the name of their table, in the order of the file.

    Raises:
        InputError: no such file. FileFormatError: not TOML, or no camera in it.
        CameraError: a camera lacks its matrix or has values that no camera has.
    """
    return read_cameras(path)[0]


def read_cameras(path: str | Path) -> tuple[dict[str, PinholeCamera], tuple[str, ...]]:
    """Return what `load_cameras` returns, and a note on tables that are passed over, if there are any."""
    from torchpose._core.reading import read_text, reading  # io imports this module

    expected = "a TOML camera file (torchpose.camera.save_cameras writes one)"
    text = read_text(path, expected)
    with reading(path, expected):
        tables, left_out = camera_tables(path, tomllib.loads(text))
        shown = ", ".join(f"[{name}]" for name in left_out)
        note = f"{path}: {shown} {'are' if len(left_out) > 1 else 'is'} passed over: no camera"
        return _cameras_of(path, tables), (note,) * bool(left_out)


def _cameras_of(
    path: str | Path, tables: Mapping[str, Mapping[str, Any]]
) -> dict[str, PinholeCamera]:
    found = {name: _camera_from_table(f"{path} [{name}]", name, t) for name, t in tables.items()}
    if len(found) > 1:  # the poses of cameras of a rig count
        for name, table in tables.items():
            missing = [key for key in ("rotation", "translation") if key not in table]
            if len(missing) == 1:
                raise CameraError(
                    f"{path} [{name}]: a pose is `rotation` and `translation`, and {missing[0]} is not there"
                )
    return found


def camera_of_name(cameras: Mapping[str, PinholeCamera], name: str) -> PinholeCamera | None:
    """Return the camera whose table has a name, or else the only one that is called so; None without one."""
    called_so = [camera for camera in cameras.values() if camera.name == name]
    return cameras.get(name, called_so[0] if len(called_so) == 1 else None)


def list_names(cameras: Mapping[str, PinholeCamera]) -> str:
    """Return the names of tables in words, each with what its camera is called, if that is something else."""
    return ", ".join(
        key if camera.name == key else f"{key} ({camera.name})" for key, camera in cameras.items()
    )


def save_cameras(
    cameras: Sequence[PinholeCamera] | Mapping[str, PinholeCamera], path: str | Path
) -> None:
    """Write cameras as TOML, one table each, atomically: an interrupted write leaves no partial file.

    Args:
        cameras: one or more, with different names, or those of `load_cameras`; those without a name are
            called ``cam_01``, ... (a single one ``camera``).
        path: the file, which is replaced.

    Raises:
        InputError: no camera, or two with one name. OutputError: the file cannot be written.
    """
    from torchpose._core.files import atomic_path  # io imports this module

    given = cameras.values() if isinstance(cameras, Mapping) else cameras
    cameras = list(given) if isinstance(given, Iterable) else [given]
    if not all(isinstance(camera, PinholeCamera) for camera in cameras):
        kinds = [type(camera).__name__ for camera in cameras]
        raise InputError(f"cameras must be PinholeCameras in a list, got {kinds}")
    names = [c.name or (f"cam_{i:02d}" if len(cameras) > 1 else "camera")
             for i, c in enumerate(cameras, start=1)]  # fmt: skip
    if not names or len(set(names)) != len(names):
        raise InputError(f"cameras must be one or more with names of their own, got {names}")
    text = "\n".join(_camera_to_toml(n, c) for n, c in zip(names, cameras, strict=True))
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


# --- helpers --------------------------------------------------------------------------------------


def _vector(name: str, values: Any, length: int | None) -> Tensor:
    vector = _numbers(name, values)
    if vector.ndim == 2 and 1 in vector.shape:
        vector = vector.flatten()
    if vector.ndim != 1 or (length is not None and len(vector) != length):
        wanted = "a list of numbers" if length is None else f"{length} numbers"
        raise CameraError(f"{name} must be {wanted}, got shape {list(vector.shape)}")
    if not bool((vector.abs() <= _FARTHEST).all()):
        raise CameraError(
            f"{name} must be finite and at most {_FARTHEST:g}, got {vector.tolist()!s:.200}"
        )
    return vector


def _turn(name: str, values: Any) -> Tensor:
    """Return the Rodrigues vector [3] of one, or of a rotation matrix."""
    numbers = _numbers(name, values)
    if tuple(numbers.shape) == (3, 3):
        off = (numbers @ numbers.mT - torch.eye(3).to(numbers)).abs().max()
        if not (float(off) < _NOT_SQUARE and float(torch.linalg.det(numbers)) > 0):
            raise CameraError(
                f"{name} must be a rotation, whose rows are of length 1 and at right angles, with the "
                f"determinant 1, got {numbers.tolist()}"
            )
        return matrix_to_rotvec(numbers)
    turn = _vector(name, values, 3)
    if float(turn.norm()) > _LARGEST_TURN:
        raise CameraError(
            f"{name} must be a Rodrigues vector in radians of at most "
            f"{_LARGEST_TURN:g}, got {turn.tolist()}; give degrees as radians"
        )
    return turn


def _numbers(name: str, values: Any, wanted: str = "numbers") -> Tensor:
    """Return a tensor of numbers; true and false are none."""
    try:
        if _holds_bool(values):
            raise TypeError
        check_real(name, values)
        return torch.as_tensor(values, dtype=torch.float64).detach().cpu().clone()
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise CameraError(f"{name} must be {wanted}, got {values!r:.200}") from error


def _holds_bool(values: Any) -> bool:
    if isinstance(values, list | tuple):
        return any(_holds_bool(value) for value in values)
    return isinstance(values, bool) or getattr(values, "dtype", None) in (torch.bool, np.bool_)


def _image_side(name: str, value: Any) -> int | None:
    if value is None:
        return None
    try:
        side = int(value)
        if isinstance(value, bool) or not 0 < side <= _LARGEST_SIDE or side != float(value):
            raise ValueError
    except (TypeError, ValueError, OverflowError) as error:
        raise CameraError(
            f"{name} must be a positive whole number of pixels, at most {_LARGEST_SIDE}, got "
            f"{value!r:.60}"
        ) from error
    return side


def _camera_from_table(where: str, name: str, table: Mapping[str, Any]) -> PinholeCamera:
    size = table.get("size", (None, None))
    check_keys(where, table)
    try:
        if not isinstance(size, Sequence) or len(size) != 2:
            raise CameraError(f"size must be [width, height], got {size!r:.60}")
        if not isinstance(table.get("fisheye", False), bool):
            raise CameraError(f"fisheye must be true or false, got {table['fisheye']!r:.60}")
        base = PinholeCamera.from_matrix(table["matrix"])
        fx, fy, skew, cx, cy = (float(e) for e in intrinsics(base.matrix))
        return PinholeCamera(
            fx, fy, cx, cy, size[0], size[1], str(table.get("name") or name), skew=skew,
            distortions=table.get("distortions", ()),
            rotation=table.get("rotation", (0.0, 0.0, 0.0)),
            translation=table.get("translation", (0.0, 0.0, 0.0)),
            fisheye=bool(table.get("fisheye", False)),
            up=table.get("up"),
        )  # fmt: skip
    except CameraError as error:
        raise CameraError(f"{where}: {error}") from error


def _camera_to_toml(name: str, camera: PinholeCamera) -> str:
    table: dict[str, Any] = {}
    if camera.image_size is not None:
        table["size"] = [float(s) for s in camera.image_size]
    for key in ("matrix", "distortions", "rotation", "translation"):
        table[key] = getattr(camera, key).double().tolist()
    table["fisheye"] = camera.fisheye
    if camera.up is not None:
        table["up"] = camera.up.double().tolist()
    return table_text(name, table)
