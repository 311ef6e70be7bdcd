"""Small mixtures, draws from them, and their posterior by dense algebra."""

import numpy as np

from optsim.decoding.mixture.posterior import measured_through, posterior
from optsim.decoding.mixture.posterior_spread import Spread
from optsim.priors.mixture import Mixture


def some_mixture(rng, k=3, r=6, patch=3, slots=5, rest=0.01):
    """Any mixture, well conditioned."""
    basis = np.linalg.qr(rng.standard_normal((patch * patch * slots, r)))[0].T.reshape(r, patch, patch, slots)
    roots = rng.standard_normal((k, r, r))
    shares = rng.random(k) + 0.2
    return Mixture(
        rng.random((patch, patch, slots)).astype(np.float32),
        basis.astype(np.float32),
        shares / shares.sum(),
        rng.standard_normal((k, r)),
        roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(r),
        rest * np.linspace(0.5, 1.5, k) if k > 1 else np.full(1, rest),
    )


def dense_posterior(mixture, weights, signal, variance):
    """Posterior mean of z, by densities and inverses of whole matrices in float64."""
    chance, means, _, _ = dense_components(mixture, weights, signal, variance)
    return chance @ means


def dense_variance(mixture, weights, signal, variance):
    """Posterior variance of each element of a patch: law of total variance, the basis's rest added."""
    chance, means, covariances, basis = dense_components(mixture, weights, signal, variance)
    # Components this unlikely are left out of the estimate, so of its variance too.
    chance[chance < 1e-3 * chance.max()] = 0
    chance /= chance.sum()
    off = means - chance @ means
    whole = np.einsum("k,kij->ij", chance, covariances) + np.einsum("k,ki,kj->ij", chance, off, off)
    outside = chance @ mixture.rest * (1 - np.square(basis).sum(axis=1))
    return np.diag(basis @ whole @ basis.T) + outside


def dense_components(mixture, weights, signal, variance):
    """Each component's chance, mean and covariance, and the basis (element, r)."""
    pixels, slots = weights.shape
    matrix = np.zeros((pixels, pixels * slots))
    for p in range(pixels):
        matrix[p, p * slots : (p + 1) * slots] = weights[p]
    basis = mixture.basis.reshape(len(mixture.basis), -1).astype(np.float64).T
    base = mixture.base.ravel().astype(np.float64)
    logs, means, covariances = [], [], []
    parts = (mixture.shares, mixture.means, mixture.covariances, mixture.rest)
    for share, mean, covariance, rest in zip(*parts, strict=True):
        a = matrix @ basis
        total = a @ covariance @ a.T + rest * matrix @ matrix.T + variance * np.eye(pixels)
        off = signal - matrix @ (base + basis @ mean)
        solved = np.linalg.inv(total) @ off
        logs.append(np.log(share) - 0.5 * (np.linalg.slogdet(total)[1] + off @ solved))
        means.append(mean + covariance @ a.T @ solved)
        covariances.append(covariance - covariance @ a.T @ np.linalg.inv(total) @ a @ covariance)
    chance = np.exp(np.array(logs) - max(logs))
    return chance / chance.sum(), np.array(means), np.array(covariances), basis


def unit_weights(rng, pixels=9, slots=5):
    """Weights of the same norm at every pixel: then what the basis leaves out is the same in all, exactly."""
    weights = rng.random((pixels, slots))
    return (weights / np.linalg.norm(weights, axis=1, keepdims=True)).astype(np.float32)


def drawn(mixture, n, rng):
    """Patches from the prior itself, what its basis leaves out included: array (n, pixel, slot)."""
    member = rng.choice(len(mixture.shares), n, p=mixture.shares)
    roots = np.linalg.cholesky(mixture.covariances)
    z = mixture.means[member]
    z = z + np.einsum("nij,nj->ni", roots[member], rng.standard_normal(z.shape))
    basis = mixture.basis.reshape(len(mixture.basis), -1)
    rest = np.sqrt(mixture.rest[member])[:, None] * rng.standard_normal((n, basis.shape[1]))
    rest -= rest @ basis.T @ basis
    return (z @ basis + rest + mixture.base.ravel()).reshape(n, -1, mixture.slots)


def asked(mixture, weights, signals, variance):
    """Estimate and variance of each element, (n, pixel, slot)."""
    noise = np.full(len(signals), variance, np.float32)
    known = posterior(measured_through(mixture, weights), signals.astype(np.float32), noise)
    mean = known.mean() @ mixture.basis.reshape(len(mixture.basis), -1) + mixture.base.ravel()
    shape = (len(signals), *weights.shape)
    return mean.reshape(shape), Spread.of(mixture).variance(known).reshape(shape)
