"""Slow, plain references: dense joint Gaussians and enumeration, in NumPy and without any recursion."""

import itertools

import numpy as np
import torch


def random_covariance(rng, dim, scale=1.0):
    a = rng.standard_normal((dim, dim)) * scale
    return a @ a.T + 0.3 * scale**2 * np.eye(dim)


def random_mixture(rng, n_components=3, dim=4, spread=2.0):
    weights = rng.dirichlet(np.full(n_components, 3.0))
    means = rng.standard_normal((n_components, dim)) * spread
    covs = np.stack([random_covariance(rng, dim, 0.7) for _ in range(n_components)])
    return weights, means, covs


def paper_transition(mean, cov, process_cov):
    """(BL 35-37), written with inverses as the paper prints them."""
    noise = np.linalg.inv(np.linalg.inv(process_cov) + np.linalg.inv(cov))
    matrix = noise @ np.linalg.inv(process_cov)
    return matrix, noise @ np.linalg.inv(cov) @ mean, noise


def dense_posterior(models, mean0, cov0, observed, noise_cov, z, mask):
    """Posterior of x_1..x_T given the measured z, from the joint Gaussian of all of them.

    Args:
        models: T triples (F, b, N). mean0, cov0: before the first prediction. noise_cov: R, or [T, Z, Z].
        z, mask: [T, Z].

    Returns:
        Means [T, D], covariances [T, D, D], log evidence of all that is measured.
    """
    n_frames, dim = len(models), len(mean0)
    mean = np.zeros((n_frames, dim))
    cov = np.zeros((n_frames, dim, n_frames, dim))
    m, p = mean0, cov0
    for t, (f, b, n) in enumerate(models):
        m, p = f @ m + b, f @ p @ f.T + n
        mean[t], cov[t, :, t, :] = m, p
        for s in range(t):
            cov[t, :, s, :] = f @ cov[t - 1, :, s, :]
            cov[s, :, t, :] = cov[t, :, s, :].T
    mean, cov = mean.reshape(-1), cov.reshape(n_frames * dim, n_frames * dim)
    rows = [t * dim + i for t in range(n_frames) for k, i in enumerate(observed) if mask[t, k]]
    noise = np.zeros((n_frames, len(observed), n_frames, len(observed)))
    for t in range(n_frames):
        noise[t, :, t, :] = noise_cov[t] if np.ndim(noise_cov) == 3 else noise_cov
    kept = np.flatnonzero(mask.reshape(-1))
    noise = noise.reshape(z.size, z.size)[np.ix_(kept, kept)]
    values = z.reshape(-1)[kept]
    if len(rows):
        s = cov[np.ix_(rows, rows)] + noise
        gain = np.linalg.solve(s, cov[rows]).T
        residual = values - mean[rows]
        _, log_det = np.linalg.slogdet(s)
        quad = residual @ np.linalg.solve(s, residual)
        log_evidence = -0.5 * (quad + log_det + len(rows) * np.log(2 * np.pi))
        mean, cov = mean + gain @ residual, cov - gain @ cov[rows]
    else:
        log_evidence = 0.0
    cov = cov.reshape(n_frames, dim, n_frames, dim)
    diagonal = np.stack([cov[t, :, t, :] for t in range(n_frames)])
    return mean.reshape(n_frames, dim), diagonal, log_evidence


def enumerate_trajectories(
    weights, means, covs, models_of, observed, noise_cov, z, mask, chain=None
):
    """Exact posterior mean at each frame, given all frames, over every trajectory of indicators.

    Args:
        models_of: component -> (F, b, N). chain: rows p(next | now), or None for draws from pi.
            With a chain, the track's start (mean, covariance) is that of its first indicator.

    Returns:
        Smoothed means [T, D], the log evidence, and the posterior of the indicator [T, K].
    """
    n_frames, n_components = len(z), len(weights)
    total, logs, marginals = [], [], []
    for path in itertools.product(range(n_components), repeat=n_frames):
        log_p = np.log(weights[path[0]])
        for a, b in itertools.pairwise(path):
            log_p += np.log(weights[b] if chain is None else chain[a, b])
        models = [models_of[i] for i in path]
        mean, _, evidence = dense_posterior(
            models, means[path[0]], covs[path[0]], observed, noise_cov, z, mask
        )
        total.append(mean)
        logs.append(log_p + evidence)
        marginals.append(np.eye(n_components)[list(path)])
    logs = np.array(logs)
    log_evidence = np.logaddexp.reduce(logs)
    w = np.exp(logs - log_evidence)
    return (
        np.tensordot(w, np.stack(total), 1),
        log_evidence,
        np.tensordot(w, np.stack(marginals), 1),
    )


def tensor(a):
    return torch.as_tensor(np.ascontiguousarray(a), dtype=torch.float64)
