"""Back-constrained Gaussian process latent variable model of poses (MR 13, 14, 21-26).

A pose x is f(z) + noise, every column of f a Gaussian process over a latent space of few dimensions,
and z = g(x) is a smooth function of the pose, so that poses that are alike are neighbours. Fitted to
the relative part rotations of a motion it is the manifold of the manifold-regularised particle filter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchpose._core.reading import reading
from torchpose.errors import FileFormatError, InputError, ShapeError, check_finite, check_shape
from torchpose.priors.manifold import prediction as gplvm_prediction
from torchpose.priors.manifold.file import TENSORS, ManifoldInfo, read_manifold, write_manifold
from torchpose.priors.manifold.fit import GPLVMFit, best_fit, median_gamma
from torchpose.priors.manifold.kernel import KernelParameters
from torchpose.priors.manifold.noise import (
    MotionNoise,
    at_rate,
    check_unseen,
    motion_noise,
    no_noise,
)
from torchpose.priors.manifold.pose_sequences import column_scale, join_sequences, principal_axes
from torchpose.priors.manifold.prediction import Fitted, Prepared

__all__ = ["BackConstrainedGPLVM"]

_WATCHED, _ALONE = {"steps": 40, "n_init": 4}, {"steps": 3, "n_init": 1}


class BackConstrainedGPLVM(nn.Module):
    """Manifold of poses: x = f(z) + noise with f a Gaussian process, z = g(x).

    k(z, z') = beta exp(-gamma_z / 2 ||z - z'||^2) + beta_0   (MR 14)
    g_i(x) = sum_t a_ti exp(-gamma_x / 2 ||x - x_t||^2) + b_i   (MR 21, 22)

    Use `fit`; the constructor takes what a fit has found. The factor of the kernel matrix and
    alpha = K^-1 X are computed once, so that the poses of any number of latent points are a single
    product. `.float()` makes a manifold that predicts in single precision, from an alpha computed in
    double.

    Args:
        poses: training poses X [T, Q]; of bodies, columns without a unit (quaternion vectors).
        lengths: frames of each sequence in them [S].
        weights: a [T, d]. bias: b [d]. gamma_x: of (MR 22), one over squared units of the poses.
        kernel: beta, beta_0, gamma_z, sigma_z.
        scale: what columns are divided by [Q]; ones in the published form.
        info: what it was fitted on.

    Attributes:
        std_latent: sigma x->z [d] (MR 27). std_pose: sigma z->x [Q] (MR 30). std_step: sigma x->x
            [Q] (MR 29). All are for one frame, and NaN until `fit_noise` has been called.
        latents: z of the training poses [T, d].

    Raises:
        ShapeError: sizes do not fit together. InputError: values that are not finite, too few frames.

    Reference: Gonczarek & Tomczak, Articulated tracking with manifold regularized particle filter,
    2016, section 5.

    >>> import torch
    >>> angle = torch.linspace(0, 12, 60, dtype=torch.float64)
    >>> poses = torch.stack([angle.sin(), angle.cos(), (2 * angle).sin()], 1)
    >>> manifold = BackConstrainedGPLVM.fit(poses, steps=5)
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
    latents: Tensor

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
            self.register_buffer(name, value.detach().to(poses.device, torch.float64).clone())
        self.register_buffer("lengths", lengths.detach().clone())
        for name, value in no_noise(latent_dim, columns, self.poses)._asdict().items():
            self.register_buffer(name, value)
        self.register_load_state_dict_post_hook(_prepare_again)
        self._prepare()

    # --- fit

    @classmethod
    def fit(
        cls,
        poses: Float[Tensor, "T Q"] | Sequence[Float[Tensor, "_ Q"]],
        latent_dim: int = 2,
        *,
        gamma_x: float | None = None,
        steps: int | None = None,
        seed: int = 0,
        optimiser: str = "lbfgs",
        learning_rate: float | None = None,
        tolerance: float = 1e-5,
        n_init: int | None = None,
        smoothness: float = 0.0,
        standardise: bool = False,
        validation: Float[Tensor, "V Q"] | Sequence[Float[Tensor, "_ Q"]] | None = None,
        patience: int = 3,
        info: ManifoldInfo | None = None,
        progress: bool = False,
    ) -> BackConstrainedGPLVM:
        """Fit a manifold to the poses of one motion, or of several sequences.

        The mean pose is subtracted, latent points start from principal components, and the objective
        (MR 16) is maximised. Time and memory of a step grow with the cube and the square of the
        number of frames: 0.1 s for 350 frames, some 20 s for 2,000, on one core.

        Args:
            poses: one sequence [T, Q], or several of the same columns.
            latent_dim: d.
            gamma_x: of (MR 22); by default one over the squared median distance of the poses. The
                published 1e-4 is for other units.
            steps: of ten iterations of the optimiser, at most; by default 40 with validation poses and
                3 without. Further ones make the back constraints follow the training poses so closely
                that other poses come back worse.
            seed: of the frames whose distances are compared, where there are more than 2,000.
            optimiser: "lbfgs" or "adam". learning_rate: None for the optimiser's own.
            tolerance: gain of the objective per number and step at which to stop.
            n_init: starts, see `principal_start`; the one with the lowest held-out error, or else
                the highest objective, is kept. By default 4 with validation poses and 1 without.
            smoothness: of the back constraints, see `GPLVMFit`.
            standardise: divide every column by its standard deviation, so that all weigh the same
                in the objective and in gamma_x; the published form does not.
            validation: poses of other trials. With them the fit stops after `patience` steps that
                bring them back no better, x - f(g(x)), and returns to the step that was best.
            patience: see there.
            info: what the poses are of. progress: show a bar for every start.

        Raises:
            InputError: fewer than 10 frames, NaN (frame and column are named), no motion, bad
                settings. ShapeError: not [T, Q], or sequences with different columns.
        """
        info = ManifoldInfo() if info is None else info
        joined, lengths = join_sequences(poses, info.columns)
        scale = column_scale(joined) if standardise else torch.ones_like(joined[0])
        target = (joined - joined.mean(0)) / scale
        gamma = median_gamma(target, seed) if gamma_x is None else gamma_x
        defaults = _ALONE if validation is None else _WATCHED
        steps = defaults["steps"] if steps is None else steps
        n_init = defaults["n_init"] if n_init is None else n_init
        error = None
        if validation is not None:
            watched, _ = join_sequences(validation, info.columns, joined.shape[1])
            error = lambda fit: (  # noqa: E731
                cls.from_fit(fit, joined, lengths, scale).reconstruction_error(watched)
            )
        best = best_fit(
            lambda start: GPLVMFit(
                target, latent_dim, gamma, optimiser, learning_rate, smoothness, start=start
            ),
            n_init, steps, tolerance, progress, error, patience,
        )  # fmt: skip
        return cls.from_fit(best, joined, lengths, scale, info)

    @classmethod
    def from_fit(
        cls,
        fit: GPLVMFit,
        poses: Float[Tensor, "T Q"],
        lengths: Sequence[int],
        scale: Float[Tensor, " Q"],
        info: ManifoldInfo | None = None,
    ) -> BackConstrainedGPLVM:
        """The manifold that a fit stands at, its latent axes turned to the principal ones.

        Args:
            fit: to (poses - mean) / scale. lengths: frames of each sequence.
        """
        with torch.no_grad():
            latents = fit.features @ fit.coordinates + fit.bias
            turn = principal_axes(latents)
            weights, bias = fit.weights @ turn, fit.bias @ turn
            sizes = torch.tensor(list(lengths))
            return cls(poses, sizes, weights, bias, fit.gamma_x, fit.kernel, scale=scale, info=info)

    def fit_noise(
        self,
        poses: Float[Tensor, "T Q"] | Sequence[Float[Tensor, "_ Q"]],
        fps: float,
    ) -> BackConstrainedGPLVM:
        """Set the three standard deviations from validation poses; returns the manifold itself.

        sigma x->z: root mean square of g(x_t) - g(x_t-1) (MR 27); sigma z->x: of x_t - f(g(x_t))
        (MR 30); sigma x->x: of x_t - x_t-1 (MR 29), each dimension apart; see `motion_noise`.

        Args:
            poses: one sequence or several that were not fitted to; on those that were, sigma z->x
                comes out too small. fps: their frame rate, which all three are for.

        Raises:
            InputError: fewer than 10 frames, NaN, a frame rate that is not positive, or frames that
                were fitted to. ShapeError: other columns.
        """
        if not 0 < fps < math.inf:
            raise InputError(f"fps must be positive, got {fps:g}")
        joined, lengths = join_sequences(poses, self.info.columns, self.dim)
        joined = joined.to(self.poses)
        check_unseen(joined, lengths, self.poses)
        latents = self.to_latent(joined)
        noise = motion_noise(joined, latents, self.pose_mean(latents), lengths)
        for name, value in noise._asdict().items():
            getattr(self, name).copy_(value)
        self.info = self.info.with_noise(fps, latents, joined, lengths)
        return self

    def at_rate(self, fps: float) -> BackConstrainedGPLVM:
        """The same with standard deviations for another frame rate, see `gplvm_noise.at_rate`."""
        return at_rate(self, fps)

    # --- both ways

    def to_latent(self, x: Float[Tensor, "*batch Q"]) -> Float[Tensor, "*batch d"]:
        """Latent points of poses, z = g(x)   (MR 21).

        Raises:
            ShapeError: another number of columns.
        """
        check_shape("x", x, ("...", self.dim))
        flat = x.reshape(-1, self.dim).to(self.poses.dtype)
        found = gplvm_prediction.to_latent(flat, self._fitted, self._prepared)
        return found.reshape(*x.shape[:-1], self.latent_dim)

    def pose_mean(self, z: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch Q"]:
        """Mean pose of latent points, f(z) = X^T K^-1 k   (MR 25).

        Raises:
            ShapeError: another number of latent dimensions.
        """
        check_shape("z", z, ("...", self.latent_dim))
        found = gplvm_prediction.to_pose_mean(self._flat(z), self._fitted, self._prepared)
        return found.reshape(*z.shape[:-1], self.dim)

    def to_pose(
        self, z: Float[Tensor, "*batch d"]
    ) -> tuple[Float[Tensor, "*batch Q"], Float[Tensor, "*batch"]]:
        """Mean and variance of the poses of latent points   (MR 24-26).

        mu = X^T K^-1 k,   sigma^2 = k(z, z) - k^T K^-1 k + sigma_z^2

        The variance is that of a pose, noise included, where (MR 26) is that of f(z) alone. It takes
        most of the time; `pose_mean` leaves it out.

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
        """The pose on the manifold that a pose leads to, f(g(x))."""
        return self.pose_mean(self.to_latent(x))

    def reconstruction_error(self, x: Float[Tensor, "*batch Q"]) -> float:
        """Root mean square of x - f(g(x)) over all columns."""
        return float((x - self.reconstruct(x)).square().mean().sqrt())

    def forward(
        self, x: Float[Tensor, "*batch Q"]
    ) -> tuple[Float[Tensor, "*batch Q"], Float[Tensor, "*batch"]]:
        """Mean and variance of f(g(x))."""
        return self.to_pose(self.to_latent(x))

    # --- what it is

    @property
    def latent_dim(self) -> int:
        """Number of latent dimensions d."""
        return int(self.weights.shape[1])

    @property
    def dim(self) -> int:
        """Number of columns Q of a pose."""
        return int(self.poses.shape[1])

    @property
    def kernel(self) -> KernelParameters:
        """beta, beta_0, gamma_z and sigma_z."""
        return KernelParameters(*self.log_kernel.unbind())

    def trajectories(self) -> tuple[Tensor, ...]:
        """Latent points of each sequence that it was fitted to, [T_s, d]."""
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
        """Write it as safetensors.

        Raises:
            OutputError: the file cannot be written. PriorError: `info.extra` is not JSON.
        """
        write_manifold(path, self.info, {name: getattr(self, name) for name in TENSORS})

    @classmethod
    def load(cls, path: str | Path) -> BackConstrainedGPLVM:
        """Read what `save` has written.

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
        if not all(bool(b.isfinite().all()) for b in (manifold.latents, *manifold._prepared)):
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
        return Prepared(self.latents, *(getattr(self, f"_{name}") for name in Prepared._fields[1:]))

    def _prepare(self) -> None:
        """What prediction needs and follows from the rest."""
        for name, value in gplvm_prediction.prepare(self.poses, self._fitted)._asdict().items():
            own = name if name == "latents" else f"_{name}"
            self.register_buffer(own, value.to(self.poses.dtype), persistent=False)

    def _flat(self, z: Tensor) -> Float[Tensor, "N d"]:
        return z.reshape(-1, self.latent_dim).to(self.poses.dtype)


def _prepare_again(manifold: BackConstrainedGPLVM, _: Any) -> None:
    manifold._prepare()
