"""A body whose poses are plain vectors, so that filters over poses have exact answers."""

import math

import torch


class LinearBody:
    """States in R^D; the first `n_root` columns are the root's, which no manifold covers."""

    def __init__(self, dim, n_root=0):
        self.dim = dim
        self.relative_columns = tuple(range(n_root, dim))

    def perturb(self, state, step):
        return state + step

    def difference(self, a, b):
        return a - b

    def mean(self, states, log_weights):
        return torch.einsum("...n,...nd->...d", log_weights.softmax(-1), states)

    def joints(self, state):
        return state[..., None].expand(*state.shape, 3) / 3**0.5


class LinearManifold:
    """z = A x + a, f(z) = W z + b."""

    def __init__(self, A, a, W, b, std_latent, std_pose, std_step):
        self.A, self.a, self.W, self.b = A, a, W, b
        self.std_latent, self.std_pose, self.std_step = std_latent, std_pose, std_step
        self.latents = torch.zeros(5, len(a), dtype=A.dtype)

    def to_latent(self, x):
        return x @ self.A.T + self.a

    def pose_mean(self, z):
        return z @ self.W.T + self.b

    def check_for(self, body, fps=None):
        pass


class BoxLimits:
    """Every column between -high and high."""

    def __init__(self, high):
        self.high = high

    def clamp(self, states):
        return states.clamp(-self.high, self.high)

    def inside(self, states):
        return states.abs() <= self.high


def gaussian_likelihood(H, R):
    """(states, frame [B, Z]) -> log N(frame | H x, R)."""
    whitener = torch.linalg.inv(torch.linalg.cholesky(R))
    log_norm = whitener.diagonal().log().sum() - 0.5 * len(R) * math.log(2 * math.pi)

    def log_likelihood(states, frame):
        white = (frame[:, None] - states @ H.T) @ whitener.T
        return log_norm - 0.5 * white.square().sum(-1)

    return log_likelihood


def dense_gaussian(factors, dim):
    """Mean and covariance of the density that is a product of exp(-sign / 2 |J x - c|^2_precision)."""
    precision = torch.zeros(dim, dim, dtype=torch.float64)
    shift = torch.zeros(dim, dtype=torch.float64)
    for J, c, weight, sign in factors:
        precision += sign * J.T @ weight @ J
        shift += sign * J.T @ weight @ c
    cov = torch.linalg.inv(precision)
    return cov @ shift, cov


def condition_on(mean, cov, H, R, z):
    """Posterior and log evidence of a linear measurement; NaN measures nothing."""
    if bool(torch.isnan(z).any()):
        return mean, cov, torch.zeros((), dtype=mean.dtype)
    S = H @ cov @ H.T + R
    K = cov @ H.T @ torch.linalg.inv(S)
    evidence = torch.distributions.MultivariateNormal(H @ mean, S).log_prob(z)
    return mean + K @ (z - H @ mean), cov - K @ H @ cov, evidence


def assert_within_error(samples, exact, slack=0.0, factor=5.0):
    """The mean over runs (dimension 0) agrees with the exact value, given its own standard error."""
    error = samples.std(0) / len(samples) ** 0.5
    distance = (samples.mean(0) - exact).abs()
    assert (distance <= factor * error + slack).all(), (distance / error).max()
