"""Fit a back-constrained GPLVM: objective (MR 15, 16), start by PCA, L-BFGS or Adam."""

import math
from collections.abc import Callable, Iterator
from functools import partial
from itertools import combinations
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose._core.checks import check_choice, check_shape
from torchpose.errors import InputError
from torchpose.math._gaussian import safe_cholesky
from torchpose.priors._manifold.prediction import KernelParameters, covariance, rbf

OPTIMISERS = ("lbfgs", "adam")
LOG_2PI = math.log(2 * math.pi)
_PER_STEP = 10  # iterations of the optimiser in a step
_LEARNING_RATE = {"lbfgs": 1.0, "adam": 0.05}
_PAIRED = 2000  # frames at most of which all pairs are looked at
_RIDGE, _REGULAR = 1e-2, 1e-6  # of the back constraints: at the start, and of their coordinates
_FIRST_NOISE, _FIRST_CONSTANT = 0.1, 0.01  # variances, shares of that of the poses
_START_NOISE = 0.3  # standard deviation of what moves a start at random


def log_likelihood(
    poses: Float[Tensor, "T Q"], latents: Float[Tensor, "T d"], kernel: KernelParameters
) -> Float[Tensor, ""]:
    """Return the log-likelihood of poses, every column a Gaussian process over the latent points.

    ln p(X|Z) = -Q T / 2 ln 2 pi - Q / 2 ln |K| - 1/2 tr(X^T K^-1 X)   (MR 15)

    Args:
        poses: X, less its mean. latents: Z. kernel: of K, which includes the noise.
    """
    count, columns = poses.shape
    factor = safe_cholesky(covariance(latents, kernel))
    white = torch.linalg.solve_triangular(factor, poses, upper=False)
    log_det = 2 * factor.diagonal().log().sum()
    return -0.5 * (columns * (count * LOG_2PI + log_det) + white.square().sum())


def objective(
    poses: Float[Tensor, "T Q"], latents: Float[Tensor, "T d"], kernel: KernelParameters
) -> Float[Tensor, ""]:
    """Return L(Z) = ln p(X|Z) - 1/2 ||Z||_F^2   (MR 16)."""
    return log_likelihood(poses, latents, kernel) - 0.5 * latents.square().sum()


def median_gamma(poses: Float[Tensor, "T Q"], seed: int = 0) -> float:
    """Return gamma_x such that the kernel of two poses at the median distance is exp(-1/2)   (MR 22).

    Args:
        poses: X. seed: the seed of which frames are compared, where there are more than 2,000.

    Raises:
        InputError: more than half of all pairs are the same pose.
    """
    if len(poses) > _PAIRED:
        generator = torch.Generator().manual_seed(seed)
        chosen = torch.randperm(len(poses), generator=generator)[:_PAIRED]
        poses = poses[chosen.to(poses.device)]
    distance = float(torch.pdist(poses).median())
    if not distance > 0:
        raise InputError(
            "gamma_x cannot be told from the median distance of the poses, which is 0: most of them "
            "are the same; give gamma_x, or frames with motion"
        )
    return 1.0 / distance**2


def principal_start(
    poses: Float[Tensor, "T Q"], latent_dim: int, start: int = 0
) -> Float[Tensor, "T d"]:
    """Return principal components of poses, scaled to variance one: latent points to start from.

    Start 0 are the first d components. The second component of a walk often swings twice in a cycle,
    so that the path of the first two crosses itself and two phases share a latent point; other starts
    are the other choices of d among the first d + 2: for d = 2 the first and third, first and fourth,
    second and third, and so on. What more starts are asked for are the first d and noise.

    Args:
        poses: X, less its mean. latent_dim: d. start: which one.

    Raises:
        InputError: the poses vary in fewer than d directions.
    """
    left, values, _ = torch.linalg.svd(poses, full_matrices=False)
    rank = int((values > 1e-9 * values[0].clamp_min(1e-300)).sum())
    if rank < latent_dim:
        raise InputError(
            f"{latent_dim} latent dimensions need poses that vary in as many directions, got "
            f"{rank}; leave still frames out or take fewer dimensions"
        )
    choices = list(combinations(range(min(rank, latent_dim + 2)), latent_dim))
    scores = left[:, list(choices[start if start < len(choices) else 0])] * math.sqrt(len(poses))
    if start < len(choices):
        return scores
    generator = torch.Generator().manual_seed(start)
    noise = torch.randn(scores.shape, generator=generator, dtype=scores.dtype)
    return scores + _START_NOISE * noise.to(scores.device)


class GPLVMFit(nn.Module):
    """Fits a back-constrained GPLVM; the whole state of the fit is in its `state_dict`.

    Maximises (MR 16) over the back constraints z_i = sum_t a_ti k_x(x, x_t) + b_i (MR 21), beta,
    beta_0 and sigma_z. The weights a are optimised as v = L^T a with K_x = L L^T, in which the
    objective is far better conditioned; the functions g are the same. As printed, (MR 16) has no
    maximum: c Z with gamma_z / c^2 has the same likelihood and a smaller penalty, the smaller c is. So
    gamma_z is held at 1, and Z is in units of the kernel's length.

    Args:
        poses: X [T, Q], less its mean.
        latent_dim: d. gamma_x: of (MR 22).
        optimiser: "lbfgs" (with line search) or "adam". learning_rate: None for the optimiser's own.
        smoothness: weight of a penalty 1/2 sum_i a_i^T K_x a_i, which takes each g_i for a draw from a
            Gaussian process; 0 is the published form.
        start: which principal components to start from, see `principal_start`.

    Raises:
        InputError: an unknown optimiser, a setting that is not positive, poses without motion.

    Reference: Gonczarek & Tomczak, Articulated tracking with manifold regularized particle filter,
    2016, section 5.1; Lawrence & Quinonero-Candela, Local distance preservation in the GP-LVM through
    back constraints, 2006.
    """

    poses: Tensor
    gamma_x: Tensor
    factor: Tensor
    features: Tensor

    def __init__(
        self,
        poses: Float[Tensor, "T Q"],
        latent_dim: int,
        gamma_x: float,
        optimiser: str = "lbfgs",
        learning_rate: float | None = None,
        smoothness: float = 0.0,
        start: int = 0,
    ) -> None:
        super().__init__()
        _check(poses, latent_dim, gamma_x, optimiser, learning_rate)
        if not 0 <= smoothness < math.inf:
            raise InputError(f"smoothness must not be negative, got {smoothness:g}")
        poses = poses.detach().double()
        gamma = torch.tensor(gamma_x, dtype=torch.float64, device=poses.device)
        similar = rbf(poses, poses, gamma)
        eye = torch.eye(len(poses), dtype=torch.float64, device=poses.device)
        factor = safe_cholesky(similar + _REGULAR * eye)
        features = torch.linalg.solve_triangular(factor, similar.mT, upper=False).mT
        fixed = {"poses": poses, "gamma_x": gamma, "factor": factor, "features": features}
        for name, value in fixed.items():
            self.register_buffer(name, value, persistent=False)
        latents = principal_start(poses, latent_dim, start)
        weights = torch.cholesky_solve(latents, safe_cholesky(similar + _RIDGE * eye))
        self.coordinates = nn.Parameter(factor.mT @ weights)
        self.bias = nn.Parameter(latents.new_zeros(latent_dim))
        variance = float(poses.square().mean())
        sizes = (variance, _FIRST_CONSTANT * variance, 1.0, _FIRST_NOISE * variance)
        logs = torch.tensor([math.log(value) for value in sizes], dtype=torch.float64)
        logs[3] /= 2
        self.log_kernel = nn.Parameter(logs.to(poses.device))
        self._smoothness = smoothness
        self.history: list[float] = []
        self.scores: list[float] = []
        self._best: dict[str, Tensor] = {}
        self._optimiser = _make(optimiser, self.parameters(), learning_rate)

    @property
    def kernel(self) -> KernelParameters:
        """Return beta, beta_0, gamma_z and sigma_z."""
        beta, beta0, gamma, sigma = self.log_kernel.unbind()
        return KernelParameters(beta, beta0, gamma.detach(), sigma)

    @property
    def weights(self) -> Float[Tensor, "T d"]:
        """Return the weights a of the back constraints (MR 21)."""
        return torch.linalg.solve_triangular(self.factor.mT, self.coordinates, upper=True)

    def forward(self) -> Float[Tensor, ""]:
        """Return the objective (MR 16) less the penalty, per number of the poses: L / (T Q)."""
        latents = self.features @ self.coordinates + self.bias
        penalty = 0.5 * self._smoothness * self.coordinates.square().sum()
        return (objective(self.poses, latents, self.kernel) - penalty) / self.poses.numel()

    def step(self) -> float:
        """Take ten iterations of the optimiser, and return the objective before them, per number."""
        if isinstance(self._optimiser, torch.optim.LBFGS):
            value = -float(self._optimiser.step(self._closure).detach())
        else:
            value = -float(self._closure().detach())
            for _ in range(_PER_STEP):
                self._optimiser.step()
                self._closure()
        if not math.isfinite(value):
            raise InputError(
                f"the fit diverged after {len(self.history)} steps; take a smaller learning rate"
            )
        self.history.append(value)
        return value

    def converged(self, tolerance: float) -> bool:
        """Return whether the last step gained less than `tolerance` per number."""
        return len(self.history) > 1 and self.history[-1] - self.history[-2] < tolerance

    def note(self, score: float) -> None:
        """Record the error on other poses after a step, and keep the parameters if it is the lowest."""
        score = score if math.isfinite(score) else math.inf
        if not self.scores or score < min(self.scores):
            self._best = {k: v.detach().clone() for k, v in self.named_parameters()}
        self.scores.append(score)

    @property
    def best_step(self) -> int:
        """Return the step with the lowest recorded error, counted from 1; the last one without errors."""
        if not self.scores:
            return len(self.history)
        return 1 + min(range(len(self.scores)), key=self.scores.__getitem__)

    def restore_best(self) -> None:
        """Go back to the parameters after `best_step`."""
        with torch.no_grad():
            for name, value in self._best.items():
                self.get_parameter(name).copy_(value)

    def get_extra_state(self) -> dict[str, Any]:
        """Return the optimiser's state, the objective and errors so far, and the best parameters."""
        return {
            "optimiser": self._optimiser.state_dict(),
            "history": list(self.history),
            "scores": list(self.scores),
            "best": self._best,
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_extra_state` returned."""
        self._optimiser.load_state_dict(state["optimiser"])
        self.history, self.scores = list(state["history"]), list(state["scores"])
        self._best = dict(state["best"])

    def _closure(self) -> Tensor:
        self._optimiser.zero_grad()
        loss = -self()
        loss.backward()
        return loss


def run_fit(
    fit: GPLVMFit,
    steps: int,
    tolerance: float = 1e-5,
    progress: bool = False,
    error: Callable[[], float] | None = None,
    patience: int = 3,
) -> GPLVMFit:
    """Take steps until there are `steps` in all, or they no longer help.

    Args:
        fit: in whatever state. steps: in all, those already taken included.
        tolerance: gain of the objective per number and step below which to stop.
        progress: show a bar.
        error: on poses that are not fitted to, as the fit stands. With it the parameters with the
            lowest error are restored in the end.
        patience: steps without a lower error after which to stop.
    """
    from tqdm.auto import tqdm

    with tqdm(total=steps, desc="manifold", unit="step", disable=not progress) as bar:
        bar.update(len(fit.history))
        while len(fit.history) < steps and not fit.converged(tolerance):
            shown = f"objective {fit.step():.5f}"
            if error is not None:
                fit.note(error())
                shown += f", held-out error {fit.scores[-1]:.5f}"
            bar.set_postfix_str(shown, refresh=False)
            bar.update()
            if len(fit.scores) - fit.best_step >= patience and error is not None:
                break
    if error is not None:
        fit.restore_best()
    return fit


def best_fit(
    make: Callable[[int], GPLVMFit],
    n_init: int,
    steps: int,
    tolerance: float,
    progress: bool,
    error: Callable[[GPLVMFit], float] | None,
    patience: int,
) -> GPLVMFit:
    """Fit from several starts and return the fit with the lowest error, or else the highest objective.

    Args:
        make: a fit at start 0, 1, ... n_init: number of starts. error: on poses that are not fitted to, of a
            fit as it stands. Others: as `run_fit`.

    Raises:
        InputError: no start or no step.
    """
    if n_init < 1 or steps < 1:
        raise InputError(f"n_init and steps must be at least 1, got {n_init} and {steps}")
    fits = []
    for start in range(n_init):
        fit = make(start)
        own = None if error is None else partial(error, fit)
        fits.append(run_fit(fit, steps, tolerance, progress, own, patience))
    return max(fits, key=lambda fit: -min(fit.scores) if fit.scores else fit.history[-1])


def _make(name: str, parameters: Iterator[nn.Parameter], rate: float | None) -> Any:
    rate = _LEARNING_RATE[name] if rate is None else rate
    if name == "adam":
        return torch.optim.Adam(parameters, lr=rate)
    return torch.optim.LBFGS(
        parameters, lr=rate, max_iter=_PER_STEP, history_size=30, tolerance_grad=1e-10,
        tolerance_change=1e-12, line_search_fn="strong_wolfe",
    )  # fmt: skip


def _check(
    poses: Tensor, latent_dim: int, gamma_x: float, optimiser: str, rate: float | None
) -> None:
    check_shape("poses", poses, ("T", "Q"))
    check_choice("optimiser", optimiser, OPTIMISERS)
    if not 1 <= latent_dim <= poses.shape[1]:
        raise InputError(
            f"latent_dim must be from 1 to the number of columns, {poses.shape[1]}, got {latent_dim}"
        )
    for name, value in (("gamma_x", gamma_x), ("learning_rate", 1.0 if rate is None else rate)):
        if not 0 < value < math.inf:
            raise InputError(f"{name} must be positive, got {value:g}")
