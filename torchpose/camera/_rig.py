"""Project points into several calibrated cameras at once, and undistort their images."""

import copy
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose._core.checks import check_floating, check_shape, refuse_half
from torchpose._core.module_state import NoHalfModule
from torchpose._core.wording import counted
from torchpose.camera._lens import (
    OPENCV_DISTORTIONS,
    distort_rays,
    is_distorted,
    straighten_rays,
    undistortion_maps,
)
from torchpose.camera._pinhole import PinholeCamera, load_cameras
from torchpose.camera._projection import scale_matrix
from torchpose.errors import CameraError, InputError

_IMAGES = ("bool", "uint8", "uint16", "int16", "float32", "float64")
_LARGEST_OFF = 1.0  # pixels, between a point and its inverse distorted again


class RigView(NamedTuple):
    """Holds points as every camera sees them.

    Attributes:
        pixels: [..., C, N, 2], u and v; they mean nothing where the depth is not positive.
        depth: [..., C, N], metres along the optical axis.
    """

    pixels: Tensor
    depth: Tensor


class CameraRig(NoHalfModule):
    """Holds C calibrated cameras with poses in one room.

    x_camera = rotation x_world + translation, pixels by the matrix K (BL 3). Camera axes: x right,
    y down, z forward. Distortions are not applied by `forward`: images are undistorted when they
    are read, by `undistort`.

    Args:
        cameras: one or more `PinholeCamera`.

    Buffers: matrix [C, 3, 3] in pixels, rotation [C, 3, 3], translation [C, 3] in metres,
        distortions [C, 14] in OpenCV's order.

    Attributes:
        names: the names of the cameras ("cam_01", ... where they have no name).
        sizes: (height, width) of every camera's image in pixels, or None where it is not known.

    Raises:
        CameraError: no camera, something else than cameras, or two of the same name.

    >>> rig = CameraRig([PinholeCamera(525, 525, 319.5, 239.5, 640, 480)])
    >>> view = rig(torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64))
    >>> view.pixels.tolist(), view.depth.tolist()
    ([[[319.5, 239.5]]], [[2.0]])
    """

    matrix: Tensor
    rotation: Tensor
    translation: Tensor
    distortions: Tensor

    def __init__(self, cameras: Sequence[PinholeCamera]) -> None:
        super().__init__()
        cameras = list(cameras)
        if not cameras or not all(isinstance(c, PinholeCamera) for c in cameras):
            kinds = [type(c).__name__ for c in cameras]
            raise CameraError(f"a rig needs one or more PinholeCamera, got {kinds}")
        self.names = tuple(c.name or f"cam_{i:02d}" for i, c in enumerate(cameras, start=1))
        if len(set(self.names)) != len(self.names):
            raise CameraError(f"cameras of a rig need names of their own, got {list(self.names)}")
        self.sizes: tuple[tuple[int, int] | None, ...] = tuple(
            None if c.image_size is None else (c.image_size[1], c.image_size[0]) for c in cameras
        )
        self.fisheye = tuple(c.fisheye for c in cameras)
        self.register_buffer("matrix", torch.stack([c.matrix for c in cameras]))
        self.register_buffer("rotation", torch.stack([c.rotation_matrix for c in cameras]))
        self.register_buffer("translation", torch.stack([c.translation for c in cameras]))
        self.register_buffer("distortions", torch.stack([_padded(c) for c in cameras]))

    @classmethod
    def load(cls, path: str | Path) -> "CameraRig":
        """Read all cameras of a TOML file, in its order.

        Args:
            path: the file, see `load_cameras`.

        Returns:
            Rig of all cameras, named as their tables.

        Raises:
            InputError: no such file. FileFormatError: not such a file. CameraError: bad values.
        """
        return cls(_named(load_cameras(path)))

    def __len__(self) -> int:
        return len(self.names)

    @property
    def size(self) -> tuple[int, int] | None:
        """Return (height, width) in pixels if all cameras have the same, else None."""
        return self.sizes[0] if len(set(self.sizes)) == 1 else None

    def forward(self, points: Float[Tensor, "*batch N 3"]) -> RigView:
        """Return the pixels and depth of world points in every camera.

        Args:
            points: [..., N, 3], metres, world axes; the result has their dtype.

        Returns:
            `RigView` with pixels [..., C, N, 2] and depth [..., C, N].

        Reference: Burke & Lasenby, equation (3).
        """
        check_floating("points", points)
        check_shape("points", points, ["...", "N", 3])
        K, R, t = (b.to(points) for b in (self.matrix, self.rotation, self.translation))
        homogeneous = points.unsqueeze(-3) @ (K @ R).mT + (K @ t.unsqueeze(-1)).mT
        depth = homogeneous[..., 2]
        return RigView(homogeneous[..., :2] / depth.unsqueeze(-1), depth)

    if TYPE_CHECKING:  # nn.Module has Any
        __call__ = forward

    def select(self, index: Sequence[int]) -> "CameraRig":
        """Return the rig of some of the cameras, in the given order.

        Args:
            index: indices of cameras; negative ones count from the end.

        Returns:
            Rig with as many cameras as there are indices.

        Raises:
            CameraError: no index, one that no camera has, or a truth value.
        """
        truth = any(getattr(i, "dtype", type(i)) in (bool, np.bool_, torch.bool) for i in index)
        index = [int(i) for i in index]
        if truth or not index or not all(-len(self) <= i < len(self) for i in index):
            raise CameraError(f"indices must be among 0 to {len(self) - 1}, got {index}")
        rig = copy.copy(self)
        rig._buffers = {name: b[index] for name, b in self.named_buffers()}
        for name in ("names", "sizes", "fisheye"):
            setattr(rig, name, tuple(getattr(self, name)[i] for i in index))
        return rig

    def scaled(self, height: int, width: int) -> "CameraRig":
        """Return the same cameras with images of another size.

        Pixel centres are at whole numbers, so u' + 1/2 = (u + 1/2) width / old width, and the same
        for v. Distortions do not depend on the size.

        Args:
            height, width: the height and width of the other images, pixels.

        Returns:
            Rig with the same poses.

        Raises:
            CameraError: the size of a camera is not known. InputError: a side is not positive.
        """
        if height < 1 or width < 1:
            raise InputError(f"an image needs positive sides in pixels, got {height} x {width}")
        unknown = [n for n, s in zip(self.names, self.sizes, strict=True) if s is None]
        if unknown:
            raise CameraError(
                f"camera {unknown[0]!r} has no image size, so it cannot be scaled to "
                f"{height} x {width}; give width and height to PinholeCamera, or `size` in the file"
            )
        old = torch.tensor([s for s in self.sizes if s is not None]).to(self.matrix)
        sx, sy = width / old[:, 1], height / old[:, 0]
        matrix = scale_matrix(self.matrix, sx, sy)
        rig = copy.copy(self)
        own = {name: b.clone() for name, b in self.named_buffers()}
        rig._buffers = {**own, "matrix": matrix}
        rig.sizes = ((int(height), int(width)),) * len(self)
        return rig

    def undistort(self, images: Any) -> Any:
        """Return the images as cameras without distortion would see them; the matrix K stays.

        Pixels are interpolated linearly, and masks (bool) cut at one half. What lies outside of the
        distorted image is 0.

        Args:
            images: masks or grey images [..., C, H, W], or colour [..., C, H, W, 3]; bool, uint8 or
                float; a tensor on the CPU or an array.

        Returns:
            The same kind and shape.

        Raises:
            CameraError: another number of cameras, or another size than the cameras'. InputError: numbers
            that OpenCV does not interpolate.
        """
        array = images.numpy(force=True) if isinstance(images, Tensor) else np.asarray(images)
        colour = array.ndim >= 4 and array.shape[-1] == 3 and array.shape[-4] == len(self)
        sides = array.shape[-4:-1] if colour else array.shape[-3:]
        self.check_images("images", sides)
        if array.dtype.name not in _IMAGES:
            raise InputError(f"images must be of {', '.join(_IMAGES)}, got {array.dtype}")
        flat = array.reshape(-1, *sides, *array.shape[-1:]) if colour else array.reshape(-1, *sides)
        out = np.empty_like(flat)
        for c in range(len(self)):
            out[:, c] = self._undistorted(c, flat[:, c])
        out = out.reshape(array.shape)
        return torch.from_numpy(out).to(images.device) if isinstance(images, Tensor) else out

    def undistort_points(
        self, points: Float[Tensor, "*batch C N 2"]
    ) -> Float[Tensor, "*batch C N 2"]:
        """Return pixels as cameras without distortion would have them; the matrix K stays.

        Args:
            points: [..., C, N, 2], pixels of the C cameras; NaN stays NaN.

        Returns:
            [..., C, N, 2], pixels; the same tensor where no lens distorts. NaN where the distortions
            have no inverse: no ray in front of the camera ends there. Gradients do not pass a lens that
            distorts.

        Raises:
            CameraError: another number of cameras. ShapeError: no such points. InputError: whole numbers,
            or half precision.
        """
        check_floating("points", points)
        refuse_half("points", points)
        check_shape("points", points, ["...", "C", "N", 2])
        if points.shape[-3] != len(self):
            raise CameraError(
                f"points must be of {counted(len(self), 'camera')} ({', '.join(self.names)}), got "
                f"{points.shape[-3]}"
            )
        if not is_distorted(self.distortions, any(self.fisheye)):
            return points
        straight = points.clone()
        for c in range(len(self)):
            straight[..., c, :, :] = self._straightened(c, points[..., c, :, :])
        return straight

    def check_images(self, name: str, shape: Sequence[int]) -> None:
        """Check that images have the number and the size of this rig's cameras.

        Args:
            name: the name of the images, for the message.
            shape: [..., C, H, W].

        Raises:
            CameraError: another number of cameras, another size, or fewer than three dimensions.
        """
        if len(shape) < 3:
            raise CameraError(f"{name} must have shape [..., C, H, W], got {list(shape)}")
        count, height, width = shape[-3:]
        if count != len(self):
            raise CameraError(
                f"{name} must be of {counted(len(self), 'camera')} ({', '.join(self.names)}), got {count} "
                f"in shape {list(shape)}; rig.select([...]) keeps some of the cameras"
            )
        for camera, size in zip(self.names, self.sizes, strict=True):
            if size is not None and size != (height, width):
                raise CameraError(
                    f"{name} must be {size[0]} x {size[1]} (height x width) as camera {camera!r}, "
                    f"got {height} x {width}; rig.scaled({height}, {width}) makes cameras of that "
                    "size"
                )

    def extra_repr(self) -> str:
        return ", ".join(
            f"{n}: {'size unknown' if s is None else f'{s[1]}x{s[0]}'}"
            for n, s in zip(self.names, self.sizes, strict=True)
        )

    def _straightened(self, camera: int, points: Tensor) -> Tensor:
        """Return the undistorted pixels [..., N, 2] of one camera."""
        d, K = self.distortions[camera].double().cpu(), self.matrix[camera].double().cpu()
        known = torch.isfinite(points).all(-1)
        if not is_distorted(d, self.fisheye[camera]) or not bool(known.any()):
            return points
        pixels = points[known].double().cpu()
        rays = torch.linalg.solve(K, torch.cat([pixels, torch.ones_like(pixels[:, :1])], -1).mT).mT
        straight_rays = straighten_rays(rays[:, :2], d, self.fisheye[camera])
        again = distort_rays(straight_rays, d, self.fisheye[camera])
        off = ((again - rays[:, :2]) @ K[:2, :2].mT).norm(dim=-1)
        straight_pixels = straight_rays @ K[:2, :2].mT + K[:2, 2]
        straight_pixels[~(off < _LARGEST_OFF)] = torch.nan
        straight = points.clone()
        straight[known] = straight_pixels.to(points)
        return straight

    def _undistorted(self, camera: int, images: np.ndarray) -> np.ndarray:
        """Return the images [T, H, W] or [T, H, W, 3] of one camera."""
        import cv2

        size = images.shape[2], images.shape[1]
        d, K = self.distortions[camera], self.matrix[camera]
        maps = undistortion_maps(K, d, self.fisheye[camera], size)
        if maps is None:
            return images
        mask = images.dtype == bool
        source = images.astype(np.uint8) * 255 if mask else images
        out = np.empty_like(source)
        for image, straight in zip(source, out, strict=True):
            straight[:] = cv2.remap(np.ascontiguousarray(image), *maps, cv2.INTER_LINEAR)
        return out > 127 if mask else out


Cameras = CameraRig | PinholeCamera | Iterable[PinholeCamera] | Mapping[str, PinholeCamera]


def as_rig(cameras: Cameras) -> CameraRig:
    """Return a rig of cameras given as a rig, one camera, several, or a mapping of names.

    Raises:
        CameraError: it holds no cameras.
    """
    if isinstance(cameras, CameraRig):
        return cameras
    if isinstance(cameras, PinholeCamera):
        return CameraRig([cameras])
    if isinstance(cameras, Mapping):
        return CameraRig(_named(cameras))
    if isinstance(cameras, str | Path):
        raise CameraError(
            f"cameras must be a CameraRig or PinholeCamera, got {str(cameras)!r}; load_cameras reads them "
            "from a file"
        )
    if not isinstance(cameras, Iterable):
        raise CameraError(
            f"cameras must be a CameraRig or PinholeCamera, got {type(cameras).__name__}"
        )
    return CameraRig(list(cameras))


def centres_of_cameras(rig: CameraRig) -> Float[Tensor, "C 3"]:
    """Return where cameras are, -R^T t, world axes."""
    return -(rig.rotation.mT @ rig.translation[..., None]).squeeze(-1)


def _named(cameras: Mapping[str, Any]) -> list[Any]:
    """Return the cameras of a mapping; its keys tell two of the same name apart."""
    named = []
    for key, camera in cameras.items():
        if isinstance(camera, PinholeCamera) and camera.name != key:
            camera = copy.copy(camera)
            camera.name = key
        named.append(camera)
    return named


def _padded(camera: PinholeCamera) -> Tensor:
    d = camera.distortions
    if len(d) > OPENCV_DISTORTIONS or (camera.fisheye and len(d) > 4):
        most = 4 if camera.fisheye else OPENCV_DISTORTIONS
        raise CameraError(
            f"camera {camera.name!r} must have at most {most} distortions, got {len(d)}"
        )
    return nn.functional.pad(d, (0, OPENCV_DISTORTIONS - len(d)))
