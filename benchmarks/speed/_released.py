"""The authors' released tracker as it is written: a loop over frames and components, in plain NumPy.

It follows updatePoseEstimate.m with the weights of the paper: each component predicts, updates and
weighs itself; F and the noise are computed once, as there. It shares no code with torchpose.
"""

import math
from typing import NamedTuple

import numpy as np

Array = np.ndarray


class Model(NamedTuple):
    """pi [K], mu [K, D], Sigma [K, D, D], F, offset and noise per component, H [Z, D], R [Z, Z]."""

    weights: Array
    means: Array
    covariances: Array
    matrix: Array
    offset: Array
    noise: Array
    measure: Array
    measurement_cov: Array


def make_model(
    prior: tuple[Array, Array, Array],
    process_cov: Array,
    measurement_cov: Array,
    observed: list[int],
) -> Model:
    """Return the model: F = Sigma (Q + Sigma)^-1, offset (I - F) mu, noise F Q (BL 31-32, 35-37)."""
    weights, means, covariances = prior
    dim = means.shape[1]
    matrix = np.linalg.solve(covariances + process_cov, covariances).transpose(0, 2, 1)
    offset = means - np.einsum("kij,kj->ki", matrix, means)
    noise = matrix @ process_cov
    noise = (noise + noise.transpose(0, 2, 1)) / 2
    measure = np.eye(dim)[observed]
    return Model(weights, means, covariances, matrix, offset, noise, measure, measurement_cov)


def fixed_tracks(
    model: Model,
    z: Array,
    epsilon: float,
    mask: Array | None = None,
    measurement_cov: Array | None = None,
) -> tuple[Array, Array, Array]:
    """Filter one sequence.

    Args:
        z: [T, Z]. epsilon: the uniform weight (BL 49); 0 is the released tracker.
        mask: [T, Z], True where measured. measurement_cov: R of every frame [T, Z, Z].

    Returns:
        Means [T, D], weights before epsilon [T, K], log-evidence increments [T].
    """
    n_components, dim = model.means.shape
    means, covs = model.means.copy(), model.covariances.copy()
    weights = model.weights.copy()
    log_likelihood = np.empty(n_components)
    estimates, kept, evidence = np.empty((len(z), dim)), [], np.empty(len(z))
    for t in range(len(z)):
        measure, noise, frame = model.measure, model.measurement_cov, z[t]
        if measurement_cov is not None:
            noise = measurement_cov[t]
        if mask is not None:
            seen = mask[t]
            measure, noise, frame = measure[seen], noise[np.ix_(seen, seen)], frame[seen]
        for k in range(n_components):
            means[k], covs[k], log_likelihood[k] = _track(
                means[k], covs[k], frame, model.matrix[k], model.offset[k], model.noise[k],
                measure, noise,
            )  # fmt: skip
        predicted = model.weights * weights
        predicted /= predicted.sum()
        top = log_likelihood.max()
        joint = predicted * np.exp(log_likelihood - top)
        mass = joint.sum()
        evidence[t] = top + math.log(mass)
        weights = joint / mass
        estimates[t] = weights @ means
        kept.append(weights)
        weights = (weights + epsilon) / (1 + n_components * epsilon)
    return estimates, np.stack(kept), evidence


def _track(
    mean: Array, cov: Array, z: Array, matrix: Array, offset: Array, noise: Array,
    measure: Array, measurement_cov: Array,
) -> tuple[Array, Array, float]:  # fmt: skip
    """Predict and update one Kalman filter (BL 34-41)."""
    mean = matrix @ mean + offset
    cov = matrix @ cov @ matrix.T + noise
    cross = measure @ cov
    innovation_cov = cross @ measure.T + measurement_cov
    innovation = z - measure @ mean
    gain = np.linalg.solve(innovation_cov, cross).T
    squared = innovation @ np.linalg.solve(innovation_cov, innovation)
    log_det = np.linalg.slogdet(innovation_cov)[1]
    cov = cov - gain @ cross
    log_likelihood = -0.5 * (squared + log_det + len(z) * math.log(2 * math.pi))
    return mean + gain @ innovation, (cov + cov.T) / 2, float(log_likelihood)
