"""Hold what recordings tell about bodies that are tracked from keypoints: motion, poses, proportions."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose._core.checks import check_covariance, check_shape
from torchpose._core.module_state import derived, register_given
from torchpose._core.reading import reading
from torchpose._core.tensor_file import FileKind, read_tensors, write_tensors
from torchpose.body._articulation import Articulation
from torchpose.errors import PriorError
from torchpose.math._gaussian import safe_cholesky
from torchpose.priors._gaussian_mixture import GaussianMixture


@dataclass(frozen=True)
class BodyMotionInfo:
    """Holds facts about the fit of a `BodyMotion`; fields that are not known are empty.

    Attributes:
        name: the name of the prior. persons: ids of the persons in the recordings. actions: what they did.
        sources: recordings or data sets. licence: the licence of the data. command: that made it.
        fps: frames per second at which motion was looked at. n_frames: frames of all recordings.
        extra: anything else that JSON can hold.
    """

    name: str = ""
    persons: tuple[str, ...] = ()
    actions: tuple[str, ...] = ()
    sources: tuple[str, ...] = ()
    licence: str = ""
    command: str = ""
    fps: float | None = None
    n_frames: int = 0
    extra: dict[str, Any] = field(default_factory=dict)


_KIND = FileKind(
    "torchpose-body-motion",
    3,
    BodyMotionInfo,
    older=(1, 2),
    tensors={
        "acceleration": "V", "correlation": "V V", "decay": "V", "drift": "V D", "shift_std": "S",
        "shift_time": "T", "pull_time": "1", "scale_mean": "G", "scale_cov": "G G", "weights": "K",
        "means": "K Q", "covariances": "K Q Q",
    },
    newer=("correlation", "drift"),
    positive=("acceleration", "decay", "shift_std", "shift_time", "pull_time", "weights"),
    covariances=("correlation", "scale_cov", "covariances"),
)  # fmt: skip


class PosePull(NamedTuple):
    """Holds the expected slope [..., Q] and curvature [..., Q, Q] of the log density of poses at a pose."""

    slope: Tensor
    curvature: Tensor


class BodyMotion(nn.Module):
    """Holds a prior over the motion, poses and proportions of articulated bodies.

    - Velocities v of root and angles are Ornstein-Uhlenbeck processes, dv = -decay v dt + acceleration dW,
      where the Wiener processes W are correlated: the trunk stays where the pelvis turns, and feet do. On
      top of it they accelerate on average by `drift`, a linear function of pose and velocities.
    - Joints of the trunk shift from where a rigid part has them, as processes about zero with the standard
      deviation `shift_std` and the time `shift_time` of each, or of all.
    - Angles of all parts but the root have a mixture of Gaussians as density, towards which they tend within
      the time `pull_time` where nothing is measured.
    - Logarithms of bone lengths over the standard ones have the mean `scale_mean` and covariance `scale_cov`
      over persons.

    Args:
        acceleration: [3 + R], m or rad per s^1.5. decay: [3 + R], 1/s.
        shift_std: [S], metres, along each axis. shift_time: [S], or [1] of all, seconds. pull_time: seconds.
        scale_mean: [G]. scale_cov: [G, G]. poses: mixture over the Q `relative_angles` of `Articulation`.
        info: facts about the fit. articulation: of the bodies.
        correlation: [3 + R, 3 + R], of the accelerations; None is none.
        drift: [3 + R, 1 + Q + 3 + R], of mean accelerations by 1, the Q `relative_angles` and the velocities,
            where position is in the root's axes; None is none.

    Raises:
        ShapeError: sizes other than the articulation's. PriorError: what must be positive is not.
        CovarianceError: correlations that are none.
    """

    acceleration: Tensor
    correlation: Tensor
    decay: Tensor
    drift: Tensor
    shift_std: Tensor
    shift_time: Tensor
    pull_time: Tensor
    scale_mean: Tensor
    scale_cov: Tensor

    def __init__(
        self,
        acceleration: Float[Tensor, " V"],
        decay: Float[Tensor, " V"],
        shift_std: Float[Tensor, " S"],
        shift_time: Float[Tensor, " T"],
        pull_time: Float[Tensor, "1"],
        scale_mean: Float[Tensor, " G"],
        scale_cov: Float[Tensor, "G G"],
        poses: GaussianMixture,
        info: BodyMotionInfo | None = None,
        articulation: Articulation | None = None,
        correlation: Float[Tensor, "V V"] | None = None,
        drift: Float[Tensor, "V D"] | None = None,
    ) -> None:
        super().__init__()
        self.articulation = articulation or Articulation()
        body = self.articulation
        if correlation is None:
            correlation = torch.eye(body.n_pose).to(acceleration)
        check_shape("correlation", correlation, [body.n_pose, body.n_pose])
        check_covariance("correlation", correlation)
        columns = body.relative_columns
        n_moving = 1 + columns.stop - columns.start + body.n_pose
        if drift is None:
            drift = torch.zeros(body.n_pose, n_moving).to(acceleration)
        check_shape("drift", drift, [body.n_pose, n_moving])
        check_shape("acceleration", acceleration, [body.n_pose])
        check_shape("decay", decay, [body.n_pose])
        check_shape("shift_std", shift_std, [len(body.shifted)])
        check_shape("shift_time", shift_time, [1 if len(shift_time) == 1 else len(body.shifted)])
        check_shape("scale_mean", scale_mean, [len(body.groups)])
        check_shape("scale_cov", scale_cov, [len(body.groups), len(body.groups)])
        check_shape("means", poses.means, [None, columns.stop - columns.start])
        given = {
            "acceleration": acceleration, "decay": decay, "shift_std": shift_std,
            "shift_time": shift_time, "pull_time": pull_time,
        }  # fmt: skip
        for name, value in given.items():
            if not bool((value > 0).all()):
                raise PriorError(f"{name} must be positive, got {value.tolist()}")
            register_given(self, name, value.double())
        register_given(self, "correlation", correlation.double())
        register_given(self, "drift", drift.double())
        register_given(self, "scale_mean", scale_mean.double())
        register_given(self, "scale_cov", scale_cov.double())
        self.poses, self.info = poses, info or BodyMotionInfo()

    def pull(self, angles: Float[Tensor, "*batch Q"], cov: Float[Tensor, "*batch Q Q"]) -> PosePull:
        """Return the slope and curvature of the log density of poses, expected over its components.

        sum_k r_k Sigma_k^-1 (mu_k - theta)   and   sum_k r_k Sigma_k^-1,
        r_k ~ pi_k N(theta; mu_k, Sigma_k + P)

        Args:
            angles: theta, radians. cov: P, of the angles.
        """
        poses = self.poses
        gaps = poses.means - angles[..., None, :]
        share = self._log_shares(gaps, cov).softmax(-1)
        precisions = derived(self, "precisions", (poses.covariances,), self._make_precisions)
        curvature = (share @ precisions.flatten(1)).unflatten(-1, precisions.shape[1:])
        weighted = share[..., None] * gaps
        slope = torch.einsum("kij,...kj->...i", precisions, weighted)
        return PosePull(slope, curvature)

    def _log_shares(
        self, gaps: Float[Tensor, "*batch K Q"], cov: Float[Tensor, "*batch Q Q"]
    ) -> Float[Tensor, "*batch K"]:
        """Return log pi_k N(gap_k; 0, Sigma_k + P), up to a constant."""
        factor = safe_cholesky(self.poses.covariances + cov[..., None, :, :])
        white = torch.linalg.solve_triangular(factor, gaps[..., None], upper=False).squeeze(-1)
        log_size = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return self.poses.weights.log() - 0.5 * white.square().sum(-1) - log_size

    def _make_precisions(self) -> Tensor:
        return torch.cholesky_inverse(safe_cholesky(self.poses.covariances))

    def save(self, path: str | Path) -> None:
        """Write the prior as safetensors; the file appears whole or not at all.

        Raises:
            OutputError: the file cannot be written.
        """
        own = {name: getattr(self, name) for name in _KIND.tensors if hasattr(self, name)}
        own |= {name: getattr(self.poses, name) for name in ("weights", "means", "covariances")}
        write_tensors(path, _KIND, self.info, own)

    @classmethod
    def load(cls, path: str | Path) -> BodyMotion:
        """Read a prior that `save` wrote; tensors come back in float64.

        Raises:
            InputError: no such file. FileFormatError: truncated, foreign, damaged, or newer.
        """
        info, tensors = read_tensors(path, _KIND)
        with reading(path, "a prior over bodies"):
            given = {name: value.double() for name, value in tensors.items()}
            poses = GaussianMixture(*(given.pop(n) for n in ("weights", "means", "covariances")))
            return cls(**given, poses=poses, info=info)  # type: ignore[arg-type]
