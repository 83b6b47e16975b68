"""Define the back-constrained Gaussian process latent variable model of poses (MR 13, 14, 21-26).

A pose x is f(z) + noise, every column of f a Gaussian process over a latent space of few dimensions,
and z = g(x) is a smooth function of the pose, so that poses that are alike are neighbours. Fitted to
the relative part rotations of a motion it is the manifold of the manifold-regularised particle filter.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose._core.checks import check_finite, check_rate, check_shape, check_tensors
from torchpose._core.module_state import NoHalfModule, derived, register_given
from torchpose._core.moved import moved_function
from torchpose._core.reading import reading
from torchpose.errors import FileFormatError, InputError, ShapeError
from torchpose.priors._manifold import prediction as gplvm_prediction
from torchpose.priors._manifold.manifold_file import (
    TENSORS,
    ManifoldInfo,
    read_manifold,
    write_manifold,
)
from torchpose.priors._manifold.prediction import Fitted, KernelParameters, Prepared

LEAST_FRAMES = 10
"""Of the poses of a manifold."""


class MotionNoise(NamedTuple):
    """Holds standard deviations per frame.

    Attributes:
        std_latent: sigma x->z [d] (MR 27). std_pose: sigma z->x [Q] (MR 30). std_step: sigma x->x [Q]
            (MR 29).
    """

    std_latent: Tensor
    std_pose: Tensor
    std_step: Tensor


def no_noise(latent_dim: int, columns: int, like: Tensor) -> MotionNoise:
    """Return NaN for all of it, as before there are validation poses."""
    return MotionNoise(*(like.new_full((n,), math.nan) for n in (latent_dim, columns, columns)))


def join_sequences(
    poses: Tensor | Sequence[Tensor], columns: Sequence[str], dim: int | None = None
) -> tuple[Float[Tensor, "T Q"], list[int]]:
    """Return the poses of all sequences as one matrix in double precision, and how long each is.

    Args:
        poses: one sequence [T, Q] or several. columns: their names, for messages. dim: the number of
            columns that there have to be; any if None.

    Raises:
        ShapeError: not [T, Q], or another number of columns. InputError: no sequence, fewer than 10
            frames in all, or a value that is not finite.
    """
    parts: list[Any] = [poses] if hasattr(poses, "shape") else list(poses)
    columns_of = (part.shape[-1] for part in parts if getattr(part, "ndim", 0) == 2)
    wanted = next(columns_of, None) if dim is None else dim
    for number, part in enumerate(parts):
        where = "poses" if hasattr(poses, "shape") else f"sequence {number} of the poses"
        check_tensors(**{where: part})
        if part.ndim != 2 or part.shape[1] != wanted:
            raise ShapeError(
                f"{where} must have shape [T, {'Q' if wanted is None else wanted}], got "
                f"{list(part.shape)}; a pose is the columns that `Body.relative` returns"
            )
        bad = (~torch.isfinite(part)).nonzero()
        if len(bad):
            frame, column = (int(i) for i in bad[0])
            name = f" ({columns[column]})" if len(columns) == part.shape[1] else ""
            raise InputError(
                f"{where} must be finite, got {float(part[frame, column])} in frame {frame}, column "
                f"{column}{name}; {len(bad)} such values; leave out the frames with gaps, and end "
                "the sequence there"
            )
    count = sum(len(part) for part in parts)
    if count < LEAST_FRAMES:
        raise InputError(f"a manifold needs at least {LEAST_FRAMES} frames of poses, got {count}")
    return torch.cat([part.detach().double() for part in parts]), [len(part) for part in parts]


class BackConstrainedGPLVM(NoHalfModule):
    """Holds a manifold of poses: x = f(z) + noise with f a Gaussian process, z = g(x).

    k(z, z') = beta exp(-gamma_z / 2 ||z - z'||^2) + beta_0   (MR 14)
    g_i(x) = sum_t a_ti exp(-gamma_x / 2 ||x - x_t||^2) + b_i   (MR 21, 22)

    Use `torchpose.learning.fit_gplvm`; the constructor takes what a fit has found. The factor of the
    kernel matrix and alpha = K^-1 X are computed once, and anew where the tensors below have changed, so
    that the poses of any number of latent points are a single product. `.float()` makes a manifold that
    predicts in single precision, from an alpha computed in double.

    Args:
        poses: training poses X [T, Q]; of bodies, columns without a unit (quaternion vectors).
        lengths: frames of each sequence in them [S].
        weights: a [T, d]. bias: b [d]. gamma_x: of (MR 22), one over squared units of the poses.
        kernel: beta, beta_0, gamma_z, sigma_z.
        scale: divisor of every column [Q]; ones in the published form.
        info: facts about the fit.

    Attributes:
        std_latent: sigma x->z [d] (MR 27). std_pose: sigma z->x [Q] (MR 30). std_step: sigma x->x
            [Q] (MR 29). All are for one frame, and NaN until `fit_gplvm_noise` has been called.

    Raises:
        ShapeError: sizes do not fit together. InputError: values that are not finite, too few frames.

    Reference: Gonczarek & Tomczak, Articulated tracking with manifold regularized particle filter,
    2016, section 5.

    >>> import torch
    >>> from torchpose.learning import fit_gplvm
    >>> angle = torch.linspace(0, 12, 60, dtype=torch.float64)
    >>> poses = torch.stack([angle.sin(), angle.cos(), (2 * angle).sin()], 1)
    >>> manifold = fit_gplvm(poses, steps=5)
    >>> mean, variance = manifold.to_pose(manifold.to_latent(poses[:4]))
    >>> mean.shape, variance.shape, bool((mean - poses[:4]).abs().max() < 0.05)
    (torch.Size([4, 3]), torch.Size([4]), True)
    """

    poses: Tensor
    lengths: Tensor
    scale: Tensor
    weights: Tensor
    bias: Tensor
    gamma_x: Tensor
    log_kernel: Tensor
    std_latent: Tensor
    std_pose: Tensor
    std_step: Tensor

    def __init__(
        self,
        poses: Float[Tensor, "T Q"],
        lengths: Int[Tensor, " S"],
        weights: Float[Tensor, "T d"],
        bias: Float[Tensor, " d"],
        gamma_x: float | Float[Tensor, ""],
        kernel: KernelParameters,
        *,
        scale: Float[Tensor, " Q"] | None = None,
        info: ManifoldInfo | None = None,
    ) -> None:
        super().__init__()
        self.info = ManifoldInfo() if info is None else info
        check_shape("poses", poses, ("T", "Q"))
        check_shape("weights", weights, (len(poses), "d"))
        (_, columns), latent_dim = poses.shape, weights.shape[1]
        scale = poses.new_ones(columns) if scale is None else scale
        check_shape("bias", bias, (latent_dim,))
        check_shape("scale", scale, (columns,))
        if int(lengths.sum()) != len(poses):
            raise ShapeError(f"lengths must add up to {len(poses)} poses, got {lengths.tolist()}")
        join_sequences(poses.split(lengths.tolist()), self.info.columns)
        parts = {
            "poses": poses, "scale": scale, "weights": weights, "bias": bias,
            "gamma_x": torch.as_tensor(gamma_x, dtype=torch.float64),
            "log_kernel": torch.stack([torch.as_tensor(value) for value in kernel]),
        }  # fmt: skip
        for name, value in parts.items():
            check_finite(name, value)
            register_given(self, name, value.detach().to(poses.device, torch.float64))
        register_given(self, "lengths", lengths)
        for name, value in no_noise(latent_dim, columns, self.poses)._asdict().items():
            register_given(self, name, value)

    fit = staticmethod(moved_function("BackConstrainedGPLVM.fit", "torchpose.learning.fit_gplvm"))
    fit_noise = moved_function("fit_noise", "torchpose.learning.fit_gplvm_noise")

    def at_rate(self, fps: float) -> BackConstrainedGPLVM:
        """Return the same manifold with its standard deviations for another frame rate.

        sigma(fps) = sigma (fps_0 / fps)^g of sigma x->z and x->x, g learnt with them; sigma z->x does
        not depend on the rate.

        Args:
            fps: frames per second.

        Returns:
            A copy; this manifold does not change.

        Raises:
            InputError: a rate that is not positive. PriorError: no standard deviations, or a file that does
                not say how they grow.
        """
        check_rate("fps", fps)
        known = bool(torch.isfinite(self.std_pose).all())
        latent, step = self.info.noise_factors(fps, known)
        other = copy.deepcopy(self)
        other.std_latent *= latent
        other.std_step *= step
        other.info = replace(self.info, fps=float(fps))
        return other

    # --- both ways

    def to_latent(self, x: Float[Tensor, "*batch Q"]) -> Float[Tensor, "*batch d"]:
        """Return latent points of poses, z = g(x)   (MR 21).

        Args:
            x: poses [..., Q].

        Returns:
            Latent points [..., d].

        Raises:
            ShapeError: another number of columns.
        """
        check_shape("x", x, ("...", self.dim))
        flat = x.reshape(-1, self.dim).to(self.poses.dtype)
        found = gplvm_prediction.to_latent(flat, self._fitted, self._prepared)
        return found.reshape(*x.shape[:-1], self.latent_dim)

    def pose_mean(self, z: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch Q"]:
        """Return the mean pose of latent points, f(z) = X^T K^-1 k   (MR 25).

        Args:
            z: latent points [..., d].

        Returns:
            Poses [..., Q].

        Raises:
            ShapeError: another number of latent dimensions.
        """
        check_shape("z", z, ("...", self.latent_dim))
        found = gplvm_prediction.to_pose_mean(self._flat(z), self._fitted, self._prepared)
        return found.reshape(*z.shape[:-1], self.dim)

    def to_pose(
        self, z: Float[Tensor, "*batch d"]
    ) -> tuple[Float[Tensor, "*batch Q"], Float[Tensor, "*batch"]]:
        """Return mean and variance of the poses of latent points   (MR 24-26).

        mu = X^T K^-1 k,   sigma^2 = k(z, z) - k^T K^-1 k + sigma_z^2

        The variance is that of a pose, noise included, where (MR 26) is that of f(z) alone. It takes
        most of the time; `pose_mean` leaves it out.

        Args:
            z: latent points [..., d].

        Returns:
            Mean [..., Q], and the variance [...] that all columns share; where `scale` is not one,
            that of column q is `variance * scale[q]**2`.

        Raises:
            ShapeError: another number of latent dimensions.
        """
        check_shape("z", z, ("...", self.latent_dim))
        mean, variance = gplvm_prediction.to_pose(self._flat(z), self._fitted, self._prepared)
        return mean.reshape(*z.shape[:-1], self.dim), variance.reshape(z.shape[:-1])

    def reconstruct(self, x: Float[Tensor, "*batch Q"]) -> Float[Tensor, "*batch Q"]:
        """Return the pose on the manifold that a pose is mapped to, f(g(x)).

        Args:
            x: poses [..., Q].

        Returns:
            Poses [..., Q].

        Raises:
            ShapeError: another number of columns.
        """
        return self.pose_mean(self.to_latent(x))

    def reconstruction_error(self, x: Float[Tensor, "*batch Q"]) -> float:
        """Return the root mean square of x - f(g(x)) over all poses and columns.

        Args:
            x: poses [..., Q].

        Returns:
            Error in the unit of the columns.

        Raises:
            ShapeError: another number of columns.
        """
        return float((x - self.reconstruct(x)).square().mean().sqrt())

    def forward(
        self, x: Float[Tensor, "*batch Q"]
    ) -> tuple[Float[Tensor, "*batch Q"], Float[Tensor, "*batch"]]:
        """Return the mean and variance of the pose on the manifold that a pose is mapped to, f(g(x)).

        Args:
            x: poses [..., Q].

        Returns:
            Mean [..., Q] and variance [...], as `to_pose`.

        Raises:
            ShapeError: another number of columns.
        """
        return self.to_pose(self.to_latent(x))

    if TYPE_CHECKING:  # nn.Module has Any
        __call__ = forward

    # --- what it is

    @property
    def latent_dim(self) -> int:
        """Return the number of latent dimensions d."""
        return int(self.weights.shape[1])

    @property
    def dim(self) -> int:
        """Return the number of columns Q of a pose."""
        return int(self.poses.shape[1])

    @property
    def latents(self) -> Float[Tensor, "T d"]:
        """Return z of the training poses."""
        return self._prepared.latents

    @property
    def kernel(self) -> KernelParameters:
        """Return beta, beta_0, gamma_z and sigma_z."""
        return KernelParameters(*self.log_kernel.unbind())

    def trajectories(self) -> tuple[Tensor, ...]:
        """Return latent points of each sequence that it was fitted to, [T_s, d]."""
        return self.latents.split(self.lengths.tolist())

    def check_for(self, body: Any, fps: float | None = None) -> None:
        """Raise unless poses of a body are poses of this manifold.

        Args:
            body: a `torchpose.body.Body`. fps: of the frames to be tracked, None if it does not
                matter.

        Raises:
            PriorError: another skeleton, other columns, part rotations relative to something else,
                another frame rate, or no standard deviations although a frame rate is given.
        """
        self.info.check_for(body, self.dim)
        if fps is not None:
            self.info.check_rate(fps, known=bool(torch.isfinite(self.std_pose).all()))

    def extra_repr(self) -> str:
        return (
            f"latent_dim={self.latent_dim}, dim={self.dim}, frames={len(self.poses)}, "
            f"sequences={len(self.lengths)}, dtype={self.poses.dtype}"
        )

    def save(self, path: str | Path) -> None:
        """Write the manifold as safetensors, atomically: an interrupted write leaves no partial file.

        Args:
            path: the file, which is replaced.

        Raises:
            OutputError: the file cannot be written. PriorError: `info.extra` is not JSON.
        """
        write_manifold(path, self.info, {name: getattr(self, name) for name in TENSORS})

    @classmethod
    def load(cls, path: str | Path) -> BackConstrainedGPLVM:
        """Read what `save` has written.

        Args:
            path: safetensors file.

        Returns:
            The manifold, in float64.

        Raises:
            InputError: no such file. FileFormatError: truncated, or of another kind.
        """
        info, kept = read_manifold(path)
        kernel = KernelParameters(*kept["log_kernel"].unbind())
        with reading(path, "a manifold"):
            try:
                manifold = cls(
                    kept["poses"], kept["lengths"], kept["weights"], kept["bias"], kept["gamma_x"],
                    kernel, scale=kept["scale"], info=info,
                )  # fmt: skip
            except (InputError, ShapeError) as error:
                raise FileFormatError(f"{path}: {error}") from error
        if not all(bool(b.isfinite().all()) for b in manifold._prepared):
            raise FileFormatError(f"{path}: its numbers make no manifold; fit it again")
        for name in MotionNoise._fields:
            getattr(manifold, name).copy_(kept[name])
        return manifold

    # --- inside

    @property
    def _fitted(self) -> Fitted:
        return Fitted(self.scale, self.weights, self.bias, self.gamma_x, self.kernel)

    @property
    def _prepared(self) -> Prepared:
        """Return the tensors that prediction needs and that follow from the fit."""
        sources = (self.poses, self.scale, self.weights, self.bias, self.gamma_x, self.log_kernel)
        return derived(self, "prepared", sources, self._prepare)

    def _prepare(self) -> Prepared:
        found = gplvm_prediction.prepare(self.poses, self._fitted)
        return Prepared(*(value.to(self.poses.dtype) for value in found))

    def _flat(self, z: Tensor) -> Float[Tensor, "N d"]:
        return z.reshape(-1, self.latent_dim).to(self.poses.dtype)
